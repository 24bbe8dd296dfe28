"""Published protocols: the part of a frame, its points, and which pixels are scored, a row each.

`batch --protocol` cuts the frames and draws the points of a row, `eval --protocol` scores by it.
What is known of each, and from where, is in docs/notes/protocols.md. Importing this module imports
no library.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pnpdepth_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pnpdepth_cli.camera import Camera
    from pnpdepth_cli.points import SparsePoints

    Points = SparsePoints[NDArray[np.float32]]

KITTI_DEVKIT = "kitti-devkit"


class _Window(NamedTuple):
    """A rectangle of an image, in pixels."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True, kw_only=True)
class FramePart:
    """The part of a frame that is used."""

    halved: bool = False
    """Whether every second pixel in both directions (nearest neighbour) is used."""
    blocks: int = 1
    """Side of the blocks of pixels whose known values are averaged to one pixel."""
    crop: tuple[int, int] | None = None
    """(H, W) of the crop after halving or averaging; None for the whole image."""
    anchor: Literal["centre", "bottom"] = "centre"
    """Vertical position of the crop, which is centred horizontally."""

    def __str__(self) -> str:
        """Such as "912×228 at the bottom of the frame", for a person."""
        size = "all" if self.crop is None else f"{self.crop[1]}×{self.crop[0]} at the {self.anchor}"
        text = f"{size} of the halved frame" if self.halved else f"{size} of the frame"
        if self.blocks > 1:
            text += f", averaged over {self.blocks}×{self.blocks} pixels"
        return text

    @property
    def factor(self) -> int:
        """How many pixels of a row become one."""
        return 2 if self.halved else self.blocks

    def apply(self, image: NDArray[Any]) -> NDArray[Any]:
        """Returns this part of an image (H, W) or (H, W, C): halved or averaged, then cropped.

        Raises:
            InputError: The image is smaller than the crop.
        """
        top, left, height, width = self._window((image.shape[0], image.shape[1]))
        # The nearest neighbour at half the size: the centre of a new pixel is the corner that four
        # pixels share, and the lower right one of these is taken.
        small = image[1::2, 1::2] if self.halved else _block_means(image, self.blocks)
        return small[top : top + height, left : left + width]

    def points_in_crop(self, points: Points) -> Points:
        """Returns the points that lie in this part, in its pixel coordinates.

        Args:
            points: Points in pixel coordinates of the whole image.
        """
        # Whole numbers are pixel centres, so that the image begins at -0.5.
        xy = (points.xy.astype("f8") + 0.5) / self.factor - 0.5
        small = replace(points, xy=xy.astype("f4"))
        return small.cropped(*self._window(points.size))

    def camera_in_crop(self, camera: Camera, size: tuple[int, int]) -> Camera:
        """Returns the camera that sees this part.

        Args:
            camera: Camera of the whole image.
            size: (H, W) of the whole image.
        """
        top, left, height, width = self._window(size)
        intrinsics = camera.intrinsics.copy()
        # A coordinate x becomes (x + 0.5) / factor - 0.5, as whole numbers are pixel centres.
        intrinsics[:2] /= self.factor
        intrinsics[:2, 2] -= 0.5 - 0.5 / self.factor
        # The coordinates begin at the crop.
        intrinsics[:2, 2] -= (left, top)
        return replace(camera, intrinsics=intrinsics, size=(height, width))

    def _window(self, size: tuple[int, int]) -> _Window:
        """The crop, in pixels of the halved or averaged image.

        Args:
            size: (H, W) of the whole image.

        Raises:
            InputError: The image is smaller than the crop.
        """
        height, width = (side // self.factor for side in size)
        if self.crop is None:
            return _Window(0, 0, height, width)
        rows, columns = self.crop
        if rows > height or columns > width:
            at = f" at 1/{self.factor}" if self.factor > 1 else ""
            raise InputError(
                f"the protocol needs {columns}×{rows} pixels but the frame has"
                f" {width}×{height}{at};"
                " --protocol whole takes frames of any size"
            )
        top = height - rows if self.anchor == "bottom" else (height - rows) // 2
        return _Window(top, (width - columns) // 2, rows, columns)


def _block_means(image: NDArray[Any], side: int) -> NDArray[Any]:
    """The mean of each block of side × side pixels, float32.

    The mean of a depth map is over the pixels with known depth, and 0 where there are none.

    Args:
        image: Image (H, W, C), or a depth map (H, W) that is 0 where unknown.
        side: Side of the blocks in pixels.
    """
    if side == 1:
        return image
    import numpy as np

    # (rows of blocks, rows in a block, columns of blocks, columns in a block, channels)
    height, width = (length // side for length in image.shape[:2])
    whole_blocks = image[: height * side, : width * side]
    blocks = whole_blocks.reshape(height, side, width, side, *image.shape[2:])
    is_depth = image.ndim == 2
    counts = (blocks > 0).sum(axis=(1, 3)) if is_depth else side**2
    return np.asarray(blocks.sum(axis=(1, 3)) / np.maximum(counts, 1), np.float32)


WHOLE = FramePart()
NYU_PART = FramePart(halved=True, crop=(228, 304))
ODOMETRY_PART = FramePart(crop=(228, 912), anchor="bottom")
"""Parts of the seed paper (Wang et al. 2019, section on data sets), and of many after it."""


ForegroundFilter = tuple[int, float]
"""(pixels, metres): removes LiDAR points that the camera does not see, behind others.

A point goes if another point in its window of that many pixels has, in its own window, a point that
is nearer than the first by more than those metres (Conti et al. 2022)."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How the frames of a data set are cut, given points, and scored."""

    name: str
    note: str = ""
    """What differs from the publication, or what it leaves open."""

    # for `batch`
    part: FramePart | None = None
    """None: the data set's own."""
    sample: str | None = None
    """Points that are drawn from the ground truth, as `--sample` has them. None: the data set's."""
    seed: int | None = None
    """Random seed of the points. None: the user's."""
    foreground: ForegroundFilter | None = None
    """Filter of the points of a LiDAR. None: no filter."""

    # for `eval`
    scale: float = 256.0
    """Codes per metre of integer files that neither the file nor the user states."""
    min_depth: float = 0.0
    """Ground truth is scored above this depth, metres."""
    max_depth: float | None = None
    """Ground truth is scored below this depth, metres."""
    clip: bool = False
    """Whether predictions are clipped to these bounds, empty ones too."""
    crop: str = "none"
    """Name of the rectangle of the part in which pixels are scored; "none" for all of it."""
    exclude_sparse: bool = False
    """Whether pixels with a sparse point are not scored."""


# The reference codes (monodepth2's evaluate_depth.py, BTS's eval) clamp predictions with
# `pred[pred < min_depth] = min_depth`, which scores empty ones (0, NaN) as the lower bound.
_EIGEN = Protocol(name="eigen", part=WHOLE, crop="eigen", min_depth=1e-3, max_depth=80.0, clip=True)
_NOT_FOUND = "which pixels the paper draws, with which seed, size and bounds, was not found"
_RESAMPLED = "the paper halves frames by interpolation; here every second pixel is taken"

PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        # Ma and Karaman's evaluation, which the seed paper's follows: no bounds, no crop.
        Protocol(name="paper"),
        Protocol(name="whole", part=WHOLE),
        Protocol(name="nyu", part=NYU_PART),
        Protocol(name="kitti-odometry", part=ODOMETRY_PART),
        # Eigen et al. 2014 with the bounds of later tables (BTS, AdaBins): 0.001 to 10 m.
        replace(_EIGEN, name="nyu-eigen", scale=1000.0, max_depth=10.0, crop="nyu"),
        # The completion benchmark's measures in its units, with nothing filled in.
        Protocol(name="kitti"),
        Protocol(name=KITTI_DEVKIT),
        _EIGEN,
        replace(_EIGEN, name="garg", crop="garg"),
        Protocol(
            name="marigold-dc-nyu",
            part=NYU_PART,
            sample="500",
            seed=2024,
            note=f"the paper reads its 500 points from a file, others than these; {_RESAMPLED}",
        ),
        Protocol(name="marigold-dc-ibims", part=WHOLE, sample="shuffle:1000", seed=2024),
        Protocol(
            name="marigold-dc-scannet",
            part=WHOLE,
            sample="shuffle:500",
            seed=2024,
            note="the paper resizes images to 640×480 and does not say how it draws its points",
        ),
        Protocol(name="marigold-dc-void", part=WHOLE),
        Protocol(name="marigold-dc-lidar", part=WHOLE, foreground=(7, 1.5)),
        Protocol(
            name="omni-dc-nyu",
            part=NYU_PART,
            sample="500",
            seed=0,
            note=f"the paper names no seed of its points; {_RESAMPLED}",
        ),
        Protocol(name="omni-dc-kitti", part=FramePart(crop=(256, 1216), anchor="bottom")),
        Protocol(
            name="omni-dc-eth3d",
            part=FramePart(blocks=8, crop=(480, 640)),
            sample="2150",
            seed=0,
            note="the paper names no seed of its points, and interpolates images, which are"
            " averaged here; it has other numbers and patterns of points too",
        ),
        *(
            Protocol(
                name=name,
                part=WHOLE,
                sample=sample,
                seed=0,
                exclude_sparse=True,
                note=f"{note}; {_NOT_FOUND}",
            )
            for name, sample, note in (
                ("capa-100", "100", "100 points on ScanNet and 7-Scenes"),
                ("streamtto-rings", "lines:8", "the 8 rings are evenly spaced rows here"),
                ("streamtto-pixels", "10%", "10 % of the pixels with ground truth"),
            )
        ),
    )
}
"""All protocols by name."""


def find_protocol(name: str) -> Protocol:
    """Returns the protocol of this name. Raises UsageError if there is none."""
    if name not in PROTOCOLS:
        raise UsageError(f"no protocol {name!r}; there are {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]
