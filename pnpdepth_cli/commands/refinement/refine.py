"""`pnpdepth refine`: one image, its sparse depth, and a network; refined depth and its record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pnpdepth_cli.commands.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.commands.refinement.output_files import Outputs, plan_outputs
from pnpdepth_cli.commands.refinement.outputs import within_range, write_outputs
from pnpdepth_cli.commands.refinement.record import record_of
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.commands.stopwatch import Stopwatch, peak_memory_mb
from pnpdepth_cli.errors import DivergedError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.refiner import Refiner
from pnpdepth_cli.frames.resolve import redefined
from pnpdepth_cli.io.atomic import all_or_none
from pnpdepth_cli.io.record import write_json
from pnpdepth_cli.models.network import load_network


@dataclass(frozen=True, kw_only=True)
class RefineOutcome:
    """A refined frame on disk."""

    record: dict[str, Any]
    """What <stem>.json holds."""
    outputs: Outputs
    """The files that were written."""
    diverged: DivergedError | None
    """Why the refinement stopped early. None if it did not."""


def refine_image(
    request: RefineRequest,
    *,
    on_iteration: Callable[[int, int, float], None] = lambda done, of, loss: None,
) -> RefineOutcome:
    """Refines one frame, writes its depth and companions, and returns what was done.

    Args:
        request: What is asked for.
        on_iteration: Called with (done, of, loss) after each update of z.

    Raises:
        PnpDepthError: Any of its kinds; then nothing is written.
    """
    watch = Stopwatch()
    outputs = plan_outputs(request)
    with watch("read"):
        inputs = read_inputs(request)
    with watch("load network"):
        refiner = load_refiner(request, inputs)
    with watch("refine"), refiner:
        of = refiner.settings.iterations
        frame = refiner.refine_frame(
            inputs, on_iteration=lambda done, loss: on_iteration(done, of, loss)
        )
    return write_refined(outputs, refiner, inputs, frame, watch)


def load_refiner(
    request: RefineRequest, first: Frame, more: Callable[[], Sequence[Frame]] = tuple
) -> Refiner:
    """Returns the refiner that is asked for; this first frame decides what networks leave open.

    Args:
        request: What is asked for.
        first: The first frame.
        more: Gives further frames, which decide as well; called only if a network needs it.

    Raises:
        UsageError: The request combines what cannot be combined.
        ModelError: The network cannot be loaded.
    """
    choice, hold_out = request.network, request.hold_out
    networks = [
        load_network(spec, checkpoint, choice.device, precision=choice.precision)
        for spec, checkpoint in (
            (choice.model, choice.checkpoint),
            *((spec, None) for spec in choice.more_models),
        )
    ]
    networks[0] = redefined(networks[0], choice.output_kind, choice.normalise)
    refiner = Refiner(
        networks, request.method, uncertainty=hold_out.uncertainty, check=hold_out.baselines
    )
    return refiner.decide(first, more)


def write_refined(
    outputs: Outputs, refiner: Refiner, inputs: Inputs, frame: Refined, watch: Stopwatch
) -> RefineOutcome:
    """Scores the refined frame and writes it with its record.

    The record is the same from run to run, except `seconds` and `peak_memory_mb`.
    """
    frame = within_range(outputs, inputs, frame)
    record = record_of(refiner, inputs, frame)
    planned, outputs = outputs, outputs.without_previews(worse=bool(record["linear"]["worse"]))
    with all_or_none(outputs.paths()):
        with watch("write"):
            record |= write_outputs(outputs, inputs, frame)
        record["seconds"] = watch.seconds
        record["peak_memory_mb"] = peak_memory_mb(refiner.network.device)
        if outputs.record is not None:
            write_json(outputs.record, record)
    for path in {*planned.paths()} - {*outputs.paths()}:
        path.unlink(missing_ok=True)  # of an earlier result
    return RefineOutcome(record=record, outputs=outputs, diverged=frame.diverged)
