"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

from pnpdepth_cli.commands.refinement.outputs import plan_outputs
from pnpdepth_cli.commands.refinement.requested import load_method, read_requested
from pnpdepth_cli.commands.refinement.write_refined import write_refined
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.commands.shared.pipeline import timed
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.spent import parts_of


def refine_image(request: RefineRequest) -> FrameRecord:
    """Refines one frame, writes its depth and companions, and returns its record.

    Args:
        request: Files, network and settings of the refinement.

    Raises:
        PnpDepthError: What was asked for is at fault; then nothing is written.
    """
    seconds = dict[str, float]()
    outputs = plan_outputs(request)
    with timed(seconds, "read"):
        inputs = read_requested(request)
    with timed(seconds, "load network"), parts_of(seconds, "load network"):
        method = load_method(request, inputs)
    with timed(seconds, "refine"), method:
        frame = method.refine(inputs, with_stages=inputs.gt is not None)
    return write_refined(request, outputs, method, inputs, frame, seconds)
