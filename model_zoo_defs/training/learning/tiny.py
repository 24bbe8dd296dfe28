"""Trains the tiny edition of one of the paper's networks on rendered frames.

    python -m model_zoo_defs.training.learning.tiny --network fcrn-tiny --data DIR ... --val DIR
        --out RUN_DIR --minutes 30 --seed 1

RUN_DIR gets state.pt (everything `--resume` needs), log.csv (loss and, with --val, MAE, RMSE and
δ1 on frames that are not trained on) and NAME.safetensors (the averaged weights, in half
precision). `--resume` with more minutes or steps goes on.
"""

from __future__ import annotations

import argparse
import importlib
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from model_zoo_defs.training.learning.batches import Batch, Batches
from model_zoo_defs.training.learning.dataset import Frames
from model_zoo_defs.training.learning.learner import Learner, Schedule, append_row
from model_zoo_defs.training.learning.recipes import RECIPES, Recipe, Stage, with_start
from model_zoo_defs.training.learning.scaffold import without_scaffold
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

AVERAGING = 0.99  # runs are short, and the average must not mix the weights of two stages
SETTLING = range(1_000_000_000, 1_000_000_016)  # batch numbers that no step uses
SETTLED_ON = 48  # windows in each of them
COARSER = 0.5  # weight of each next coarser output relative to the finer one


def tiny_definition(name: str) -> ModelDefinition:
    """The definition of that name from the file of its family."""
    family = importlib.import_module(f"model_zoo_defs.{name.partition('-tiny')[0]}")
    definition: ModelDefinition = family.definitions[name]
    return definition


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One training run; the schedule follows whichever of `minutes` and `steps` ends first.

    lanes: parallel threads on a CPU, each with a batch of the recipe's size.
    """

    network: str
    data: tuple[Path, ...]
    out: Path
    val: tuple[Path, ...] = ()
    minutes: float | None = None
    steps: int = 1_000_000
    seed: int = 1
    save_every: int = 500
    val_frames: int = 24
    lanes: int = 1
    resume: bool = False


class TinyRun(Learner):
    """Training run of one tiny edition."""

    def __init__(self, definition: ModelDefinition, recipe: Recipe, settings: Settings):
        torch.manual_seed(settings.seed)
        self.definition, self.recipe = definition, recipe
        schedule = Schedule(
            lr=recipe.lr, steps=settings.steps, minutes=settings.minutes, averaging=AVERAGING
        )
        self.batches = Batches(settings.data, settings.seed, recipe.points, recipe.spliced)
        network = with_start(definition.build(), recipe)
        super().__init__(network, schedule, settings.out, definition.name, settings.lanes)

    def loss(self, part: Sequence[Tensor]) -> Tensor:
        """Returns the sum of the recipe's loss over the outputs; the finest weighs most."""
        batch = Batch(*part)
        known = self.known(batch)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.half_precision):
            outputs = self.stage.outputs(self.network, self.arguments(batch))
        total = known.new_zeros(())
        for level, output in enumerate(outputs):
            depth = as_depth(output.float(), self.definition.output_kind)
            ground_truth = F.interpolate(known, depth.shape[-2:], mode="nearest-exact")
            total = total + COARSER**level * self.recipe.loss(depth, ground_truth)
        return total

    @property
    def stage(self) -> Stage:
        """The current stage."""
        return self.recipe.stage(self.progress)

    def known(self, batch: Batch) -> Tensor:
        """The batch's depth (B, 1, H, W), 0 beyond the recipe's farthest depth."""
        return torch.where(batch.depth > self.recipe.farthest, 0.0, batch.depth)

    def batch(self, number: int) -> Batch:
        """The batch of step number `number`, at the window and image size of its stage."""
        stage = self.recipe.stage(self.schedule.progress(number, self.elapsed_s))
        size = self.recipe.batch * self.lanes
        return self.batches.batch(number, size, stage.window, stage.shown)

    @torch.no_grad()
    def save(self) -> None:
        """Recomputes the average's batch normalisation statistics on large batches, then saves.

        Running statistics of small training batches suit neither batches with few points nor
        those with the many points of a LiDAR.
        """
        kinds = nn.BatchNorm1d | nn.BatchNorm2d
        norms = [layer for layer in self.average.modules() if isinstance(layer, kinds)]
        momenta = [norm.momentum for norm in norms]
        for norm in norms:
            norm.reset_running_stats()
            norm.momentum = None  # the mean over all batches
        self.average.train()
        for number in SETTLING if norms else ():
            batch = self.batches.batch(number, SETTLED_ON, self.stage.window, self.stage.shown)
            self.average(*self.arguments(batch))
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum
        super().save()

    def exported(self) -> nn.Module:
        """The averaged network without the layers that are used only in training."""
        return without_scaffold(self.average)

    def arguments(self, batch: Batch) -> tuple[Tensor, ...]:
        """Returns the arguments of the network for a batch, its images normalised."""
        normalisation = self.definition.normalisation
        assert normalisation is not None
        mean, std = (
            torch.tensor(x, device=batch.rgb.device).view(3, 1, 1)
            for x in (normalisation.mean, normalisation.std)
        )
        return self.definition.call_arguments((batch.rgb - mean) / std, batch.sparse)

    @torch.no_grad()
    def depth(self, batch: Batch) -> Tensor:
        """Returns the averaged network's depth for a batch, (B, 1, h, w), at the stage's size."""
        self.average.eval()
        if shown := self.stage.shown:
            rgb = F.interpolate(batch.rgb, shown, mode="bilinear", antialias=True)
            batch = batch._replace(rgb=rgb)
        output = self.average(*self.arguments(Batch(*(x.to(self.device) for x in batch))))
        return as_depth(output.float().cpu(), self.definition.output_kind)


def as_depth(output: Tensor, kind: str) -> Tensor:
    """Returns depth (B, 1, h, w) from a network's output, by what its numbers are.

    Args:
        output: (B, 1, h, w).
        kind: "inverse" for inverse depth, whose depth is at most 1000; "log" for log depth, whose
            depth is limited to exp(±7); else depth itself, which is not limited.
    """
    if kind == "inverse":
        return 1.0 / output.clamp(min=1e-3)
    if kind == "log":
        return output.clamp(-7.0, 7.0).exp()
    return output


def held_out(settings: Settings, definition: ModelDefinition, recipe: Recipe) -> list[Batch]:
    """Evenly spaced frames of each validation folder as batches of one, with reproducible points.

    Frames are cropped at the right and the bottom to a multiple of the network's size.
    """
    frames_with_points = []
    step = definition.size.of if isinstance(definition.size, Multiple) else 1
    for folder in settings.val:
        frames = Frames(folder)
        chosen = np.linspace(0, len(frames) - 1, min(settings.val_frames, len(frames)))
        for index in chosen.astype(int):
            rgb, depth = frames[int(index)]
            height, width = (length - length % step for length in depth.shape)
            rgb, depth = rgb[:height, :width], depth[:height, :width]
            rng = np.random.default_rng(int(index))
            sparse = recipe.points(rng, depth) if recipe.points else np.zeros_like(depth)
            image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255.0
            points, ground_truth = (torch.from_numpy(x)[None, None] for x in (sparse, depth))
            frames_with_points.append(Batch(image, points, ground_truth))
    return frames_with_points


def scores(run: TinyRun, frames: list[Batch]) -> dict[str, float]:
    """Mean MAE and RMSE in metres and δ1 in per cent; non-metric depth is scaled by medians."""
    rows = []
    for batch in frames:
        depth = F.interpolate(run.depth(batch), batch.depth.shape[-2:], mode="bilinear")
        true = run.known(batch)
        ours, ground_truth = depth[true > 0], true[true > 0]
        if run.definition.output_scale != "metric":
            ours = ours * (ground_truth.median() / ours.median())
        ours = ours.clamp(min=1e-3)
        error = ours - ground_truth
        ratio = torch.maximum(ours / ground_truth, ground_truth / ours)
        close = 100.0 * (ratio < 1.25).float().mean()
        rows.append([error.abs().mean(), error.square().mean().sqrt(), close])
    means = np.array(rows).mean(0)
    return dict(zip(("mae", "rmse", "d1"), (round(float(x), 4) for x in means), strict=True))


def train(definition: ModelDefinition, recipe: Recipe, settings: Settings) -> Path:
    """Trains to the end of the schedule; returns the file with the averaged weights."""
    settings.out.mkdir(parents=True, exist_ok=True)
    run = TinyRun(definition, recipe, settings)
    if settings.resume:
        run.restore()
    frames = held_out(settings, definition, recipe)
    began = time.monotonic() - run.elapsed_s
    smooth = math.nan
    bar = tqdm(total=settings.steps, initial=run.step, unit="step", mininterval=10.0)
    with bar, ThreadPoolExecutor(1) as ahead:
        coming = ahead.submit(run.batch, run.step)
        while run.progress < 1.0:
            batch = coming.result()
            coming = ahead.submit(run.batch, run.step + 1)
            loss = run.learn(batch)
            smooth = loss if math.isnan(smooth) else 0.99 * smooth + 0.01 * loss
            run.elapsed_s = time.monotonic() - began
            bar.update()
            if run.step % settings.save_every == 0 or run.progress >= 1.0:
                run.save()
                now = {"step": run.step, "seconds": round(run.elapsed_s), "loss": round(smooth, 4)}
                row = now | (scores(run, frames) if frames else {})
                append_row(run.out / "log.csv", row)
                tqdm.write(str(row))
    return run.weights


def main() -> None:
    """Reads the command line and trains."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--network", choices=tuple(RECIPES), required=True)
    parser.add_argument("--data", type=Path, required=True, nargs="+", help="folders of shards")
    parser.add_argument("--val", type=Path, nargs="*", default=(), help="folders kept for watching")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--minutes", type=float, help="end after this long at the latest")
    parser.add_argument("--steps", type=int, default=Settings.steps)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lanes", type=int, default=1, help="batches learnt side by side on a CPU")
    parser.add_argument("--resume", action="store_true", help="go on from RUN_DIR/state.pt")
    options = vars(parser.parse_args())
    settings = Settings(**options | {"data": tuple(options["data"]), "val": tuple(options["val"])})
    print(train(tiny_definition(settings.network), RECIPES[settings.network], settings))


if __name__ == "__main__":
    main()
