"""From a request to a refiner: the networks, the layers to cut at, and what competes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.models.rank_layers import default_layer
from pnpdepth_cli.pipeline.refinement.held_out import competition_of
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.method import needs_folds, resolve_method
from pnpdepth_cli.pipeline.refinement.refiner import Refiner
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, NetworkChoice, RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import (
    is_dense,
    moves_weights,
    resolve_definition,
    resolve_layer,
    resolve_settings,
)
from pnpdepth_cli.pipeline.sparse.options import METRES

COMPANION = "compact"
"""The network that competes beside the user's, where there is an image."""


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
    timed = method.chosen or moves_weights(method.options)
    if hold_out.time_budget_s is not None and not timed:
        raise UsageError(f"--time-budget caps the choice, but {method.why} fixes the method")
    if choice.more_models and not method.chosen:
        raise UsageError(f"several --model compete in the choice, but {method.why} fixes a method")
    if choice.tile is not None and needs_folds(request):
        raise UsageError("--tile goes with none of --auto, --baselines and --uncertainty")
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
        networks: The user's. Where the method is chosen, the companion competes beside them.
        first: The frame whose points decide the layers to cut at.
        settings: How z of the first network is updated. None: by the request.
    """
    method, plans = resolve_method(request), []
    if method.chosen:
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
        plans.append((_name(networks, number), network, resolve_layer(definition, layer), own))
    _, network, cut_at, own = plans[0]
    folds = needs_folds(request)
    if folds and own.moves_weights:
        raise UsageError(
            "weights cannot be updated together with --auto, --baselines or --uncertainty; leave"
            " out --target and --parameters"
        )
    timed = request.hold_out.time_budget_s is not None
    return Refiner(
        request=request,
        network=network,
        layer=cut_at,
        settings=own,
        method=method,
        networks={name: each for name, each, _, _ in plans},
        competition=competition_of(method, plans, timed=timed, dense=is_dense(first.points))
        if folds
        else None,
    )


def _with_companion(
    networks: Sequence[Network], choice: NetworkChoice, frame: Frame
) -> Sequence[Network]:
    """The networks, and the companion if there is an image and it is none of them."""
    if frame.rgb is None or any(each.definition.name == COMPANION for each in networks):
        return networks
    companion = load_network(COMPANION, None, choice.device, precision=choice.precision)
    return [*networks, resolve_definition(companion, frame, _PLAIN)]


_PLAIN = NetworkChoice()
"""Nothing is chosen of further networks: their definitions say all."""


def _name(networks: Sequence[Network], number: int) -> str:
    """The network's own name, numbered if a network before it has the same."""
    name = networks[number].definition.name
    same = sum(each.definition.name == name for each in networks[:number])
    return f"{name} ({same + 1})" if same else name
