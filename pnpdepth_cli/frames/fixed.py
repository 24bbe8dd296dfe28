"""A fixed method for one frame: one network, refined as the settings say."""

from __future__ import annotations

from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.core.refine import OnIteration
from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refined import Refined, Validation, make_refined
from pnpdepth_cli.frames.validation import consistency, split_points
from pnpdepth_cli.stages import AFTER, BEFORE, LINEAR


def refine_fixed(
    network: OpenNetwork,
    frame: Frame,
    *,
    seed: int = 0,
    validated: bool = False,
    on_iteration: OnIteration = lambda done, loss: None,
) -> Refined:
    """Returns the frame refined by its one network, also if it diverged after a good depth.

    Args:
        network: The network, open.
        frame: The frame, its image moved to its points.
        seed: Random seed of the validation points.
        validated: Whether the result is validated, for which the frame is refined again.
        on_iteration: Callback after each update of z.

    Raises:
        PnpDepthError: The frame cannot be refined.
    """
    network.next_image()
    network.cut()
    own = network.refine(frame, on_iteration=on_iteration)
    depth = _propagate(own.after, frame, network.member.settings.propagate)
    validation = _validation(network, frame, depth, seed) if validated else None
    return make_refined(frame, own, depth, used=frame.points, validation=validation)


def _propagate(depth: Tensor, frame: Frame, kind: str) -> Tensor:
    """Depth (H, W) with its residual at the points propagated; "none" keeps it."""
    return depth if kind == "none" else propagate(depth, frame.points, frame.rgb, kind=kind).depth


def _validation(network: OpenNetwork, frame: Frame, depth: Tensor, seed: int) -> Validation | None:
    """Depth at validation points, refined without them.

    None where the points are too few or the method fails.

    Args:
        network: The network, open.
        frame: The frame.
        depth: (H, W) metres, refined with all points.
        seed: Random seed of the validation points.
    """
    parts = split_points(frame.points, seed)
    if parts is None:
        return None
    kept, points = parts
    fewer, kind = frame.with_points(kept), network.member.settings.propagate
    try:
        again = network.refine(fewer)
    except PnpDepthError:
        return None
    return Validation(
        points=points,
        kept=kept,
        network=again.before,
        weights=consistency(points, depth),
        predicted={
            BEFORE: points.sample(again.before),
            LINEAR: linear(kept, points.xy),
            AFTER: points.sample(_propagate(again.after, fewer, kind)),
        },
    )
