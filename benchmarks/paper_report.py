"""The tables of `benchmarks.paper_tables` as Markdown and as an image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.frames import table_row
from benchmarks.paper_figures import MEASURES, ROWS, PaperRow
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import atomic_path

Table = dict[str, Any]
Result = dict[str, Any]

ERRORS = MEASURES[:3]
TITLES = ("RMSE", "MAE", "MRE", "δ1", "δ2", "δ3")
STATES = {"paper": "the paper's setting", "tuned": "our setting"}
PUBLISHED = "published"
COLOURS = {PUBLISHED: "0.7", STATES["paper"]: "tab:orange", STATES["tuned"]: "tab:blue"}


def markdown(table: Table) -> str:
    """A set's table with the paper's figures beside ours, the δ at 1.01^k, and the steps."""
    rows, beside = table["rows"], table["beside_paper"]
    title = f"## {heading(table)}\n\n{_sample_line(table)}\n"
    texts = [title, _measures(rows, table["street"], beside=beside)]
    if any(row["fine"] for row in rows):
        texts.append(_fine(rows, beside=beside))
    notes = [*table["notes"], *remarks(rows)]
    texts += [_steps(rows), "\n" + "\n".join(f"- {note}" for note in notes)]
    return "\n".join(text for text in texts if text) + "\n"


def heading(table: Table) -> str:
    """Which of the paper's tables a set's is, on what."""
    name = f"Table {'II' if table['street'] else 'I'}"
    return f"{name} on {table['set']}"


def _sample_line(table: Table) -> str:
    """What the means are over; the interval needs several groups of frames."""
    rendered = table["set"].startswith("rendered")
    groups = "each its own group" if rendered else "of one sequence, one group"
    return f"Means over frames (n in the table), {groups}; one draw of the points, no interval."


def paper_row(row: Result, street: bool) -> PaperRow:
    """The paper's lines for a result."""
    return next(p for p in ROWS if p.name == row["paper_row"] and p.street == street)


def _measures(rows: Sequence[Result], street: bool, *, beside: bool) -> str:
    lines = [table_row("network", "input", "points", "frames", "", *TITLES, head=True)]
    for row in rows:
        # The paper's two lines.
        published = paper_row(row, street)
        if beside:
            fine = published.fine
            points = published.points or "LiDAR"
            before, after = (
                dict(zip(MEASURES, figures, strict=True))
                for figures in (published.before, published.after)
            )
            start = (f"*{published.name}, published*", published.kind, "", "", "before")
            lines.append(table_row(*start, *_cells(before, fine=fine)))
            after_cells = _cells(after, before, fine=fine, printed=published.gains)
            lines.append(table_row("", "", points, "", "after", *after_cells))
        # Ours: before, with each setting, and the points without any network.
        start = (f"`{row['network']}`", row["kind"], "", row["frames"], "before")
        scores = row["scores"]
        before = scores["before"]
        lines.append(table_row(*start, *_cells(before)))
        start = ("", "", f"{row['points']:.0f}", "")
        for state, title in STATES.items():
            how = f"{title}: {described(row['settings'])}" if state == "tuned" else title
            lines.append(table_row(*start, how, *_cells(scores[state], before)))
        lines.append(table_row(*start, "the points interpolated", *_cells(scores["linear"])))
    if any(row["fine"] for row in rows) and beside:
        lines.append("\n† δ at 1.01^k, in the next table")
    return "\n".join(lines)


def described(settings: dict[str, dict[str, Any]]) -> str:
    """Our setting in a few words."""
    setting = settings["tuned"]
    paper = settings["paper"]
    names = ("layer", "lr", "update", "iterations", "loss")
    if all(setting[name] == paper[name] for name in names):
        return "the same"
    lr = str(setting["lr"]).replace("%", " %")
    loss = "" if setting["loss"] == "l1" else f", {setting['loss']}"
    return f"`{setting['layer']}`, {setting['update']} {lr}, K {setting['iterations']}{loss}"


def _cells(
    values: dict[str, float],
    before: dict[str, float] | None = None,
    *,
    fine: bool = False,
    printed: Sequence[float] = (),
) -> list[str]:
    """Six cells; with the gains over `before` in per cent, the first as printed."""
    cells = []
    for column, name in enumerate(MEASURES):
        if name in ERRORS:
            gain = f" ({_gain(values[name], before[name])})" if before else ""
            if column < len(printed):
                gain = f" ({printed[column]:+.1f} %)"
            cells.append(f"{values[name]:.4f}{gain}")
        else:
            cells.append("†" if fine else f"{values[name]:.1f}")
    return cells


def _gain(after: float, before: float) -> str:
    return f"{100 * (1 - after / before):+.1f} %".replace("-", "−")


def _fine(rows: Sequence[Result], *, beside: bool) -> str:
    """The δ at 1.01^k of the depth completion rows, before and after."""
    lines = [
        "\nδ at 1.01, 1.01², 1.01³, as in the paper's depth completion rows, before → after\n",
        table_row("network", "", *TITLES[3:], head=True),
    ]
    for row in (row for row in rows if row["fine"]):
        if beside:
            published = paper_row(row, street=True)
            pairs = zip(published.before[3:], published.after[3:], strict=True)
            cells = (f"{before:.1f} → {after:.1f}" for before, after in pairs)
            lines.append(table_row(f"*{published.name}, published*", "", *cells))
        for state, title in STATES.items():
            before, after = row["scores"]["before"], row["scores"][state]
            names = ("fine1", "fine2", "fine3")
            cells = (f"{before[name]:.1f} → {after[name]:.1f}" for name in names)
            lines.append(table_row(f"`{row['network']}`", title, *cells))
    return "\n".join(lines)


def _steps(rows: Sequence[Result]) -> str:
    """How far the paper's step moves z, and what both settings do at the points themselves."""
    titles = ("network", "z", "std(z)", "α", "L1, the paper's setting", "loss, our setting")
    lines = [
        "\nThe step against the feature map: standard deviation of the paper's z, α as its"
        " fraction, and the mean L1 in metres at the points before → after\n",
        table_row(*titles, "MAE fell in", head=True),
    ]
    for row in rows:
        paper, tuned = (row["settings"][state] for state in STATES)
        fraction = 100 * paper["lr"] / row["std_z"]
        cells = (
            f"`{row['network']}`",
            f"`{paper['layer']}`",
            f"{row['std_z']:.3g}",
            f"{fraction:.2g} %" if fraction < 10 else f"{fraction:.0f} %",
            *(f"{how['loss_before']:.3f} → {how['loss_after']:.3f}" for how in (paper, tuned)),
            " / ".join(f"{how['frames_with_lower_mae']:.0%}" for how in (paper, tuned)),
        )
        lines.append(table_row(*cells))
    return "\n".join(lines)


def remarks(rows: Sequence[Result]) -> list[str]:
    """Alignments, pixels that are not scored, and divergence."""
    notes = []
    for row in rows:
        if row["aligned"]:
            kinds = ", ".join(f"{kind} in {count}" for kind, count in row["aligned"].items())
            notes.append(
                f"`{row['network']}` does not give metres: its output is aligned with the same"
                f" points, once for before and after alike ({kinds} frames)"
            )
        if row["coverage"] < 0.9995:
            notes.append(
                f"`{row['network']}`: {100 * (1 - row['coverage']):.2f} % of the pixels with known"
                " ground truth have no positive depth before or after, and are not scored"
            )
        if row["diverged"]:
            notes.append(f"`{row['network']}`: {row['diverged']} refinements diverged")
    return notes


def plot(tables: Sequence[Table], path: Path) -> None:
    """An image of the gains in MAE: published, at the paper's setting, and with our defaults.

    UsageError without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("--plot needs matplotlib: pip install matplotlib") from None
    tables = [table for table in tables if table["rows"]]
    if not tables:
        raise UsageError("--plot: there is no table to draw")
    # A panel for each table, a group of bars for each network.
    figure = Figure(figsize=(9, 2.4 * len(tables) + 0.4), layout="constrained")
    drawn: dict[str, Any] = {}
    panels = figure.subplots(len(tables), squeeze=False)[:, 0]
    for table, axes in zip(tables, panels, strict=True):
        bars = bars_of(table)
        width = 0.8 / len(bars)
        for number, (title, heights) in enumerate(bars.items()):
            offset = (number - (len(bars) - 1) / 2) * width
            positions = [index + offset for index in range(len(heights))]
            drawn[title] = axes.bar(positions, heights, width, color=COLOURS[title], label=title)
        # Names below the groups.
        labels = [f"{row['network']}\n{row['points']:.0f} points" for row in table["rows"]]
        axes.set_xticks(range(len(labels)), labels, fontsize=8)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.set_ylabel("MAE lower by, %")
        axes.set_title(heading(table), fontsize=10)
    figure.legend(handles=list(drawn.values()), loc="outside upper center", ncols=len(drawn))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


def bars_of(table: Table) -> dict[str, list[float]]:
    """Gains in MAE in per cent, of each row, by what they are gains of."""
    bars: dict[str, list[float]] = {}
    if table["beside_paper"]:
        published = [paper_row(row, table["street"]) for row in table["rows"]]
        bars[PUBLISHED] = [100 * (1 - row.after[1] / row.before[1]) for row in published]
    for state, title in STATES.items():
        bars[title] = [row["settings"][state]["gains"]["mae"] for row in table["rows"]]
    return bars
