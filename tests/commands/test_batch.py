from __future__ import annotations

import csv
import json
import os
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pnpdepth_cli.choices import BASELINES
from pnpdepth_cli.commands.many_frames.find_frames import find_frames
from pnpdepth_cli.commands.many_frames.summary import BatchSummary, write_summary
from pnpdepth_cli.commands.refine import refine_image
from pnpdepth_cli.commands.requests.batch_request import BatchRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord, Scores
from pnpdepth_cli.errors import InputError, OutputError, UsageError
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.file_bytes import plain
from tests.builders import result_record
from tests.commands.batches import (
    NAMES,
    Recorder,
    add_frame,
    batch,
    done,
    pairs_on_disk,
    refinement,
    results,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive")


def summary(root: Path) -> Any:
    return json.loads((root / "out" / "summary.json").read_text())


def rows_of(root: Path) -> list[dict[str, str]]:
    """The rows of summary.csv."""
    with (root / "out/summary.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_second_run_does_nothing_and_a_batch_equals_single_refinements(root: Path) -> None:
    refine = {"holdout": 0.3, "seed": 5}
    batch(root, refine=refine)
    os.utime(root / "rgb/a.png", (1, 1))  # that a file was touched or moved does not matter
    os.utime(root / "out/b_depth.png", (1, 1))
    moved = root.rename(root.with_name("moved"))
    together = results(moved / "out")
    listener = Recorder()
    before = {path: path.stat().st_mtime_ns for path in (moved / "out").glob("[a-d]*")}
    assert done(moved, listener, refine=refine) == []
    assert listener.messages[-1] == "4 frames, all of them done already"
    assert {path: path.stat().st_mtime_ns for path in before} == before
    moved.rename(root)
    shutil.rmtree(root / "out")
    for name in NAMES:
        folders = {"image": "rgb", "sparse": "sparse", "gt": "gt"}
        files = {kind: root / folder / f"{name}.png" for kind, folder in folders.items()}
        refine_image(refinement(root, output=root / "out", **files, **refine))
    assert len(together) == 4 * len(NAMES)
    assert together == results(root / "out")


def test_only_what_is_missing_or_changed_is_done_again_as_by_one_run(root: Path) -> None:
    (root / "gt/b.png").unlink()
    batch(root)
    for source, changed, why in (
        (None, "out/b_depth.png", "result missing"),
        ("rgb/c.png", "rgb/b.png", "input changed"),
        ("gt/a.png", "gt/b.png", "other input files"),
        ("rgb/c.png", "out/b.json", "record damaged"),
        (None, "out/b.json", "interrupted"),
    ):
        (root / changed).unlink(missing_ok=True)
        if source:
            shutil.copy(root / source, root / changed)
        listener = Recorder()
        assert done(root, listener) == ["b"]
        assert f"1 to do (1 {why})" in " ".join(listener.messages)
    # Files of a run with other options do not stay beside new ones.
    batch(root, refine={"uncertainty": True, "format": "exr"})
    (root / "out/a_mine.png").write_bytes(b"the user's own")
    batch(root)
    redone = results(root / "out")
    shutil.rmtree(root / "out")
    batch(root)
    assert redone == results(root / "out") | {"a_mine.png": b"the user's own"}


def test_other_settings_weights_or_code_in_the_same_file_do_all_again(root: Path) -> None:
    loss, code = root / "mine.py", root / "net/my_net.py"
    loss.write_text("def loss(one, other):\n    return (one - other).abs().mean()")
    own = load_file(root / "net/my_net.safetensors")
    torch.save({"model": own, "ema": own}, root / "w.pt")
    refine: dict[str, Any] = {}
    for change in (
        lambda: refine.update(normalise="bytes"),
        lambda: refine.update(loss=str(loss)),
        lambda: edit(loss, ".abs()", "**2"),
        lambda: edit(code, "2 + 3", "2.5 + 3"),
        lambda: refine.update(checkpoint=root / "w.pt"),
        lambda: refine.update(checkpoint=root / "w.pt:ema"),
    ):
        change()
        assert done(root, limit=1, refine=refine) == ["a"]
    assert done(root, limit=1, refine=refine) == []


def test_a_bad_frame_is_reported_counted_skipped_and_done_when_it_is_mended(root: Path) -> None:
    good = (root / "rgb/b.png").read_bytes()
    (root / "rgb/b.png").write_bytes(good[:200])
    listener = Recorder()
    counts = batch(root, listener).counts
    assert (counts["done"], counts["failed"], counts["pending"]) == (3, 1, 0)
    assert "b.png" in (listener.records[1].message or "")
    assert not list((root / "out").glob("b*_*"))
    (root / "rgb/b.png").write_bytes(good)
    assert done(root) == ["b"]
    for name in NAMES:  # even all
        (root / f"sparse/{name}.png").write_bytes(b"no depth")
    assert batch(root).counts["failed"] == 4


ODD = ("with space", "ümlaut 深度", "new\nline", "-dash", "quote'\"", "perc%ent", "[x]*", "=1+1")


def test_any_name_that_a_file_can_have_will_do(tmp_path: Path) -> None:
    names = sorted((*ODD, os.fsdecode(b"caf\xe9"), "one/a", "two/a", "a"))
    root = pairs_on_disk(tmp_path / "drive", tuple(names))
    assert batch(root).counts["done"] == len(names)
    assert all((root / "out" / f"{name}_depth.png").is_file() for name in names)
    assert sorted(row["name"] for row in summary(root)["frames"]) == names
    assert len(rows_of(root)) == len(names)
    assert done(root) == []


def test_results_inside_are_no_frames_and_what_holds_the_frames_is_no_output(root: Path) -> None:
    output = root / "gt" / "deep" / "out"
    batch(root, output=output, refine={"format": "exr"})
    assert done(root, output=output) == list(NAMES)
    assert summary(root / "gt/deep")["unmatched"] == []
    for bad in (".", "rgb", "..", "rgb/a.png"):
        with pytest.raises(OutputError):
            batch(root, output=root / bad)
    shutil.rmtree(root / "rgb")
    (root / "rgb").mkdir()
    with pytest.raises(InputError, match="no frame"):
        batch(root)


@pytest.mark.parametrize("name", ["c.json", "c_depth.png", "summary.csv"])
def test_what_no_batch_made_is_not_replaced_unless_asked_for(name: str, root: Path) -> None:
    (root / "out").mkdir()
    (root / "out" / name).write_text("mine")
    for _ in range(2):  # a refused run does not make the folder a batch's own
        with pytest.raises(OutputError, match=rf"{name} exists, and no batch wrote it; --over"):
            batch(root)
    assert [path.read_text() for path in (root / "out").iterdir()] == ["mine"]
    batch(root, refine={"overwrite": True})
    batch(root)  # it is the batch's own now
    assert (root / "out" / name).read_bytes() != b"mine"


@pytest.mark.parametrize(
    "name", ["../up", "/up", ".batch.lock/x", "summary", "fine\u0301", "ok_view", "ok_depth.png/x"]
)
def test_a_name_without_files_of_its_own_is_refused(root: Path, name: str) -> None:
    names = ["ok", "fin\u00e9", name]
    rows = [f'rgb/a.png,sparse/a.png,"{listed}"' for listed in names]
    (root / "list.csv").write_text("\n".join(["image,sparse,name", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(repr(name))):
        batch(root, source=root / "list.csv", html=root / "report", html_3d=True)
    assert not (root / "out").exists()


def test_shards_share_a_folder_without_overlap_and_the_limit_comes_first(root: Path) -> None:
    (root / "sparse/a.png").write_bytes(b"no depth")
    assert [done(root, shard=(number, 3)) for number in (1, 2, 3)] == [["a", "d"], ["b"], ["c"]]
    counts = summary(root)["counts"]
    assert (counts["done"], counts["failed"], counts["pending"]) == (3, 1, 0)
    assert batch(root, limit=3, shard=(2, 2), output=root / "few").counts["pending"] == 3
    assert [path.name for path in (root / "few").glob("*_depth.png")] == ["b_depth.png"]


def test_frames_are_chosen_by_name_step_and_number_measures_by_columns(root: Path) -> None:
    assert done(root, names="[b-d]", every=2) == ["b", "d"]
    assert done(root, names="[a-c]", every=2, limit=1, columns=("delta1", "mae")) == ["a"]
    assert summary(root)["counts"]["pending"] == 1
    header = [*rows_of(root)[0]]
    assert header[6:8] == ["delta1_before", "mae_before"]
    assert "rmse" not in " ".join(header)
    for mistake in ({"names": "A*"}, {"columns": ("mse",)}):
        with pytest.raises(UsageError, match=r"A\*|--columns"):
            batch(root, **mistake)


def test_a_least_confidence_is_for_frames_with_a_mask_and_none_of_their_own(root: Path) -> None:
    rows = ("sparse/a.png,1", "sparse/b.png,", ",")
    lines = ["image,sparse,sparse_mask,min_confidence"]
    lines += [f"rgb/{n}.png,sparse/{n}.png,{row}" for n, row in zip("abc", rows, strict=True)]
    (root / "list.csv").write_text("\n".join(lines))
    refine = refinement(root, min_confidence=2.0)
    request = BatchRequest(source=root / "list.csv", output=root / "out", refine=refine)
    assert [frame.min_confidence for frame in find_frames(request).frames] == [1, 2, None]
    with pytest.raises(UsageError, match="--min-confidence"):
        find_frames(replace(request, source=root))


def test_a_folder_of_depth_maps_takes_the_place_of_a_network(root: Path) -> None:
    (root / "maps").mkdir()
    for name in "abc":
        truth = read_depth(root / f"gt/{name}.png").values
        np.save(root / f"maps/{name}.npy", 0.5 + 2 / truth)
    refine = {"method": "alone", "model": "compact", "checkpoint": None}
    with pytest.raises(InputError, match="named d"):
        batch(root, depth=root / "maps", refine=refine)
    summary = batch(root, depth=root / "maps", names="[abc]", refine=refine)
    assert summary.counts["done"] == 3
    assert {*summary.weights} == {"depth map"}
    assert summary.errors["ground_truth"]["after"]["mae"] < 0.02


def test_a_stopped_batch_goes_on_without_what_a_kill_left(root: Path) -> None:
    stops = iter([False, False, True, True])
    assert batch(root, Recorder(lambda: next(stops))).counts["pending"] == 2
    (root / "out" / "deep").mkdir()
    for folder in ("out", "out/deep"):
        (root / folder / ".0123456789ab").write_bytes(b"half")
    listener = Recorder()
    assert done(root, listener) == ["c", "d"]
    assert "removed 2 half-written files of a run that was killed" in listener.messages
    assert not list(root.rglob(".0123456789ab"))


def test_frames_on_which_a_network_diverges_are_counted_and_not_done_again(root: Path) -> None:
    formula = "2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))"
    edit(root / "net/my_net.py", formula, "torch.exp(self.decode(self.middle(self.encode(rgb))))")
    summary = batch(root, refine={"lr": "1e4"})
    assert summary.counts["diverged"] == 4
    assert summary.titles["after"] == "tiny"  # of the updates asked for, none is in the depth
    assert done(root, refine={"lr": "1e4"}) == []
    assert (read_depth(root / "out/a_depth.png").values > 0).all()


class Summarised(NamedTuple):
    """A batch in two runs: what the last one returned, both files of it, and what was said."""

    result: BatchSummary
    content: dict[str, Any]
    table: list[dict[str, str]]
    messages: list[str]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The frames of summary.json."""
        return list(self.content["frames"])


@pytest.fixture(scope="module")
def summarised(tmp_path_factory: pytest.TempPathFactory) -> Summarised:
    """Four frames, and seven images that are of no frame."""
    root = pairs_on_disk(tmp_path_factory.mktemp("summarised") / "drive")
    for number in range(7):
        shutil.copy(root / "rgb/a.png", root / f"rgb/x{number}.png")
    listener = Recorder()
    refine = {"holdout": 0.2, "baselines": True}
    batch(root, listener, limit=2, refine=refine)
    result = batch(root, refine=refine)
    return Summarised(result, summary(root), rows_of(root), listener.messages)


def test_the_summary_is_what_the_batch_returns_with_the_frames_of_all_runs(
    summarised: Summarised,
) -> None:
    content = {key: value for key, value in summarised.content.items() if key != "frames"}
    assert content == plain(asdict(summarised.result))
    assert [row["name"] for row in summarised.rows] == list(NAMES)


def test_the_table_of_the_summary_has_its_rows(summarised: Summarised) -> None:
    second = summarised.rows[1]
    assert [line["name"] for line in summarised.table] == list(NAMES)
    after = second["errors"]["ground_truth"]["after"]
    assert float(summarised.table[1]["rmse_after"]) == after["rmse"]


def test_the_summary_has_the_errors_of_every_stage_at_all_points(summarised: Summarised) -> None:
    errors = summarised.content["errors"]
    assert errors.keys() == {"ground_truth", "held_out", "validation", "used"}
    for basis, stages in errors.items():
        assert {"before", "after"} <= stages.keys()
        assert basis not in ("ground_truth", "validation") or {*BASELINES} <= stages.keys()


def test_an_error_of_the_summary_is_the_mean_of_its_rows(summarised: Summarised) -> None:
    for basis, stages in summarised.content["errors"].items():
        for stage, means in stages.items():
            assert means["frames"] == 4
            for measure in means.keys() - {"frames"}:
                values = [row["errors"][basis][stage][measure] for row in summarised.rows]
                assert means[measure] == pytest.approx(np.mean(values), rel=1e-12)


def test_files_of_no_frame_are_all_in_the_summary_and_five_are_named(
    summarised: Summarised,
) -> None:
    assert len(summarised.content["unmatched"]) == 7
    assert sum("rgb/x" in text for text in summarised.messages) == 5


def test_the_summary_counts_weights_notes_and_frames_that_are_independent(root: Path) -> None:
    after: Scores = {"rmse": 1.0, "mae": 1.0, "mre": 0.1, "delta1": 0.9}
    unknown = dict.fromkeys(after)  # where no pixel of the plain prediction can be scored
    kinds = ("warning: {} of 9,000 pixels clipped", "note: {} % sky", "input: unit, unsure ({})")
    records = [
        FrameRecord(
            name=f"{'ab'[number % 2]}/{number:04}",
            errors={"ground_truth": {"before": unknown, "after": after}},
            notes=[*(kind.format(number) for kind in kinds), "gt: 5 pixels"],
            result=result_record("net", "compact", weights={"net": weight}),
        )
        for number, weight in enumerate((0.1, 0.4, 0.1, 0.2))
    ]
    (root / "out").mkdir()
    request = BatchRequest(source=root, output=root / "out", refine=refinement(root))
    told = write_summary(request, find_frames(request), {}, records)
    assert told.errors["ground_truth"]["before"]["rmse"] is None
    assert told.errors["ground_truth"]["after"]["rmse"] == 1
    assert told.weights == {"net": {"mean": pytest.approx(0.2), "least": 0.1, "largest": 0.4}}
    names = [record.name for record in records]
    of_first = f" (numbers of {names[0]})"
    assert told.frame_notes == {kind.format(0) + of_first: names for kind in kinds}
    assert ["4 frames count as 2 groups of frames" in note for note in told.notes] == [True]


def test_mean_weights_add_up_where_a_frame_lacks_a_network(root: Path) -> None:
    weights: list[dict[str, float]] = [
        {"net": 0.5, "compact": 0.5},
        {"compact": 0.9, "linear": 0.1},
        {"net": 0.2, "compact": 0.8},
        {},  # of a method without weights
    ]
    records = [
        FrameRecord(
            name=f"{number}",
            errors={"ground_truth": {"before": {"mae": 1.0}, "after": {"mae": 2.0}}},
            result=result_record("net", "compact", weights=of_frame),
        )
        for number, of_frame in enumerate(weights)
    ]
    (root / "out").mkdir()
    request = BatchRequest(source=root, output=root / "out", refine=refinement(root))
    told = write_summary(request, find_frames(request), {}, records)
    means = {name: spread["mean"] for name, spread in told.weights.items()}
    assert means == pytest.approx({"net": 0.7 / 3, "compact": 2.2 / 3, "linear": 0.1 / 3})
    assert sum(means.values()) == pytest.approx(1)
    assert told.weights["net"]["least"] == 0
    assert told.titles["after"] == "fused (net 23%, compact 73%, linear 3%)"


def test_results_are_not_written_through_a_planted_link(root: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    add_frame(root, "room/e")
    batch(root, limit=1)
    (root / "out/room").symlink_to(tmp_path / "elsewhere")
    (root / "out/b_depth.png").symlink_to(tmp_path / "elsewhere/stolen.png")
    with pytest.raises(OutputError):
        batch(root)
    assert list((tmp_path / "elsewhere").iterdir()) == []
