"""A method of refinement, with nothing left open, for any number of frames in memory.

This is what `refine`, `batch`, Ray workers and the Python API call; reading and writing are around
it. The steps of a frame are in `frames.refine_frame`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace

import torch

from pnpdepth_cli.completion.image_registration import estimate_registration
from pnpdepth_cli.completion.registration_evidence import Evidence
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Frame, Refined, Register, UsedNetwork
from pnpdepth_cli.frames.measured import with_measured, with_note_on_measured
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refine_frame import Pipeline, refine_frame
from pnpdepth_cli.frames.resolve import normalisation_name, resolve_definition, resolve_member
from pnpdepth_cli.frames.uncertainty import with_uncertainty
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.stored_map import stored_map
from pnpdepth_cli.settings import PAPER, Settings

COMPANION = "compact"
"""The network that is fused with the user's, where there is an image."""
_FRAMES_TRIED = 3
"""After so many frames that tell nothing of the registration, no more are read."""


def check_combination(asked: Settings, networks: int, maps: int = 0) -> None:
    """Raises UsageError if settings that need a network with a layer come with depth maps instead.

    Raised, too, if the paper's method comes with several networks: it refines one.

    Args:
        asked: Settings that the user gives.
        networks: Number of networks.
        maps: Number of depth maps besides, each of which takes the place of a network.
    """
    if asked.is_paper and maps:
        raise UsageError(
            "method 'paper' updates z of a network, and a depth map has none; use 'fused' or"
            " 'alone', or leave out the depth map"
        )
    if asked.layer is not None and maps:
        raise UsageError("a depth map has no layer to cut at; leave out `layer`, or the depth map")
    if asked.is_paper and networks > 1:
        raise UsageError(
            f"method 'paper' refines one network, not {networks}; 'fused' and 'alone' fuse several"
        )


def pipeline_of(asked: Settings, *, validated: bool = False) -> Pipeline:
    """Returns the steps of the method that is asked for.

    Args:
        asked: Settings that the user gives.
        validated: Whether the paper's method has validation points, for which each frame is refined
            once more. The other methods always have them.
    """
    # A note names settings of updates that are not used. Who states 0 updates knows it.
    unused = tuple(asked.of_updates) if asked.iterations != 0 else ()
    if not asked.is_paper:
        return Pipeline(propagation=asked.propagate, unused=unused)
    return Pipeline(
        leaves_outliers_out=False,
        validates=validated,
        fuses=False,
        propagation=PAPER.propagate if asked.propagate is None else asked.propagate,
        unused=unused,
    )


def _with_maps(networks: Sequence[Network], count: int) -> list[Network]:
    """The networks and a stand-in for each depth map of a frame; the user's first comes first.

    If the first network takes a prior, as the included one does, it completes the maps, which are
    the user's networks. Any other network is the user's first, and the maps follow.

    Args:
        networks: The networks, at least one.
        count: Number of depth maps of each frame.
    """
    maps = [stored_map(number, count) for number in range(count)]
    if count and networks[0].definition.takes_prior:
        return [*maps, *networks]
    return [*networks, *maps]


def _network_of_record(member: OpenNetwork) -> UsedNetwork:
    """What a result keeps of a network: its name, layer, settings, input and output."""
    definition = member.network.definition
    return UsedNetwork(
        name=member.name,
        layer=member.layer,
        settings=member.settings,
        output_kind=definition.output_kind,
        normalise=normalisation_name(definition),
        device=str(member.network.device),
        is_map=definition.input_kind == "map",
        checkpoint=member.network.checkpoint,
    )


class Method:
    """Refines frames with one network, or several that are fused; a context manager.

    The networks are cut when the first frame is refined, and are as before when it closes.

    Args:
        networks: Networks of the user.
        asked: Settings that the user gives: the method, and values for its steps. Those of a step
            of the network are for the first network; the others have their own.
        first: The first frame. It decides what definitions leave open, such as the RGB range.
        more: Function that returns further frames, which decide as well; called only if a network
            leaves its RGB range open. The default, `tuple`, returns none.
        validated: Whether the paper's method has validation points, for which each frame is refined
            once more. The other methods always have them.
        uncertainty: Whether the standard deviation of the depth is estimated too.
        keep_measured: Whether the result has the points' own depth at their pixels.

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
        keep_measured: bool = False,
    ) -> None:
        self.asked = asked
        self.pipeline = pipeline_of(asked, validated=validated or uncertainty)
        self._uncertainty = uncertainty
        self._keep_measured = keep_measured
        self.registrations: dict[tuple[int, int], Register] = {}
        """How images of a size are moved to their points, where several frames decided it."""
        self._stack = ExitStack()
        self._maps = len(first.predicted)
        check_combination(asked, len(networks), self._maps)
        networks = _with_maps(networks, self._maps)
        # What the definitions leave open is decided.
        first = first.registered()
        resolved = [
            resolve_definition(network, first, lambda: [frame.registered() for frame in more()])
            for network in networks
        ]
        # The included network, `COMPANION`, joins with method `fused` and an image, unless it is
        # among the user's. Where it came to complete depth maps, but the method is `alone` or there
        # is no image, it leaves.
        if self._maps and (asked.method == "alone" or first.rgb is None):
            resolved = [network for network in resolved if not network.definition.takes_prior]
        names = {network.definition.name for network in resolved}
        if asked.method == "fused" and first.rgb is not None and COMPANION not in names:
            companion = load_network(COMPANION, None, str(resolved[0].device))
            resolved.append(resolve_definition(companion, first))
        # Layers and settings are decided.
        first_network, *others = resolved
        self.members = (
            resolve_member(first_network, first, asked),
            *(resolve_member(network, first, Settings()) for network in others),
        )

    def __enter__(self) -> Method:
        for member in self.members:
            self._stack.enter_context(member)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def first_member(self) -> OpenNetwork:
        """The user's first network."""
        return self.members[0]

    def refine(self, frame: Frame, *, with_stages: bool = False) -> Refined:
        """Returns one frame refined, the same whatever was refined before.

        Args:
            frame: The frame, with as many depth maps as the first one.
            with_stages: Whether the depth after each step is returned, too.

        Raises:
            PnpDepthError: The frame cannot be refined.
        """
        if len(frame.predicted) != self._maps:
            raise UsageError(
                f"a frame has {len(frame.predicted)} depth maps, but the first one has"
                f" {self._maps}; give every frame as many"
            )
        seed = self.asked.seed
        torch.manual_seed(seed)
        # The image is moved to the points.
        if frame.register == "auto" and frame.size in self.registrations:
            frame = replace(frame, register=self.registrations[frame.size])
        frame = frame.registered()
        # The steps of the method; then measured pixels, what the record keeps, and uncertainty.
        refined = refine_frame(
            self.members, frame, self.pipeline, seed=seed, with_stages=with_stages
        )
        refined = with_measured(refined) if self._keep_measured else with_note_on_measured(refined)
        refined = replace(
            refined,
            asked=self.asked,
            networks=tuple(_network_of_record(member) for member in self.members),
            camera=frame.camera,
        )
        if not self._uncertainty:
            return refined
        return with_uncertainty(refined, of_matches=frame.of_matches)

    def share_registration(self, frames: Iterable[Frame]) -> None:
        """Decides by some frames together how all images of one size are moved to their points.

        The size is that of the first image that tells it. A frame of another size decides alone.

        Args:
            frames: Frames of a sequence, read as they are needed.
        """
        evidences: list[Evidence] = []
        for number, frame in enumerate(frames, 1):
            if frame.register == "auto":
                evidence = frame.evidence_of_registration
                if evidence is not None:
                    evidences.append(evidence)
            if number == _FRAMES_TRIED and not evidences:  # such as scans, none of which will tell
                break
        if evidences:
            self.registrations = {evidences[0].size: estimate_registration(evidences)}
