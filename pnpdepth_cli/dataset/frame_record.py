"""What is kept of a refined frame: its files, network, settings, errors and outputs.

`NAME.json` beside a result is one, and `summary.json` of a batch and `pnpdepth eval --json` hold
one a frame. Means, tables, reports and comparisons read nothing else.
"""

from __future__ import annotations

import threading
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import LENSES
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.file_record import FigureRecord, FileRecord, what_applies
from pnpdepth_cli.io.file_bytes import Fingerprint, one_line, plain, read_json, write_json
from pnpdepth_cli.measures import AFTER, GT, HELD_OUT, LINEAR, VALIDATION
from pnpdepth_cli.points import METRES

SCHEMA = 2
"""Version of the schema of a record; another one is not read."""
_CONVERTING = threading.Lock()
"""msgspec learns the types at the first record, and crashes if two threads have a first one."""

Pose = NDArray[np.float64]
"""(3, 4) x_world = pose · (x, 1), in the unit of the depth."""
Scores = dict[str, int | float | None]
"""Errors by the key of their measure, with the number of pixels or points that they are of."""


@dataclass(frozen=True, kw_only=True)
class CameraRecord:
    """The camera of the image, and its pose."""

    intrinsics: list[list[float]]
    """(3, 3)"""
    lens: str
    distortion: list[float] = field(default_factory=list)
    pose: list[list[float]] | None = None
    """(3, 4) from the camera's coordinates to the world's. None: unknown."""
    source: str

    @classmethod
    def of(cls, camera: Camera, pose: Pose | None) -> CameraRecord:
        """Returns what is kept of a camera and its pose."""
        return cls(
            intrinsics=camera.intrinsics.tolist(),
            lens=camera.lens,
            distortion=list(camera.distortion),
            pose=None if pose is None else pose.tolist(),
            source=camera.source,
        )

    def read(self) -> tuple[Camera, Pose | None]:
        """Returns the camera and its pose. Raises ValueError if no camera has these numbers."""
        intrinsics = np.array(self.intrinsics, np.float64).reshape(3, 3)
        pose = None if self.pose is None else np.array(self.pose, np.float64).reshape(3, 4)
        has_focal_lengths = min(intrinsics[0, 0], intrinsics[1, 1]) > 0
        has_last_row = intrinsics[2].tolist() == [0, 0, 1]
        if not has_focal_lengths or not has_last_row or self.lens not in LENSES:
            raise ValueError("no camera has these intrinsics")
        camera = Camera(
            intrinsics=intrinsics,
            lens=self.lens,
            distortion=tuple(self.distortion),
            source=self.source,
        )
        return camera, pose


@dataclass(frozen=True, kw_only=True)
class ModelRecord:
    """The user's network."""

    name: str
    spec: str
    """What the user called it."""
    checkpoint: str | None = None
    checkpoint_sha256: str | None = None


@dataclass(frozen=True, kw_only=True)
class NetworkRecord:
    """How a network's depth was aligned and its z updated, with nothing left open."""

    name: str
    layer: str
    iterations: int
    lr: float | str
    loss: str
    update: str
    schedule: str
    blur: float
    align: str


@dataclass(frozen=True, kw_only=True)
class MethodRecord:
    """How the frame was refined."""

    name: str
    """One of `choices.METHODS`."""
    propagation: str
    """How the residual at the points was propagated."""
    networks: list[NetworkRecord]
    """The user's networks first."""

    @property
    def names(self) -> list[str]:
        """The names of the networks."""
        return [network.name for network in self.networks]


@dataclass(frozen=True, kw_only=True)
class PointsRecord:
    """The sparse depth."""

    used: int
    held_out: int
    nearest: float
    farthest: float
    moved: int | None = None
    """Number of the points used that are of neighbouring frames. None: none was asked for."""


@dataclass(frozen=True, kw_only=True)
class BatchState:
    """State by which a batch knows that a frame is done."""

    settings: str
    """SHA-256 of the settings that decide the result."""
    inputs: dict[str, Fingerprint] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ResultRecord:
    """A refined depth map: how it was made, of what, and its files."""

    outputs: dict[str, str] = field(default_factory=dict)
    """The files by kind; of a batch, below its output folder."""
    depth_scale: float | None = None
    """Integers per metre of the depth file. None for a file of metres."""
    size: tuple[int, int]
    """(width, height)"""
    points: PointsRecord
    """The sparse depth."""
    neighbours: list[FileRecord] = field(default_factory=list)
    """Points of neighbouring frames."""
    camera: CameraRecord | None = None
    """The camera in pixels of the image. None: unknown."""
    model: ModelRecord
    """The user's network."""
    method: MethodRecord
    """How the frame was refined."""
    settings: dict[str, str | int | float | None]
    """The settings of the user's network, with nothing left open."""
    weights: dict[str, float] = field(default_factory=dict)
    """Weights of the experts in the result, by name."""
    registration: dict[str, float] | None = None
    """How the image was moved to the points. None: it was not."""
    alignment: dict[str, str | int | float | list[float] | None] | None = None
    """How the network's output was aligned with the points."""
    loss: list[float | None] = field(default_factory=list)
    """Loss at the points before the first update and after each."""
    improved_fraction: float | None = None
    """Fraction of the scored pixels, else of the held-out points, whose error fell."""
    figures: dict[str, FigureRecord] = field(default_factory=dict)
    """Where the panels of the PNGs for a person lie, by kind."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds by what they were spent on."""
    peak_memory_mb: dict[str, float] = field(default_factory=dict)
    """Largest memory in 10^6 bytes of the process, and of the GPU if one is used."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of the program, Python and the numerical libraries."""

    def __post_init__(self) -> None:
        """Raises ValueError for a result without a network or a setting that a report reads."""
        if not self.method.networks:
            raise ValueError("it names no network")
        for name in ("align", "iterations", "propagate"):
            if name not in self.settings:
                raise ValueError(f"its settings lack {name!r}")


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """A frame that was refined, or scored, or that failed."""

    schema: int = SCHEMA
    """Version of this schema."""
    name: str = ""
    """The frame's name; a slash stands for a folder."""
    group: str | None = None
    """The sequence that the data set says it belongs to."""
    status: Literal["done", "diverged", "failed"] = "done"
    message: str | None = None
    """Why it diverged or failed."""
    batch: BatchState | None = None
    """None for `pnpdepth refine` and `eval`."""
    inputs: dict[str, FileRecord] = field(default_factory=dict)
    """The files, by what they are of: the image, the sparse depth, the ground truth."""
    unit: str = METRES
    """Unit of all depths: "m", or "model units" of a COLMAP model without scale."""
    errors: dict[str, dict[str, Scores]] = field(default_factory=dict)
    """Errors by basis (`BASES`), then by stage: before, after, linear, and those of the method."""
    notes: list[str] = field(default_factory=list)
    """Lines for a person; a warning begins with "warning"."""
    result: ResultRecord | None = None
    """The refined depth. None of a frame that failed, or that `eval` scored."""

    def __post_init__(self) -> None:
        """Raises ValueError for a record that lacks what is read of it later.

        Errors must have the stage after refinement. A refined frame of a batch must have its
        result, and the number of pixels or points behind its errors.
        """
        for basis, stages in self.errors.items():
            if AFTER not in stages:
                raise ValueError(f"the errors {basis} are not of the result")
        if self.batch is None or self.status == "failed":
            return
        if self.result is None:
            raise ValueError("it does not say how the frame was refined")
        for basis, stages in self.errors.items():
            count = "pixels" if basis == GT else "points"
            if stages[AFTER].get(count) is None:
                raise ValueError(f"the errors {basis} lack how many pixels or points they are of")

    def refined(self) -> ResultRecord:
        """Returns the result of a frame that was refined. Raises InputError for any other."""
        if self.result is None:
            why = self.message or "it was not refined"
            raise InputError(f"frame {self.name!r} has no result: {why}; refine it again")
        return self.result

    @property
    def warnings(self) -> list[str]:
        """The notes that are warnings."""
        return [note for note in self.notes if note.startswith("warning")]

    @property
    def worse_than_linear(self) -> bool | None:
        """Whether the MAE is above that of linear interpolation of all points.

        By ground truth, else at held-out points, else at validation points; None without any.
        """
        for basis in (GT, HELD_OUT, VALIDATION):
            stages = self.errors.get(basis, {})
            result_mae = stages.get(AFTER, {}).get("mae")
            linear_mae = stages.get(LINEAR, {}).get("mae")
            if result_mae is not None and linear_mae is not None:
                return result_mae > linear_mae
        return None

    def to_json(self) -> dict[str, Any]:
        """Returns the record in JSON's own types, without entries that are None, false or empty.

        None stays where it is a value: in settings, alignment, loss and errors.
        """
        entry: dict[str, Any] = plain(asdict(self, dict_factory=what_applies))
        return entry

    @classmethod
    def from_json(cls, entry: object, source: Path) -> FrameRecord:
        """Returns the record of an entry that `to_json` gave.

        Args:
            entry: The content of a JSON file, or a part of it.
            source: The file, for messages.

        Raises:
            InputError: The entry is no record of this version of the program.
        """
        if isinstance(entry, dict) and entry.get("schema") != SCHEMA:
            raise InputError(
                f"{source} is no record of this version of pnpdepth, whose schema is {SCHEMA}; run"
                " again the command that wrote it"
            )
        try:
            with _CONVERTING:  # msgspec is not safe to call first in two threads
                return msgspec.convert(entry, cls)
        # msgspec raises ValidationError, also for our ValueErrors, and lets UsageError pass. A text
        # that is not Unicode ends its own message in a UnicodeError.
        except (msgspec.ValidationError, OverflowError, UnicodeError, UsageError) as error:
            raise InputError(
                f"{source} is no record of a frame as this version writes it"
                f" ({one_line(str(error))}); remove it, and run again"
            ) from error

    def write(self, path: Path) -> None:
        """Writes the record, whole or not at all."""
        write_json(path, self.to_json())

    @classmethod
    def read(cls, path: Path) -> FrameRecord:
        """Returns the record in a file. Raises InputError if it holds none."""
        return cls.from_json(read_json(path), path)
