"""The class of the Python API: frames of arrays, refined with networks that stay open."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace

from numpy.typing import ArrayLike

from pnpdepth_cli.errors import DivergedError, UsageError
from pnpdepth_cli.frames.adapt import learn, too_little, weights_in_place
from pnpdepth_cli.frames.frame import Frame, Registration, registration_to_make
from pnpdepth_cli.frames.from_arrays import Unit, frame_of_arrays
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.frames.resolve import resolve_definition
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings

Pair = tuple[ArrayLike | None, ArrayLike | SparsePoints]
"""An image and its sparse depth; see `Refiner.refine`."""


class Refiner:
    """Refines frames with one network, or several that are fused; a context manager.

    The networks stay cut open from frame to frame and are as before when it closes. What their
    definitions leave open (such as the RGB range of an ONNX file) is decided by the first frame.
    Frames of several threads are refined one after the other.

    Args:
        network: Network from `load_network`; several are fused by the default method.
        settings: Settings of the refinement; what they leave open, the network decides. With any
        setting of the method, `network` alone is refined by it; without, by the default method.
        uncertainty: Whether the standard deviation of the depth is estimated too.
        registration: Whether images are moved to their points: "auto", if their depth edges show
        that they are not registered; "off"; or by (zoom, right, down), pixels.
        adapt: Frames of the same sequence, (image, sparse) each. Before the first frame is refined,
            the weights of `network`, which must take points, learn from them. The new weights are
            used while the refiner is open, if points hidden from its input show that they are
            better.

    Raises:
        UsageError: The settings contradict each other.
        InputError: A frame of `adapt` cannot be used.
    """

    def __init__(
        self,
        network: Network | Sequence[Network],
        settings: Settings | None = None,
        *,
        uncertainty: bool = False,
        registration: Registration = "auto",
        adapt: Sequence[Pair] = (),
    ) -> None:
        self._networks = list(network) if isinstance(network, Sequence) else [network]
        if not self._networks or not all(isinstance(each, Network) for each in self._networks):
            raise UsageError("network must be from load_network, or several in a list")
        if not isinstance(settings, Settings | None):
            raise UsageError(f"settings must be Settings, not {type(settings).__name__}")
        self._asked = settings or Settings()
        self._uncertainty = uncertainty
        self._register = registration_to_make(registration, self._asked)
        self._adapt = [frame_of_arrays(*pair, self._register, None) for pair in adapt]
        self._method: Method | None = None
        self._stack = ExitStack()
        self._lock = threading.Lock()
        if len(self._networks) > 1 and self._asked.fixed_by:
            raise UsageError(f"several networks are fused, but {self._asked.fixed_by} fixes one")

    def __enter__(self) -> Refiner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Refiner({', '.join(map(repr, self._networks))})"

    def close(self) -> None:
        """Restores the networks."""
        self._method = None
        self._stack.close()

    def refine(
        self,
        image: ArrayLike | None,
        sparse: ArrayLike | SparsePoints,
        *,
        unit: Unit | None = None,
    ) -> Refined:
        """Returns one frame of arrays refined.

        Args:
            image: RGB (H, W, 3), uint8, uint16, or in 0..1 or 0..255; also grey (H, W), with alpha,
                or channels first. None for a network that takes sparse depth only.
            sparse: Depth map (H, W) in metres with 0 for unknown, rows (N, 3) of x, y and depth
                (pixel centres at whole numbers), or SparsePoints.
            unit: Unit of the depth of an array, "m" or "mm"; needed for integers, and where half of
            the depths are beyond 200.

        Raises:
            InputError: Image or points cannot be used.
            DivergedError: The loss became non-finite; `last_good` is the Refined before that.
        """
        frame = frame_of_arrays(image, sparse, self._register, unit)
        with self._lock:
            method = self._method_for(frame)
            refined = method.refine(frame)
        refined = replace(refined, notes=(*method.network.notes, *frame.notes, *refined.notes))
        if refined.diverged is not None:
            raise DivergedError(str(refined.diverged), refined)
        return refined

    def share_registration(self, frames: Iterable[Pair]) -> None:
        """Decides by some frames together how the images of a sequence are moved to the points.

        Images of the size of the first one are then all moved alike; else each decides alone.

        Args:
            frames: Frames (image, sparse) of the sequence, such as 16 spread over it.
        """
        read = [frame_of_arrays(*pair, self._register, None) for pair in frames]
        if read:
            with self._lock:
                self._method_for(read[0]).share_registration(read)

    def _method_for(self, first: Frame) -> Method:
        """The method, which this frame decides if it is the first."""
        if self._method is None:
            networks = list(self._networks)
            if self._adapt:
                networks[0] = self._adapt_network(
                    resolve_definition(networks[0], first.registered())
                )
            method = Method(
                networks,
                self._asked,
                first,
                uncertainty=self._uncertainty,
            )
            self._method = self._stack.enter_context(method)
        return self._method

    def _adapt_network(self, network: Network) -> Network:
        """The network with the weights that it learnt, if they are better, and a note on them."""
        why, own = too_little(len(self._adapt), self._adapt[0]), "the network's own weights: "
        if why is None:
            named = ((f"frame {number}", frame) for number, frame in enumerate(self._adapt))
            learnt = learn(network, named, seed=self._asked.seed)
            why = str(learnt)
            if learnt.is_better:
                own = ""
                self._stack.enter_context(weights_in_place(network, learnt.weights))
        return replace(network, notes=(*network.notes, f"adapt: {own}{why}"))
