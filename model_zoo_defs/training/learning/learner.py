"""Training of one network: step, running average of the weights, schedule, save and restore."""

from __future__ import annotations

import copy
import csv
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

# Steps in which the learning rate rises from 0, unless the run says otherwise.
WARM_UP_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Length and learning rate of a run; the first limit that is reached ends it.

    Without `minutes` the same seed and frames give the same bytes on the same machine.
    """

    lr: float
    """Learning rate after the warm-up."""
    steps: int
    """Steps of the run."""
    minutes: float | None = None
    """Length of the run; None sets no limit of time."""
    averaging: float = 0.999
    """Decay of the running average of the weights per step."""
    decay: int | None = None
    """Steps at the end in which the rate falls, constant until then; None: it falls throughout."""
    warm_up: int = WARM_UP_STEPS
    """Steps in which the rate rises from 0."""

    def progress(self, step: int, elapsed_s: float) -> float:
        """Returns the fraction of the run that is done: the larger of that of steps and of time."""
        by_clock = elapsed_s / (self.minutes * 60) if self.minutes else 0.0
        return min(1.0, max(step / self.steps, by_clock))

    def rate(self, step: int, elapsed_s: float) -> float:
        """Returns the learning rate of a step: linear warm-up, then cosine decay to 0."""
        warmth = min(1.0, (step + 1) / self.warm_up)
        # How far the decay is, 0..1.
        if self.decay is None:
            done = self.progress(step, elapsed_s)
        elif self.decay == 0:
            done = 0.0
        else:
            done = max(0.0, 1.0 - (self.steps - step) / self.decay)
        return self.lr * warmth * 0.5 * (1.0 + math.cos(math.pi * done))


class Learner:
    """The network being trained, its running average, and the optimiser.

    Subclasses define `loss`.

    Args:
        network: The network to train.
        schedule: Length and learning rate of the run.
        out: Folder that gets state.pt (everything `restore` needs) and NAME.safetensors (the
            averaged weights, in half precision).
        name: Name of the file of weights.
        lanes: Parts of a batch that are computed at the same time on a CPU, a thread each.
    """

    def __init__(
        self, network: nn.Module, schedule: Schedule, out: Path, name: str, lanes: int = 1
    ):
        self.schedule = schedule
        self.out = out
        self.name = name
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = network.to(self.device)
        self.average = copy.deepcopy(self.network)
        _channels_last(self.network)
        _channels_last(self.average)
        self.learnt = [p for p in self.network.parameters() if p.requires_grad]
        self.optimiser = torch.optim.AdamW(
            self.groups(), lr=schedule.lr, weight_decay=1e-2, fused=True
        )
        # On a CPU two halves of a batch on a thread each beat one batch on two threads: they wait
        # for each other once a step, not at every operation.
        self.lanes = 1 if self.device.type == "cuda" else lanes
        self.pool = ThreadPoolExecutor(self.lanes)
        if self.lanes > 1:
            torch.set_num_threads(1)
        self.step = 0
        self.elapsed_s = 0.0

    def groups(self) -> list[dict[str, Any]]:
        """Returns the optimiser's groups of parameters; `factor` multiplies a group's rate."""
        return [{"params": self.learnt, "factor": 1.0}]

    def loss(self, part: Sequence[Tensor]) -> Tensor:
        """Returns the loss to minimise, of a part of a batch."""
        raise NotImplementedError

    @property
    def progress(self) -> float:
        """Fraction of the run that is done."""
        return self.schedule.progress(self.step, self.elapsed_s)

    def learn(self, batch: Sequence[Tensor]) -> float:
        """Takes one optimiser step on a batch; returns the loss before it."""
        self.network.train()
        for group in self.optimiser.param_groups:
            group["lr"] = group["factor"] * self.schedule.rate(self.step, self.elapsed_s)
        # Each lane computes the gradients of a part of the batch; their mean counts.
        parts = list(zip(*(tensor.chunk(self.lanes) for tensor in batch), strict=True))
        results = list(self.pool.map(self._loss_and_gradients, parts))
        gradients = zip(*(of_part for _, of_part in results), strict=True)
        for parameter, of_parts in zip(self.learnt, gradients, strict=True):
            reached = [gradient for gradient in of_parts if gradient is not None]
            parameter.grad = torch.stack(reached).mean(0) if len(reached) > 1 else of_parts[0]
        nn.utils.clip_grad_norm_(self.learnt, 1.0)
        self.optimiser.step()
        self.step += 1
        follow(self.average, self.network, self.step, self.schedule.averaging)
        return float(sum(loss for loss, _ in results) / len(results))

    def _loss_and_gradients(
        self, part: Sequence[Tensor]
    ) -> tuple[float, tuple[Tensor | None, ...]]:
        """Returns loss and gradients of a part of a batch; None where no gradient comes back."""
        torch.set_num_threads(1)  # applies to the calling thread only
        loss = self.loss([tensor.to(self.device) for tensor in part])
        # A stage that trains a part of the network leaves the rest without gradient.
        return float(loss.detach()), torch.autograd.grad(loss, self.learnt, allow_unused=True)

    def save(self) -> None:
        """Writes state.pt and the averaged weights, each whole or not at all."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "elapsed_s": self.elapsed_s,
        }
        torch.save(state, self.out / "state.pt.part")
        (self.out / "state.pt.part").replace(self.out / "state.pt")
        export(self.exported(), self.weights)

    def exported(self) -> nn.Module:
        """Returns the network whose weights are exported."""
        return self.average

    def restore(self) -> None:
        """Loads the state written by `save`; without a state.pt, does nothing."""
        if not (self.out / "state.pt").exists():
            return
        state = torch.load(self.out / "state.pt", map_location=self.device)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]
        self.elapsed_s = state["elapsed_s"]

    @property
    def weights(self) -> Path:
        """Path of the file with the averaged weights."""
        return self.out / f"{self.name}.safetensors"


@torch.no_grad()
def follow(average: nn.Module, network: nn.Module, step: int, decay: float) -> None:
    """Updates the running average of the weights after a step.

    Args:
        average: Network whose weights are the average; they are changed.
        network: Network that is trained.
        step: Number of the step, from 1.
        decay: Fraction of the average that stays.
    """
    # A young average follows faster; else the first export would equal the initial weights.
    keep = min(decay, (1 + step) / (10 + step))
    torch._foreach_lerp_(_averaged(average), _averaged(network), 1.0 - keep)


def _averaged(network: nn.Module) -> list[Tensor]:
    """Returns the tensors that are averaged: parameters and statistics of normalisation."""
    statistics = [buffer for buffer in network.buffers() if buffer.is_floating_point()]
    return [*network.parameters(), *statistics]


def _channels_last(network: nn.Module) -> None:
    """Lays the network's kernels out in memory with channels last, which torch computes faster."""
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)


def export(network: nn.Module, path: Path) -> None:
    """Writes the weights to a safetensors file, in half precision."""
    half = {
        name: tensor.detach()
        .to("cpu", torch.float16 if tensor.is_floating_point() else tensor.dtype)
        .contiguous(memory_format=torch.contiguous_format)
        for name, tensor in network.state_dict().items()
    }
    part = path.with_name(path.name + ".part")
    save_file(half, part)
    part.replace(path)


def append_row(path: Path, row: dict[str, float]) -> None:
    """Appends the row to the CSV file, with a header line if the file is new."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)
