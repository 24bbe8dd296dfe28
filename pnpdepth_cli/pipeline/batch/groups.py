"""Decides how many frames of one size go through the network together.

A batch of small frames is faster than single ones, but a convolution library may choose another
algorithm for it, and results then differ in the last bits. As that depends on the shapes, it is
tried: the first frames of a size are refined one at a time, and then once more together. If every
bit is equal and together is faster, the next frames of this size go together, always as many as
were tried. If bits differ, frames go together only where the user names the number, with a warning.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DeviceError, NoPointsError, PnpDepthError, UsageError
from pnpdepth_cli.frames.frame import RefinedFrame, WarmStart
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.method import needs_check, resolve_method
from pnpdepth_cli.pipeline.refinement.refiner import Opened, Refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import moves_weights

_MAX_FRAMES = 16
_MAX_PIXELS = {"cpu": 2**18}
_MAX_PIXELS_GPU = 2**23
"""Of the frames that are tried together; a larger single frame keeps the device busy by itself."""
_MAX_TIME_RATIO = 0.95
"""Together must take less than this fraction of the time of one at a time."""
_ROUNDING = 1e-3
"""A larger relative difference of plain predictions is more than rounding."""


@dataclass(frozen=True, kw_only=True)
class _Alone:
    """A frame that was refined by itself."""

    inputs: Inputs
    """As read."""
    frame: RefinedFrame
    """The result."""
    seconds: float
    """How long it took."""


class FrameGroups:
    """Refines frames, several together where that changes no result.

    Args:
        refiner: The network and its settings.
        opened: The refiner's networks, open.
        wanted: How many frames go together; None for as many as give equal bits in less time.
        say: Receives what was decided.
    """

    def __init__(
        self, refiner: Refiner, opened: Opened, wanted: int | None, say: Callable[[str], None]
    ) -> None:
        why_alone = _why_alone(refiner.request)
        if why_alone is not None:
            if wanted not in (None, 1):
                say(f"batch size: 1; {why_alone}")
            wanted = 1
        self.refiner, self._opened = refiner, opened
        self._wanted, self._say = wanted, say
        self._count: dict[tuple[int, int], int] = {}  # by size, how many go together
        self._limit: dict[tuple[int, int], int] = {}  # by size, how many fit into memory
        self._inexact: set[tuple[int, int]] = set()
        self._carried: dict[str, WarmStart] = {}  # of the last frame, by the first of its window
        self._alone: list[_Alone] = []  # the last frames, of one size not tried yet

    @property
    def largest(self) -> int:
        """The most frames that go together."""
        return max(self._count.values(), default=1)

    def of_size(self, size: tuple[int, int]) -> int:
        """Returns how many frames of this size go together."""
        return self._count.get(size, 1)

    def refine(self, group: Sequence[Inputs]) -> list[RefinedFrame | Exception]:
        """Returns the refined frames, all of one size; for one that fails, its error."""
        if 1 < len(group) == self.of_size(group[0].size):
            frames = self._together(group)
            if frames is not None:
                return frames
        return [self._refined_alone(inputs) for inputs in group]

    def try_out(self) -> None:
        """Decides for a size, once enough frames of it were refined one at a time."""
        if not self._alone:
            return
        size = self._alone[0].inputs.size
        count = self._to_try(size)
        if len(self._alone) >= count:
            tried, self._alone = self._alone[:count], []
            self._count[size] = self._tried(size, tried)

    def _to_try(self, size: tuple[int, int]) -> int:
        pixels = _MAX_PIXELS.get(self.refiner.network.device.type, _MAX_PIXELS_GPU)
        wanted = self._wanted or min(_MAX_FRAMES, pixels // (size[0] * size[1]))
        return max(1, min(wanted, self._limit.get(size, wanted)))

    def _refined_in_window(self, inputs: Inputs) -> RefinedFrame | Exception:
        """The frame, beginning where the one before in its window ended; alone if that failed."""
        first, begins = inputs.window[0], len(inputs.window) == 1
        carried = WarmStart() if begins else self._carried.get(first, WarmStart())
        self._carried = {}
        try:
            frame = self.refiner.refine_next(self._opened, inputs, carried)
        except Exception as error:  # concerns this frame only
            return error
        self._carried = {first: frame.carried or WarmStart()}
        return replace(frame, carried=None)

    def _refined_alone(self, inputs: Inputs) -> RefinedFrame | Exception:
        if inputs.window:
            return self._refined_in_window(inputs)
        start = time.perf_counter()
        try:
            frame = self.refiner.refine(self._opened, inputs)
        except Exception as error:  # concerns this frame only
            return error
        seconds = time.perf_counter() - start
        if self._alone and self._alone[0].inputs.size != inputs.size:
            self._alone.clear()
        if inputs.size not in self._count and self._to_try(inputs.size) > 1:
            self._alone.append(_Alone(inputs=inputs, frame=frame, seconds=seconds))
        return frame

    def _together(self, group: Sequence[Inputs]) -> list[RefinedFrame | Exception] | None:
        """The frames refined in one pass; None if they are to be refined one at a time."""
        size = group[0].size
        try:
            frames = self._pass(group, self.refiner.settings)
        except DeviceError:  # out of memory
            self._limit[size] = len(group) // 2
            del self._count[size]
            return None
        except UsageError:  # concerns one frame only, such as too few points to hold some out
            return None
        except Exception:
            self._count[size] = 1
            return None
        if any(isinstance(frame, NoPointsError) for frame in frames):
            return None  # fewer frames went through the network than were compared
        if size in self._inexact:
            note = f"refined together with {len(group) - 1} others, which alters the last bits"
            return [
                replace(f, notes=(*f.notes, note)) if isinstance(f, RefinedFrame) else f
                for f in frames
            ]
        return list(frames)

    def _pass(
        self, group: Sequence[Inputs], settings: RefineSettings
    ) -> list[RefinedFrame | PnpDepthError]:
        assert isinstance(self._opened, Split)
        return self.refiner.refine_together(self._opened, group, settings)

    def _tried(self, size: tuple[int, int], alone: Sequence[_Alone]) -> int:
        """How many frames of the size are to go together from now on."""
        count = len(alone)
        while count > 1:
            try:
                return count if self._may_go_together(size, alone[:count]) else 1
            except DeviceError:
                count //= 2
            except PnpDepthError as error:
                self._say(f"batch size: 1 for {_name(size)}; together: {error}")
                return 1
        return 1

    def _may_go_together(self, size: tuple[int, int], alone: Sequence[_Alone]) -> bool:
        """Whether frames refined together, in less time, have the same results as alone."""
        group = [each.inputs for each in alone]
        plain = self._pass(group, replace(self.refiner.settings, iterations=0))
        assert isinstance(self._opened, Split)
        if not self._opened.static_graph:
            self._say(
                f"batch size: 1 for {_name(size)}; the network's control flow depends on image"
                " values, which differ between the frames of a batch"
            )
            return False
        if not all(_is_close(one, each.frame) for one, each in zip(plain, alone, strict=True)):
            self._say(
                f"batch size: 1 for {_name(size)}; frames that go together influence each other"
            )
            return False
        exact = all(_same(one.before, each.frame.before) for one, each in _frames(plain, alone))
        spent_s = expected_s = 0.0
        if exact:
            start = time.perf_counter()
            frames = self._pass(group, self.refiner.settings)
            spent_s = time.perf_counter() - start
            expected_s = len(alone) * statistics.median(each.seconds for each in alone)
            exact = len(list(_frames(frames, alone))) == len(alone) and all(
                _is_equal(one, each.frame) for one, each in _frames(frames, alone)
            )
        return self._decided(size, len(alone), exact, spent_s, expected_s)

    def _decided(
        self, size: tuple[int, int], count: int, exact: bool, spent_s: float, expected_s: float
    ) -> bool:
        group = f"{count} frames of {_name(size)} together"
        if exact and (self._wanted or spent_s < _MAX_TIME_RATIO * expected_s):
            self._say(
                f"batch size: {group}, {expected_s / spent_s:.1f} × as fast and equal bit for bit"
                " to one at a time"
            )
            return True
        if exact:
            self._say(f"batch size: 1 for {_name(size)}; {count} together are no faster")
            return False
        if self._wanted:
            self._say(
                f"warning: batch size: {group} differ from one at a time in the last bits of the"
                " network's output; --batch-size auto keeps the results of single frames"
            )
            self._inexact.add(size)
            return True
        self._say(
            f"batch size: 1 for {_name(size)}; {count} together differ in the last bits"
            f" (--batch-size {count} refines them together nevertheless)"
        )
        return False


def _why_alone(request: RefineRequest) -> str | None:
    """Why each frame has to be refined by itself; None if it need not."""
    if resolve_method(request).is_default or needs_check(request):
        return "the default method refines each frame alone"
    if request.network.tile is not None:
        return "tiles go through the network one by one"
    if moves_weights(request.method):
        return "weights are updated for each frame alone"
    if request.files.window:
        return "each frame of a window begins where the one before ended"
    return None


def _frames(
    frames: Sequence[RefinedFrame | PnpDepthError], alone: Sequence[_Alone]
) -> list[tuple[RefinedFrame, _Alone]]:
    pairs = zip(frames, alone, strict=True)
    return [(frame, each) for frame, each in pairs if isinstance(frame, RefinedFrame)]


def _is_close(frame: RefinedFrame | PnpDepthError, other: RefinedFrame) -> bool:
    return isinstance(frame, RefinedFrame) and np.allclose(
        frame.before, other.before, rtol=_ROUNDING, atol=0
    )


def _is_equal(frame: RefinedFrame, other: RefinedFrame) -> bool:
    """True if all that is written of the two is equal."""
    return (
        _same(frame.before, other.before)
        and _same(frame.after, other.after)
        and frame.refinement.losses == other.refinement.losses
        and frame.refinement.step == other.refinement.step
        and (frame.alignment, frame.notes) == (other.alignment, other.notes)
        and str(frame.diverged) == str(other.diverged)
    )


def _same(one: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    return one.tobytes() == other.tobytes()


def _name(size: tuple[int, int]) -> str:
    return f"{size[1]}×{size[0]}"
