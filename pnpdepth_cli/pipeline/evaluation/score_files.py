"""Scores as CSV, Markdown and LaTeX text."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import text_cell
from pnpdepth_cli.pipeline.evaluation.compare import Comparison
from pnpdepth_cli.pipeline.evaluation.result import Evaluation, Part, frame_record

Rows = Sequence[Sequence[str]]

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
        "δ": r"$\delta$", "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "−": "$-$",
        "·": r"$\cdot$", "\n": " ",
    }
)  # fmt: skip


def check_targets(
    targets: Sequence[Path | None], inputs: Sequence[Path], *, overwrite: bool
) -> None:
    """Raises OutputError for a file that cannot be written, or may not be; `-` is stdout."""
    for path in targets:
        if path is None or str(path) == "-":
            continue
        if path.resolve() in {source.resolve() for source in inputs}:
            raise OutputError(f"{path} is one of the inputs; name another output")
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: its folder does not exist; create it first")


def write_bytes(path: Path, data: bytes) -> None:
    """`path` holds the bytes; its folder has to exist."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def shown(measure: Measure, value: float | None, *, unit: bool = False) -> str:
    """The value as a person reads it, in the measure's shown unit; – where there is none."""
    if value is None or math.isnan(value):
        return "–"
    if measure.percent:
        return f"{value:.{measure.decimals}%}"
    text = f"{value * measure.shown_factor:,.{measure.decimals}f}"
    return f"{text} {unit_of(measure)}".rstrip() if unit else text


def unit_of(measure: Measure) -> str:
    """The unit that `shown` shows; empty for ratios and shares."""
    return measure.shown_unit or measure.unit


def heading(measure: Measure) -> str:
    """A column's title such as `RMSE [m] ↓`."""
    unit = "" if not unit_of(measure) else f" [{unit_of(measure)}]"
    return f"{measure.title}{unit} {'↑' if measure.higher_is_better else '↓'}"


def frames_csv(evaluation: Evaluation) -> str:
    """A line for each frame of the truth: its files, its counts, and its measures as stored."""
    keys = [measure.key for measure in evaluation.protocol.measures]
    records = [frame_record(frame) for frame in evaluation.frames]
    columns = [name for name in records[0] if name not in ("values", "error")]
    rows = [
        [*(_cell(r[name]) for name in columns), *(_cell(r["values"].get(key)) for key in keys),
         text_cell(r["error"] or "")]
        for r in records
    ]  # fmt: skip
    return csv_text([*columns, *keys, "error"], rows)


def means_table(evaluation: Evaluation, name: str) -> tuple[list[str], list[list[str]]]:
    """(header, one row): the means with their intervals, and the coverage."""
    measures, interval = evaluation.protocol.measures, evaluation.interval
    cells = [shown(measure, evaluation.mean[measure.key]) for measure in measures]
    if interval is not None:
        halves = [shown(measure, interval.half_width(measure.key)) for measure in measures]
        cells = [f"{cell} ± {half}" for cell, half in zip(cells, halves, strict=True)]
    header = ["", *(heading(measure) for measure in measures), "frames", "coverage"]
    frames = f"{len(evaluation.scored):,} of {len(evaluation.frames):,}"
    return header, [[name, *cells, frames, f"{evaluation.coverage:.2%}"]]


def part_cells(parts: Sequence[Part]) -> list[list[str]]:
    """A row for each part: its bounds, its share of the truth, RMSE, MAE, MRE and coverage."""
    total = sum(part.known for part in parts)
    rows = []
    for part in parts:
        low, high = f"{part.low:g}", f"{part.high:g}"
        rows.append([
            f"{low} or more" if math.isinf(part.high) else f"{low} to {high}",
            f"{part.known / total:.1%}",
            *("–" if math.isnan(v) else f"{v:.4f}" for v in (part.rmse, part.mae, part.mre)),
            f"{part.pixels / part.known:.2%}",
        ])  # fmt: skip
    return rows


def comparison_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """(header, a row for each measure): the first run, and the others with gain, interval, p."""
    base, *others = comparison.runs
    header = ["", base.label]
    for run in others:
        header += [run.label, "gain [%]", "low", "high", "p"]
    rows = []
    for measure in comparison.measures:
        row = [heading(measure), shown(measure, base.mean[measure.key])]
        for run, gains in zip(others, comparison.gains, strict=True):
            gain = gains[measure.key]
            bounds = (gain.percent, gain.low_percent, gain.high_percent)
            row += [
                shown(measure, run.mean[measure.key]),
                *("–" if math.isnan(value) else f"{value:+.2f}" for value in bounds),
                "–" if math.isnan(gain.p_value) else f"{gain.p_value:.4f}",
            ]
        rows.append(row)
    return header, rows


def comparison_caption(comparison: Comparison) -> str:
    """What the table is of."""
    return (
        f"{len(comparison.names):,} shared frames, gains in per cent of {comparison.runs[0].label}"
    )


def csv_text(header: Sequence[str], rows: Rows) -> str:
    """RFC 4180, but with lines that end as on Unix."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()


def markdown_text(header: Sequence[str], rows: Rows, caption: str) -> str:
    """A table in GitHub's Markdown, the numbers to the right, with its caption below."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    body = "".join(f"| {' | '.join(_in_markdown(cell) for cell in line)} |\n" for line in lines)
    return f"{body}\n{caption}\n"


def latex_text(header: Sequence[str], rows: Rows, caption: str) -> str:
    """A tabular with the rules of the package booktabs, with its caption as a comment above."""
    lines = [
        " & ".join(cell.translate(_LATEX) for cell in line) + r" \\" for line in (header, *rows)
    ]
    return "\n".join(
        (
            f"% {' '.join(caption.split())}",
            rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            "",
        )
    )


def _in_markdown(cell: str) -> str:
    return " ".join(cell.split()).replace("|", r"\|")


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return text_cell(value) if isinstance(value, str) else str(value)
