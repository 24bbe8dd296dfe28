"""Trains `compact` on rendered frames.

    python -m model_zoo_defs.training.train --data DIR --val DIR --out RUN_DIR --steps N --seed 1

RUN_DIR gets state.pt (everything `--resume` needs), log.csv (losses), val.csv (scores in per cent
of linear interpolation's) and compact.safetensors (the averaged weights, in half precision).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import DataLoader
from tqdm import tqdm

from model_zoo_defs.compact import Compact
from model_zoo_defs.training.dataset import Counting, Sample, Samples
from model_zoo_defs.training.encoder_weights import pretrained_encoder
from model_zoo_defs.training.learner import Learner, Schedule, append_row
from model_zoo_defs.training.validation import Case, cases, scores

# weights of the depths at 1/16, 1/8, 1/4, 1/2 and full size
LEVEL_WEIGHTS = (0.15, 0.2, 0.3, 0.4, 1.0)


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


class Run(Learner):
    """`compact` being trained."""

    network: Compact

    def __init__(self, settings: Settings):
        torch.manual_seed(settings.seed)
        network = Compact()
        if settings.pretrained:
            network.encoder.load_state_dict(pretrained_encoder())
        # Photographs are what the encoder knows and rendered frames are not: it stays as it is.
        network.encoder.requires_grad_(False)
        schedule = Schedule(lr=settings.lr, steps=settings.steps, minutes=settings.minutes)
        lanes = min(settings.lanes, settings.batch)
        super().__init__(network, schedule, settings.out, "compact", lanes)

    def loss(self, part: Sequence[Tensor]) -> Tensor:
        """How far the depths of all levels are from the truth."""
        rgb, sparse, depth = part
        rgb = rgb.contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16):
            depths = self.network.pyramid(rgb, sparse)
        return pyramid_loss(depths, depth)


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
    if settings.resume:
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
    return run.weights


def _report(run: Run, held_out: list[Case], loss: float) -> None:
    run.save()
    out, now = run.out, {"step": float(run.step), "seconds": round(run.elapsed_s)}
    append_row(out / "log.csv", now | {"loss": round(loss, 4)})
    if held_out:
        found = {k: round(v, 2) for k, v in scores(run.average, held_out, run.device).items()}
        append_row(out / "val.csv", now | found)
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
