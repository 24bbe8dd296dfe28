"""Real frames for measuring."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.frames import ALL_SETS, EvalFrame, evenly, frames_of


def numbered(count: int) -> list[EvalFrame]:
    nothing = np.zeros((1, 1), np.float32)
    return [
        EvalFrame(f"{number}", np.zeros((1, 1, 3), np.float32), nothing) for number in range(count)
    ]


@pytest.mark.parametrize(
    ("count", "names"), [(1, "0"), (2, "0 9"), (4, "0 3 6 9"), (99, "0 1 2 3 4 5 6 7 8 9")]
)
def test_frames_are_chosen_evenly_with_the_first_and_the_last(count: int, names: str) -> None:
    assert [frame.name for frame in evenly(numbered(10), count)] == names.split()


def test_a_half_of_a_set_has_its_even_or_its_odd_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "nyu").mkdir()
    monkeypatch.setitem(ALL_SETS, "nyu", lambda _root: iter(numbered(5)))
    halves = {half: frames_of("nyu", tmp_path, 9, half) for half in ("even", "odd")}
    assert [frame.name for frame in halves["even"]] == ["0", "2", "4"]
    assert [frame.name for frame in halves["odd"]] == ["1", "3"]


def test_a_set_that_is_not_there_has_no_frames(tmp_path: Path) -> None:
    assert frames_of("icl_nuim", tmp_path, 3) == []
