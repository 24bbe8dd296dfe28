"""Renders training frames: python -m model_zoo_defs.training.rendering.render --help."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from model_zoo_defs.training.scenes.scenes import (
    CAMERAS,
    KINDS,
    VIEWS_PER_SCENE,
    Frame,
    scene_frames,
)


@dataclass(frozen=True, kw_only=True)
class Job:
    """Settings of one rendering run."""

    out: Path
    seed: int
    height: int
    width: int
    frames: int
    shard_frames: int
    kinds: tuple[str, ...]
    camera: str = "any"

    def scene(self, number: int) -> list[Frame]:
        """Returns the frames of one scene."""
        return scene_frames(
            self.seed,
            number,
            height=self.height,
            width=self.width,
            kinds=self.kinds,
            rig=CAMERAS[self.camera],
        )


def shard_path(out: Path, index: int) -> Path:
    """Returns the path of a shard."""
    return out / f"shard_{index:05d}.npz"


def render_shard(job: Job, index: int) -> int:
    """Writes one shard, unless it exists; returns its number of frames."""
    target = shard_path(job.out, index)
    first = index * job.shard_frames
    count = min(job.shard_frames, job.frames - first)
    if target.exists():
        return count
    frames: list[Frame] = []
    first_scene = first // VIEWS_PER_SCENE
    for scene in range(first_scene, math.ceil((first + count) / VIEWS_PER_SCENE)):
        frames += job.scene(scene)
    frames = frames[:count]
    temporary = target.with_suffix(f".{os.getpid()}.tmp")
    with temporary.open("wb") as stream:
        np.savez(
            stream,
            rgb=np.stack([frame.rgb for frame in frames]),
            depth=np.stack([frame.depth for frame in frames]),
            kind=np.array([frame.kind for frame in frames], np.uint8),
            intrinsics=np.stack([frame.intrinsics for frame in frames]),
        )
    temporary.replace(target)
    return count


def render_all(job: Job, *, workers: int) -> None:
    """Writes every missing shard; the bytes do not depend on the number of workers."""
    job.out.mkdir(parents=True, exist_ok=True)
    indices = range(math.ceil(job.frames / job.shard_frames))
    work = partial(render_shard, job)
    with tqdm(total=job.frames, unit="frame", smoothing=0.05) as progress:
        if workers == 1:
            for index in indices:
                progress.update(work(index))
            return
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            for count in pool.imap(work, indices):
                progress.update(count)


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Returns the options of the command line; None reads those of the process."""
    parser = argparse.ArgumentParser(description="Render random scenes with exact depth.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--size", default="256x320", help="height x width in pixels")
    parser.add_argument("--shard-frames", type=int, default=64, help="a multiple of 4")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds to draw from")
    parser.add_argument("--camera", choices=tuple(CAMERAS), default="any")
    chosen = parser.parse_args(arguments)
    unknown = set(chosen.kinds.split(",")) - set(KINDS)
    if unknown:
        parser.error(f"unknown kinds: {', '.join(sorted(unknown))}; known: {', '.join(KINDS)}")
    if chosen.shard_frames % VIEWS_PER_SCENE:
        parser.error(f"--shard-frames must be a multiple of {VIEWS_PER_SCENE}")
    return chosen


def main(arguments: Sequence[str] | None = None) -> None:
    """Renders what the command line asks for."""
    chosen = _parsed(arguments)
    height, width = (int(side) for side in chosen.size.split("x"))
    job = Job(
        out=chosen.out,
        seed=chosen.seed,
        height=height,
        width=width,
        frames=chosen.frames,
        shard_frames=chosen.shard_frames,
        kinds=tuple(chosen.kinds.split(",")),
        camera=chosen.camera,
    )
    render_all(job, workers=chosen.workers)


if __name__ == "__main__":
    main()
