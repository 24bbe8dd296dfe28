from __future__ import annotations

import csv
import json
import os
import shutil
import threading
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.cli.tables import print_batch
from pnpdepth_cli.commands.batch import reading as batch_reading
from pnpdepth_cli.commands.batch import running as batch_running
from pnpdepth_cli.commands.batch.batch import plan_batch, run_batch
from pnpdepth_cli.commands.batch.request import BatchRequest
from pnpdepth_cli.commands.batch.summary import _SCORES, Tally
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.commands.refinement.refine import refine_image
from pnpdepth_cli.commands.report.batch import BatchReport
from pnpdepth_cli.commands.sparse.options import ScanOptions
from pnpdepth_cli.core.metrics import Scores
from pnpdepth_cli.errors import InputError, LayerError, ModelError, OutputError, UsageError
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.sensors import SamplePattern
from tests.commands.batches import (
    NAMES,
    RecordingListener,
    add_frame,
    batch,
    pairs_on_disk,
    refine_one_by_one,
    refinement,
    results,
    times,
)
from tests.commands.report_pages import frames_of
from tests.commands.scan_frames import scan_on_disk


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive")


def summary(root: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((root / "out" / "summary.json").read_text())
    return content


def test_a_batch_equals_as_many_single_refinements_byte_for_byte(root: Path) -> None:
    batch(root, workers=3, refine={"holdout": 0.3, "seed": 5})
    together = results(root / "out")
    shutil.rmtree(root / "out")
    refine_one_by_one(root, NAMES, holdout=0.3, seed=5)
    assert len(together) == 4 * len(NAMES)
    assert together == results(root / "out")


def test_so_does_a_batch_of_lidar_scans(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", ())
    on_disk = scan_on_disk(root / "net")
    parts = (
        ("image", "rgb", on_disk.image),
        ("sparse", "sparse", on_disk.scan),
        ("gt", "gt", on_disk.gt),
    )
    for _, part, file in (*parts, ("", "calib", on_disk.calib)):
        (root / part).mkdir(exist_ok=True)
        for name in "ab":
            shutil.copy(file, root / part / f"{name}{file.suffix}")
    batch(root, refine={"scan": ScanOptions(max_range=5.6)})
    together = results(root / "out")
    shutil.rmtree(root / "out")
    for name in "ab":
        scan = ScanOptions(calib=root / f"calib/{name}.txt", max_range=5.6)
        files = {p: root / f / f"{name}{file.suffix}" for p, f, file in parts}
        refine_image(refinement(root, output=root / "out", scan=scan, **files))
    assert len(together) == 8
    assert together == results(root / "out")


def test_a_second_run_does_nothing_also_where_files_were_touched_or_moved(root: Path) -> None:
    batch(root)
    os.utime(root / "rgb/a.png", (1, 1))
    os.utime(root / "out/b_depth.png", (1, 1))
    moved = root.rename(root.with_name("moved"))
    before, listener = times(moved / "out"), RecordingListener()
    batch(moved, listener)
    assert (listener.to_do, listener.names) == (0, [])
    assert listener.messages[-1] == "4 frames, all of them done already"
    assert times(moved / "out") == before
    assert [row["name"] for row in summary(moved)["frames"]] == list(NAMES)


def remove_a_result(root: Path) -> None:
    (root / "out/b_preview.png").unlink()


def alter_an_input(root: Path) -> None:
    shutil.copy(root / "rgb/c.png", root / "rgb/b.png")


def add_the_truth(root: Path) -> None:
    shutil.copy(root / "gt/a.png", root / "gt/b.png")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (remove_a_result, "result missing: b_preview.png"),
        (alter_an_input, "input changed: image"),
        (add_the_truth, "other input files"),
    ],
)
def test_only_what_is_missing_or_changed_is_done_again(root: Path, change: Any, why: str) -> None:
    (root / "gt/b.png").unlink()
    batch(root)
    change(root)
    request = BatchRequest(source=root, output=root / "out", refine=refinement(root))
    assert [(p.name, p.why) for p in plan_batch(request, lambda text: None)] == [("b", why)]
    listener = RecordingListener()
    batch(root, listener)
    assert listener.names == ["b"]
    redone = results(root / "out")
    shutil.rmtree(root / "out")
    batch(root)
    assert redone == results(root / "out")


@pytest.mark.parametrize(
    "settings", [{"iterations": 2}, {"holdout": 0.2}, {"format": "exr"}, {"align": "scale"}]
)
def test_other_settings_do_all_again(root: Path, settings: dict[str, Any]) -> None:
    batch(root)
    listener = RecordingListener()
    batch(root, listener, refine=settings)
    assert listener.names == list(NAMES)
    assert "4 to do (4 other settings)" in listener.messages[1]


def test_another_network_in_the_same_file_does_all_again(root: Path) -> None:
    batch(root)
    model = root / "net/my_net.py"
    model.write_text(model.read_text().replace("2 + 3", "2.5 + 3"))
    listener = RecordingListener()
    batch(root, listener)
    assert listener.names == list(NAMES)


def test_a_bad_frame_is_reported_counted_and_skipped(root: Path) -> None:
    good = (root / "rgb/b.png").read_bytes()
    (root / "rgb/b.png").write_bytes(good[:200])
    listener = RecordingListener()
    counts = batch(root, listener).summary["counts"]
    assert (counts["done"], counts["failed"], counts["pending"]) == (3, 1, 0)
    assert [row["status"] for row in listener.rows] == ["done", "failed", "done", "done"]
    assert "b.png: PNG is cut short" in listener.rows[1]["message"]
    assert not list((root / "out").glob("b*_*"))
    (root / "rgb/b.png").write_bytes(good)
    again = RecordingListener()
    counts = batch(root, again).summary["counts"]
    assert again.names == ["b"]
    assert (counts["done"], counts["failed"]) == (4, 0)


def test_the_first_frame_may_be_the_bad_one_and_even_all(root: Path) -> None:
    (root / "rgb/a.png").write_bytes(b"no image")
    assert batch(root).summary["counts"]["done"] == 3
    for name in "bcd":
        (root / f"sparse/{name}.png").write_bytes(b"no depth")
    counts = batch(root, refine={"seed": 1}).summary["counts"]
    assert (counts["done"], counts["failed"]) == (0, 4)


def test_depth_that_does_not_fit_the_format_is_clipped_and_noted(root: Path) -> None:
    model = root / "net/my_net.py"
    far = "(2 + 900 * (rgb[0, 2, 0, 0] < 0.3)) + 3"
    model.write_text(model.read_text().replace("2 + 3", far))
    listener = RecordingListener()
    outcome = batch(root, listener, refine={"iterations": 0})
    assert outcome.summary["counts"]["done"] == 4
    clipped = []
    for name in "abcd":
        notes = json.loads((root / f"out/{name}.json").read_text())["notes"]
        clipped.append(any("pixels clipped to" in note for note in notes))
    assert sum(clipped) == 1


def test_a_divergence_keeps_the_last_good_depth_and_is_counted(root: Path) -> None:
    model = root / "net/my_net.py"
    text = model.read_text()
    formula = "2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))"
    assert formula in text
    exponential = "torch.exp(self.decode(self.middle(self.encode(rgb))))"
    model.write_text(text.replace(formula, exponential))
    outcome = batch(root, refine={"lr": "1e4"})
    assert outcome.summary["counts"]["diverged"] == 4
    assert (read_depth(root / "out/a_depth.png").values > 0).all()
    listener = RecordingListener()
    batch(root, listener, refine={"lr": "1e4"})
    assert listener.names == []


def test_a_mistake_that_concerns_all_frames_stops_the_batch_at_once(root: Path) -> None:
    with pytest.raises(LayerError, match="did you mean middle"):
        batch(root, refine={"layer": "midle"})
    with pytest.raises(UsageError, match="lr must be a step size"):
        batch(root, refine={"lr": "fast"})
    with pytest.raises(UsageError, match="is no scan"):
        batch(root, refine={"scan": ScanOptions(max_range=10)})
    model = root / "net/my_net.py"
    model.write_text(model.read_text() + "\nraise ValueError('no')\n")
    with pytest.raises(ModelError):
        batch(root)


def test_a_network_that_fails_on_one_frame_only_fails_there(root: Path) -> None:
    tall = np.zeros((50, 40, 3), np.uint8)
    add_frame(root, "e", tall)
    for part in ("sparse", "gt"):
        cv2.imwrite(str(root / part / "e.png"), np.full((50, 40), 2000, np.uint16))
    model = root / "net/my_net.py"
    check = "        assert rgb.shape[2] < rgb.shape[3]\n        return"
    model.write_text(model.read_text().replace("        return", check, 1))
    for _ in range(2):  # the second run has nothing but this frame to do
        counts = batch(root, refine={"depth_scale": 1000}).summary["counts"]
        assert (counts["done"], counts["failed"]) == (4, 1)


def test_every_file_without_a_partner_is_reported(root: Path) -> None:
    (root / "sparse/b.png").unlink()
    shutil.copy(root / "gt/a.png", root / "gt/lost.png")
    shutil.copy(root / "sparse/a.png", root / "sparse/spare.png")
    listener = RecordingListener()
    outcome = batch(root, listener)
    assert outcome.summary["counts"]["frames"] == 3
    messages = "\n".join(listener.messages)
    for name in ("rgb/b.png", "gt/lost.png", "sparse/spare.png"):
        assert f"warning: {root / name} has no partner" in messages
    assert len(outcome.summary["unmatched"]) == 3


def test_frames_of_one_stem_in_several_folders_keep_their_folders(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", ("one/a", "two/a", "a"))
    assert batch(root).summary["counts"]["done"] == 3
    for name in ("one/a", "two/a", "a"):
        assert (root / "out" / f"{name}_depth.png").is_file()
    rows = ["image,sparse"] + [f"rgb/{n}.png,sparse/{n}.png" for n in ("one/a", "two/a")]
    (root / "list.csv").write_text("\n".join(rows) + "\n")
    batch(root, source=root / "list.csv", output=root / "listed")
    assert (root / "listed/one/a_depth.png").is_file()


ODD = ("with space", "ümlaut 深度", "new\nline", "-dash", "quote'\"", "perc%ent", "[x]*")


def test_any_name_that_a_file_can_have_will_do(tmp_path: Path) -> None:
    undecodable = os.fsdecode(b"caf\xe9")
    root = pairs_on_disk(tmp_path / "drive", (*ODD, undecodable))
    listener = RecordingListener()
    batch(root, listener)
    assert {row["status"] for row in listener.rows} == {"done"}
    names = sorted((*ODD, undecodable))
    assert sorted(row["name"] for row in summary(root)["frames"]) == names
    with (root / "out/summary.csv").open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(names)
    again = RecordingListener()
    batch(root, again)
    assert again.names == []


def test_links_that_go_round_in_circles_end(root: Path) -> None:
    (root / "rgb/loop").symlink_to(root / "rgb")
    (root / "rgb/self.png").symlink_to(root / "rgb/self.png")
    (root / "sparse/up").symlink_to(root)
    assert batch(root).summary["counts"] == {
        "frames": 4, "done": 4, "diverged": 0, "failed": 0, "pending": 0, "with_warnings": 0,
    }  # fmt: skip


def test_a_folder_that_cannot_be_read_is_reported_and_left_out(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (root / "rgb/locked").mkdir()
    entries = Path.iterdir

    def iterdir(path: Path) -> Iterator[Path]:
        if path.name == "locked":
            raise PermissionError(13, "Permission denied", str(path))
        return entries(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    listener = RecordingListener()
    assert batch(root, listener).summary["counts"]["done"] == 4
    assert any("locked cannot be read (permission denied)" in text for text in listener.messages)


def test_results_inside_the_input_are_never_taken_as_input(root: Path) -> None:
    for output in (root / "rgb" / "out", root / "gt" / "deep" / "out"):
        batch(root, output=output, refine={"format": "exr"})
        listener = RecordingListener()
        outcome = batch(root, listener, output=output)
        assert listener.names == list(NAMES)
        assert outcome.summary["unmatched"] == []
        shutil.rmtree(output)


@pytest.mark.parametrize("output", [".", "rgb", ".."])
def test_an_output_folder_that_holds_the_frames_is_refused(root: Path, output: str) -> None:
    with pytest.raises(OutputError, match="holds the frames themselves"):
        batch(root, output=root / output)
    assert not list(root.rglob("batch.jsonl"))


@pytest.mark.parametrize("name", ["c.json", "c_depth.png", "summary.csv", "summary.json"])
def test_what_no_batch_made_is_not_replaced_unless_asked_for(name: str, root: Path) -> None:
    (root / "out").mkdir()
    (root / "out" / name).write_text("mine")
    with pytest.raises(OutputError, match=rf"{name} exists, and no batch wrote it; --overwrite"):
        batch(root)
    assert [p.name for p in (root / "out").iterdir() if p.suffix != ".lock"] == [name]
    assert (root / "out" / name).read_text() == "mine"
    batch(root, refine={"overwrite": True})
    batch(root)  # it is the batch's own now
    assert (root / "out" / name).read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("../up", "leads out of the output folder"),
        ("/up", "leads out of the output folder"),
        ("summary", "needs a file of the batch's own"),
        ("summary.csv/x", "needs a file of the batch's own"),
        (".batch.lock/x", "needs a file of the batch's own"),
        ("fine\u0301", "is that of another frame"),
        ("ok_depth.png/x", "needs a file of frame 'ok'"),
        ("ok.json/deep/x", "needs a file of frame 'ok'"),
        ("ok_sigma", "needs a file of frame 'ok'"),
    ],
)
def test_a_name_without_files_of_its_own_is_a_failed_frame_in_plan_and_run(
    root: Path, name: str, why: str
) -> None:
    names = ("ok", "fin\u00e9", name)
    rows = [f'rgb/a.png,sparse/a.png,"{each}"' for each in names]
    (root / "list.csv").write_text("\n".join(["image,sparse,name", *rows]), encoding="utf-8")
    request = BatchRequest(
        source=root / "list.csv",
        output=root / "out",
        refine=refinement(root, uncertainty=True, iterations=0),
    )
    said: list[str] = []
    assert [each.name for each in plan_batch(request, said.append)] == ["ok", "fin\u00e9"]
    assert sum(f"{why}; rename it" in line for line in said) == 1
    listener = RecordingListener()
    counts = run_batch(request, listener).summary["counts"]
    assert (counts["frames"], counts["done"], counts["failed"], counts["pending"]) == (3, 2, 1, 0)
    assert [row["status"] for row in listener.rows] == ["done", "done"]
    assert not (root / "up_depth.png").exists()
    assert {row["name"]: row["message"] for row in summary(root)["frames"]}[name].count(why) == 1


def test_a_listed_file_that_is_not_there_is_a_failed_frame(root: Path) -> None:
    (root / "list.csv").write_text("image,sparse\nrgb/a.png,sparse/a.png\nno.png,sparse/b.png\n")
    listener = RecordingListener()
    counts = batch(root, listener, source=root / "list.csv").summary["counts"]
    assert (counts["done"], counts["failed"]) == (1, 1)
    assert any("no.png does not exist; correct line 3" in text for text in listener.messages)


def test_shards_share_a_folder_without_overlap_and_the_limit_comes_first(root: Path) -> None:
    parts = []
    for number in (1, 2, 3):
        listener = RecordingListener()
        outcome = batch(root, listener, shard=(number, 3))
        parts.append(listener.names)
    assert parts == [["a", "d"], ["b"], ["c"]]
    assert outcome.summary["counts"]["done"] == 4
    listener = RecordingListener()
    batch(root, listener)
    assert listener.names == []
    listener = RecordingListener()
    outcome = batch(root, listener, limit=3, shard=(2, 2), output=root / "few")
    assert listener.names == ["b"]
    assert outcome.summary["counts"]["pending"] == 3


def test_the_summary_has_the_means_of_its_rows_and_all_earlier_frames(root: Path) -> None:
    batch(root, limit=2, refine={"holdout": 0.2})
    outcome = batch(root, refine={"holdout": 0.2})
    content = summary(root)
    rows = content.pop("frames")
    assert content == json.loads(json.dumps(outcome.summary))
    assert [row["name"] for row in rows] == list(NAMES)
    for kind in ("sparse_error", "held_out_error", "scores"):
        assert content["mean"][kind]["frames"] == 4
        for stage in ("before", "after"):
            for measure, mean in content["mean"][kind][stage].items():
                values = [row[kind][stage][measure] for row in rows]
                assert mean == pytest.approx(np.mean(values), rel=1e-12)
    record = json.loads((root / "out/b.json").read_text())
    row = rows[1]
    assert row["scores"] == record["scores"]
    assert row["seconds"].keys() == {"read", "refine", "write"}
    assert row["inputs"] == {p: record["inputs"][p]["path"] for p in ("image", "sparse", "gt")}
    assert all((root / "out" / path).is_file() for path in row["outputs"].values())
    with (root / "out/summary.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [line["name"] for line in table] == list(NAMES)
    assert float(table[1]["rmse_after"]) == row["scores"]["after"]["rmse"]
    assert float(table[1]["held_out_error_mae_before"]) == row["held_out_error"]["before"]["mae"]


def test_the_table_has_every_score() -> None:
    assert set(_SCORES) == set(Scores.__dataclass_fields__) - {"pixels"}


def test_a_batch_can_be_stopped_between_frames_and_goes_on(root: Path) -> None:
    stops = iter([False, False, True])
    listener = RecordingListener()
    outcome = batch(root, listener, stopped=lambda: next(stops))
    assert outcome.stopped
    assert listener.names == ["a", "b"]
    assert outcome.summary["counts"]["pending"] == 2
    again = RecordingListener()
    assert not batch(root, again).stopped
    assert again.names == ["c", "d"]


def test_frames_without_sparse_depth_need_to_be_sampled(root: Path, tmp_path: Path) -> None:
    kitchen = tmp_path / "kitchen"
    kitchen.mkdir()
    shutil.copytree(root / "net", kitchen / "net")
    for name in NAMES:
        shutil.copy(root / f"rgb/{name}.png", kitchen / f"frame-{name}.color.png")
        shutil.copy(root / f"gt/{name}.png", kitchen / f"frame-{name}.depth.png")
    with pytest.raises(UsageError, match="'7scenes', which has no sparse depth; --sample 500"):
        batch(kitchen)
    outcome = batch(kitchen, refine={"sample": SamplePattern(kind="uniform", count=50)})
    assert outcome.summary["counts"]["done"] == 4
    record = json.loads((kitchen / "out/frame-a.json").read_text())
    assert record["points"]["used"] == 50
    assert record["inputs"]["sparse"]["count"] == 50
    outcome = batch(kitchen, refine={"sample": SamplePattern(kind="uniform", count=10**6)})
    assert outcome.summary["counts"]["failed"] == 4


def test_a_protocol_cuts_image_points_and_truth_alike(root: Path) -> None:
    (root / "list.csv").write_text(
        "image,sparse,gt,protocol\nrgb/a.png,sparse/a.png,gt/a.png,nyu\n"
    )
    size = (2 * 228, 2 * 304)
    image = np.zeros((*size, 3), np.uint8)
    depth = np.zeros(size, np.uint16)
    depth[101:300:7, 50:500:9] = 2000 + np.arange(50)
    cv2.imwrite(str(root / "rgb/a.png"), image)
    for part in ("sparse", "gt"):
        cv2.imwrite(str(root / part / "a.png"), depth)
    options = {"iterations": 0, "depth_scale": 1000.0}
    batch(root, source=root / "list.csv", refine=options)
    assert read_depth(root / "out/a_depth.png").values.shape == (228, 304)
    record = json.loads((root / "out/a.json").read_text())
    assert record["size"] == [304, 228]
    assert record["points"]["used"] == np.count_nonzero(depth)
    batch(root, source=root / "list.csv", refine=options, protocol="whole")
    assert read_depth(root / "out/a_depth.png").values.shape == size


def test_an_empty_folder_is_an_error_that_names_the_layouts(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"any layout; layouts need: nyu-mat .*; pairs rgb, sparse"
    ):
        batch(tmp_path)
    for part in ("rgb", "sparse"):
        (tmp_path / part).mkdir()
    with pytest.raises(InputError, match=r"has no frame in it; layouts are manifest, .*pairs"):
        batch(tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "changes",
    [{"workers": 0}, {"batch_size": 0}, {"limit": 0}, {"shard": (3, 2)}, {"shard": (0, 2)}],
)
def test_numbers_that_make_no_sense_are_refused(root: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        batch(root, **changes)


@pytest.mark.parametrize(("batch_size", "most_allowed"), [(1, 6), (3, 6 + 3 * 3)])
def test_only_a_few_frames_are_in_memory_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch_size: int, most_allowed: int
) -> None:
    root = pairs_on_disk(tmp_path / "drive", tuple(f"{i:02}" for i in range(16)), gt=False)
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    most = 0

    def watched(request: Any) -> Any:
        nonlocal most
        inputs = read_inputs(request)
        alive.add(inputs.points.xy)
        most = max(most, len(alive))
        return inputs

    monkeypatch.setattr(batch_reading, "read_inputs", watched)
    batch(root, workers=1, batch_size=batch_size)
    assert most <= most_allowed


def test_reading_and_writing_go_on_while_the_network_runs(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: set[str] = set()
    second_is_read, second_is_refined = threading.Event(), threading.Event()
    refined = 0
    refine, write = Refiner.refine_frame, batch_running.write_refined

    def reading(request: Any) -> Any:
        read.add(str(request.files.image))
        if len(read) == 2:
            second_is_read.set()
        return read_inputs(request)

    def refining(self: Refiner, inputs: Any) -> Any:
        nonlocal refined
        assert threading.current_thread() is threading.main_thread()
        assert second_is_read.wait(60), "the second frame is not read while the first is refined"
        refined += 1
        if refined == 2:
            second_is_refined.set()
        return refine(self, inputs)

    def writing(*arguments: Any) -> Any:
        assert second_is_refined.wait(60), "the second frame waits until the first is written"
        return write(*arguments)

    monkeypatch.setattr(batch_reading, "read_inputs", reading)
    monkeypatch.setattr(batch_running, "write_refined", writing)
    monkeypatch.setattr(Refiner, "refine_frame", refining)
    assert batch(root, workers=1).summary["counts"]["done"] == 4


def test_frames_in_hdf5_files_are_cut_sampled_and_known_by_their_file(
    root: Path, tmp_path: Path
) -> None:
    h5py = pytest.importorskip("h5py")
    rooms = tmp_path / "rooms"
    (rooms / "official").mkdir(parents=True)
    shutil.copytree(root / "net", rooms / "net")
    x = np.linspace(0, 1, 640, dtype=np.float32)
    for number in (1, 2):
        with h5py.File(rooms / "official" / f"{number:05}.h5", "w") as file:
            file["rgb"] = np.full((3, 480, 640), 50 * number, np.uint8)
            file["depth"] = np.tile(1 + number + x, (480, 1))
    options = {"sample": SamplePattern(kind="uniform", count=100), "iterations": 1}
    listener = RecordingListener()
    batch(rooms, listener, refine=options)
    assert listener.names == ["official_00001", "official_00002"]
    assert any("protocol: nyu cuts the frames" in text for text in listener.messages)
    record = json.loads((rooms / "out/official_00002.json").read_text())
    assert record["size"] == [304, 228]
    assert record["points"]["used"] == 100
    assert record["scores"]["after"]["pixels"] == 304 * 228
    again = RecordingListener()
    batch(rooms, again, refine=options)
    assert again.names == []


def test_a_plain_prediction_without_scores_ends_no_batch(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batch(root, html=tmp_path / "report")
    summary = json.loads((root / "out" / "summary.json").read_text())
    tally = Tally()
    for row in summary["frames"]:
        # what a record holds where no pixel of the plain prediction can be scored
        row["scores"]["before"] |= dict.fromkeys(_SCORES) | {"pixels": 0}
        tally.add(row)
    mean = tally.mean()
    assert mean["scores"]["before"]["rmse"] is None
    assert mean["scores"]["after"]["rmse"] > 0
    capsys.readouterr()
    print_batch(summary | {"mean": mean})
    assert "–" in capsys.readouterr().err
    report = BatchReport(folder=tmp_path / "report", output=root / "out")
    report.write(summary | {"mean": mean}, lambda: summary["frames"])
    assert frames_of(tmp_path / "report")["a"]["values"]["rmse_before"] is None


def test_baselines_are_in_the_summary_the_table_the_csv_and_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, report = pairs_on_disk(tmp_path / "drive", ("a", "b")), tmp_path / "report"
    outcome = batch(root, refine={"baselines": True}, html=report)
    summary = json.loads((root / "out" / "summary.json").read_text())
    rows = summary["frames"]
    names = list(rows[0]["baselines"])
    assert {"linear", "network", "result"} <= set(names)
    mean = summary["baselines"]["linear"]
    per_frame = [row["baselines"]["linear"] for row in rows]
    assert mean["frames"] == 2
    assert mean["mae"] == pytest.approx(np.mean([each["scores"]["mae"] for each in per_frame]))
    assert mean["held_out_mae"] == pytest.approx(
        np.mean([each["held_out_mae"] for each in per_frame])
    )
    with (root / "out" / "summary.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["baseline_linear_mae"]) for line in lines] == [
        each["scores"]["mae"] for each in per_frame
    ]
    print_batch(outcome.summary)
    assert "against every simple baseline" in capsys.readouterr().err
    assert "Simple baselines: means over frames" in (report / "index.html").read_text()


def test_a_formula_as_a_name_is_text_in_the_summary(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive", ("=1+1", "@b"))
    batch(root)
    with (root / "out/summary.csv").open(newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == ["'=1+1", "'@b"]


def test_an_unsure_guess_of_the_input_range_is_repeated_at_the_end(root: Path) -> None:
    batch(root, limit=2)
    note = "input: rgb range 'unit', unsure (error after alignment: unit 9.0%, imagenet 9.1%)"
    for name in "ab":
        path = root / "out" / f"{name}.json"
        record = json.loads(path.read_text())
        path.write_text(json.dumps(record | {"notes": [*record["notes"], note]}))
    listener = RecordingListener()
    assert batch(root, listener, limit=2).summary["unsure"] == [note]
    assert listener.messages[-1] == f"warning: {note}"
