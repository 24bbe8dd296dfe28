"""`pnpdepth adapt`: a network's weights learn from the points of a folder, without ground truth.

As in `--target masked` (`core.refine`), points are hidden from the network's input and asked for;
here the weights keep what they learn, over all frames. Every tenth frame is for validation: the
weights with the smallest loss at its hidden points are written, the first among them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from scipy.stats import ttest_1samp
from torch import Tensor, nn

from pnpdepth_cli import __version__
from pnpdepth_cli.choices import UPDATES
from pnpdepth_cli.commands.batch.frames import Task, task_of
from pnpdepth_cli.commands.batch.request import AdaptRequest
from pnpdepth_cli.commands.refinement.inputs import read_inputs
from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.masks import Masks
from pnpdepth_cli.core.split import InputSplit
from pnpdepth_cli.core.update_rules import SCHEDULES, Update, step_size
from pnpdepth_cli.core.weights import MovingWeights
from pnpdepth_cli.core.weights_refinement import FrameOfPoints
from pnpdepth_cli.errors import DivergedError, InputError, NoPointsError
from pnpdepth_cli.frames.frame import is_dense
from pnpdepth_cli.frames.prepare import PreparedFrame, prepare
from pnpdepth_cli.frames.refine import opened_frame
from pnpdepth_cli.frames.resolve import resolve_definition, resolve_settings
from pnpdepth_cli.io.atomic import all_or_none, atomic_path
from pnpdepth_cli.io.layouts import list_frames
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.settings import Settings

MOST_VALIDATED = 16
STEPS_A_VISIT = 4
"""Updates on a frame before the next is taken."""
_IN_MEMORY = 64
"""Frames that are kept in memory."""

OnStep = Callable[[int, int, str], None]
"""Called with (updates made, of, text)."""


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
    options = Settings(
        target="masked",
        iterations=request.steps,
        lr=str(request.lr),
        update="adam",
        schedule="cosine",
        seed=seed,
    )
    settings = resolve_settings(network.definition, options, dense=is_dense(first.points))
    for note in (*first.notes, *network.notes):
        say(note)
    adaptation = _Adaptation(network, settings, tasks, request)
    training, validation = len(adaptation.training), len(adaptation.validation)
    say(f"frames to learn from: {training}; for validation: {validation}")
    with network.cut_at_points() as split:
        losses = adaptation.run(split, on_step)
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


class _Adaptation:
    """The state of an adaptation: its frames, the weights, and the best of them.

    The iterations of the settings are those of all frames together.
    """

    def __init__(
        self, network: Network, settings: Settings, tasks: Sequence[Task], request: AdaptRequest
    ) -> None:
        every = list(range(len(tasks)))
        validation = every[request.validated - 1 :: request.validated] or every[-1:]
        chosen = np.linspace(0, len(validation) - 1, min(MOST_VALIDATED, len(validation)))
        self.validation = [validation[round(position)] for position in chosen]
        self.training = [index for index in every if index not in set(validation)]
        self._network, self._settings, self._checks = network, settings, request.checks
        self._prepared = lru_cache(_IN_MEMORY)(lambda index: _prepared(network, tasks[index]))
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._weights = MovingWeights(network.module, "weights")
        self._rules: list[Update] = []
        self._alphas: list[float] = []
        self.best, self.kept = self._weights, 0
        self._losses: dict[int, NDArray[np.float64]] = {}

    def run(self, split: InputSplit, on_step: OnStep) -> dict[int, float]:
        """Makes all updates. Returns the validation loss by the number of updates."""
        of, updates = self._settings.iterations, 0
        losses = {0: self._validated(split, 0)}
        best: list[Tensor] | None = None
        for index in self._visits():
            visit = min(STEPS_A_VISIT, of - updates)
            loss = self._visited(split, index, updates, visit)
            checked = (updates + visit) * self._checks // of > updates * self._checks // of
            updates += visit
            on_step(updates, of, f"loss {loss:.4f}")
            if checked:
                losses[updates] = self._validated(split, updates)
                if losses[updates] < losses[self.kept]:
                    best, self.kept = list(self._weights.theta), updates
        start = [parameter.detach().float() for parameter in self._weights.parameters()]
        self._weights.theta = start if best is None else best
        return losses

    def p_value(self) -> float | None:
        """Returns that of a one-sided paired t test that the validation loss fell."""
        ratios = np.log(self._losses[self.kept] / self._losses[0])
        if len(ratios) < 2 or not self.kept:
            return None
        return float(ttest_1samp(ratios, 0, alternative="less").pvalue)

    def _visits(self) -> Iterator[int]:
        """The frames to learn from, shuffled anew when all were visited."""
        left = -(-self._settings.iterations // STEPS_A_VISIT)
        while left > 0:
            order = torch.randperm(len(self.training), generator=self._generator).tolist()
            yield from (self.training[index] for index in order[:left])
            left -= len(order)

    def _visited(self, split: InputSplit, index: int, first: int, steps: int) -> float:
        """Updates the weights on a frame. Returns the mean loss."""
        total = 0.0
        with self._frame(split, index) as frame:
            masks = Masks(frame.inliers, self._settings, self._generator)
            for step in range(first, first + steps):
                hidden = masks.next()
                with torch.enable_grad(), self._weights.in_place(requires_grad=True) as theta:
                    loss = self._loss(frame, hidden)
                    loss.backward()  # type: ignore[no-untyped-call]
                if not bool(loss.isfinite()):
                    raise DivergedError(
                        f"the loss is not finite after {step} updates; try a smaller --lr"
                    )
                self._update([value.grad for value in theta], step)
                total += float(loss.detach())
        return total / steps

    def _update(self, gradients: Sequence[Tensor | None], step: int) -> None:
        if not self._rules:
            self._weights.keep([gradient is not None for gradient in gradients])
            self._rules = [UPDATES[self._settings.update]() for _ in self._weights.theta]
            lr = self._settings.lr
            self._alphas = [step_size(lr, each) for each in self._weights.parameters()]
        factor = SCHEDULES[self._settings.schedule](step / self._settings.iterations)
        known = [gradient for gradient in gradients if gradient is not None]
        moving = zip(self._weights.theta, self._alphas, self._rules, known, strict=True)
        self._weights.theta = [
            value - factor * alpha * rule(gradient) for value, alpha, rule, gradient in moving
        ]

    def _validated(self, split: InputSplit, updates: int) -> float:
        """The mean loss at hidden points of the validation frames, the same each time."""
        losses = []
        for index in self.validation:
            generator = torch.Generator().manual_seed(self._settings.seed)
            with self._frame(split, index) as frame, torch.no_grad(), self._weights.in_place():
                hidden = Masks(frame.inliers, self._settings, generator).next()
                losses.append(float(self._loss(frame, hidden)))
        self._losses[updates] = np.array(losses)
        return float(np.mean(losses))

    def _loss(self, frame: FrameOfPoints, hidden: Tensor) -> Tensor:
        output = frame.predict_in_steps(frame.inliers.select(~hidden))
        hidden_points = frame.inliers.select(hidden)
        loss = checked_loss(self._settings.loss)
        return loss(hidden_points.sample(frame.depth_of(output)), hidden_points.depth)

    @contextmanager
    def _frame(self, split: InputSplit, index: int) -> Iterator[FrameOfPoints]:
        prepared = self._prepared(index)
        reader = prepared.depth_reader(self._settings)
        with opened_frame(split, prepared, reader, self._settings.mask_scale) as frame:
            yield frame


def _prepared(network: Network, task: Task) -> PreparedFrame:
    frame = prepare(network, read_inputs(task.request).registered())
    if len(frame.points) < 2:
        raise NoPointsError(f"{task.name}: {len(frame.points)} points; hiding some needs 2")
    return frame


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
