"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from pnpdepth_cli.commands.error_tables import names_of_depths
from pnpdepth_cli.commands.refinement.output_files import Outputs, plan_outputs, stale_outputs
from pnpdepth_cli.commands.refinement.outputs import within_range, without_unknown, write_outputs
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.refinement.refined_record import record_of
from pnpdepth_cli.commands.stopwatch import Stopwatch, peak_memory_mb
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.dataset.read_frame import read_frame
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.refined import Refined
from pnpdepth_cli.frames.resolve import with_input_range
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.models.network import load_network


class RefineOutcome(NamedTuple):
    """A refined frame on disk: what its record holds, the files that were written, and why the
    refinement stopped early, if it did."""

    record: FrameRecord
    outputs: Outputs
    diverged: DivergedError | None


def refine_image(
    request: RefineRequest,
    *,
    on_iteration: Callable[[int, int, float], None] = lambda done, of, loss: None,
) -> RefineOutcome:
    """Refines one frame, writes its depth and companions, and returns what was done.

    Args:
        request: Files, network and settings of the refinement.
        on_iteration: Callback with (done, of, loss) after each update of z.

    Raises:
        PnpDepthError: Any of its kinds; then nothing is written.
    """
    watch = Stopwatch()
    outputs = plan_outputs(request)
    with watch("read"):
        inputs = read_requested(request)
    with watch("load network"):
        method = load_method(request, inputs)
    with watch("refine"), method:
        of = method.settings.iterations
        frame = method.refine(inputs, on_iteration=lambda done, loss: on_iteration(done, of, loss))
    return write_refined(request, outputs, method, inputs, frame, watch)


def read_requested(request: RefineRequest) -> Frame:
    """Returns the frame that is asked for, as `read_frame` reads it."""
    return read_frame(
        request.files,
        request.read_options,
        seed=request.method.seed,
        holdout=request.hold_out.holdout,
        needs_camera=request.outputs.view_3d,
    )


def load_method(
    request: RefineRequest, first: Frame, more: Callable[[], Sequence[Frame]] = tuple
) -> Method:
    """Returns the method that is asked for; this first frame decides what networks leave open.

    Args:
        request: Networks and settings of the refinement.
        first: The first frame.
        more: Function of further frames, which decide as well; called only if a network needs it.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    choice, hold_out = request.network, request.hold_out
    chosen = [(choice.model, choice.checkpoint), *((spec, None) for spec in choice.more_models)]
    networks = [load_network(spec, checkpoint, choice.device) for spec, checkpoint in chosen]
    networks[0] = with_input_range(networks[0], choice.normalise)
    return Method(
        networks,
        request.method,
        first,
        more,
        validated=hold_out.baselines,
        uncertainty=hold_out.uncertainty or request.outputs.unknown == "zero",
    )


def write_refined(
    request: RefineRequest,
    outputs: Outputs,
    method: Method,
    inputs: Frame,
    frame: Refined,
    watch: Stopwatch,
) -> RefineOutcome:
    """Scores the refined frame and writes it with its record.

    The record is the same from run to run, except `seconds` and `peak_memory_mb`.
    """
    frame = within_range(outputs, inputs, without_unknown(request, inputs, frame))
    record = record_of(request, method, inputs, frame)
    stale = []
    if "record" in outputs:
        record_path = outputs["record"]
        stale = stale_outputs(record_path.parent, record_path.stem, outputs)
    with all_or_none(outputs.values()):
        with watch("write"):
            improved, figures = write_outputs(outputs, inputs, frame, names_of_depths(record))
        record = replace(
            record,
            improved_fraction=improved,
            figures=figures,
            outputs={kind: str(path) for kind, path in outputs.items()},
            seconds=watch.seconds,
            peak_memory_mb=peak_memory_mb(method.network.device),
        )
        if "record" in outputs:
            record.write(outputs["record"])
    for path in stale:  # of a run with other options
        path.unlink(missing_ok=True)
    return RefineOutcome(record=record, outputs=outputs, diverged=frame.diverged)
