"""The gate of every number from a sensor: its unit, on arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pnpdepth_cli.dataset.plausible import SCANS, divisor_to_metres
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading

FLOAT = Reading("PFM", None, False)
PNG = Reading("PNG", 256.0)


def divisor(depth: np.ndarray, reading: Reading, given: float | None = None, *more: Any) -> Any:
    return divisor_to_metres(depth, reading, "x", "--depth-scale", given, *more)


@pytest.mark.parametrize(
    ("depth", "reading"),
    [
        *((np.array([m] * 5 + [1e6] * 2), PNG) for m in (0.02, 0.5, 80, 1000)),
        (np.array([]), FLOAT),
        (np.full(20, 700.5), FLOAT),
        (np.arange(199.0), FLOAT),  # whole numbers of a median of 99
    ],
)
def test_plausible_metres_need_no_word(depth: np.ndarray, reading: Reading) -> None:
    assert divisor(depth, reading) == (1, [])


@pytest.mark.parametrize(
    ("median", "scale", "advice"),
    [
        (2000.0, 1.0, "--depth-scale 1000 (now 1) would make it 2.0 m"),
        (0.01, 100_000.0, "--depth-scale 1000 (now 100000) would make it 1.0 m"),
        (0.002, 1000.0, "--depth-scale 1 (now 1000) would make it 2.0 m"),  # whole metres
        (0.0002, 1000.0, "--depth-scale 1 (now 1000) would make it 0.2 m"),
        (4e9, 1.0, "give numbers per metre with --depth-scale (now 1)"),
    ],
)
def test_a_plausible_scale_is_proposed(median: float, scale: float, advice: str) -> None:
    _, (warning,) = divisor(np.full(3, median), Reading("PNG", scale))
    assert warning.startswith("warning: x: median ")
    assert advice in warning
    with pytest.raises(InputError, match="keeps it"):
        divisor(np.full(3, median), Reading("PNG", scale, assumed=True))


@pytest.mark.parametrize(
    ("depth", "kind"),
    [
        (np.full(3, 2500.0), []),
        (np.arange(200.0, 900.0), []),
        (np.arange(201.0), []),  # whole numbers of a median of 100
        (np.full(20, 700.5), [SCANS]),  # a scan's are nearer than a depth may be
    ],
)
def test_millimetres_stop_and_the_option_reads_them(depth: np.ndarray, kind: list[Any]) -> None:
    with pytest.raises(InputError, match=r"--depth-scale \d+ \(now 1\)"):
        divisor(depth, FLOAT, None, *kind)
    assert divisor(depth, FLOAT, 1000.0, *kind)[0] == 1000
    kept, (warning,) = divisor(depth, FLOAT, 1.0, *kind)
    assert (kept, warning.startswith("warning: ")) == (1, True)


def test_a_room_in_centimetres_is_warned_of_but_not_the_ground_below_an_aircraft() -> None:
    room = np.linspace(100.5, 500, 50)
    ground = np.linspace(250.5, 350, 50)
    kept, (warning,) = divisor(room, FLOAT)
    assert kept == 1
    assert "--depth-scale 100 (now 1) would make it 3.0 m" in warning
    assert divisor(room, FLOAT, 100.0)[0] == 100
    assert divisor(room, FLOAT, 1.0) == divisor(ground, FLOAT) == (1, [])
