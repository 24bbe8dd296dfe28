"""The parts that `bench` times, and what is measured of them."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest
import torch

from pnpdepth_cli.commands import bench
from pnpdepth_cli.commands.bench import FIRST_FRAME, in_turn, run_bench
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.settings import Settings
from tests.commands.frames import FrameOnDisk, frame_on_disk


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> FrameOnDisk:
    return frame_on_disk(tmp_path_factory.mktemp("frame"))


def measured(frame: FrameOnDisk, **more: Any) -> dict[str, Any]:
    fields = {"model": str(frame.model), "checkpoint": frame.checkpoint, "size": (40, 60)}
    return run_bench(**{**fields, "points": 80, "repeats": 2, **more})


def test_every_part_is_timed_and_compared_with_one_forward_pass(frame: FrameOnDisk) -> None:
    record = json.loads(json.dumps(measured(frame, precision="bf16")))
    parts = record["parts"]
    assert list(parts) == [
        *("forward", "front", "rear", "rear and gradient", "refinement", FIRST_FRAME)
    ]
    forward, front, rear = (parts[name]["median_s"] for name in ("forward", "front", "rear"))
    for part in parts.values():
        assert 0 < part["lower_s"] <= part["median_s"] <= part["upper_s"]
        assert part["forwards"] == part["median_s"] / forward
    assert record["limit"] == (front + 11 * rear) / (front + rear)
    assert record["network_size"] == record["size"] == [40, 60]
    assert (record["points"], record["iterations"], record["layer"]) == (80, 5, "middle")
    assert (record["precision"], record["threads"]) == ("bf16", torch.get_num_threads())
    assert record["versions"]["torch"] == torch.__version__


def test_a_network_without_weights_gets_random_ones_and_a_note(frame: FrameOnDisk) -> None:
    result = measured(frame, checkpoint=None)
    assert result["checkpoint"] is None
    assert any("weights: random" in note for note in result["notes"])


def test_only_random_weights_leave_the_output_unaligned(
    frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[str | None]()

    def resolved(definition: Any, method: Settings) -> Settings:
        asked.append(method.align)
        return resolve_settings(definition, method)

    monkeypatch.setattr(bench, "resolve_settings", resolved)
    measured(frame)
    measured(frame, checkpoint=None)
    assert asked == [None, "none"]


def test_where_no_layer_is_named_the_cut_is_that_of_refine(
    frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "default_layer", lambda network, size, count: "encode")
    assert measured(frame)["layer"] == "encode"


def test_parts_run_in_turn_and_the_first_round_does_not_count() -> None:
    ran: list[str] = []
    rounds: list[tuple[int, int]] = []
    todo = {name: lambda name=name: ran.append(name) for name in "ab"}
    spent = in_turn(
        todo, 2, torch.device("cpu"), on_round=lambda done, of: rounds.append((done, of))
    )
    assert "".join(ran) == "ababab"
    assert {name: len(times) for name, times in spent.items()} == {"a": 2, "b": 2}
    assert rounds == [(1, 3), (2, 3), (3, 3)]


def test_the_peak_is_what_is_needed_at_once_not_what_is_left() -> None:
    # in a process of its own: what others have done to the C library's heap would show
    code = (
        "import torch\n"
        "from pnpdepth_cli.commands.bench import peak_mb\n"
        "def run():\n"
        "    for _ in range(3):\n"
        "        torch.ones(16_000_000)  # 64 MB each, one at a time\n"
        "print(peak_mb(run, torch.device('cpu')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "None\n" or 60 < float(done.stdout) < 90
