"""A network cut at its arguments: what does not depend on those that vary is computed once."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.recording import Recording
from pnpdepth_cli.core.split.replay import Replay
from pnpdepth_cli.core.split.split import Split
from pnpdepth_cli.core.split.structure import tensors_in

_BEFORE_ALL_CALLS = -1
"""Position of the cut among the recorded calls."""


class InputSplit(Split):
    """A network cut at some of its arguments, as a context manager.

    with InputSplit(network) as split:
        output = split.first(rgb, sparse, varying={1})     # once for each frame
        output = split.again(rgb, fewer_points)            # many times

    In `again`, submodules that do not depend on a varying argument return what they gave in
    `first`, as the image encoder of a network that takes image and sparse depth. A network that
    branches on values of its arguments runs as a whole, unless `static_graph` promises otherwise.

    Args:
        network: Any module.
        static_graph: As of `Split`.
    """

    def __init__(self, network: nn.Module, *, static_graph: bool = False) -> None:
        super().__init__(network, "", static_graph=static_graph)
        self._varying: frozenset[int] = frozenset()

    def _find_cut(self) -> CutPoint:
        return CutPoint.at_arguments(self._network)

    def first(self, *arguments: Any, varying: Collection[int]) -> Any:
        """Returns what the network returns, without gradients, and remembers what is fixed.

        Args:
            *arguments: Of the network's forward.
            varying: Positions of the arguments that `again` may change.
        """
        replay = self._replay
        with torch.no_grad():
            if (
                replay is not None
                and self._varying == frozenset(varying)
                and replay.recording.holds_for(arguments)
            ):
                replay.next_frame(arguments)
                return self._run(replay)
            self._varying = frozenset(varying)
            return self._learn(arguments)

    def again(self, *arguments: Any) -> Any:
        """Returns what the network returns for other values of the varying arguments."""
        replay = self._replay
        if replay is None:
            raise RuntimeError("again() needs first() first")
        replay.change_arguments(arguments)
        return self._run(replay)

    def _learn(self, arguments: Sequence[Any]) -> Any:
        assert self._interception is not None
        self._replay = None  # frees the tensors of the last frame
        self._interception.all()
        replay = Replay(self._cut, arguments)
        replay.recording = Recording(cut=_BEFORE_ALL_CALLS, static_graph=True)
        self._replay = replay
        return self._record_rear(replay, self._varying_tensors(replay))

    def _varying_tensors(self, replay: Replay) -> list[Tensor]:
        value = replay.arguments.value
        return [t for index in sorted(self._varying) for _, t in tensors_in(value[index])]
