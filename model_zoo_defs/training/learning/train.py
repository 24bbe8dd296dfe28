r"""Trains `compact` on rendered frames.

    python -m model_zoo_defs.training.learning.train --data DIR --val DIR --out RUN_DIR \
        --steps N --seed 1

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
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from model_zoo_defs.compact import Compact
from model_zoo_defs.training.learning.dataset import Counting, Sample, Samples
from model_zoo_defs.training.learning.encoder_weights import pretrained_encoder
from model_zoo_defs.training.learning.learner import WARM_UP_STEPS, Learner, Schedule, append_row
from model_zoo_defs.training.learning.validation import Case, cases, scores

# Weight of the loss of σ beside that of depth.
SIGMA_WEIGHT = 0.1
# Stages of the encoder that are trained if any are: those at 1/16 and 1/32.
ENCODER_STAGES = ("s16", "s32")
# Weights of the depths at 1/16, 1/8, 1/4, 1/2 and full size.
LEVEL_WEIGHTS = (0.15, 0.2, 0.3, 0.4, 1.0)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One training run.

    start: weights to start from; without them the encoder is pretrained and the rest random.
    decay: steps at the end in which the rate falls to 0; None: it falls throughout.
    encoder_rate: of the encoder's last stages, over that of all else; 0: they are frozen.
    """

    data: tuple[Path, ...]
    out: Path
    steps: int
    seed: int = 1
    val: Path | None = None
    batch: int = 8
    lanes: int = 2
    size: tuple[int, int] = (192, 256)
    lr: float = 1e-3
    save_every: int = 500
    val_frames: int = 24
    pretrained: bool = True
    start: Path | None = None
    decay: int | None = None
    warm_up: int = WARM_UP_STEPS
    averaging: float = 0.999
    encoder_rate: float = 0.0
    workers: int = 1
    resume: bool = False


class Run(Learner):
    """Training run of `compact`."""

    network: Compact

    def __init__(self, settings: Settings):
        torch.manual_seed(settings.seed)
        network = Compact()
        if settings.pretrained:
            network.encoder.load_state_dict(pretrained_encoder())
        if settings.start:
            network.load_state_dict(load_file(settings.start))
        # The encoder is pretrained on photographs, which rendered frames differ from: it is frozen,
        # or its last stages are trained at a low rate.
        self.encoder_rate = settings.encoder_rate
        network.encoder.requires_grad_(False)
        if settings.encoder_rate > 0:
            for stage in ENCODER_STAGES:
                network.encoder.stages[stage].requires_grad_(True)
        # `train_inliers` trains it: the loss of depth makes it worse at outliers.
        network.inlier_weights.requires_grad_(False)
        schedule = Schedule(
            lr=settings.lr, steps=settings.steps, averaging=settings.averaging,
            decay=settings.decay, warm_up=settings.warm_up,
        )  # fmt: skip
        lanes = min(settings.lanes, settings.batch)
        super().__init__(network, schedule, settings.out, "compact", lanes)
        self.bfloat16 = self.device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()

    def groups(self) -> list[dict[str, Any]]:
        """Returns the optimiser's parameter groups, each with its factor on the learning rate.

        The encoder's is `encoder_rate`.
        """
        groups: dict[float, list[nn.Parameter]] = {}
        for name, parameter in self.network.named_parameters():
            if parameter.requires_grad:
                factor = self.encoder_rate if name.startswith("encoder.") else 1.0
                groups.setdefault(factor, []).append(parameter)
        return [{"params": members, "factor": factor} for factor, members in groups.items()]

    def loss(self, part: Sequence[Tensor]) -> Tensor:
        """Returns the loss of depth at all levels plus the weighted loss of sigma.

        Args:
            part: Image, sparse depth, ground truth and prior of a batch, as in `Sample`.
        """
        rgb, sparse, depth, prior = part
        rgb = rgb.contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            outputs = self.network.outputs(rgb, sparse, prior if bool(prior.any()) else None)
            sigma = self.network.sigma(outputs)
        of_sigma = sigma_loss(sigma, outputs.depths[-1], depth)
        return pyramid_loss(outputs.depths, depth) + SIGMA_WEIGHT * of_sigma


def sigma_loss(sigma: Tensor, depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Returns the mean negative log likelihood of log depth's error, Laplace distributed.

    Args:
        sigma: Scale of the distribution (B, 1, H, W).
        depth: Predicted depth (B, 1, H, W) in metres; no gradient goes to it.
        ground_truth: Depth (B, 1, H, W) in metres, 0 = unknown.
    """
    known = ground_truth > 0
    error = (torch.log(depth.detach()[known]) - torch.log(ground_truth[known])).abs()
    scale = sigma[known]
    return (error / scale + torch.log(scale)).mean()


def pyramid_loss(depths: list[Tensor], ground_truth: Tensor) -> Tensor:
    """Returns the weighted sum of `depth_loss` over the levels.

    Args:
        depths: Depth (B, 1, h, w) in metres of each level.
        ground_truth: Depth (B, 1, H, W) in metres, 0 = unknown.
    """
    total = ground_truth.new_zeros(())
    for weight, depth in zip(LEVEL_WEIGHTS, depths, strict=True):
        stride = ground_truth.shape[-1] // depth.shape[-1]
        centre = stride // 2
        total = total + weight * depth_loss(
            depth, ground_truth[..., centre::stride, centre::stride]
        )
    return total


def depth_loss(depth: Tensor, ground_truth: Tensor) -> Tensor:
    """Log of (mean log error + mean error relative to the median depth), averaged over the batch.

    The log makes samples with many and with few points count alike: the loss measures the
    relative change of a sample's error.
    """
    known = ground_truth > 0
    safe = torch.where(known, ground_truth, depth.detach())
    count = known.sum((1, 2, 3)).clamp(min=1)
    log_error = (torch.log(depth) - torch.log(safe)).abs().sum((1, 2, 3)) / count
    medians = []
    for depths, are_known in zip(ground_truth.flatten(1), known.flatten(1), strict=True):
        has_any = bool(are_known.any())
        medians.append(depths[are_known].median() if has_any else depths.new_ones(()))
    error = ((depth - safe).abs().sum((1, 2, 3)) / count) / torch.stack(medians)
    return torch.log(log_error + 0.5 * error + 1e-2).mean()


def _loader(settings: Settings, first_step: int) -> Iterable[Sample]:
    """Returns the batches of samples from a step on to the end of the run."""
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
    """Saves the run, and appends its loss and its scores on the held-out cases to its files."""
    run.save()
    out = run.out
    now = {"step": float(run.step), "seconds": round(run.elapsed_s)}
    append_row(out / "log.csv", now | {"loss": round(loss, 4)})
    if held_out:
        results = {k: round(v, 2) for k, v in scores(run.average, held_out, run.device).items()}
        append_row(out / "val.csv", now | results)
        tqdm.write(f"step {run.step}: {results}")


def _size(text: str) -> tuple[int, int]:
    """Returns (height, width) of a text such as 192x256."""
    height, width = text.split("x")
    return int(height), int(width)


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    # Files.
    parser.add_argument("--data", type=Path, required=True, nargs="+", help="folders of shards")
    parser.add_argument("--val", type=Path, help="folder of shards kept for validation")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    # The schedule.
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--resume", action="store_true", help="go on from RUN_DIR/state.pt")
    parser.add_argument(
        "--window", dest="size", type=_size, default=Settings.size, help="height x width in pixels"
    )
    parser.add_argument("--batch", type=int, default=Settings.batch)
    parser.add_argument("--lr", type=float, default=Settings.lr)
    parser.add_argument("--start", type=Path, help="weights to start from")
    parser.add_argument("--decay", type=int, help="constant rate, falling in the last N steps")
    parser.add_argument("--warm-up", type=int, default=Settings.warm_up)
    parser.add_argument("--averaging", type=float, default=Settings.averaging)
    parser.add_argument("--encoder-rate", type=float, default=0.0, help="times the rate; 0: frozen")
    parser.add_argument("--save-every", type=int, default=Settings.save_every)
    # What does not change the weights, but for the lanes.
    parser.add_argument("--val-frames", type=int, default=Settings.val_frames)
    parser.add_argument("--lanes", type=int, default=Settings.lanes)
    parser.add_argument("--workers", type=int, default=Settings.workers)
    options = parser.parse_args()
    print(train(Settings(**vars(options) | {"data": tuple(options.data)})))


if __name__ == "__main__":
    main()
