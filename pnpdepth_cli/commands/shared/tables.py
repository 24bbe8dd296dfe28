"""One table for every place it goes to: the terminal, CSV, LaTeX and the page of a report.

The table of errors, of a refined frame or in the mean over a batch, has a row for each stage.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.dataset.frame_record import FrameRecord, ResultRecord, Scores
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.measures import (
    AFTER,
    ALONE,
    BASES,
    BEFORE,
    GT,
    HELD_OUT,
    LINEAR,
    MEASURES,
    PROPAGATED,
    UPDATED,
    USED,
    Measure,
    choose_measures,
)

Style = Literal["", "bold", "dim", "good", "bad"]
Cell = tuple[str, Style]
"""A text and its style: LaTeX shows "bold", the terminal all."""
Errors = Mapping[str, Mapping[str, Scores]]
"""Scores by basis, then by stage, as `FrameRecord.errors` has them."""

_LINEAR = "linear interpolation of all points"
"""Title of the row that others are compared with."""
_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
        "δ": r"$\delta$", "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "−": "$-$",
        "·": r"$\cdot$", "×": r"$\times$", "°": r"$^\circ$", "<": "$<$", "–": "--",
        "…": r"\ldots{}", "σ": r"$\sigma$", "\n": " ",
    }
)  # fmt: skip
_NAMED = 5
"""Names of a long list that are shown."""
_SEPARATOR = re.compile(r"([_/\-])")
"""What stands between the parts of a frame's name, such as the slash of a folder."""
_LEAST_SAVED = 8
"""Characters for which a name is shortened."""
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")
"""A comma between groups of three digits, which LaTeX's columns of numbers do not have."""
_LEAST_WEIGHT = 0.005
"""Weight of a fused depth below which its text would be 0 %."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of cells; the first column is left-aligned, the others, of numbers, right-aligned."""

    title: str = ""
    columns: Sequence[Measure | str]
    """A measure, or the heading of any other column."""
    rows: Sequence[Sequence[object]]
    """Texts, numbers, None, and cells of `Cell`."""

    @property
    def headings(self) -> list[str]:
        """The headings of the columns."""
        return [
            column.heading if isinstance(column, Measure) else column for column in self.columns
        ]

    @property
    def cells(self) -> list[list[Cell]]:
        """The cells as they are shown."""
        return [list(map(_cell, row)) for row in self.rows]

    def csv(self) -> str:
        """Returns the cells as they are, None and NaN empty, below the keys of the measures."""
        buffer = io.StringIO()
        keys = [column.key if isinstance(column, Measure) else column for column in self.columns]
        rows = [list(map(_plain_cell, row)) for row in self.rows]
        csv.writer(buffer, lineterminator="\n").writerows([keys, *rows])
        return buffer.getvalue()

    def latex(self) -> str:
        """Returns a tabular with rules of the package booktabs; its title is a comment above."""
        headings: list[Cell] = [(heading, "") for heading in self.headings]
        header, *rows = (
            " & ".join(_in_latex(text, style) for text, style in row) + r" \\"
            for row in [headings, *self.cells]
        )
        lines = (
            f"% {' '.join(self.title.split())}",
            r"% needs \usepackage{booktabs}",
            rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
            r"\toprule",
            header,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        )
        return "\n".join(lines)


def _cell(value: object) -> Cell:
    """The cell of a value as a person reads it: numbers with commas, nothing for None."""
    if isinstance(value, tuple):  # a cell already
        return value
    if isinstance(value, str):
        return value, ""
    return "" if value is None else f"{value:,}", ""


def _plain_cell(value: object) -> object:
    """The value as a program reads it: a cell without its style, None for NaN."""
    plain = value[0] if isinstance(value, tuple) else value
    return None if isinstance(plain, float) and math.isnan(plain) else plain


def _in_latex(text: str, style: Style) -> str:
    """The text as LaTeX sets it, without commas in numbers; bold if that is its style."""
    text = _THOUSANDS.sub("", text).translate(_LATEX)
    return rf"\textbf{{{text}}}" if style == "bold" else text


def count_of(number: float, noun: str) -> str:
    """Returns a text such as `1 frame` or `2,000 frames`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def some_names(names: Iterable[str]) -> str:
    """Returns a few of the names on one line, and how many more there are."""
    listed = list(names)
    text = ", ".join(one_line(name) for name in listed[:_NAMED])
    more = len(listed) - _NAMED
    return f"{text} and {more:,} more" if more > 0 else text


def short_names(names: Sequence[str]) -> list[str]:
    """Returns the first name in full, and others with … for what they share with it.

    What is shared ends at a separator, so that numbers stay whole. All names are in full where that
    would save little.
    """
    # How many parts all names share at the start, and how many at the end of what follows the
    # first part that differs.
    parts_of_names = [_SEPARATOR.split(name) for name in names]
    start = _shared_parts(parts_of_names)
    ends_reversed = [parts[start + 1 :][::-1] for parts in parts_of_names]
    end = _shared_parts(ends_reversed)
    before = "…" if start else ""
    after = "…" if end else ""
    middles = ["".join(parts[start : len(parts) - end]) for parts in parts_of_names]
    short = [f"{before}{middle}{after}" for middle in middles]
    if len(names) < 2 or len(short[0]) + _LEAST_SAVED > len(names[0]):
        return [*names]
    return [names[0], *short[1:]]


def _shared_parts(names: Sequence[Sequence[str]]) -> int:
    """How many parts, from the first on, are the same in all names."""
    count = 0
    for parts in zip(*names, strict=False):
        if len({*parts}) > 1:
            break
        count += 1
    return count


def write_text(path: Path, text: str) -> None:
    """Writes the text whole or not at all; characters of a name that is not UTF-8 as escapes."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))


def bases_of(errors: Errors) -> list[str]:
    """Returns what errors are shown on: ground truth and held-out points, else the best basis.

    They are keys of `measures.BASES`, which names the best first. The list is empty without any
    error.
    """
    bases = [basis for basis in BASES if errors.get(basis)]
    return [basis for basis in bases if basis in (GT, HELD_OUT)] or bases[:1]


def means_tables(
    errors: Errors, unit: str, titles: Mapping[str, str], keys: Sequence[str] | None = None
) -> list[Table]:
    """Returns the mean errors of a batch: one table against ground truth, one at held-out points.

    Without either, the one table is at validation points, else at the points used.

    Args:
        errors: Mean errors by basis, then by stage.
        unit: Unit of the depths.
        titles: What each stage is, in words, in the order of the rows.
        keys: Keys of the measures, in the order of the columns. None: the main ones.
    """
    # A row for each baseline that was scored besides, under its own name.
    baselines = {name: name for name in BASELINES if name not in titles}
    rows = {**titles, **baselines}
    return [
        _errors_table("means", basis, errors[basis], unit, rows, keys) for basis in bases_of(errors)
    ]


def refinement_tables(record: FrameRecord) -> list[Table]:
    """Returns the errors of a refined frame: a table against ground truth, one at held-out points.

    Without either, the one table is at validation points, else at the points used.

    Raises:
        InputError: The frame has no result.
    """
    result = record.refined()
    names = " + ".join(result.method.names)
    title = f"{names}, method {result.method.name}"
    titles = stage_titles(result)
    return [
        _errors_table(title, basis, record.errors[basis], record.unit, titles)
        for basis in bases_of(record.errors)
    ]


def _errors_table(
    about: str,
    basis: str,
    by_stage: Mapping[str, Scores],
    unit: str,
    titles: Mapping[str, str],
    keys: Sequence[str] | None = None,
) -> Table:
    """A row for each stage: its errors, and its MAE against that of linear interpolation.

    Args:
        about: Beginning of the title.
        basis: What the errors are measured on, a key of `measures.BASES`.
        by_stage: Errors by stage; the result is among them.
        unit: Unit of the depths.
        titles: What each stage is, in words, in the order of the rows.
        keys: Keys of the measures, in the order of the columns. None: the main ones.
    """
    # The measures that the result has, of those that are asked for.
    result = by_stage[AFTER]
    linear = by_stage.get(LINEAR, {})
    chosen = choose_measures(MEASURES, keys)
    measures = [measure for measure in chosen if measure.key in result and (keys or measure.main)]
    # A row for each stage that was scored.
    rows = []
    for stage in [stage for stage in titles if stage in by_stage]:
        scores = by_stage[stage]
        title = titles[stage]
        # A stage that not all frames have is a mean over others than the result.
        if scores.get("frames") != result.get("frames"):
            title += f" (over {scores['frames']:,} frames)"
        texts = [
            measure.text(scores.get(measure.key), unit if measure.unit == "m" else measure.unit)
            for measure in measures
        ]
        style: Style = "bold" if stage == AFTER else ""
        row: list[Cell] = [(text, style) for text in (title, *texts)]
        # The change against linear interpolation, where both are means over as many frames.
        if stage == LINEAR:
            row.append(("", ""))
        else:
            is_over_as_many_frames = scores.get("frames") == linear.get("frames")
            linear_mae = linear.get("mae") if is_over_as_many_frames else None
            row.append(change_cell(linear_mae, scores.get("mae")))
        rows.append(row)
    remark = ", where a change proves nothing" if basis == USED else ""
    return Table(
        title=f"{about}: errors {BASES[basis]}{remark}, {_count_text(result)}",
        columns=["", *(measure.title for measure in measures), "MAE vs linear"],
        rows=rows,
    )


def _count_text(scores: Scores) -> str:
    """How many frames, pixels or points the scores are of."""
    if "frames" in scores:
        return count_of(scores["frames"] or 0, "frame")
    if "coverage" in scores:
        return f"{scores['pixels']:,} pixels ({scores['coverage']:.1%} of those known)"
    return count_of(scores["points"] or 0, "point") if "points" in scores else ""


def stage_titles(result: ResultRecord) -> dict[str, str]:
    """Returns what each stage of a frame is, in words, by stage in the order of the refinement.

    Where the result is the depth of the network's last step, that step has no title of its own.
    """
    method = result.method
    name = method.networks[0].name
    updates = len(result.loss) - 1  # fewer than asked if they diverged
    # The steps of the user's network.
    titles = {BEFORE: name}
    if result.alignment is not None:
        titles[BEFORE] = f"{name}, aligned with the points"
    if updates > 0:
        titles[UPDATED] = f"{name}, {count_of(updates, 'update')} of z"
    if method.propagation != "none":
        titles[PROPAGATED] = f"{name}, residual propagated"
    # The result: the last of these steps, unless other depth is fused with it; then what is fused.
    weighted = [fused for fused, weight in result.weights.items() if weight > 0]
    if not weighted or weighted == [name]:
        _, titles[AFTER] = titles.popitem()
    else:
        titles[ALONE] = f"{method.names[-1]} alone"
        titles[AFTER] = f"fused ({weights_text(result.weights)})"
    titles[LINEAR] = _LINEAR
    return titles


def names_of_depths(result: ResultRecord) -> tuple[str, str]:
    """Returns what the depth before and the depth after of a result are of, in a few words."""
    titles = stage_titles(result)
    # Where nothing changed the prediction, it is the result, which then has the only title.
    return titles.get(BEFORE, titles[AFTER]), titles[AFTER]


def weights_text(weights: Mapping[str, float]) -> str:
    """Returns as text how much each network, or interpolation, weighs in a fused result.

    What would be 0 % is left out.

    Args:
        weights: Weights, fractions of 1, by name.
    """
    return ", ".join(
        f"{name} {weight:.0%}" for name, weight in weights.items() if weight >= _LEAST_WEIGHT
    )


def mean_weights_text(weights: Mapping[str, Mapping[str, float]]) -> str:
    """Returns as text how much each network, or interpolation, weighs in the results of a batch.

    Args:
        weights: Mean, least and largest weight over the frames, by name.
    """
    return ", ".join(
        f"{name} {weight['mean']:.0%} ({weight['least']:.0%} to {weight['largest']:.0%})"
        for name, weight in weights.items()
    )


def change_cell(before: float | None, after: float | None) -> Cell:
    """Returns how much an error rose or fell, in per cent of that before: a good or a bad cell.

    The cell is – where an error is unknown (None or NaN), or that before is 0.
    """
    if before is None or after is None or before == 0 or math.isnan(before - after):
        return "–", "dim"
    rise = after / before - 1
    style: Style = "dim"
    if rise < 0:
        style = "good"
    elif rise > 0:
        style = "bad"
    return f"{rise:+.1%}", style
