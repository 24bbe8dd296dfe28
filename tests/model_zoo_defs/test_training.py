"""Training of `compact` and of the tiny editions: a run learns, stops, and goes on."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from model_zoo_defs.training.learning import mean_weights, recipes
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

tiny = pytest.importorskip("model_zoo_defs.training.learning.tiny")
train = pytest.importorskip("model_zoo_defs.training.learning.train")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Slopes with a near box and a corner of unknown depth; brightness follows depth."""
    folder = tmp_path_factory.mktemp("shards")
    rows, columns = np.indices((48, 64))
    for number in range(2):
        depth = np.stack([4.0 + 0.02 * rows - 0.01 * columns] * 3)
        for place, view in enumerate(depth):
            rng = np.random.default_rng(10 * number + place)
            top, left = rng.integers(5, 25, 2)
            view[top : top + 15, left : left + 20] = rng.uniform(0.5, 3.0)
        depth[:, :4, :6] = 0.0
        rgb = np.repeat((depth * 50.0).astype(np.uint8)[..., None], 3, axis=-1)
        np.savez(folder / f"shard_{number:05d}.npz", rgb=rgb, depth=depth.astype(np.float32))
    return folder


def learned(folder: Path) -> bool:
    log = np.genfromtxt(folder / "log.csv", delimiter=",", names=True, dtype=None)
    assert log["step"].tolist() == [4, 8]
    return bool(log["loss"][1] < log["loss"][0])


def test_compact_learns_and_going_on_gives_the_same_bytes(shards: Path, tmp_path: Path) -> None:
    whole = train.Settings(
        data=(shards,), val=shards, val_frames=1, out=tmp_path / "whole", steps=8, batch=2,
        size=(32, 64), save_every=4, pretrained=False, workers=0, lr=1e-2,
    )  # fmt: skip
    weights = train.train(whole).read_bytes()
    assert learned(whole.out)
    assert (whole.out / "val.csv").exists()
    # as a run killed right after step 4 leaves its folder
    broken = replace(whole, out=tmp_path / "broken")
    broken.out.mkdir()
    run = train.Run(broken)
    for sample in itertools.islice(train._loader(broken, 0), 4):
        run.learn(sample)
    run.save()
    assert train.train(replace(broken, resume=True)).read_bytes() == weights


TOY = ModelDefinition(
    name="toy-tiny", input_kind="rgb", size=Multiple(1),
    build=lambda: nn.Sequential(nn.BatchNorm2d(3), nn.Conv2d(3, 1, 3, padding=1)),
)  # fmt: skip
RECIPE = recipes.Recipe(
    loss=recipes.log_error, batch=2, lr=0.3, half_precision=False, flat={"1": 0.5},
    stages=(
        recipes.Stage(window=(32, 48), shown=(16, 24), until=0.5),
        recipes.Stage(window=(32, 48)),
    ),
)  # fmt: skip


@pytest.mark.parametrize("lanes", [1, 2])
def test_an_edition_learns_and_goes_on_as_it_was(lanes: int, shards: Path, tmp_path: Path) -> None:
    whole = tiny.Settings(
        network="toy-tiny", data=(shards,), val=(shards,), out=tmp_path / "whole", steps=8,
        save_every=4, lanes=lanes,
    )  # fmt: skip
    weights = tiny.train(TOY, RECIPE, whole).read_bytes()
    broken = replace(whole, out=tmp_path / "broken")
    broken.out.mkdir()
    run = tiny.TinyRun(TOY, RECIPE, broken)
    for number in range(4):
        run.learn(run.batch(number))
    run.save()
    assert tiny.train(TOY, RECIPE, replace(broken, resume=True)).read_bytes() == weights
    assert learned(whole.out)


def test_weights_are_averaged_by_their_parts_and_stored_in_half_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = load_file(Path(mean_weights.__file__).parents[2] / "weights" / "compact.safetensors")
    save_file({name: tensor.float() + 1 for name, tensor in shipped.items()}, tmp_path / "a")
    save_file({name: tensor.float() - 2 for name, tensor in shipped.items()}, tmp_path / "b")
    arguments = ["--weights", "a", "b", "--parts", "2", "1", "--out", "mean"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["mean_weights", *arguments])
    mean_weights.main()
    # Twice one more and once two less leave the weights as they are.
    mean = load_file(tmp_path / "mean")
    assert mean.keys() == shipped.keys()
    for name, tensor in shipped.items():
        assert mean[name].dtype == tensor.dtype
        torch.testing.assert_close(mean[name], tensor, rtol=1e-3, atol=1e-6)
