"""Formats scores as text: cells of tables, CSV, Markdown and LaTeX."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import write_csv
from pnpdepth_cli.pipeline.evaluation.compare import Comparison
from pnpdepth_cli.pipeline.evaluation.result import ErrorBin, Evaluation, frame_record

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
    """Raises OutputError for a file that cannot or may not be written; `-` is stdout."""
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
    """Writes the bytes whole or not at all; the folder has to exist."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def format_value(measure: Measure, value: float | None, *, unit: bool = False) -> str:
    """Returns the value as text in the measure's shown unit; – for NaN and None."""
    if value is None or math.isnan(value):
        return "–"
    if measure.percent:
        return f"{value:.{measure.decimals}%}"
    text = f"{value * measure.shown_factor:,.{measure.decimals}f}"
    return f"{text} {unit_of(measure)}".rstrip() if unit else text


def unit_of(measure: Measure) -> str:
    """Returns the unit of `format_value`; empty for ratios and percentages."""
    return measure.shown_unit or measure.unit


def column_title(measure: Measure) -> str:
    """Returns a title such as `RMSE [m] ↓`."""
    unit = "" if not unit_of(measure) else f" [{unit_of(measure)}]"
    return f"{measure.title}{unit} {'↑' if measure.higher_is_better else '↓'}"


def frames_csv(evaluation: Evaluation) -> str:
    """Returns a line for each frame: its files, its counts, and its measures as stored."""
    keys = [measure.key for measure in evaluation.protocol.measures]
    records = [frame_record(frame) for frame in evaluation.frames]
    columns = [name for name in records[0] if name not in ("values", "error")]
    rows = [
        [*(_cell(r[name]) for name in columns), *(_cell(r["values"].get(key)) for key in keys),
         r["error"] or ""]
        for r in records
    ]  # fmt: skip
    return csv_text([*columns, *keys, "error"], rows)


def interval_text(evaluation: Evaluation, measure: Measure) -> str:
    """Returns the interval of a mean such as `1.02 … 1.31`; – where there is none."""
    if evaluation.interval is None:
        return "–"
    ends = (evaluation.interval.low[measure.key], evaluation.interval.high[measure.key])
    return " … ".join(format_value(measure, end) for end in ends)


def means_table(evaluation: Evaluation, name: str) -> tuple[list[str], list[list[str]]]:
    """Returns (header, one row) of the means with their intervals, and the coverage."""
    measures, interval = evaluation.protocol.measures, evaluation.interval
    cells = [format_value(measure, evaluation.mean[measure.key]) for measure in measures]
    if interval is not None:
        ends = [interval_text(evaluation, measure) for measure in measures]
        cells = [f"{cell} ({end})" for cell, end in zip(cells, ends, strict=True)]
    header = ["", *(column_title(measure) for measure in measures), "frames", "coverage"]
    frames = f"{len(evaluation.scored):,} of {len(evaluation.frames):,}"
    return header, [[name, *cells, frames, f"{evaluation.coverage:.2%}"]]


def bin_rows(bins: Sequence[ErrorBin]) -> list[list[str]]:
    """Returns a row for each bin: edges, fraction of the ground truth, errors and coverage."""
    total = sum(each.known for each in bins)
    rows = []
    for each in bins:
        low, high = f"{each.low:g}", f"{each.high:g}"
        rows.append([
            f"{low} or more" if math.isinf(each.high) else f"{low} to {high}",
            f"{each.known / total:.1%}",
            *("–" if math.isnan(v) else f"{v:.4f}" for v in (each.rmse, each.mae, each.mre)),
            f"{each.pixels / each.known:.2%}",
        ])  # fmt: skip
    return rows


def comparison_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Returns (header, a row for each measure and run); all runs but the first have gain and p."""
    base, *others = comparison.runs
    header = ["measure", "run", "mean", "gain [%]", "low", "high", "p"]
    rows = []
    for measure in comparison.measures:
        title, mean = column_title(measure), format_value(measure, base.mean[measure.key])
        rows.append([title, base.label, mean, *["–"] * 4])
        for run, gains in zip(others, comparison.gains, strict=True):
            gain = gains[measure.key]
            bounds = (gain.percent, gain.low_percent, gain.high_percent)
            rows.append([
                title,
                run.label,
                format_value(measure, run.mean[measure.key]),
                *("–" if math.isnan(value) else f"{value:+.2f}" for value in bounds),
                "–" if math.isnan(gain.p_adjusted) else f"{gain.p_adjusted:.4f}",
            ])  # fmt: skip
    return header, rows


def comparison_caption(comparison: Comparison) -> str:
    """Returns the caption of the table of a comparison, one line."""
    return (
        f"{len(comparison.names):,} shared frames; gains in per cent of the error of"
        f" {comparison.runs[0].label};"
        f" intervals (95 %) and p-values over {comparison.clusters.describe()}, p adjusted for"
        f" {len(comparison.measures)} measures (Holm)"
    )


def csv_text(header: Sequence[str], rows: Rows) -> str:
    """Returns the table as `write_csv` writes it."""
    buffer = io.StringIO()
    write_csv(buffer, header, rows)
    return buffer.getvalue()


def markdown_text(header: Sequence[str], rows: Rows, caption: str) -> str:
    """Returns a table in GitHub's Markdown, numbers right-aligned, and its caption below."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    body = "".join(f"| {' | '.join(_in_markdown(cell) for cell in line)} |\n" for line in lines)
    return f"{body}\n{caption}\n"


def latex_text(header: Sequence[str], rows: Rows, caption: str) -> str:
    """Returns a tabular with rules of the package booktabs, and its caption as a comment above."""
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
    return str(value)
