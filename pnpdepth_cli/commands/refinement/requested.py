"""What a request asks for, from its files: the frame, and the method with its networks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_as_read import ReadFrame
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.resolve import with_input_range
from pnpdepth_cli.models.network import load_network


def read_requested(request: RefineRequest) -> ReadFrame:
    """Returns the frame of the request's files, as `read_frame` reads it."""
    return read_frame(
        request.files,
        request.read_options,
        seed=request.method.seed,
        holdout=request.holdout,
        needs_camera=request.view_3d,
    )


def load_method(
    request: RefineRequest, first: ReadFrame, more: Callable[[], Sequence[ReadFrame]] = tuple
) -> Method:
    """Returns the method that the request asks for, with its networks loaded.

    What neither the request nor a network states, such as the layer or the range of the input, is
    found on the first frame.

    Args:
        request: Networks and settings of the refinement.
        first: The first frame that is refined.
        more: Function that returns further frames on which it is found as well; called only if a
            network needs them.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    # The user's networks; the range of the input that a user states is that of the first.
    network = load_network(request.model, request.checkpoint, request.device)
    others = [load_network(model, None, request.device) for model in request.more_models]
    return Method(
        [with_input_range(network, request.normalise), *others],
        request.method,
        first,
        more,
        validated=request.baselines,
        # Where depth is supported is found with its standard deviation.
        uncertainty=request.uncertainty or request.unknown == "zero",
        keep_measured=request.keep_measured,
    )
