"""A method of refinement, with nothing left open, for any number of frames in memory.

This is what `refine`, `batch`, Ray workers and the Python API call; reading and writing are around
it. The default method is `frames.default`. A fixed method is one network, refined as the settings
say.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace

import torch
from torch import Tensor

from pnpdepth_cli.completion.image_registration import Evidence, estimate_registration, evidence
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.errors import PnpDepthError, UsageError
from pnpdepth_cli.frames.default import refine_default
from pnpdepth_cli.frames.frame import Frame, Refined, Register, Validation, make_refined
from pnpdepth_cli.frames.fuse import split_frame
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.resolve import resolve_definition, resolve_member
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.settings import Settings, fixing
from pnpdepth_cli.stages import AFTER, BEFORE, LINEAR

COMPANION = "compact"
"""The network that is fused with the user's, where there is an image."""
_TRIED = 3  # after so many frames that tell nothing of the registration, no more are read


def check_combination(asked: Settings, networks: int) -> None:
    """Checks that settings that fix one network come neither with several nor with "alone".

    Raises:
        UsageError: They do.
    """
    fixed = ", ".join(f"`{name}`" for name in fixing(asked))
    if fixed and networks > 1:
        raise UsageError(f"several networks are fused, but {fixed} fixes one")
    if fixed and asked.method == "alone":
        raise UsageError(f"with {fixed} the network is refined alone: leave out `method` alone")


class Method:
    """Refines frames with one network, or several that are fused; a context manager.

    The networks are cut when the first frame is refined, and are as before when it closes.

    Args:
        networks: Networks of the user; several are fused by the default method.
        asked: Settings that the user gives. With any setting of the method, the network is refined
        by it alone; without, by the default method.
        first: The first frame, which decides what definitions leave open.
        more: Function of further frames, which decide as well; called only if a network needs it.
        validated: Whether a fixed method is validated, for which each frame is refined again.
        uncertainty: Whether the standard deviation of the depth is estimated too.

    Raises:
        UsageError: The settings contradict each other.
        ModelError: A network cannot be used.
    """

    def __init__(
        self,
        networks: Sequence[Network],
        asked: Settings,
        first: Frame,
        more: Callable[[], Sequence[Frame]] = tuple,
        *,
        validated: bool = False,
        uncertainty: bool = False,
    ) -> None:
        self.asked, self.is_default = asked, not asked.fixed_by
        self._uncertainty, self._validated = uncertainty, validated or uncertainty
        self.registrations: dict[tuple[int, int], Register] = {}
        """How images of a size are moved to their points, where several frames decided it."""
        self._stack = ExitStack()
        check_combination(asked, len(networks))
        # What the definitions leave open is decided.
        first = first.registered()
        resolved = [
            resolve_definition(network, first, lambda: [each.registered() for each in more()])
            for network in networks
        ]
        # The included network joins, unless it is there.
        named = {network.definition.name for network in resolved}
        fused = self.is_default and asked.method == "fused" and first.rgb is not None
        if fused and COMPANION not in named:
            companion = load_network(COMPANION, None, str(resolved[0].device))
            resolved.append(resolve_definition(companion, first))
        # Layers and settings are decided.
        own, *others = resolved
        self.members = (
            resolve_member(own, first, asked, is_default=self.is_default),
            *(resolve_member(n, first, Settings(), is_default=self.is_default) for n in others),
        )

    def __enter__(self) -> Method:
        for member in self.members:
            self._stack.enter_context(member)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def own(self) -> OpenNetwork:
        """The user's network."""
        return self.members[0]

    def refine(self, frame: Frame) -> Refined:
        """Returns one frame refined, the same whatever was refined before.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        seed = self.asked.seed
        torch.manual_seed(seed)
        if frame.register == "auto" and frame.size in self.registrations:
            frame = replace(frame, register=self.registrations[frame.size])
        frame = frame.registered()
        if self.is_default:
            refined = refine_default(self.members, frame, seed=seed)
        else:
            refined = refine_fixed(self.own, frame, seed=seed, validated=self._validated)
        if not self._uncertainty:
            return refined
        source = frame.sources.get("sparse")  # only a COLMAP model names an image
        return with_uncertainty(refined, of_matches=bool(source and source.image))

    def share_registration(self, frames: Iterable[Frame]) -> None:
        """Decides the registration that images of one size share, by all these frames together.

        The size is that of the first image that tells it. A frame of another size decides alone.
        """
        usable = list[Evidence]()
        for read, frame in enumerate(frames, 1):
            if frame.image is not None and frame.register == "auto":
                known = evidence(frame.image, frame.points)
                usable += [] if known is None else [known]
            if read == _TRIED and not usable:  # such as scans, none of which will tell
                break
        if usable:
            self.registrations = {usable[0].size: estimate_registration(usable)}


def refine_fixed(
    network: OpenNetwork, frame: Frame, *, seed: int = 0, validated: bool = False
) -> Refined:
    """Returns the frame refined by its one network, also if it diverged after a good depth.

    Args:
        network: The network, open.
        frame: The frame, its image moved to its points.
        validated: Whether the result is validated, for which the frame is refined again.

    Raises:
        PnpDepthError: The frame cannot be refined.
    """
    network.next_image()
    network.cut()
    own = network.refine(frame)
    kind = network.settings.propagate
    depth = propagate(own.after, frame.points, frame.rgb, kind=kind)
    validation = _validation(network, frame, depth, seed) if validated else None
    return make_refined(frame, own, depth, used=frame.points, validation=validation)


def _validation(network: OpenNetwork, frame: Frame, depth: Tensor, seed: int) -> Validation | None:
    """Depth at validation points, refined without them. None without any, or where it fails."""
    split, kind = split_frame(frame, depth, seed), network.settings.propagate
    points, kept = split.points, split.kept
    if not len(points):
        return None
    try:
        again = network.refine(kept)
    except PnpDepthError:
        return None
    return Validation(
        points=points,
        kept=kept.points,
        network=again.before,
        weights=split.weights,
        predicted={
            BEFORE: points.sample(again.before),
            LINEAR: linear(kept.points, points.xy),
            AFTER: points.sample(propagate(again.after, kept.points, kept.rgb, kind=kind)),
        },
    )
