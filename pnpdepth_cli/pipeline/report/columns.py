"""What a report's page is told of figures: its columns, and text for its head."""

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
    """A figure that every frame has, or has not.

    Shown is value × factor in `unit`, or in per cent. signed: above 0 is better, below 0 worse.
    listed: it stands in the list of frames too, not only where a frame is looked at.
    """

    key: str
    title: str
    unit: str = ""
    decimals: int = 4
    factor: float = 1.0
    percent: bool = False
    higher_is_better: bool = False
    signed: bool = False
    listed: bool = True


def column_of(measure: Measure, *, title: str = "", key: str = "", listed: bool) -> Column:
    """The column of a measure, under its own title and key or others."""
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
    """So many frames, in words."""
    return f"{count:,} frame{'' if count == 1 else 's'}"


def tile(label: str, value: str, remark: str = "") -> dict[str, str]:
    """A figure that is shown large."""
    return {"label": label, "value": value, "remark": remark}


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    """A table of text; the first cell of each row is its title."""
    return {"caption": caption, "header": list(header), "rows": [list(row) for row in rows]}


def figures(columns: Sequence[Column], sort_by: str) -> dict[str, Any]:
    """The columns for the page, which of them it sorts by at first, and what never changes."""
    colours = DepthScale(low_m=1.0, high_m=2.0).paint(np.linspace(1, 2, _SWATCHES)).tolist()
    return {
        "columns": [asdict(column) for column in columns],
        "sort_by": [column.key for column in columns].index(sort_by),
        "depth_colours": [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in colours],
        "logarithmic_from": LOGARITHMIC_FROM,
        "foot": f"Made by pnpdepth {__version__}. This page works offline.",
    }
