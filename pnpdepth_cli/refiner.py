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
from pnpdepth_cli.frames.adapt import learn, reason_not_to_learn, weights_in_place
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

WHITE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
"""Value of white by the type of an image's integers."""

Unit = Literal["m", "mm"]
UNITS = {"m": 1.0, "mm": 1000.0}
"""How many of each unit of depth make a metre."""

FARTHEST_MEDIAN_M = 200.0
"""No frame has half of its depths farther than this; a larger median is in another unit."""

DECIDED_BY = 5
"""So many frames of one size decide together how later ones are moved to their points."""

_OPEN: set[nn.Module] = set()
"""Modules that refiners have cut open."""
_OPENING = threading.Lock()
"""Lock of `_OPEN`."""

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
        # What the user asks for, checked.
        self._networks = list(network) if isinstance(network, Sequence) else [network]
        if not self._networks or not all(
            isinstance(network, Network) for network in self._networks
        ):
            raise UsageError("network must be from load_network, or several in a list")
        if not isinstance(settings, Settings | None):
            raise UsageError(f"settings must be Settings, not {type(settings).__name__}")
        self._asked = Settings() if settings is None else settings
        self._uncertainty = uncertainty
        self._keep_measured = keep_measured
        self._register = registration_to_make(registration, self._asked)
        self._adapt = [_frame_of_pair(pair, self._register) for pair in adapt]
        # What follows from the first frame, and lasts until the refiner is closed.
        self._method: Method | None = None
        self._is_closed = False
        self._moved: dict[tuple[int, int], set[str]] = {}
        """How images were moved to their points, as texts, by the image's (H, W)."""
        self._evidences: dict[tuple[int, int], list[Evidence]] = {}
        """What the first frames tell of the registration, by the image's (H, W)."""
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
        # The arrays are checked and refined, by one thread at a time.
        frame = frame_of_arrays(image, sparse, self._register, unit, camera, depth)
        with self._lock:
            method = self._method_for(frame)
            notes_on_registration = self._keep_registration(method, frame)
            refined = method.refine(frame, with_stages=stages)
            # Until frames of this size decide together, each decides alone how its image is moved
            # to the points, and two may decide differently.
            decides_alone = self._register == "auto" and frame.size not in method.registrations
            is_moved_otherwise = decides_alone and self._is_moved_otherwise(frame, refined)
        # What a person should know, and how the frame is saved.
        notes = [
            *method.first_member.network.notes,
            *frame.notes,
            *notes_on_registration,
            *refined.notes,
        ]
        if is_moved_otherwise:
            notes.append(
                "note: images of this size were moved to their points in different ways;"
                " `share_registration` decides once for a sequence"
            )
        refined = replace(refined, notes=tuple(notes), saver=save)
        # A refinement that diverged is an error, which holds the frame as it was before that.
        if refined.diverged is not None:
            raise DivergedError(str(refined.diverged), refined)
        return refined

    def share_registration(self, frames: Iterable[Pair]) -> None:
        """Decides by some frames together how the images of a sequence are moved to the points.

        Not all frames tell how. All images of the size of the first that does are moved alike from
        then on. An image of another size is moved as its own points say.

        Args:
            frames: Frames (image, sparse) of the sequence, such as 16 spread over it.

        Raises:
            InputError: A frame is no such pair, or cannot be used.
        """
        checked = [_frame_of_pair(pair, self._register) for pair in frames]
        if checked:
            with self._lock:
                self._method_for(checked[0]).share_registration(checked)

    def _keep_registration(self, method: Method, frame: Frame) -> list[str]:
        """Decides how images of a frame's size are moved, once `DECIDED_BY` such frames tell how.

        From then on all images of that size are moved to their points in one way, which
        `method.registrations` holds.

        Args:
            method: The method, which gets the registration.
            frame: The frame that is refined next.

        Returns:
            A list of one note, which says what is decided now; empty if nothing is decided in this
            call, or nothing changes by it.
        """
        if self._register != "auto" or frame.size in method.registrations:
            return []  # the user states it, or it is decided already
        # What this frame tells is added to what frames of its size told before.
        evidences = self._evidences.setdefault(frame.size, [])
        evidence = frame.evidence_of_registration
        if evidence is not None:
            evidences.append(evidence)
        if len(evidences) < DECIDED_BY:
            return []
        shared = estimate_registration(self._evidences.pop(frame.size))
        method.registrations[frame.size] = shared
        # No note where images of this size were not moved so far, and will not be. In `_moved` the
        # text of a registration of None, "None", stands for an image that was not moved.
        moved_before = self._moved.get(frame.size, set()) - {str(None)}
        if shared is None and not moved_before:
            return []
        how = "are not moved"
        if shared is not None:
            how = f"are all moved by {shared}"
        return [
            f"registration: from now on images of this size {how}, as {DECIDED_BY} frames show"
            " together; `share_registration` decides it by other frames"
        ]

    def _is_moved_otherwise(self, frame: Frame, refined: Refined) -> bool:
        """Whether images of a frame's size, this one included, were moved in different ways so far.

        How this image was moved to its points is remembered for later calls.

        Args:
            frame: The frame, before it was refined.
            refined: The same frame refined, which says how its image was moved.
        """
        if frame.image is None:
            return False  # there is no image to move
        moved = self._moved.setdefault(frame.size, set())
        moved.add(str(refined.registration))
        return len(moved) > 1

    def _method_for(self, first: Frame) -> Method:
        """The method with its networks, open for refinement. The first call makes it.

        Args:
            first: The frame that is to be refined. That of the first call decides the settings
                which the user and the networks' definitions leave open; later ones have no effect.

        Raises:
            UsageError: The refiner is closed, or another one uses a network.
        """
        if self._is_closed:
            raise UsageError("this Refiner is closed; make another one, or stay inside its `with`")
        if self._method is None:
            # Where any step fails, the stack undoes those before it.
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
        """The network with a note on what it learnt from the frames of `adapt`.

        Its module has the learnt weights until the stack closes, if they are better.

        Args:
            network: The network, its definition with nothing left open.
            opening: Stack of what is undone when the refiner closes.
        """
        reason = reason_not_to_learn(len(self._adapt), self._adapt[0])
        note = f"adapt: the network's own weights: {reason}"
        if reason is None:
            named_frames = ((f"frame {number}", frame) for number, frame in enumerate(self._adapt))
            learnt = learn(network, named_frames, seed=self._asked.seed)
            note = f"adapt: the network's own weights: {learnt}"
            if learnt.is_better:
                note = f"adapt: {learnt}"
                opening.enter_context(weights_in_place(network, learnt.weights))
        return replace(network, notes=(*network.notes, note))


@contextmanager
def _opened(modules: Sequence[nn.Module]) -> Iterator[None]:
    """Inside, no other refiner can open these modules: two cuts of one would disturb each other.

    Args:
        modules: The networks' modules.

    Raises:
        UsageError: A module is open already, or is among these twice.
    """
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
    """Returns depth as float32 metres, of the same shape; unknown depth stays as it is.

    Args:
        depth: Depth in an array of any shape; not finite or <= 0 is unknown.
        what: Name of the depth in messages.
        unit: Unit of the depth; needed for integers, and for depth that is too large for metres.

    Raises:
        InputError: The unit is needed, or the depth is no array of numbers.
        UsageError: There is no such unit.
    """
    numbers = _numbers(depth, what)
    if unit is not None:
        if unit not in UNITS:
            raise UsageError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
        return (numbers / UNITS[unit]).astype(np.float32)
    known = numbers[np.isfinite(numbers) & (numbers > 0)]
    if numbers.dtype.kind in "iu":
        raise InputError(
            f'{what} is of {numbers.dtype}; give its unit, such as unit="mm" or unit="m"'
        )
    if known.size and np.median(known) > FARTHEST_MEDIAN_M:
        raise InputError(
            f"{what} is {np.median(known):,.0f} in the median, which is too far for metres; give"
            ' its unit, such as unit="mm" or unit="m"'
        )
    return numbers.astype(np.float32)


def _numbers(values: ArrayLike, what: str) -> NDArray[Any]:
    """An array of real numbers or bools. Raises InputError if the values are none.

    Args:
        values: What the user gives.
        what: Name of the values in messages.
    """
    try:
        array = np.asarray(values)
    # numpy raises ValueError for ragged rows; torch TypeError for a tensor on a GPU, and
    # RuntimeError for one with a gradient.
    except (ValueError, TypeError, RuntimeError) as error:
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
    """Returns the frame of an image and its sparse depth, checked.

    Points outside the image are left out; a note counts them.

    Args:
        image: Image as `Refiner.refine` takes it, or None.
        sparse: Sparse depth as `Refiner.refine` takes it.
        register: How the image is to be moved to the points. None: it is not, and both are taken as
            of one view.
        unit: Unit of the depth of an array.
        camera: Intrinsics (3, 3) in pixels of the image, or a Camera.
        depth: Depth map (H, W) of another network, or several in a list.

    Raises:
        InputError: Image, points, camera or depth maps cannot be used.
    """
    # Image and points, these in pixels of the image.
    rgb = None if image is None else _rgb(image)
    size = None if rgb is None else (rgb.shape[0], rgb.shape[1])
    points, unknown_count = _points(sparse, size, unit)
    if size is not None:  # points of another resolution
        points = points.resized(*size)
    inside = points.cropped(0, 0, *points.size)
    if not len(inside):
        raise NoPointsError(f"none of the {len(points)} sparse points lies in the image")
    # What is not used, by reason.
    unused = {
        "outside the image": len(points) - len(inside),
        "without a depth above 0": unknown_count,
    }
    notes = [
        f"sparse: {count:,} points {reason} are not used"
        for reason, count in unused.items()
        if count
    ]
    return Frame(
        rgb=None if rgb is None else tensor_of(rgb),
        points=inside,
        camera=None if camera is None else _camera(camera, inside.size),
        predicted=tuple(_maps(depth, inside.size)),
        register=register,
        one_view=register is None,
        notes=tuple(notes),
    )


def _maps(depth: ArrayLike | Sequence[ArrayLike], size: tuple[int, int]) -> Iterator[Tensor]:
    """Yields depth maps of networks (H, W) float32 in their own numbers, NaN = unknown.

    Args:
        depth: One map, also as a list of rows; or a list of maps, which may be empty.
        size: (H, W) of the image.

    Raises:
        InputError: A map has another size, or no finite value.
    """
    # A list is one map of rows, unless it is empty or its first entry is a map of two axes.
    maps: list[Any] = [depth]
    if isinstance(depth, list | tuple) and (not depth or np.ndim(depth[0]) > 1):
        maps = [*depth]
    for depth_map in maps:
        numbers = _numbers(depth_map, "the depth map").astype(np.float32)
        if numbers.shape != size:
            raise InputError(f"the depth map is {numbers.shape}, but the image is {size}")
        is_known = np.isfinite(numbers)
        if not is_known.any():
            raise InputError("the depth map has no finite value")
        yield torch.from_numpy(np.where(is_known, numbers, np.float32(np.nan)))


def _camera(camera: ArrayLike | Camera, size: tuple[int, int]) -> Camera:
    """The camera of an image, which a user gives as intrinsics or as a Camera.

    Args:
        camera: Intrinsics (3, 3) in pixels of the image, or a Camera of images of this size.
        size: (H, W) of the image.

    Raises:
        InputError: The camera is of another size, or no camera has these intrinsics.
    """
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
    """The frame of a pair (image, sparse).

    Args:
        pair: Image and sparse depth, as `Refiner.refine` takes them.
        register: How the image is to be moved to the points. None: it is not.

    Raises:
        InputError: It is no pair, or image or points cannot be used.
    """
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(f"frames are pairs (image, sparse), not {type(pair).__name__}")
    return frame_of_arrays(*pair, register)


def _rgb(image: ArrayLike) -> NDArray[np.float32]:
    """The image as (H, W, 3) float32 in 0…1. Raises InputError if it is none.

    Integers are divided by their white: 255, or 65535 for uint16 with any value above 255, as
    files are read.
    """
    pixels = _numbers(image, "an image")
    if pixels.ndim == 2:
        pixels = pixels[:, :, None].repeat(3, axis=2)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise InputError(f"an image has shape (H, W, 3) or (H, W), not {np.shape(image)}")
    if pixels.dtype in WHITE:
        white = WHITE[pixels.dtype]
        if pixels.max() <= 255:  # also of uint16 that holds 8 bits
            white = 255.0
        return (pixels / white).astype(np.float32)
    if pixels.dtype.kind != "f" or not (pixels >= 0).all() or not (pixels <= 1).all():
        raise InputError(
            "an image is uint8, uint16, or float in 0..1; this one is"
            f" {pixels.dtype} in {pixels.min()}..{pixels.max()}; divide it by its white"
        )
    return pixels.astype(np.float32)


def _points(
    sparse: ArrayLike | SparsePoints, size: tuple[int, int] | None, unit: Unit | None
) -> tuple[SparsePoints, int]:
    """The points, and how many rows of x, y and depth are left out, as they have no depth above 0.

    Rows that are not finite are among those left out. The points' frame has the size of the map;
    of rows, that of the image; of SparsePoints, their own.

    Args:
        sparse: Depth map, rows or points, as `Refiner.refine` takes them.
        size: (H, W) of the image. None: there is no image.
        unit: Unit of the depth of an array.

    Raises:
        InputError: The array is neither, its size is not the image's, or its unit is not known.
        NoPointsError: No depth is known.
    """
    if isinstance(sparse, SparsePoints):
        return sparse.tensors(), 0
    numbers = _numbers(sparse, "sparse depth")
    unknown_count = 0
    if numbers.ndim != 2:
        raise InputError(f"sparse depth has shape (H, W) or (N, 3), not {numbers.shape}")
    # Three columns are rows of x, y and depth, unless the image is as narrow as that.
    if numbers.shape[1] == 3 and numbers.shape != size:
        if size is None:
            raise InputError("rows of x, y and depth need an image for the size of the frame")
        depth_of_rows = in_metres(numbers[:, 2], "the sparse depth", unit)
        is_known = np.isfinite(numbers).all(axis=1) & (depth_of_rows > 0)
        xy = numbers[is_known, :2].astype(np.float32)
        depth = depth_of_rows[is_known]
        unknown_count = int(np.count_nonzero(~is_known))
    else:
        # Anything else is a depth map, of which the known pixels are points.
        if size is not None and numbers.shape != size:
            raise InputError(f"the sparse depth map is {numbers.shape} but the image is {size}")
        size = numbers.shape[0], numbers.shape[1]
        numbers = in_metres(numbers, "the sparse depth", unit)
        rows, columns = np.nonzero(np.isfinite(numbers) & (numbers > 0))
        xy = np.stack([columns, rows], axis=1).astype(np.float32)
        depth = numbers[rows, columns]
    if not len(depth):
        raise NoPointsError("the sparse depth has no value above 0")
    return SparsePoints(xy=xy, depth=depth, size=size).tensors(), unknown_count
