from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import asdict, replace

import pytest
import torch

from pnpdepth_cli.errors import LayerError, UsageError
from pnpdepth_cli.pipeline import bench
from pnpdepth_cli.pipeline.bench import (
    FIRST_FRAME,
    FULL,
    MASKED,
    PAPER_TIMES,
    Bench,
    BenchRequest,
    Quartiles,
    Timed,
    in_turn,
    run_bench,
)
from tests.pipeline.frames import FrameOnDisk, frame_on_disk

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> FrameOnDisk:
    return frame_on_disk(tmp_path_factory.mktemp("frame"))


def request(frame: FrameOnDisk, **more: object) -> BenchRequest:
    fields = {"model": str(frame.model), "checkpoint": frame.checkpoint, "size": (40, 60)}
    fields |= {"points": 80, "repeats": 2}
    return BenchRequest(**fields | more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def result(frame: FrameOnDisk) -> Bench:
    return run_bench(request(frame, precision="bf16"))


def test_every_part_is_timed_as_often_as_asked_and_compared_with_one_forward_pass(
    result: Bench,
) -> None:
    assert [part.name for part in result.parts] == [
        *("forward", "front", "rear", "rear backward", "refinement", FIRST_FRAME, FULL),
    ]
    forward = result.part("forward").seconds.median
    for part in result.parts:
        assert 0 < part.seconds.lower <= part.seconds.median <= part.seconds.upper
        assert part.seconds.runs == 2
        assert part.forwards == part.seconds.median / forward


def test_the_limit_follows_from_the_parts_and_from_counted_operations(result: Bench) -> None:
    front, rear = (result.part(name).seconds.median for name in ("front", "rear"))
    assert result.limit_measured == (front + 11 * rear) / (front + rear)
    # encode 20·30·8 outputs of 3·9 products; middle, which is cut at, 20·30·8 of 8·9; decode, the
    # one part behind, 20·30·8 inputs into 16 outputs each.
    ahead, behind = 4800 * (27 + 72), 4800 * 16
    assert result.limit_by_flops == (ahead + 11 * behind) / (ahead + behind)


def test_low_precision_is_compared_with_fp32(result: Bench, frame: FrameOnDisk) -> None:
    assert result.precision == "bf16"
    assert result.depth_change is not None
    assert 0 < result.depth_change < 0.02
    full = run_bench(request(frame))
    assert full.depth_change is None
    assert FULL not in [part.name for part in full.parts]


def test_the_record_is_json_and_holds_the_measurements(result: Bench) -> None:
    record = json.loads(json.dumps(asdict(result)))
    assert record["network_size"] == record["size"] == [40, 60]
    assert (record["points"], record["iterations"], record["layer"]) == (80, 5, "middle")
    assert record["threads"] == torch.get_num_threads()
    assert record["versions"]["torch"] == torch.__version__


def test_refinement_by_hidden_points_is_timed_where_asked_for() -> None:
    request = BenchRequest(size=(32, 32), points=40, repeats=1, target="masked")
    assert run_bench(request).part(MASKED).forwards > 1
    with pytest.raises(UsageError, match="takes no sparse depth"):
        run_bench(replace(request, model="fcrn-tiny"))


def test_a_network_without_weights_gets_random_ones_and_a_note(frame: FrameOnDisk) -> None:
    result = run_bench(request(frame, checkpoint=None))
    assert result.checkpoint is None
    assert any("weights: random" in note for note in result.notes)


def test_where_no_layer_is_named_the_cut_is_that_of_refine(
    frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "default_layer", lambda network, size, count: "encode")
    assert run_bench(request(frame)).layer == "encode"


def test_a_missing_layer_and_no_repeats_are_errors(frame: FrameOnDisk) -> None:
    with pytest.raises(LayerError, match="midle"):
        run_bench(request(frame, layer="midle"))
    with pytest.raises(UsageError, match="at least one"):
        run_bench(request(frame, points=0))


def test_the_papers_table_has_its_seven_networks_and_its_four_ratios() -> None:
    assert len({paper.name for paper in PAPER_TIMES}) == 7
    ratios = {p.name: round(p.forwards, 1) for p in PAPER_TIMES if p.forwards is not None}
    assert ratios == {"Ma": 5.1, "Jaritz": 3.3, "Uhrig": 5.2, "Chodosh": 1.4}


# ------------------------------------------------------------------ measuring


def test_parts_run_in_turn_and_the_first_round_does_not_count() -> None:
    ran: list[str] = []
    rounds: list[tuple[int, int]] = []
    todo = {
        "a": Timed(run=lambda prepared: ran.append(f"a{prepared}"), prepare=lambda: len(ran)),
        "b": Timed(run=lambda prepared: ran.append("b")),
    }
    spent = in_turn(todo, 2, CPU, on_round=lambda done, of: rounds.append((done, of)))
    assert ran == ["a0", "b", "a2", "b", "a4", "b"]
    assert {name: len(times) for name, times in spent.items()} == {"a": 2, "b": 2}
    assert rounds == [(1, 3), (2, 3), (3, 3)]


def test_what_is_prepared_is_not_timed() -> None:
    todo = {"a": Timed(run=lambda _: None, prepare=lambda: time.sleep(0.05))}
    assert in_turn(todo, 1, CPU)["a"][0] < 0.05


def test_a_spread_is_the_median_and_the_quartiles() -> None:
    assert Quartiles.of([5.0, 1.0, 2.0, 4.0, 3.0]) == Quartiles(median=3, lower=2, upper=4, runs=5)
    assert Quartiles.of([2.0]) == Quartiles(median=2, lower=2, upper=2, runs=1)


def test_the_peak_is_what_is_needed_at_once_not_what_is_left() -> None:
    # in a process of its own: what others have done to the C library's heap would show
    code = (
        "import torch\n"
        "from pnpdepth_cli.pipeline.bench import peak_mb\n"
        "def run():\n"
        "    for _ in range(3):\n"
        "        torch.ones(16_000_000)  # 64 MB each, one at a time\n"
        "print(peak_mb(run, torch.device('cpu')))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "None\n" or 60 < float(done.stdout) < 90
