"""Frames that go through the network together, against one at a time."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from pnpdepth_cli.errors import DeviceError, StorageError
from pnpdepth_cli.pipeline.batch import groups as batch_groups
from pnpdepth_cli.pipeline.batch import resolving
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from tests.pipeline.batches import (
    RecordingListener,
    add_frame,
    batch,
    pairs_on_disk,
    refine_one_by_one,
    results,
)
from tests.pipeline.frames import NETWORK

NAMES = tuple("abcdefgh")
FORMULA = "2 + 3 * self.decode(torch.tanh(self.middle(self.encode(rgb))))"
assert FORMULA in NETWORK


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive", NAMES)


@pytest.fixture
def plain_convolutions() -> Iterator[None]:
    """Torch convolves frame by frame, so together gives the bits of one at a time."""
    torch._C._set_mkldnn_enabled(False)  # the public switch sets, and warns of, more than this
    yield
    torch._C._set_mkldnn_enabled(True)


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many frames went together each time, trials included."""
    sizes: list[int] = []
    refine_together = Refiner.refine_together

    def counted(refiner: Refiner, split: Any, group: Any, settings: Any) -> Any:
        sizes.append(len(group))
        return refine_together(refiner, split, group, settings)

    monkeypatch.setattr(Refiner, "refine_together", counted)
    return sizes


def small_frame(root: Path, name: str, size: tuple[int, int] = (20, 33)) -> None:
    add_frame(root, name, np.full((*size, 3), 90, np.uint8))
    for part in ("sparse", "gt"):
        cv2.imwrite(str(root / part / f"{name}.png"), np.full(size, 2000, np.uint16))


def paint_in_shades(root: Path) -> None:
    """The images differ in their means."""
    for number, name in enumerate(NAMES):
        cv2.imwrite(str(root / f"rgb/{name}.png"), np.full((46, 62, 3), 20 * number, np.uint8))


def change_network(root: Path, *changes: tuple[str, str]) -> None:
    model = root / "net/my_net.py"
    text = model.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    model.write_text(text)


def alone(root: Path, **refine: Any) -> dict[str, Any]:
    """What a batch gives that takes one frame at a time; the output folder is new."""
    shutil.rmtree(root / "out", ignore_errors=True)
    batch(root, batch_size=1, refine=refine)
    return results(root / "out")


@pytest.mark.usefixtures("plain_convolutions")
@pytest.mark.parametrize(("size", "groups"), [(2, [2] * 5), (3, [3] * 3)])
def test_groups_equal_as_many_single_refinements_byte_for_byte(
    root: Path, passes: list[int], size: int, groups: list[int]
) -> None:
    listener = RecordingListener()
    batch(root, listener, batch_size=size, refine={"holdout": 0.3, "seed": 5})
    assert passes == groups  # two of them the trial's
    assert any("equal bit for bit" in text for text in listener.messages)
    assert listener.names == list(NAMES)
    together = results(root / "out")
    shutil.rmtree(root / "out")
    refine_one_by_one(root, NAMES, holdout=0.3, seed=5)
    assert len(together) == 4 * len(NAMES)
    assert together == results(root / "out")


@pytest.mark.usefixtures("plain_convolutions")
def test_other_sizes_and_bad_frames_between_them_change_nothing(
    root: Path, passes: list[int]
) -> None:
    (root / "rgb/d.png").write_bytes(b"no image")
    for name in ("e2", "x", "y", "z"):
        small_frame(root, name)
    add_frame(root, "zz")
    listener = RecordingListener()
    batch(root, listener, batch_size=2)
    # a b tried; c, a bad one and e go together; the small e2; f g, h alone; x y tried; then z, zz
    assert passes == [2, 2, 2, 2, 2, 2]
    bad = [row["name"] for row in listener.rows if row["status"] == "failed"]
    assert bad == ["d"]
    assert listener.names == [*"abcde", "e2", *"fghxyz", "zz"]
    together = results(root / "out")
    assert together == alone(root)


@pytest.mark.usefixtures("plain_convolutions")
def test_a_frame_whose_points_the_network_does_not_see_leaves_the_others_as_they_are(
    root: Path, passes: list[int]
) -> None:
    change_network(root, ("Multiple(4)", 'Fixed(32, 32, fit="crop")'), ("Multiple,", "Fixed,"))
    left = np.zeros((46, 62), np.uint16)
    left[10, 1] = left[20, 2] = 2000
    cv2.imwrite(str(root / "sparse/f.png"), left)
    listener = RecordingListener()
    batch(root, listener, batch_size=4)
    assert passes == [4, 4, 4]
    (failed,) = [row for row in listener.rows if row["status"] == "failed"]
    assert failed["name"] == "f"
    assert "none of the 2 sparse points" in failed["message"]
    together = results(root / "out")
    assert len(together) == 4 * 7
    assert together == alone(root)


@pytest.mark.usefixtures("plain_convolutions")
def test_a_diverging_frame_in_a_group_leaves_the_others_as_they_are(
    root: Path, passes: list[int]
) -> None:
    change_network(
        root,
        ("        return " + FORMULA,
         "        gain = torch.where(rgb.mean((1, 2, 3), keepdim=True) > 0.9, 1.0, 1e-6)\n"
         "        return torch.exp(gain * self.decode(self.middle(self.encode(rgb))))"),
    )  # fmt: skip
    cv2.imwrite(str(root / "rgb/f.png"), np.full((46, 62, 3), 255, np.uint8))
    listener = RecordingListener()
    batch(root, listener, batch_size=4, refine={"lr": "1e4"})
    assert passes == [4, 4, 4]
    states = {row["name"]: row["status"] for row in listener.rows}
    assert states == {name: "diverged" if name == "f" else "done" for name in NAMES}
    together = results(root / "out")
    assert together == alone(root, lr="1e4")


@pytest.mark.usefixtures("plain_convolutions")
def test_a_batch_stopped_among_groups_goes_on_to_the_same_results(root: Path) -> None:
    stops = iter([False, False, False, True])
    listener = RecordingListener()
    assert batch(root, listener, batch_size=2, stopped=lambda: next(stops)).stopped
    assert listener.names == ["a", "b", "c", "d"]
    (root / "out/b_depth.png").unlink()
    again = RecordingListener()
    batch(root, again, batch_size=2)
    assert again.names == ["b", "e", "f", "g", "h"]
    together = results(root / "out")
    assert together == alone(root)


def test_what_auto_does_never_shows_in_the_results(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_groups, "_MAX_FRAMES", 3)
    listener = RecordingListener()
    batch(root, listener, refine={"lr": "5%"})
    assert sum("batch size" in text for text in listener.messages) == 1
    together = results(root / "out")
    assert together == alone(root, lr="5%")


@pytest.mark.usefixtures("plain_convolutions")
@pytest.mark.parametrize(("faster", "goes_together"), [(1e9, True), (0.0, False)])
def test_auto_takes_frames_together_only_where_that_is_faster(
    root: Path,
    passes: list[int],
    monkeypatch: pytest.MonkeyPatch,
    faster: float,
    goes_together: bool,
) -> None:
    monkeypatch.setattr(batch_groups, "_MAX_FRAMES", 3)
    monkeypatch.setattr(batch_groups, "_MAX_TIME_RATIO", faster)
    listener = RecordingListener()
    batch(root, listener)
    assert passes == ([3, 3, 3] if goes_together else [3, 3])
    (note,) = [text for text in listener.messages if "batch size" in text]
    assert ("equal bit for bit" in note) == goes_together
    assert ("no faster" in note) != goes_together


ROUNDS = (FORMULA, f"{FORMULA} + 1e-5 * rgb.mean()")
"""A network whose last bits depend on what else goes through it."""


@pytest.mark.usefixtures("plain_convolutions")
def test_where_bits_differ_auto_goes_on_one_at_a_time(
    root: Path, passes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_groups, "_MAX_FRAMES", 3)
    paint_in_shades(root)
    change_network(root, ROUNDS)
    listener = RecordingListener()
    batch(root, listener)
    assert passes == [3]  # the plain prediction was enough to know
    assert any(
        "batch size: 1 for 62×46; 3 together differ in the last bits" in text
        for text in listener.messages
    )
    together = results(root / "out")
    assert together == alone(root)


@pytest.mark.usefixtures("plain_convolutions")
def test_a_number_by_the_user_may_alter_the_last_bits_with_a_note_and_a_record(
    root: Path, passes: list[int]
) -> None:
    paint_in_shades(root)
    change_network(root, ROUNDS)
    listener = RecordingListener()
    batch(root, listener, batch_size=3)
    assert passes == [3, 3]
    (note,) = [text for text in listener.messages if "batch size" in text]
    assert note.startswith("warning: batch size: 3 frames of 62×46 together differ from one at a")
    for name in NAMES:
        notes = json.loads((root / f"out/{name}.json").read_text())["notes"]
        together = "refined together with 2 others, which alters the last bits" in notes
        assert together == (name in "def")


MIXED = (FORMULA, f"({FORMULA}) * (1 + rgb.mean() - rgb.mean().detach() + rgb.std())")
CHOOSES = ("        return", "        rgb = rgb / 2 if float(rgb.mean()) > 0.9 else rgb\n"
           "        return")  # fmt: skip


@pytest.mark.usefixtures("plain_convolutions")
@pytest.mark.parametrize(
    ("change", "why"),
    [
        (MIXED, "frames that go together influence each other"),
        (CHOOSES, "control flow depends on image"),
    ],
)
def test_a_network_that_mixes_frames_gets_them_one_at_a_time_whatever_is_asked(
    root: Path, passes: list[int], change: tuple[str, str], why: str
) -> None:
    paint_in_shades(root)
    change_network(root, change)
    listener = RecordingListener()
    batch(root, listener, batch_size=3)
    assert passes == [3]
    assert any(why in text for text in listener.messages)
    together = results(root / "out")
    assert together == alone(root)


def test_a_network_for_one_frame_alone_gets_one_at_a_time(root: Path, passes: list[int]) -> None:
    change_network(root, ("        return", "        assert len(rgb) == 1\n        return"))
    listener = RecordingListener()
    assert batch(root, listener, batch_size=4).summary["counts"]["done"] == len(NAMES)
    assert passes == [4]
    assert any(
        "batch size: 1 for 62×46; together: the network's" in text for text in listener.messages
    )


@pytest.mark.usefixtures("plain_convolutions")
def test_out_of_memory_halves_the_group_and_goes_on(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refine_together = Refiner.refine_together
    tried: list[int] = []
    room = 4

    def with_little_room(refiner: Refiner, split: Any, group: Any, settings: Any) -> Any:
        nonlocal room
        tried.append(len(group))
        room = 2 if len(tried) == 4 else room  # the memory is needed elsewhere
        if len(group) > room:
            raise DeviceError("device 'cpu' is out of memory")
        return refine_together(refiner, split, group, settings)

    monkeypatch.setattr(Refiner, "refine_together", with_little_room)
    for name in ("i", "j", "k", "l", "m", "n"):
        add_frame(root, name)
    outcome = batch(root, batch_size=8)
    # a-h tried as 8, then 4; i-l fail as 4, so i j are tried as 2; then m n
    assert tried == [8, 4, 4, 4, 2, 2, 2]
    assert outcome.summary["counts"]["done"] == 14
    together = results(root / "out")
    monkeypatch.setattr(Refiner, "refine_together", refine_together)
    assert together == alone(root)


@pytest.mark.parametrize("how", ["end", "stop", "full disk"])
def test_afterwards_the_network_is_as_before(
    root: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    refiners: list[Refiner] = []
    load = resolving.load_refiner

    def loaded(*arguments: Any) -> Refiner:
        refiner = load(*arguments)
        refiner.network.module.encode.train()
        refiner.network.module.decode.weight.requires_grad_(True)
        refiners.append(refiner)
        return refiner

    class Stops(RecordingListener):
        def frame(self, row: dict[str, Any]) -> None:
            super().frame(row)
            if how == "full disk" and len(self.rows) == 2:
                raise StorageError("full")

    monkeypatch.setattr(resolving, "load_refiner", loaded)
    stops = iter([False, False, how == "stop", *[False] * 9])
    listener = Stops()
    if how == "full disk":
        with pytest.raises(StorageError):
            batch(root, listener, stopped=lambda: next(stops))
    else:
        batch(root, listener, stopped=lambda: next(stops))
    assert len(listener.rows) == (len(NAMES) if how == "end" else 2)
    (refiner,) = refiners
    module = refiner.network.module
    assert all("forward" not in vars(part) for part in module.modules())
    assert [part.training for part in module.children()] == [True, False, False, False]
    assert [n for n, p in module.named_parameters() if p.requires_grad] == ["decode.weight"]


def test_the_profile_has_the_time_of_each_stage(root: Path) -> None:
    (root / "rgb/b.png").write_bytes(b"no image")
    assert "profile" not in batch(root, limit=1).summary
    profile = batch(root, profile=True).summary["profile"]
    stored = json.loads((root / "out/summary.json").read_text())["profile"]
    assert stored == profile
    seconds = profile["seconds"]
    assert profile["frames"] == 6
    assert all(seconds[stage] > 0 for stage in ("network", "reading", "writing", "wall"))
    of_the_main_thread = ("network", "waiting_for_reader", "waiting_for_writer")
    assert sum(seconds[stage] for stage in of_the_main_thread) <= seconds["wall"]
    assert profile["frames_per_second"] == pytest.approx(6 / seconds["wall"], rel=1e-2)
    assert profile["network_busy"] == pytest.approx(seconds["network"] / seconds["wall"], rel=1e-2)


def test_what_is_chosen_for_each_frame_by_itself_is_never_refined_together(
    root: Path, passes: list[int]
) -> None:
    listener = RecordingListener()
    batch(root, listener, batch_size=2, limit=3, refine={"uncertainty": True})
    assert passes == []
    assert [row["status"] for row in listener.rows] == ["done"] * 3
    assert any("choose the method for each frame alone" in text for text in listener.messages)
