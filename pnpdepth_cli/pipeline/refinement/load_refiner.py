"""From a request to a refiner: the networks, the layers to cut at, and their settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Frame, is_dense
from pnpdepth_cli.frames.fuse import Member
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.method import needs_check, resolve_method
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, NetworkChoice, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import (
    moves_weights,
    resolve_definition,
    resolve_layer,
    resolve_settings,
)
from pnpdepth_cli.pipeline.sparse.options import METRES

COMPANION = "compact"
"""The network that is fused with the user's, where there is an image."""
UPDATES = 5
"""Most updates of z in the default method. More fit what propagation fits anyway."""
HIDDEN_POINT_STEPS = 40
"""Most steps by hidden points; of dense points the network's own number."""


def load_refiner(
    request: RefineRequest, first: Inputs, more: Callable[[], Sequence[Inputs]] = tuple
) -> Refiner:
    """Returns the refiner that is asked for; this first frame decides what the network leaves open.

    Args:
        request: What is asked for.
        first: The first frame.
        more: Gives further frames, which decide as well; called only if a network needs it.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    choice, hold_out, method = request.network, request.hold_out, resolve_method(request)
    timed = method.is_default or moves_weights(method.options)
    if hold_out.time_budget_s is not None and not timed:
        raise UsageError(
            f"--time-budget caps steps by hidden points, but {method.reason} makes none"
        )
    if choice.more_models and not method.is_default:
        raise UsageError(f"several --model are fused, but {method.reason} fixes one network")
    frame, networks = first.frame(), []

    def more_frames() -> list[Frame]:
        return [each.frame() for each in more()]

    for number, spec in enumerate((choice.model, *choice.more_models)):
        checkpoint = choice.checkpoint if number == 0 else None
        network = load_network(spec, checkpoint, choice.device, precision=choice.precision)
        own = choice if number == 0 else _PLAIN
        networks.append(resolve_definition(network, frame, own, more_frames))
    return refiner_of(request, networks, first)


def refiner_of(
    request: RefineRequest,
    networks: Sequence[Network],
    first: Inputs,
    *,
    settings: RefineSettings | None = None,
) -> Refiner:
    """Returns the refiner of networks that leave nothing open.

    Args:
        request: What is asked for.
        networks: The user's. In the default method the companion is fused with them.
        first: The frame whose points decide the layers to cut at.
        settings: How z of the first network is updated. None: by the request.
    """
    method, members = resolve_method(request), list[Member]()
    if method.is_default:
        networks = _with_companion(networks, request.network, first.frame())
    for number, network in enumerate(networks):
        definition = network.definition
        options = method.options if number == 0 else MethodOptions()
        layer = options.layer
        if layer is None and not method.own_layer and options.target != "masked":
            layer = default_layer(network, first.size, len(first.points))
        own = resolve_settings(
            definition,
            options,
            request.hold_out,
            metric=first.unit == METRES,
            dense=is_dense(first.points),
        )
        if number == 0 and settings is not None:
            own = settings
        member = Member(network=network, layer=resolve_layer(definition, layer), settings=own)
        members.append(_of_default(member, request, first) if method.is_default else member)
    user = members[0]
    if needs_check(request) and user.settings.moves_weights:
        raise UsageError(
            "--baselines and --uncertainty go with updates of z; leave out --target and"
            " --parameters"
        )
    return Refiner(
        request=request,
        network=user.network,
        layer=user.layer,
        settings=user.settings,
        method=method,
        members=tuple(members),
    )


def _of_default(member: Member, request: RefineRequest, first: Inputs) -> Member:
    """The network as the default method refines it.

    A network whose output is metric is aligned too, where the points say that it should be. Of
    networks that take the points, only those made for fusion, with a prior, are updated.
    """
    definition, settings = member.network.definition, member.settings
    iterations = min(settings.iterations, UPDATES)
    if not member.takes_points and settings.align == "none":
        settings = replace(settings, align="auto")
    if member.takes_points and not member.takes_prior:
        iterations = 0
    hidden_points = None
    if request.hold_out.time_budget_s is not None and member.takes_points:
        dense = is_dense(first.points)
        hidden_points = resolve_settings(definition, MethodOptions(target="masked"), dense=dense)
        if not dense:
            hidden_points = replace(hidden_points, iterations=HIDDEN_POINT_STEPS)
    settings = replace(settings, iterations=iterations)
    return replace(member, settings=settings, hidden_points=hidden_points)


def _with_companion(
    networks: Sequence[Network], choice: NetworkChoice, frame: Frame
) -> Sequence[Network]:
    """The networks, and the companion if there is an image and it is none of them."""
    if frame.rgb is None or any(each.definition.name == COMPANION for each in networks):
        return networks
    companion = load_network(COMPANION, None, choice.device, precision=choice.precision)
    return [*networks, resolve_definition(companion, frame, _PLAIN)]


_PLAIN = NetworkChoice()
"""Of further networks, whose definitions decide everything."""
