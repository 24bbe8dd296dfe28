"""The door of the Python API: arrays of a user as frames, refined with networks that stay open."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.completion.image_registration import estimate_registration
from pnpdepth_cli.completion.registration_evidence import Evidence
from pnpdepth_cli.dataset.saved_result import save
from pnpdepth_cli.errors import DivergedError, InputError, NoPointsError, UsageError
from pnpdepth_cli.frames.adapt import learn, too_little, weights_in_place
from pnpdepth_cli.frames.frame import (
    Frame,
    Refined,
    Register,
    Registration,
    registration_to_make,
    tensor_of,
)
from pnpdepth_cli.frames.method import Method, check_combination
from pnpdepth_cli.frames.resolve import resolve_definition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

FULL_SCALE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
"""Value of white by the type of an image's integers."""

Unit = Literal["m", "mm"]
UNITS = {"m": 1.0, "mm": 1000.0}
"""How many of each unit of depth make a metre."""

FARTHEST_MEDIAN_M = 200.0
"""No frame has half of its depths farther than this; a larger median is in another unit."""

DECIDED_BY = 5
"""So many frames of one size decide together how later ones are moved to their points."""

_OPEN: set[nn.Module] = set()  # modules that refiners have cut open
_OPENING = threading.Lock()

Pair = tuple[ArrayLike | None, ArrayLike | SparsePoints]
"""An image and its sparse depth; see `Refiner.refine`."""


class Refiner:
    """Refines frames with one network, or several that are fused; a context manager.

    The networks stay cut open from frame to frame and are as before when it closes. What their
    definitions leave open (such as the RGB range of an ONNX file) is decided by the first frame.
    Frames of several threads are refined one after the other. Another refiner cannot use a network
    before this one closes.

    Args:
        network: Network from `load_network`, or several, which are fused.
        settings: The method and values for its steps; what they leave open, the network decides.
            The values are for the first network, if there are several.
        uncertainty: Whether the standard deviation of the depth is estimated too.
        keep_measured: Whether the depth of points at whole pixels is kept there exactly.
        registration: Whether images are moved to their points: "auto", if their depth edges show
            that they are not registered; "off"; or by (zoom, right, down), pixels. With "auto" the
            first four frames of a size decide alone. The first five together decide for the fifth
            and all later ones.
        adapt: Frames of the same sequence, (image, sparse) each. Before the first frame is refined,
            the weights of `network`, which must take points, learn from them. The new weights are
            used while the refiner is open, if points hidden from its input show that they are
            better.

    Raises:
        UsageError: The settings contradict each other, or another refiner uses a network.
        InputError: A frame of `adapt` cannot be used.
    """

    def __init__(
        self,
        network: Network | Sequence[Network],
        settings: Settings | None = None,
        *,
        uncertainty: bool = False,
        keep_measured: bool = False,
        registration: Registration = "auto",
        adapt: Sequence[Pair] = (),
    ) -> None:
        # What is asked for, checked.
        self._networks = list(network) if isinstance(network, Sequence) else [network]
        if not self._networks or not all(
            isinstance(network, Network) for network in self._networks
        ):
            raise UsageError("network must be from load_network, or several in a list")
        if not isinstance(settings, Settings | None):
            raise UsageError(f"settings must be Settings, not {type(settings).__name__}")
        self._asked = settings or Settings()
        self._uncertainty = uncertainty
        self._keep_measured = keep_measured
        self._register = registration_to_make(registration, self._asked)
        self._adapt = [_frame_of_pair(pair, self._register) for pair in adapt]
        # What follows from the first frame, and lasts until the refiner is closed.
        self._method: Method | None = None
        self._is_closed = False
        self._moved: dict[tuple[int, int], set[str]] = {}  # how images were moved, by their size
        self._telling: dict[tuple[int, int], list[Evidence]] = {}  # of the first frames, likewise
        self._stack = ExitStack()
        self._lock = threading.Lock()
        check_combination(self._asked, len(self._networks))

    def __enter__(self) -> Refiner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Refiner({', '.join(map(repr, self._networks))})"

    def close(self) -> None:
        """Restores the networks. No frame can be refined afterwards."""
        self._is_closed = True
        self._method = None
        self._stack.close()

    def refine(
        self,
        image: ArrayLike | None,
        sparse: ArrayLike | SparsePoints,
        *,
        unit: Unit | None = None,
        depth: ArrayLike | Sequence[ArrayLike] = (),
        camera: ArrayLike | Camera | None = None,
        stages: bool = False,
    ) -> Refined:
        """Returns one frame of arrays refined.

        Args:
            image: RGB (H, W, 3) or grey (H, W), uint8, uint16, or float in 0..1. None for a network
                that takes sparse depth only.
            sparse: Depth map (H, W) in metres with 0 for unknown, rows (N, 3) of x, y and depth
                (pixel centres at whole numbers), or SparsePoints.
            unit: Unit of the depth of an array, "m" or "mm"; needed for integers, and where half of
                the depths are beyond 200.
            depth: Depth map (H, W) that any network gave for the image, or several in a list: the
                map takes the place of a network's output. It may hold depth, disparity or their
                logarithm, up to scale and shift; not finite is unknown.
            camera: Intrinsics (3, 3) in pixels of the image, or a Camera; needed by a network that
                takes them.
            stages: Whether the depth after each step is returned too, as `Refined.stages`.

        Raises:
            InputError: Image, points or camera cannot be used.
            DivergedError: The loss became non-finite. Its `last_good` is the Refined of the updates
                before that, whose `diverged` is this error's message.
            UsageError: The refiner is closed.
        """
        frame = frame_of_arrays(image, sparse, self._register, unit, camera, depth)
        with self._lock:
            method = self._method_for(frame)
            decision = self._keep_registration(method, frame)
            refined = method.refine(frame, with_stages=stages)
            decides_alone = self._register == "auto" and frame.size not in method.registrations
            differs = decides_alone and self._differs(frame, refined)
        notes = [*method.own.network.notes, *frame.notes, *decision, *refined.notes]
        if differs:
            notes.append(
                "note: images of this size were moved to their points in different ways;"
                " `share_registration` decides once for a sequence"
            )
        refined = replace(refined, notes=tuple(notes), saver=save)
        if refined.diverged is not None:
            raise DivergedError(str(refined.diverged), refined)
        return refined

    def share_registration(self, frames: Iterable[Pair]) -> None:
        """Decides by some frames together how the images of a sequence are moved to the points.

        Images of the size of the first one are then all moved alike; else each decides alone.

        Args:
            frames: Frames (image, sparse) of the sequence, such as 16 spread over it.

        Raises:
            InputError: A frame is no such pair, or cannot be used.
        """
        read = [_frame_of_pair(pair, self._register) for pair in frames]
        if read:
            with self._lock:
                self._method_for(read[0]).share_registration(read)

    def _keep_registration(self, method: Method, frame: Frame) -> list[str]:
        """Lets the first frames of a size decide how it and later ones are moved, and says so."""
        if self._register != "auto" or frame.size in method.registrations:
            return []
        telling = self._telling.setdefault(frame.size, [])
        of_frame = frame.evidence_of_registration
        if of_frame is not None:
            telling.append(of_frame)
        if len(telling) < DECIDED_BY:
            return []
        shared = estimate_registration(self._telling.pop(frame.size))
        method.registrations[frame.size] = shared
        # Nothing is said of images that were never moved, and stay.
        if shared is None and self._moved.get(frame.size, set()) <= {str(None)}:
            return []
        how = "are not moved" if shared is None else f"are all moved by {shared}"
        return [
            f"registration: from now on images of this size {how}, as {DECIDED_BY} frames show"
            " together; `share_registration` decides it by other frames"
        ]

    def _differs(self, frame: Frame, refined: Refined) -> bool:
        """Whether this image was moved otherwise than the earlier ones of its size."""
        if frame.image is None:
            return False
        moved = self._moved.setdefault(frame.size, set())
        moved.add(str(refined.registration))
        return len(moved) > 1

    def _method_for(self, first: Frame) -> Method:
        """The method, which this frame decides if it is the first."""
        if self._is_closed:
            raise UsageError("this Refiner is closed; make another one, or stay inside its `with`")
        if self._method is None:
            with ExitStack() as opening:
                opening.enter_context(_opened([network.module for network in self._networks]))
                networks = list(self._networks)
                if self._adapt:
                    resolved = resolve_definition(networks[0], first.registered())
                    networks[0] = self._adapt_network(resolved, opening)
                method = Method(
                    networks,
                    self._asked,
                    first,
                    uncertainty=self._uncertainty,
                    keep_measured=self._keep_measured,
                )
                self._method = opening.enter_context(method)
                self._stack = opening.pop_all()
        return self._method

    def _adapt_network(self, network: Network, opening: ExitStack) -> Network:
        """The network with the weights that it learnt, if they are better, and a note on them."""
        why = too_little(len(self._adapt), self._adapt[0])
        weights = "the network's own weights: "
        if why is None:
            named = ((f"frame {number}", frame) for number, frame in enumerate(self._adapt))
            learnt = learn(network, named, seed=self._asked.seed)
            why = str(learnt)
            if learnt.is_better:
                weights = ""
                opening.enter_context(weights_in_place(network, learnt.weights))
        return replace(network, notes=(*network.notes, f"adapt: {weights}{why}"))


@contextmanager
def _opened(modules: Sequence[nn.Module]) -> Iterator[None]:
    """Inside, no other refiner opens these modules: two cuts of one would disturb each other."""
    with _OPENING:
        if len(set(modules)) < len(modules) or not _OPEN.isdisjoint(modules):
            raise UsageError(
                "a network is in use by another Refiner: close that one, share it between threads,"
                " or load the network again"
            )
        _OPEN.update(modules)
    try:
        yield
    finally:
        _OPEN.difference_update(modules)


def in_metres(depth: ArrayLike, what: str, unit: Unit | None = None) -> NDArray[np.float32]:
    """Returns depth as float32 metres; not finite or <= 0 is unknown.

    Args:
        depth: Depth in an array of any shape.
        what: Name of the depth in messages.
        unit: Unit of the depth; needed for integers, and for depth that is too large for metres.

    Raises:
        InputError: The unit is needed.
        UsageError: There is no such unit.
    """
    values = _numbers(depth, what)
    if unit is not None:
        if unit not in UNITS:
            raise UsageError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
        return (values / UNITS[unit]).astype(np.float32)
    known = values[np.isfinite(values) & (values > 0)]
    if values.dtype.kind in "iu":
        raise InputError(
            f'{what} is of {values.dtype}; give its unit, such as unit="mm" or unit="m"'
        )
    if known.size and np.median(known) > FARTHEST_MEDIAN_M:
        raise InputError(
            f"{what} is {np.median(known):,.0f} in the median, which is too far for metres; give"
            ' its unit, such as unit="mm" or unit="m"'
        )
    return values.astype(np.float32)


def _numbers(values: ArrayLike, what: str) -> NDArray[Any]:
    """An array of real numbers. Raises InputError if the values are none."""
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:  # ragged rows, a tensor on a GPU
        raise InputError(f"{what} cannot be made an array: {error}") from None
    if array.dtype.kind not in "buif":
        raise InputError(f"{what} must be an array of numbers, not {type(values).__name__}")
    return array


def frame_of_arrays(
    image: ArrayLike | None,
    sparse: ArrayLike | SparsePoints,
    register: Register = None,
    unit: Unit | None = None,
    camera: ArrayLike | Camera | None = None,
    depth: ArrayLike | Sequence[ArrayLike] = (),
) -> Frame:
    """Returns the frame of an image and its sparse depth; see `Refiner.refine`.

    Raises:
        InputError: Image or points cannot be used.
    """
    rgb = None if image is None else _rgb(image)
    size = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    points, unknown = _points(sparse, size, unit)
    points = points.resized(*size) if size else points
    inside = points.cropped(0, 0, *points.size)
    if not len(inside):
        raise NoPointsError(f"none of the {len(points)} sparse points lies in the image")
    lost = {"outside the image": len(points) - len(inside), "without a depth above 0": unknown}
    return Frame(
        rgb=None if rgb is None else tensor_of(rgb),
        points=inside,
        camera=None if camera is None else _camera(camera, inside.size),
        predicted=tuple(_maps(depth, inside.size)),
        register=register,
        one_view=register is None,
        notes=tuple(f"sparse: {n:,} points {why} are not used" for why, n in lost.items() if n),
    )


def _maps(depth: ArrayLike | Sequence[ArrayLike], size: tuple[int, int]) -> Iterator[Tensor]:
    """The depth maps (H, W), NaN = unknown. Raises InputError if one has another size."""
    maps: list[Any] = [depth]
    if isinstance(depth, list | tuple) and (not depth or np.ndim(depth[0]) > 1):
        maps = [*depth]
    for numbers in maps:
        values = _numbers(numbers, "the depth map").astype(np.float32)
        if values.shape != size:
            raise InputError(f"the depth map is {values.shape}, but the image is {size}")
        known = np.isfinite(values)
        if not known.any():
            raise InputError("the depth map has no finite value")
        yield torch.from_numpy(np.where(known, values, np.float32(np.nan)))


def _camera(camera: ArrayLike | Camera, size: tuple[int, int]) -> Camera:
    """The camera of an image (H, W). Raises InputError if no camera has these intrinsics."""
    if isinstance(camera, Camera):
        if camera.size is not None and camera.size != size:
            raise InputError(f"the camera's images are {camera.size}, but the image is {size}")
        return camera
    intrinsics = _numbers(camera, "the camera's intrinsics").astype(np.float64)
    if intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all():
        raise InputError(f"the camera's intrinsics are finite (3, 3), not {intrinsics.shape}")
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0 or intrinsics[2].tolist() != [0, 0, 1]:
        raise InputError(
            "the camera's intrinsics are fx 0 cx, 0 fy cy, 0 0 1 in pixels, with fx and fy above 0"
        )
    return Camera(intrinsics=intrinsics, size=size, source="given")


def _frame_of_pair(pair: Pair, register: Register) -> Frame:
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(f"frames are pairs (image, sparse), not {type(pair).__name__}")
    return frame_of_arrays(*pair, register)


def _rgb(image: ArrayLike) -> NDArray[np.float32]:
    """The image as (H, W, 3) in 0…1."""
    values = _numbers(image, "an image")
    if values.ndim == 2:
        values = values[:, :, None].repeat(3, axis=2)
    if values.ndim != 3 or values.shape[2] != 3 or not values.size:
        raise InputError(f"an image has shape (H, W, 3) or (H, W), not {np.shape(image)}")
    if values.dtype in FULL_SCALE:
        white = 255.0 if values.max() <= 255 else FULL_SCALE[values.dtype]  # as files are read
        return (values / white).astype(np.float32)
    if values.dtype.kind != "f" or not (values >= 0).all() or not (values <= 1).all():
        raise InputError(
            "an image is uint8, uint16, or float in 0..1; this one is"
            f" {values.dtype} in {values.min()}..{values.max()}; divide it by its white"
        )
    return values.astype(np.float32)


def _points(
    sparse: ArrayLike | SparsePoints, size: tuple[int, int] | None, unit: Unit | None
) -> tuple[SparsePoints, int]:
    """The points, and how many rows have no depth.

    Points of a map have the map's size, rows of x, y and depth the image's.
    """
    if isinstance(sparse, SparsePoints):
        return sparse.tensors(), 0
    values = _numbers(sparse, "sparse depth")
    unknown = 0
    if values.ndim != 2:
        raise InputError(f"sparse depth has shape (H, W) or (N, 3), not {values.shape}")
    # Three columns are rows of x, y and depth, unless the image is as narrow as that.
    if values.shape[1] == 3 and values.shape != size:
        if size is None:
            raise InputError("rows of x, y and depth need an image for the size of the frame")
        column = in_metres(values[:, 2], "the sparse depth", unit)
        known = np.isfinite(values).all(axis=1) & (column > 0)
        xy = values[known, :2].astype(np.float32)
        depth = column[known]
        unknown = int(np.count_nonzero(~known))
    else:
        # Anything else is a depth map, of which the known pixels are points.
        if size is not None and values.shape != size:
            raise InputError(f"the sparse depth map is {values.shape} but the image is {size}")
        size = values.shape[0], values.shape[1]
        values = in_metres(values, "the sparse depth", unit)
        rows, columns = np.nonzero(np.isfinite(values) & (values > 0))
        xy = np.stack([columns, rows], axis=1).astype(np.float32)
        depth = values[rows, columns]
    if not len(depth):
        raise NoPointsError("the sparse depth has no value above 0")
    return SparsePoints(xy=xy, depth=depth, size=size).tensors(), unknown
