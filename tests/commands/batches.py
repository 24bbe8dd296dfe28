"""Folders of small frames, and batches of them, for tests."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.commands.batch import run_batch
from pnpdepth_cli.commands.many_frames.summary import BatchSummary
from pnpdepth_cli.commands.requests.batch_request import BatchRequest, Listener
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import write_depth
from tests.commands.frames import frame_on_disk

NAMES = ("a", "b", "c", "d")
STEP_M = 0.1


class Recorder(Listener):
    """Keeps the messages and records of a batch."""

    def __init__(
        self,
        stopped: Callable[[], bool] = lambda: False,
        on_frame: Callable[[], object] = lambda: None,
    ) -> None:
        self._on_frame = on_frame
        self.messages: list[str] = []
        self.records: list[FrameRecord] = []
        super().__init__(self.messages.append, lambda done, of: None, stopped)

    def frame(self, record: FrameRecord) -> None:
        super().frame(record)
        self.records.append(record)
        self._on_frame()

    @property
    def names(self) -> list[str]:
        return [record.name for record in self.records]


def pairs_on_disk(root: Path, names: tuple[str, ...] = NAMES) -> Path:
    """rgb/ sparse/ gt/ with these frames, all a little different, and net/ with a network."""
    (root / "net").mkdir(parents=True)
    image = cv2.imread(str(frame_on_disk(root / "net").image))
    for number, name in enumerate(names):
        add_frame(root, name, np.roll(image, number, axis=1))
    return root


def drive_on_disk(root: Path, frames: int = 4, *, points: int = 400) -> Path:
    """rgb/ sparse/ calib/ of so many frames, poses.txt, and net/ with a network.

    Every frame is 0.1 m ahead of the one before; there are two walls and a floor.
    """
    (root / "net").mkdir(parents=True)
    image = cv2.imread(str(frame_on_disk(root / "net").image))
    for folder in ("rgb", "sparse", "calib"):
        (root / folder).mkdir()
    down, right = (np.mgrid[:46, :62] - np.array([22.5, 30.5])[:, None, None]) / 60
    rows = []
    for number in range(frames):
        with np.errstate(divide="ignore"):
            floor = np.where(down > 0, 1.5 / down, np.inf)
            left = np.where(right < 0, -1 / right, np.inf)
        depth = np.minimum(np.minimum(floor, left), 5 - STEP_M * number)
        known = np.random.default_rng(number).permutation(depth.size)[:points]
        sparse = np.zeros(depth.shape, np.float32)
        name = f"drive_{number:03}"
        sparse.flat[known] = depth.flat[known]
        write_depth(root / f"sparse/{name}.png", sparse, scale=1000)
        cv2.imwrite(str(root / f"rgb/{name}.png"), np.roll(image, number, axis=1))
        (root / f"calib/{name}.txt").write_text("K: [60, 0, 30.5, 0, 60, 22.5, 0, 0, 1]")
        rows.append(f"1 0 0 0 0 1 0 0 0 0 1 {STEP_M * number}")
    (root / "poses.txt").write_text("\n".join(rows) + "\n")
    return root


def add_frame(root: Path, name: str, image: Any = None) -> None:
    """One more frame, with the image of the network by default."""
    for folder, file in (("rgb", "img"), ("sparse", "s"), ("gt", "gt")):
        target = root / folder / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / "net" / f"{file}.png", target)
    if image is not None:
        (root / "rgb" / f"{name}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())


def refinement(root: Path, **changes: Any) -> RefineRequest:
    """A request to refine with the network in net/, by default by the paper's method."""
    fields: dict[str, Any] = {
        "method": "paper",
        "model": str(root / "net" / "my_net.py"),
        "checkpoint": root / "net" / "my_net.safetensors",
    }
    return RefineRequest().with_fields(**fields | changes)


def batch(root: Path, listener: Recorder | None = None, **changes: Any) -> BatchSummary:
    """A batch of the folder into its out/."""
    fields: dict[str, Any] = {"source": root, "output": root / "out"} | changes
    fields["refine"] = refinement(root, **fields.get("refine", {}))
    return run_batch(BatchRequest(**fields), listener or Recorder())


def done(root: Path, listener: Recorder | None = None, **changes: Any) -> list[str]:
    """The names of the frames that a batch does."""
    listener = listener or Recorder()
    batch(root, listener, **changes)
    return listener.names


def results(folder: Path) -> dict[str, bytes | dict[str, Any]]:
    """Every result below a folder: bytes, and records without times, folders, what a batch adds."""
    contents: dict[str, bytes | dict[str, Any]] = {}
    for path in filter(Path.is_file, folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.startswith(("summary.", ".batch.")):
            continue
        contents[name] = path.read_bytes()
        if path.suffix == ".json" and not path.name.startswith("."):  # those need not be whole
            record = json.loads(path.read_text())
            record.pop("batch", None)
            result = record["result"]
            for key in ("seconds", "peak_memory_mb"):
                result.pop(key)
            result["outputs"] = {kind: Path(file).name for kind, file in result["outputs"].items()}
            contents[name] = record
    return contents
