"""Trains `compact` on rendered frames.

    python -m model_zoo_defs.training.train --data DIR --val DIR --out RUN_DIR --steps N --seed 1

RUN_DIR gets state.pt (everything `--resume` needs), log.csv (losses), val.csv (scores in per cent
of linear interpolation's) and compact.safetensors (the averaged weights, in half precision).
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from model_zoo_defs.compact import Compact
from model_zoo_defs.training.dataset import Counting, Sample, Samples
from model_zoo_defs.training.encoder_weights import pretrained_encoder
from model_zoo_defs.training.validation import Case, cases, scores

# weights of the depths at 1/16, 1/8, 1/4, 1/2 and full size
LEVEL_WEIGHTS = (0.15, 0.2, 0.3, 0.4, 1.0)
AVERAGING = 0.999
WARM_UP_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One training run; `minutes` ends it earlier than `steps` would, the schedule follows."""

    data: tuple[Path, ...]
    out: Path
    steps: int
    seed: int = 1
    val: Path | None = None
    minutes: float | None = None
    batch: int = 8
    lanes: int = 2
    size: tuple[int, int] = (192, 256)
    lr: float = 1e-3
    save_every: int = 500
    val_frames: int = 24
    pretrained: bool = True
    workers: int = 1
    resume: bool = False


class Run:
    """The network being trained, its running average, and the optimiser."""

    def __init__(self, settings: Settings):
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = Compact().to(self.device)
        if settings.pretrained:
            self.network.encoder.load_state_dict(pretrained_encoder())
        # Photographs are what the encoder knows and rendered frames are not: it stays as it is.
        self.network.encoder.requires_grad_(False)
        self.learnt = [p for p in self.network.parameters() if p.requires_grad]
        self.average = Compact().to(self.device)
        self.average.load_state_dict(self.network.state_dict())
        for network in (self.network, self.average):
            _channels_last(network)
        self.optimiser = torch.optim.AdamW(self.learnt, lr=settings.lr, weight_decay=1e-2)
        # On a CPU two halves of a batch on a thread each beat one batch on two threads: they wait
        # for each other once a step, not at every operation.
        self.lanes = 1 if self.device.type == "cuda" else min(settings.lanes, settings.batch)
        self.pool = ThreadPoolExecutor(self.lanes)
        if self.lanes > 1:
            torch.set_num_threads(1)
        self.step, self.elapsed_s = 0, 0.0

    @property
    def progress(self) -> float:
        """How much of the run is done, 0..1, by steps or by the clock, whichever is further."""
        by_clock = self.elapsed_s / (self.settings.minutes * 60) if self.settings.minutes else 0.0
        return min(1.0, max(self.step / self.settings.steps, by_clock))

    def learn(self, sample: Sample) -> float:
        """One step of the optimiser has been made; returns the loss."""
        self.network.train()
        factor = min(1.0, (self.step + 1) / WARM_UP_STEPS)
        factor *= 0.5 * (1.0 + math.cos(math.pi * self.progress))
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.lr * factor
        parts = [Sample(*part) for part in zip(*(x.chunk(self.lanes) for x in sample), strict=True)]
        results = list(self.pool.map(self._loss_and_gradients, parts))
        gradients = zip(*(found for _, found in results), strict=True)
        for parameter, pieces in zip(self.learnt, gradients, strict=True):
            parameter.grad = torch.stack(pieces).mean(0) if len(pieces) > 1 else pieces[0]
        nn.utils.clip_grad_norm_(self.learnt, 1.0)
        self.optimiser.step()
        self.step += 1
        # young averages follow faster, or the first export would be the initial weights
        keep = min(AVERAGING, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.average.parameters()), list(self.network.parameters()), 1.0 - keep
            )
        return float(sum(loss for loss, _ in results) / len(results))

    def _loss_and_gradients(self, part: Sample) -> tuple[float, tuple[Tensor, ...]]:
        torch.set_num_threads(1)  # a setting of the thread it is called in
        rgb, sparse, depth = (x.to(self.device) for x in part)
        rgb = rgb.contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16):
            depths = self.network.pyramid(rgb, sparse)
        loss = pyramid_loss(depths, depth)
        return float(loss.detach()), torch.autograd.grad(loss, self.learnt)

    def save(self) -> None:
        """state.pt and compact.safetensors hold this moment, whole or not at all."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "elapsed_s": self.elapsed_s,
        }
        out = self.settings.out
        torch.save(state, out / "state.pt.part")
        (out / "state.pt.part").replace(out / "state.pt")
        export(self.average, out / "compact.safetensors")

    def restore(self) -> None:
        """The run stands where `save` left it."""
        state = torch.load(self.settings.out / "state.pt", map_location=self.device)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.elapsed_s = state["step"], state["elapsed_s"]


def _channels_last(network: nn.Module) -> None:
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)


def export(network: nn.Module, path: Path) -> None:
    """The weights are in a safetensors file, in half precision."""
    half = {
        name: tensor.detach()
        .to("cpu", torch.float16)
        .contiguous(memory_format=torch.contiguous_format)
        for name, tensor in network.state_dict().items()
    }
    part = path.with_name(path.name + ".part")
    save_file(half, part)
    part.replace(path)


def pyramid_loss(depths: list[Tensor], truth: Tensor) -> Tensor:
    """The weighted sum of `depth_loss` over the levels; truth (B, 1, H, W), 0 = unknown."""
    total = truth.new_zeros(())
    for weight, depth in zip(LEVEL_WEIGHTS, depths, strict=True):
        stride = truth.shape[-1] // depth.shape[-1]
        centre = stride // 2
        total = total + weight * depth_loss(depth, truth[..., centre::stride, centre::stride])
    return total


def depth_loss(depth: Tensor, truth: Tensor) -> Tensor:
    """Log of (mean log error + mean error relative to the median depth), averaged over the batch.

    The log makes samples with many and with few points count alike: what is rewarded is the
    share of its error a sample loses.
    """
    known = truth > 0
    safe = torch.where(known, truth, depth.detach())
    count = known.sum((1, 2, 3)).clamp(min=1)
    log_error = (torch.log(depth) - torch.log(safe)).abs().sum((1, 2, 3)) / count
    rows = zip(truth.flatten(1), known.flatten(1), strict=True)
    medians = torch.stack(
        [row[seen].median() if bool(seen.any()) else row.new_ones(()) for row, seen in rows]
    )
    error = ((depth - safe).abs().sum((1, 2, 3)) / count) / medians
    return torch.log(log_error + 0.5 * error + 1e-2).mean()


def _append(path: Path, row: dict[str, float]) -> None:
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def _loader(settings: Settings, first_step: int) -> Iterable[Sample]:
    start = first_step * settings.batch
    numbers = Counting(start, (settings.steps - first_step) * settings.batch)
    data = Samples(settings.data, settings.size, settings.seed)
    return DataLoader(
        data, batch_size=settings.batch, sampler=numbers, num_workers=settings.workers,
        prefetch_factor=4 if settings.workers else None,
    )  # fmt: skip


def train(settings: Settings) -> Path:
    """Trains to the end of the schedule; returns the file with the averaged weights."""
    settings.out.mkdir(parents=True, exist_ok=True)
    run = Run(settings)
    if settings.resume and (settings.out / "state.pt").exists():
        run.restore()
    held_out = cases(settings.val, settings.val_frames) if settings.val else []
    began = time.monotonic() - run.elapsed_s
    smooth = math.nan
    with tqdm(total=settings.steps, initial=run.step, unit="step", mininterval=5.0) as bar:
        for sample in _loader(settings, run.step):
            loss = run.learn(Sample(*sample))
            smooth = loss if math.isnan(smooth) else 0.99 * smooth + 0.01 * loss
            run.elapsed_s = time.monotonic() - began
            bar.update()
            bar.set_postfix(loss=f"{smooth:.3f}", refresh=False)
            if run.step % settings.save_every == 0 or run.progress >= 1.0:
                _report(run, held_out, smooth)
            if run.progress >= 1.0:
                break
    return settings.out / "compact.safetensors"


def _report(run: Run, held_out: list[Case], loss: float) -> None:
    run.save()
    out, now = run.settings.out, {"step": float(run.step), "seconds": round(run.elapsed_s)}
    _append(out / "log.csv", now | {"loss": round(loss, 4)})
    if held_out:
        found = {k: round(v, 2) for k, v in scores(run.average, held_out, run.device).items()}
        _append(out / "val.csv", now | found)
        tqdm.write(f"step {run.step}: {found}")


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, nargs="+", help="folders of shards")
    parser.add_argument("--val", type=Path, help="folder of shards kept for validation")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, help="end after this long at the latest")
    parser.add_argument("--resume", action="store_true", help="go on from RUN_DIR/state.pt")
    parser.add_argument("--batch", type=int, default=Settings.batch)
    parser.add_argument("--lr", type=float, default=Settings.lr)
    options = parser.parse_args()
    print(train(Settings(**vars(options) | {"data": tuple(options.data)})))


if __name__ == "__main__":
    main()
