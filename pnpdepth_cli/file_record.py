"""What a record keeps of each file: of one that was read, and of a figure that was written."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pnpdepth_cli.errors import UsageError

PATTERNS = ("uniform", "shuffle", "grid", "lines", "features")
"""Which pixels of dense depth become sparse points: `pnpdepth_cli.sensors.simulation`."""

FileKind = Literal[
    "image", "depth", "scan", "colmap", "sampled", "neighbour", "calibration", "unread"
]
"""What a file of a frame is.

- depth: a map or a list of points, such as sparse depth, ground truth or a network's depth map
- scan: points of a LiDAR, projected by a calibration
- colmap: a COLMAP model
- sampled: ground truth that points were sampled from
- neighbour: points of a neighbouring frame
- unread: a file of which nothing but the path is known
"""


def file_and_part(path: Path) -> tuple[Path, str]:
    """Returns the file and the part that a name FILE:PART consists of.

    A network in a file of several, or an array in an archive, is named so. The part is empty where
    the name has none, or where a file of the whole name exists.
    """
    file_name, _, part = path.name.rpartition(":")
    if not file_name or path.exists():
        return path, ""
    return path.with_name(file_name), part


def what_applies(entries: Iterable[tuple[str, object]]) -> dict[str, object]:
    """Returns a record's fields without those that are None, False, or an empty dict or list.

    It is given to `dataclasses.asdict` as `dict_factory`.

    Args:
        entries: Name and value of each field.
    """
    return {
        name: value
        for name, value in entries
        if value is not None and value is not False and value not in ({}, [])
    }


@dataclass(frozen=True, kw_only=True)
class SamplePattern:
    """Which of the pixels with known depth are sampled."""

    kind: str = "uniform"
    """One of `PATTERNS`."""
    count: int | None = None
    """Number of points, or of lines for `lines`; None with a fraction."""
    fraction: float | None = None
    """Fraction of the known pixels, 0 to 1; None with a count."""
    seed: int | None = None
    """Random seed. None in what is asked for: that of the method."""

    def __post_init__(self) -> None:
        """Raises UsageError unless the pattern is known, and has a count or else a fraction."""
        count, fraction = self.count, self.fraction
        if self.kind not in PATTERNS:
            raise UsageError(f"pattern {self.kind!r} is not one of {', '.join(PATTERNS)}")
        if (count is None) == (fraction is None):
            raise UsageError("give a number of points or a fraction of the pixels")
        if (count is not None and count < 1) or (fraction is not None and not 0 < fraction <= 1):
            raise UsageError("give at least one point, or a fraction above 0 and at most 100 %")
        if self.kind == "lines" and count is None:
            raise UsageError("pattern 'lines' needs the number of lines as its count")

    def wanted(self, available: int) -> int:
        """Returns how many to sample: the count, or the fraction of what is available.

        Args:
            available: Number of pixels with known depth; of `lines`, of rows of the image.
        """
        if self.count is not None:
            return self.count
        fraction = self.fraction or 0.0  # given, as there is no count
        return max(1, round(fraction * available))


@dataclass(frozen=True, kw_only=True)
class FileRecord:
    """A file of a frame, and how it was read. What does not apply to its kind is None or empty."""

    path: str
    kind: FileKind = "unread"
    """What the file is, which says how it was read."""
    sha256: str | dict[str, str] | None = None
    """SHA-256 of the content; of a COLMAP model, that of each of its files."""
    read_as: str | None = None
    """Format and unit, in words."""
    scale: float | None = None
    """Integers per metre. None for a file of metres."""
    assumed: bool = False
    """Whether the scale is assumed, as neither the file nor the user nor the data set states it."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Number of points that were dropped, by the reason."""
    mask: str | None = None
    """Path of the mask, or confidence, that was applied to the points."""
    least: float | None = None
    """Least confidence of a point that is used."""
    sampled: SamplePattern | None = None
    """Of "sampled": how the points were sampled."""
    calibration: str | None = None
    """Of a scan: path of the calibration by which it was projected."""
    camera: int | None = None
    """Of a scan: number of the camera in the calibration."""
    extrinsics: str | None = None
    """Of a scan: path of the pose of the scanner."""
    keep_occluded: bool = False
    """Of a scan: whether points that are occluded by nearer ones were kept."""
    image: str | None = None
    """Of a COLMAP model: name that the frame's image has in the model."""
    unit_scale: float | None = None
    """Of a COLMAP model: metres per unit."""
    poses: str | None = None
    """Of a neighbour: where the motion to it is from."""
    motion: list[list[float]] | None = None
    """Of a neighbour: (3, 4) from the camera's coordinates there to those at the frame."""
    contradicts_images: bool = False
    """Of a neighbour: whether the images show another motion."""

    def __post_init__(self) -> None:
        """Raises ValueError for a kind without the field that says how such a file was read."""
        needed = {"sampled": self.sampled, "scan": self.calibration, "colmap": self.image}
        if self.kind in needed and needed[self.kind] is None:
            raise ValueError(f"a file of kind {self.kind!r} does not say how it was read")


@dataclass(frozen=True, kw_only=True)
class FigureRecord:
    """A PNG for a person, as a report shows it again."""

    size: tuple[int, int]
    """(width, height) in pixels."""
    panels: dict[str, tuple[int, int, int, int]]
    """(left, top, width, height) of each panel, by its title."""
    scale_m: tuple[float, float] | None = None
    """Depths at the ends of the colours, of a figure of depth."""
    ends: tuple[str, str] | None = None
    """Texts at the ends of the colours, of a figure of gains."""
    unknown: str | None = None
    """What the dark pixels of a figure of gains are. None where there are none."""
    footer: str | None = None
    """Text below a figure of gains."""
