"""How many frames of one size go through the network together.

Together is faster where frames are small, but the library that convolves may take another way for
several frames than for one, and its sums then differ in the last bits. Which way it takes depends
on the shapes, so it is tried: the first frames of a size are refined one at a time, and then once
more together. Where every bit is the same, and together is faster, the next frames of this size go
together, always so many as were tried. Where bits differ, only a number that the user has named
makes them go together, and that is said.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DeviceError, NoPointsError, PnpDepthError
from pnpdepth_cli.pipeline.refinement.frame import FrameToRefine, RefinedFrame, refine_frames
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.refine import Refiner
from pnpdepth_cli.pipeline.refinement.request import RefineRequest

_MOST = 16
_PIXELS = {"cpu": 2**18}
_PIXELS_ELSEWHERE = 2**23
"""Of the frames that are tried together; beyond it, one frame keeps the device busy by itself."""
_FASTER = 0.95
"""Together must take less than this share of the time of one at a time."""
_LAST_BITS = 1e-3
"""Plain predictions further apart than this, relative to depth, differ in more than rounding."""


@dataclass(frozen=True, kw_only=True)
class _Alone:
    """A frame that was refined by itself, and the seconds it took."""

    inputs: Inputs
    frame: RefinedFrame
    seconds: float


class FrameGroups:
    """Refines frames, together where they may be; split: the refiner's network, open.

    wanted: how many, None for as many as give the same bits in less time. say: told what was found.
    """

    def __init__(
        self, refiner: Refiner, split: Split, wanted: int | None, say: Callable[[str], None]
    ) -> None:
        why_alone = _why_alone(refiner.request)
        if why_alone is not None:
            if wanted not in (None, 1):
                say(f"batch size: 1; {why_alone}")
            wanted = 1
        self._refiner, self._split = refiner, split
        self._wanted, self._say = wanted, say
        self._found: dict[tuple[int, int], int] = {}  # by size, how many go together
        self._most: dict[tuple[int, int], int] = {}  # by size, how many memory allows
        self._inexact: set[tuple[int, int]] = set()
        self._alone: list[_Alone] = []  # the last frames, all of one size that is to be tried

    @property
    def largest(self) -> int:
        """So many frames go together at most."""
        return max(self._found.values(), default=1)

    def of_size(self, size: tuple[int, int]) -> int:
        """So many frames of this size are to be given at once."""
        return self._found.get(size, 1)

    def refine(self, group: Sequence[Inputs]) -> list[RefinedFrame | Exception]:
        """The frames, all of one size, refined; an error in the place of one that cannot be."""
        if 1 < len(group) == self.of_size(group[0].size):
            frames = self._together(group)
            if frames is not None:
                return frames
        return [self._refined_alone(inputs) for inputs in group]

    def try_out(self) -> None:
        """Once enough frames of a size went one at a time, it is known what together gives."""
        if not self._alone:
            return
        size = self._alone[0].inputs.size
        count = self._to_try(size)
        if len(self._alone) >= count:
            tried, self._alone = self._alone[:count], []
            self._found[size] = self._tried(size, tried)

    def _to_try(self, size: tuple[int, int]) -> int:
        pixels = _PIXELS.get(self._refiner.network.device.type, _PIXELS_ELSEWHERE)
        wanted = self._wanted or min(_MOST, pixels // (size[0] * size[1]))
        return max(1, min(wanted, self._most.get(size, wanted)))

    def _refined_alone(self, inputs: Inputs) -> RefinedFrame | Exception:
        start = time.perf_counter()
        try:
            frame = self._refiner.refine(self._split, inputs)
        except Exception as error:  # one frame's own matter
            return error
        seconds = time.perf_counter() - start
        if self._alone and self._alone[0].inputs.size != inputs.size:
            self._alone.clear()
        if inputs.size not in self._found and self._to_try(inputs.size) > 1:
            self._alone.append(_Alone(inputs=inputs, frame=frame, seconds=seconds))
        return frame

    def _together(self, group: Sequence[Inputs]) -> list[RefinedFrame | Exception] | None:
        """The frames refined in one pass; None where they are to be refined one at a time."""
        size = group[0].size
        try:
            tasks = [self._refiner.task(inputs) for inputs in group]
        except PnpDepthError:  # one frame's own matter
            return None
        try:
            frames = self._pass(tasks, self._refiner.settings)
        except DeviceError:  # out of memory
            self._most[size] = len(group) // 2
            del self._found[size]
            return None
        except Exception:
            self._found[size] = 1
            return None
        if any(isinstance(frame, NoPointsError) for frame in frames):
            return None  # fewer frames went through the network than were tried
        if size in self._inexact:
            note = f"refined together with {len(group) - 1} others, which alters the last bits"
            return [
                replace(f, notes=(*f.notes, note)) if isinstance(f, RefinedFrame) else f
                for f in frames
            ]
        return list(frames)

    def _pass(
        self, tasks: Sequence[FrameToRefine], settings: RefineSettings
    ) -> list[RefinedFrame | PnpDepthError]:
        torch.manual_seed(self._refiner.request.hold_out.seed)
        return refine_frames(self._refiner.network, self._split, settings, tasks)

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
        tasks, what = [self._refiner.task(each.inputs) for each in alone], _name(size)
        plain = self._pass(tasks, replace(self._refiner.settings, iterations=0))
        if not self._split.static_graph:
            self._say(
                f"batch size: 1 for {what}; the network goes by values of its pictures, which for"
                " several at once need not be those of each"
            )
            return False
        if not all(_is_close(one, each.frame) for one, each in zip(plain, alone, strict=True)):
            self._say(f"batch size: 1 for {what}; frames that go together change one another")
            return False
        exact = all(_same(one.before, each.frame.before) for one, each in _frames(plain, alone))
        spent_s = expected_s = 0.0
        if exact:
            start = time.perf_counter()
            frames = self._pass(tasks, self._refiner.settings)
            spent_s = time.perf_counter() - start
            expected_s = len(alone) * statistics.median(each.seconds for each in alone)
            exact = len(list(_frames(frames, alone))) == len(alone) and all(
                _is_equal(one, each.frame) for one, each in _frames(frames, alone)
            )
        return self._decided(size, len(alone), exact, spent_s, expected_s)

    def _decided(
        self, size: tuple[int, int], count: int, exact: bool, spent_s: float, expected_s: float
    ) -> bool:
        what = f"{count} frames of {_name(size)} together"
        if exact and (self._wanted or spent_s < _FASTER * expected_s):
            self._say(
                f"batch size: {what}, {expected_s / spent_s:.1f} × as fast and equal bit for bit to"
                " one at a time"
            )
            return True
        if exact:
            self._say(f"batch size: 1 for {_name(size)}; {count} together are no faster")
            return False
        if self._wanted:
            self._say(
                f"warning: batch size: {what} differ from one at a time in the last bits of what"
                " the network gives; --batch-size auto keeps results those of single frames"
            )
            self._inexact.add(size)
            return True
        self._say(
            f"batch size: 1 for {_name(size)}; {count} together differ in the last bits"
            f" (--batch-size {count} takes them so all the same)"
        )
        return False


def _why_alone(request: RefineRequest) -> str | None:
    """Why each frame has to be refined by itself, None where it has not."""
    if request.hold_out.needs_folds:
        return "what goes by held-out points is chosen for each frame alone"
    if request.network.tile is not None:
        return "tiles go through the network one by one"
    return None


def _frames(
    frames: Sequence[RefinedFrame | PnpDepthError], alone: Sequence[_Alone]
) -> list[tuple[RefinedFrame, _Alone]]:
    pairs = zip(frames, alone, strict=True)
    return [(frame, each) for frame, each in pairs if isinstance(frame, RefinedFrame)]


def _is_close(frame: RefinedFrame | PnpDepthError, other: RefinedFrame) -> bool:
    return isinstance(frame, RefinedFrame) and np.allclose(
        frame.before, other.before, rtol=_LAST_BITS, atol=0
    )


def _is_equal(frame: RefinedFrame, other: RefinedFrame) -> bool:
    """True where nothing that is written of the two differs."""
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
