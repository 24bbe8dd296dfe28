"""Training of `compact`: the drawn points, the losses, and a run that stops and resumes."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("safetensors")
train = pytest.importorskip("model_zoo_defs.training.learning.train")

pytestmark = pytest.mark.slow

SHAPE = (48, 64)


def room(seed: int) -> NDArray[np.float32]:
    """A slope with a near box in it and a corner of unknown depth."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(SHAPE)
    depth = 4.0 + 0.02 * rows - 0.01 * columns
    top, left = rng.integers(5, 25, 2)
    depth[top : top + 15, left : left + 20] = rng.uniform(0.5, 3.0)
    depth[:4, :6] = 0.0
    return depth.astype(np.float32)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    for number in range(2):
        depth = np.stack([room(10 * number + i) for i in range(3)])
        # brightness follows depth, so that there is something to learn
        rgb = np.repeat((depth * 50.0).astype(np.uint8)[..., None], 3, axis=-1)
        np.savez(folder / f"shard_{number:05d}.npz", rgb=rgb, depth=depth)
    return folder


def test_a_run_learns_and_going_on_gives_the_bytes_of_an_uninterrupted_run(
    shards: Path, tmp_path: Path
) -> None:
    whole = train.Settings(
        data=(shards,), val=shards, val_frames=1, out=tmp_path / "whole", steps=8, batch=2,
        size=(32, 64), save_every=4, pretrained=False, workers=0, lr=1e-2,
    )  # fmt: skip
    weights = train.train(whole).read_bytes()
    broken = replace(whole, out=tmp_path / "broken")
    stop_at(broken, step=4)
    assert train.train(replace(broken, resume=True)).read_bytes() == weights
    with (tmp_path / "whole" / "log.csv").open() as file:
        losses = [float(row["loss"]) for row in csv.DictReader(file)]
    assert len(losses) == 2
    assert losses[1] < losses[0]
    assert (tmp_path / "whole" / "val.csv").exists()


def stop_at(settings_: train.Settings, step: int) -> None:
    """Leaves the run folder as a run killed right after `step` would."""
    settings_.out.mkdir()
    run = train.Run(settings_)
    for sample in train._loader(settings_, 0):
        run.learn(sample)
        if run.step == step:
            run.save()
            return
