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
NOTED_COVERAGE = 0.9995
"""Fraction of the known ground truth that is scored, below which a remark says so."""
COLOURS = {PUBLISHED: "0.7", STATES["paper"]: "tab:orange", STATES["tuned"]: "tab:blue"}


def markdown(table: Table) -> str:
    """Returns a set's report: errors beside those of the paper, δ at 1.01^k, steps of z, notes."""
    rows, beside = table["rows"], table["beside_paper"]
    title = f"## {heading(table)}\n\n{_sample_line(table)}\n"
    texts = [title, _measures(rows, table["street"], beside=beside)]
    if any(row["fine"] for row in rows):
        texts.append(_fine(rows, beside=beside))
    notes = [*table["notes"], *remarks(rows)]
    texts += [_steps(rows), "\n" + "\n".join(f"- {note}" for note in notes)]
    return "\n".join(text for text in texts if text) + "\n"


def heading(table: Table) -> str:
    """Returns the title of a set's table, such as "Table I on rendered rooms"."""
    name = f"Table {'II' if table['street'] else 'I'}"
    return f"{name} on {table['set']}"


def _sample_line(table: Table) -> str:
    """Returns a sentence on what the means are over, and why they have no interval."""
    rendered = table["set"].startswith("rendered")
    groups = "each its own group" if rendered else "of one sequence, one group"
    return f"Means over frames (n in the table), {groups}; one draw of the points, no interval."


def paper_row(row: Result, street: bool) -> PaperRow:
    """Returns the paper's figures of the network of a result.

    Args:
        row: Result of one of our networks.
        street: Whether it is table II, KITTI; else table I, NYU.
    """
    of_name = (paper for paper in ROWS if paper.name == row["paper_row"])
    return next(paper for paper in of_name if paper.street == street)


def _measures(rows: Sequence[Result], street: bool, *, beside: bool) -> str:
    """Returns the table of errors and δ, lines of Markdown.

    Args:
        rows: Results of our networks.
        street: Whether the paper's figures are those of its table II.
        beside: Whether the paper's figures stand above ours.
    """
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
    """Returns our setting in a few words: layer, step, iterations and loss, or "the same"."""
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
    """Returns the cells of the six `MEASURES`.

    Args:
        values: The measures by name.
        before: Those that the errors' gains in per cent are over; None: no gains.
        fine: Whether the δ are at 1.01^k: they stand in another table, and a † here.
        printed: Gains of the first measures as the paper prints them, instead of computed ones.
    """
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
    """Returns by how many per cent an error fell, with its sign; a rise is negative."""
    return f"{100 * (1 - after / before):+.1f} %".replace("-", "−")


def _fine(rows: Sequence[Result], *, beside: bool) -> str:
    """Returns the table of the δ at 1.01^k, before and after, of the depth completion rows."""
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
    """Returns the table of how far the paper's step moves z, and of the loss at the points."""
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
    """Returns a line for each network that was aligned, not scored everywhere, or diverged."""
    notes = []
    for row in rows:
        if row["aligned"]:
            kinds = ", ".join(f"{kind} in {count}" for kind, count in row["aligned"].items())
            notes.append(
                f"`{row['network']}` does not give metres: its output is aligned with the same"
                f" points, once for before and after alike ({kinds} frames)"
            )
        if row["coverage"] < NOTED_COVERAGE:
            notes.append(
                f"`{row['network']}`: {100 * (1 - row['coverage']):.2f} % of the pixels with known"
                " ground truth have no positive depth before or after, and are not scored"
            )
        if row["diverged"]:
            notes.append(f"`{row['network']}`: {row['diverged']} refinements diverged")
    return notes


def plot(tables: Sequence[Table], path: Path) -> None:
    """Draws the gains in MAE: published, at the paper's setting, and with our defaults.

    Raises:
        UsageError: matplotlib is not installed, or no table has a row.
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
    """Returns the gain in MAE of each row in per cent, by the title of the bars."""
    bars: dict[str, list[float]] = {}
    if table["beside_paper"]:
        published = [paper_row(row, table["street"]) for row in table["rows"]]
        bars[PUBLISHED] = [100 * (1 - row.after[1] / row.before[1]) for row in published]
    for state, title in STATES.items():
        bars[title] = [row["settings"][state]["gains"]["mae"] for row in table["rows"]]
    return bars
