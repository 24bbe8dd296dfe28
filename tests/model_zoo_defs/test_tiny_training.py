"""The recipe of the tiny editions: batches keep metres, losses mean what they say, runs go on."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from model_zoo_defs.training.learning import recipes
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

pytest.importorskip("safetensors")
tiny = pytest.importorskip("model_zoo_defs.training.learning.tiny")
train = pytest.importorskip("model_zoo_defs.training.learning.train")

pytestmark = pytest.mark.slow

SHAPE = (48, 64)


def slope(seed: int) -> np.ndarray:
    """Depth that grows to the right and down from 1 to 5 m, unknown in one corner."""
    rows, columns = np.indices(SHAPE)
    depth = 1.0 + 0.03 * rows + 0.04 * columns + 0.1 * seed
    depth[:4, :6] = 0.0
    return depth.astype(np.float32)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    depth = np.stack([slope(i) for i in range(4)])
    rgb = np.repeat((depth * 40.0).astype(np.uint8)[..., None], 3, axis=-1)
    np.savez(folder / "shard_00000.npz", rgb=rgb, depth=depth)
    return folder


class Toy(nn.Module):
    """Depth in metres from an image, by one layer."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(3)
        self.conv = nn.Conv2d(3, 1, 3, padding=1)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.conv(self.norm(rgb))  # type: ignore[no-any-return]


TOY = ModelDefinition(name="toy-tiny", input_kind="rgb", size=Multiple(1), build=Toy)
RECIPE = recipes.Recipe(
    loss=recipes.log_error, batch=2, lr=3e-2, half_precision=False, flat={"conv": 0.5},
    stages=(
        recipes.Stage(window=(32, 48), shown=(16, 24), until=0.5),
        recipes.Stage(window=(32, 48)),
    ),
)  # fmt: skip


def settings(shards: Path, out: Path, steps: int = 8) -> Any:
    return tiny.Settings(
        network="toy-tiny", data=(shards,), val=(shards,), out=out, steps=steps, save_every=4
    )


@pytest.mark.parametrize("lanes", [1, 2])
def test_a_run_learns_and_going_on_gives_the_bytes_of_an_uninterrupted_run(
    lanes: int, shards: Path, tmp_path: Path
) -> None:
    whole = replace(settings(shards, tmp_path / "whole"), lanes=lanes)
    weights = tiny.train(TOY, RECIPE, whole).read_bytes()
    broken = replace(whole, out=tmp_path / "broken")
    broken.out.mkdir()
    run = tiny.TinyRun(TOY, RECIPE, broken)
    for number in range(4):
        run.learn(run.batch(number))
    run.save()
    assert tiny.train(TOY, RECIPE, replace(broken, resume=True)).read_bytes() == weights
    with (tmp_path / "whole" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["4", "8"]
    assert float(rows[1]["loss"]) < float(rows[0]["loss"])
    assert {"mae", "rmse", "d1"} <= rows[1].keys()
