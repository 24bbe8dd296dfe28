"""Columns of a report's page, and the tiles and tables of its head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pnpdepth_cli import __version__
from pnpdepth_cli.core.metrics import Measure
from pnpdepth_cli.io.colours import LOGARITHMIC_FROM, DepthScale
from pnpdepth_cli.pipeline.evaluation.score_files import unit_of

_SWATCHES = 17


@dataclass(frozen=True, kw_only=True)
class Column:
    """A value of each frame, and how the page shows it."""

    key: str
    """Unique name."""
    title: str
    """Title of the column."""
    unit: str = ""
    """Unit of value × factor."""
    decimals: int = 4
    """Digits after the point."""
    factor: float = 1.0
    """The page shows value × factor."""
    percent: bool = False
    """True to show the value in per cent."""
    higher_is_better: bool = False
    """False if lower is better."""
    signed: bool = False
    """True if values above 0 are better and below 0 worse."""
    listed: bool = True
    """True to show it in the list of frames, not only in a frame's own view."""


def column_of(measure: Measure, *, title: str = "", key: str = "", listed: bool) -> Column:
    """Returns the column of a measure, with its own title and key or other ones."""
    return Column(
        key=key or measure.key,
        title=title or measure.title,
        unit=unit_of(measure),
        decimals=measure.decimals,
        factor=measure.shown_factor,
        percent=measure.percent,
        higher_is_better=measure.higher_is_better,
        listed=listed,
    )


def frames_text(count: int) -> str:
    """Returns text such as `12 frames`."""
    return f"{count:,} frame{'' if count == 1 else 's'}"


def tile(label: str, value: str, remark: str = "") -> dict[str, str]:
    """Returns a value that the page shows large."""
    return {"label": label, "value": value, "remark": remark}


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Returns a table of text; the first cell of each row is its title."""
    return {"caption": caption, "header": list(header), "rows": [list(row) for row in rows]}


def figures(columns: Sequence[Column], sort_by: str) -> dict[str, Any]:
    """Returns the page's columns, the one it is sorted by, and its constants.

    Args:
        columns: All columns.
        sort_by: Key of the column that the page is sorted by at first.
    """
    colours = DepthScale(low_m=1.0, high_m=2.0).paint(np.linspace(1, 2, _SWATCHES)).tolist()
    return {
        "columns": [asdict(column) for column in columns],
        "sort_by": [column.key for column in columns].index(sort_by),
        "depth_colours": [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in colours],
        "logarithmic_from": LOGARITHMIC_FROM,
        "foot": f"Made by pnpdepth {__version__}. This page works offline.",
    }
