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
"""Of the parts of a frame's name."""
_LEAST_SAVED = 8
"""Characters for which a name is shortened."""
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")


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
        return [c.heading if isinstance(c, Measure) else c for c in self.columns]

    @property
    def cells(self) -> list[list[Cell]]:
        """The cells as they are shown."""
        return [list(map(_cell, row)) for row in self.rows]

    def csv(self) -> str:
        """Returns the cells as they are, None and NaN empty, below the keys of the measures."""
        buffer = io.StringIO()
        keys = [c.key if isinstance(c, Measure) else c for c in self.columns]
        rows = [list(map(_plain_cell, row)) for row in self.rows]
        csv.writer(buffer, lineterminator="\n").writerows([keys, *rows])
        return buffer.getvalue()

    def latex(self) -> str:
        """Returns a tabular with rules of the package booktabs; its title is a comment above."""
        header, *rows = (
            " & ".join(_in_latex(*cell) for cell in line) + r" \\"
            for line in ([(heading, "") for heading in self.headings], *self.cells)
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
    if isinstance(value, tuple):
        return value
    if isinstance(value, str):
        return value, ""
    return "" if value is None else f"{value:,}", ""


def _plain_cell(value: object) -> object:
    """A cell without its style; None for what is no number."""
    plain = value[0] if isinstance(value, tuple) else value
    return None if isinstance(plain, float) and math.isnan(plain) else plain


def _in_latex(text: str, style: Style) -> str:
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

    What is shared ends at a separator, so that numbers stay whole.
    """
    parts = [_SEPARATOR.split(name) for name in names]
    start = _shared_parts(parts)
    end = _shared_parts([of_name[:start:-1] for of_name in parts])
    before = "…" if start else ""
    after = "…" if end else ""
    inner = ["".join(of_name[start : len(of_name) - end]) for of_name in parts]
    short = [f"{before}{text}{after}" for text in inner]
    if len(names) < 2 or len(short[0]) + _LEAST_SAVED > len(names[0]):
        return [*names]
    return [names[0], *short[1:]]


def _shared_parts(names: Sequence[Sequence[str]]) -> int:
    """How many parts, from the first on, are the same in all names."""
    same = [len({*parts}) == 1 for parts in zip(*names, strict=False)]
    return same.index(False) if False in same else len(same)


def write_text(path: Path, text: str) -> None:
    """Writes the text whole or not at all; characters of a name that is not UTF-8 as escapes."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))


def bases_of(errors: Errors) -> list[str]:
    """Returns what errors are shown on: ground truth and held-out points, else the best."""
    found = [basis for basis in BASES if errors.get(basis)]
    return [basis for basis in found if basis in (GT, HELD_OUT)] or found[:1]


def means_tables(
    errors: Errors, unit: str, titles: Mapping[str, str], keys: Sequence[str] | None = None
) -> list[Table]:
    """Returns the mean errors of a batch on each basis; its measures have these keys."""
    rows = {**titles, **{name: name for name in BASELINES if name not in titles}}
    return [_table("means", basis, errors[basis], unit, rows, keys) for basis in bases_of(errors)]


def refinement_tables(record: FrameRecord) -> list[Table]:
    """Returns the errors of a record on each basis."""
    result = record.refined()
    names = " + ".join(result.method.names)
    title = f"{names}, method {result.method.name}"
    titles = stage_titles(result)
    return [
        _table(title, basis, record.errors[basis], record.unit, titles)
        for basis in bases_of(record.errors)
    ]


def _table(
    about: str,
    basis: str,
    by_stage: Mapping[str, Scores],
    unit: str,
    titles: Mapping[str, str],
    keys: Sequence[str] | None = None,
) -> Table:
    """A row for each stage in the order of the titles: its errors, also against linear ones."""
    shown = [stage for stage in titles if stage in by_stage]
    last = AFTER
    scores = by_stage[last]
    linear = by_stage.get(LINEAR, {})
    chosen = choose_measures(MEASURES, keys)
    measures = [m for m in chosen if m.key in scores and (keys or m.main)]
    # How many pixels, points or frames they are of.
    count = count_of(scores["points"] or 0, "point") if "points" in scores else ""
    if "frames" in scores:
        count = count_of(scores["frames"] or 0, "frame")
    elif "coverage" in scores:
        count = f"{scores['pixels']:,} pixels ({scores['coverage']:.1%} of those known)"
    remark = ", where a change proves nothing" if basis == USED else ""
    # The rows.
    rows = []
    for stage in shown:
        own = by_stage[stage]
        style: Style = "bold" if stage == last else ""
        texts = [m.text(own.get(m.key), unit if m.unit == "m" else m.unit) for m in measures]
        title = titles[stage]
        if own.get("frames") != scores.get("frames"):
            title += f" (over {own['frames']:,} frames)"
        against: Cell = ("", "")
        if stage != LINEAR:
            of_same = own.get("frames") == linear.get("frames")
            against = change(linear.get("mae") if of_same else None, own.get("mae"))
        rows.append([*((text, style) for text in (title, *texts)), against])
    return Table(
        title=f"{about}: errors {BASES[basis]}{remark}, {count}",
        columns=["", *(measure.title for measure in measures), "MAE vs linear"],
        rows=rows,
    )


def stage_titles(result: ResultRecord) -> dict[str, str]:
    """Returns what each stage of a frame is, in words.

    The result is no stage of its own where it is the network's last stage: then that one is named.
    """
    method = result.method
    name = method.networks[0].name
    updates = len(result.loss) - 1  # fewer than asked if they diverged
    # The steps of the user's network.
    steps = {BEFORE: name}
    if result.alignment is not None:
        steps[BEFORE] = f"{name}, aligned with the points"
    if updates > 0:
        steps[UPDATED] = f"{name}, {count_of(updates, 'update')} of z"
    if method.propagation != "none":
        steps[PROPAGATED] = f"{name}, residual propagated"
    # What becomes of them.
    weighted = [expert for expert, weight in result.weights.items() if weight > 0]
    if weighted in ([], [name]):
        _, steps[AFTER] = steps.popitem()
    else:
        steps[ALONE] = f"{method.names[-1]} alone"
        steps[AFTER] = f"fused ({weights_text(result.weights)})"
    steps[LINEAR] = _LINEAR
    return steps


def names_of_depths(result: ResultRecord) -> tuple[str, str]:
    """Returns what the depth before and the depth after of a result are of, in a few words."""
    titles = stage_titles(result)
    return titles.get(BEFORE, titles[AFTER]), titles[AFTER]


def weights_text(weights: Mapping[str, float]) -> str:
    """Returns the weights of experts as text, without those below half a per cent."""
    return ", ".join(f"{name} {w:.0%}" for name, w in weights.items() if w >= 0.005)


def mean_weights_text(weights: Mapping[str, Mapping[str, float]]) -> str:
    """Returns mean and range of each expert's weight in the frames of a batch, as text."""
    return ", ".join(
        f"{name} {weight['mean']:.0%} ({weight['least']:.0%} to {weight['largest']:.0%})"
        for name, weight in weights.items()
    )


def change(before: float | None, after: float | None) -> Cell:
    """Returns how much an error rose or fell in per cent, as a good or a bad cell."""
    if not before or after is None or math.isnan(before - after):
        return "–", "dim"
    rise = after / before - 1
    return f"{rise:+.1%}", "good" if rise < 0 else "bad" if rise > 0 else "dim"
