"""`pnpdepth adapt`: a network's weights learn from the points of a folder, and are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from safetensors.torch import save_file
from torch import Tensor, nn

from pnpdepth_cli import __version__
from pnpdepth_cli.commands.batch.frames import Task, task_of
from pnpdepth_cli.commands.batch.request import AdaptRequest
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.frames.adapt import Adaptation, OnStep, adaptation_settings
from pnpdepth_cli.frames.resolve import resolve_definition
from pnpdepth_cli.io.atomic import all_or_none, atomic_path
from pnpdepth_cli.io.layouts import list_frames
from pnpdepth_cli.models.network import load_network

Adapted = dict[str, Any]
"""What was learnt, and from what: `losses` at hidden points of the validation frames by the number
of updates; the weights written are those after `kept` of them, whose loss is `change` over that of
the first minus 1; `p_value` is of a one-sided paired t test that it fell."""


def adapt(request: AdaptRequest, say: Callable[[str], None], on_step: OnStep) -> Adapted:
    """Writes the adapted weights and their card; returns what was learnt.

    `say` receives notes, and `on_step` is called after the updates of each visit of a frame.

    Raises:
        InputError: There are fewer than two frames, or a file cannot be used.
        UsageError: The network takes no sparse depth.
        DivergedError: The loss is not finite.
        OutputError: A file cannot be written.
    """
    layout, listing = list_frames(request.source, request.layout)
    tasks = [task_of(request, frame) for frame in listing.frames[: request.limit]]
    if len(tasks) < 2:
        raise InputError(
            f"{request.source} ({layout}) gives {len(tasks)} frame; an adaptation needs 2 or more"
        )
    return adapt_to(tasks, request, say, on_step)


def adapt_to(
    tasks: Sequence[Task], request: AdaptRequest, say: Callable[[str], None], on_step: OnStep
) -> Adapted:
    """Does what `adapt` does with these frames, whichever the request selects."""
    choice, seed = request.refine.network, request.refine.method.seed
    network = load_network(choice.model, choice.checkpoint, choice.device)
    first = read_inputs(tasks[0].request)
    network = resolve_definition(network, first.registered())
    settings = adaptation_settings(network, first, steps=request.steps, lr=request.lr, seed=seed)
    for note in (*first.notes, *network.notes):
        say(note)
    frames = {task.name: partial(read_inputs, task.request) for task in tasks}
    adaptation = Adaptation(
        network, settings, frames, validated=request.validated, checks=request.checks
    )
    training, validation = len(adaptation.training), len(adaptation.validation)
    say(f"frames to learn from: {training}; for validation: {validation}")
    losses = adaptation.run(on_step)
    adapted = {
        "network": network.definition.name,
        "checkpoint": None if choice.checkpoint is None else str(choice.checkpoint),
        "source": str(request.source),
        "output": str(request.output),
        "training_frames": training,
        "validation_frames": validation,
        "steps": request.steps,
        "kept": adaptation.kept,
        "change": losses[adaptation.kept] / losses[0] - 1,
        "lr": request.lr,
        "seed": seed,
        "loss": settings.loss,
        "hidden": settings.mask_fraction,
        "losses": losses,
        "p_value": adaptation.p_value(),
    }
    _write(request, adapted, network.module, adaptation.best.values())
    return adapted


def _write(
    request: AdaptRequest,
    adapted: Adapted,
    module: nn.Module,
    moved: Mapping[nn.Parameter, Tensor],
) -> None:
    """Writes all tensors of the network with those that moved, and the card; both or none."""
    state = dict(module.state_dict())
    for name, parameter in module.named_parameters(remove_duplicate=False):
        if parameter in moved:
            state[name] = moved[parameter]
    copies = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    with all_or_none((request.output, request.card)):
        with atomic_path(request.output) as path:
            save_file(copies, path)
        with atomic_path(request.card) as path:
            path.write_text(card_of(adapted, request.output.name), encoding="utf-8")


def card_of(adapted: Adapted, file: str) -> str:
    """Returns the model card in Markdown."""
    rows = "\n".join(f"| {updates} | {loss:.5f} |" for updates, loss in adapted["losses"].items())
    return f"""# {file}

Weights of `{adapted["network"]}`, adapted to the frames of `{adapted["source"]}` by
`pnpdepth adapt` {__version__}. Use: `--model {adapted["network"]} --checkpoint {file}`.

- **Start**: {adapted["checkpoint"] or "the network's own weights"}.
- **Data**: frames to learn from: {adapted["training_frames"]}; for validation:
  {adapted["validation_frames"]}; images and sparse depth, no ground truth.
- **Method**: {adapted["hidden"]:.0%} of the points of a frame are hidden from the input, and the
  loss (`{adapted["loss"]}`) is taken at these. {adapted["steps"]} updates,
  step size {adapted["lr"]:g}, seed {adapted["seed"]}.
- **Written**: the weights after {adapted["kept"]} updates, whose validation loss is the smallest:
  {adapted["change"]:+.1%} against the start.
- **Limits**: adapted to this camera, sensor and scene; others may get worse. The licence of the
  start and that of the frames apply.

| updates | loss at hidden points of the validation frames |
|---|---|
{rows}
"""
