"""The recipe of the tiny editions: batches keep metres, losses mean what they say, runs go on."""

from __future__ import annotations

import copy
import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from model_zoo_defs.training.learning import batches, recipes
from model_zoo_defs.training.learning.scaffold import scaffolded, without_scaffold
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


def test_a_batch_depends_on_its_number_alone(shards: Path) -> None:
    straight, jumping = (batches.Batches([shards], 3, batches.some_points) for _ in range(2))
    straight.batch(0, 2, (32, 48)), straight.batch(1, 2, (32, 48))
    for one, other in zip(
        straight.batch(2, 2, (32, 48)), jumping.batch(2, 2, (32, 48)), strict=True
    ):
        assert torch.equal(one, other)
    of_another_seed = batches.Batches([shards], 4, batches.some_points).batch(2, 2, (32, 48))
    assert not torch.equal(straight.batch(2, 2, (32, 48)).depth, of_another_seed.depth)


def test_a_batch_changes_colours_but_neither_depth_nor_geometry(shards: Path) -> None:
    seen = set(np.load(shards / "shard_00000.npz")["depth"].ravel().tolist())
    batch = batches.Batches([shards], 1).batch(0, 8, (32, 48))
    assert set(batch.depth.ravel().tolist()) <= seen
    for rgb, depth in zip(batch.rgb, batch.depth[:, 0], strict=True):
        # brightness follows depth in these frames, in whatever light, mirrored or not
        together = torch.corrcoef(torch.stack([rgb.mean(0).ravel(), depth.ravel()]))[0, 1]
        assert together > 0.9


def test_spliced_windows_are_whole_columns_of_frames_in_their_own_rows(shards: Path) -> None:
    frames = np.load(shards / "shard_00000.npz")["depth"]
    columns = {column.tobytes() for frame in frames for column in frame.T}
    plain, spliced = (
        batches.Batches([shards], 1, spliced=fraction).batch(0, 20, SHAPE).depth[:, 0].numpy()
        for fraction in (0.0, 1.0)
    )
    assert {column.tobytes() for window in spliced for column in window.T} <= columns
    # depth grows by one step a column in a whole window, to the left or to the right
    steps = [len(np.unique(np.round(np.diff(window[-1]), 1))) for window in (*plain, *spliced)]
    assert max(steps[:20]) == 1
    assert np.mean(np.array(steps[20:]) > 1) > 0.5


def test_the_fine_half_of_eigen_starts_as_what_the_coarse_half_says() -> None:
    definition = tiny.tiny_definition("eigen-tiny")
    network = recipes.with_start(definition.build(), recipes.RECIPES["eigen-tiny"]).eval()
    rgb = torch.rand(1, 3, 228, 304, generator=torch.Generator().manual_seed(0))
    coarse = torch.randn(1, 1, 55, 74, generator=torch.Generator().manual_seed(1))
    assert torch.equal(network.fine(rgb, coarse), coarse)


@pytest.mark.parametrize("draw", [batches.some_points, batches.many_points])
def test_points_are_depths_of_the_window_or_of_what_lies_behind(draw: batches.Points) -> None:
    depth = slope(0)
    for seed in range(20):
        sparse = draw(np.random.default_rng(seed), depth)
        assert sparse.shape == depth.shape
        assert sparse.any()
        assert set(np.unique(sparse)) <= set(np.unique(depth))
        assert bool((sparse[sparse > 0] >= depth[sparse > 0]).all())


def test_the_logarithm_goes_on_below_the_nearest_depth_and_can_climb_back() -> None:
    depth = torch.tensor([-1.0, 0.0, recipes.NEAREST, 1.0, 20.0], requires_grad=True)
    logarithm = recipes.smooth_log(depth)
    assert torch.equal(logarithm[2:], torch.log(depth[2:]))
    assert bool((logarithm.diff() > 0).all())
    (gradient,) = torch.autograd.grad(logarithm.sum(), depth)
    assert bool((gradient > 0).all())


LOSSES = (
    recipes.log_error,
    recipes.log_error_up_to_scale,
    recipes.relative_error,
    recipes.inverse_error,
    train.depth_loss,
)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_is_least_for_the_ground_truth_and_ignores_unknown_depth(loss: Any) -> None:
    ground_truth = torch.from_numpy(np.stack([slope(0), slope(5)]))[:, None]
    best = ground_truth / 10.0 if loss is recipes.log_error_up_to_scale else ground_truth
    guess = torch.where(ground_truth > 0, best, 7.0)
    assert loss(guess, ground_truth) == loss(
        torch.where(ground_truth > 0, best, 70.0), ground_truth
    )
    noise = 1.0 + 0.05 * torch.randn(ground_truth.shape, generator=torch.Generator().manual_seed(0))
    assert loss(guess, ground_truth) < loss(guess * noise, ground_truth)


def test_a_start_is_what_the_recipe_says() -> None:
    toy, drop = Toy(), nn.Dropout(0.5)
    recipe = replace(RECIPE, quiet=("norm",), dropout=0.25, flat={"toy.conv": 2.0})
    recipes.with_start(nn.ModuleDict({"toy": toy, "drop": drop}), recipe)
    assert drop.p == 0.25
    assert not toy.norm.weight.any()
    assert bool((toy(torch.rand(1, 3, 8, 8)) == 2.0).all())


def test_without_its_scaffold_a_network_predicts_the_same_and_is_the_published_one() -> None:
    torch.manual_seed(0)
    plain = nn.Sequential(
        nn.Conv2d(3, 5, 3),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(5 * 6 * 6, 7),
        nn.ReLU(),
        nn.Linear(7, 2),
    )
    keys = list(plain.state_dict())
    before = [weight.clone() for weight in plain.state_dict().values()]
    network = scaffolded(plain, ("0", "3"))
    network.train()
    optimiser = torch.optim.SGD(network.parameters(), lr=0.1)
    for _ in range(5):
        optimiser.zero_grad()
        network(torch.randn(8, 3, 8, 8) * 3 + 1).square().mean().backward()
        optimiser.step()
    network.eval()
    copied, without = copy.deepcopy(network), without_scaffold(network)
    x = torch.randn(4, 3, 8, 8)
    assert list(without.state_dict()) == keys
    assert len(network.state_dict()) > len(keys)  # it goes on learning with its scaffold
    torch.testing.assert_close(without(x), network(x), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(copied(x), network(x))
    assert not any(
        torch.equal(*pair) for pair in zip(before, without.state_dict().values(), strict=True)
    )


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


def test_what_is_saved_normalises_by_the_mean_over_all_settling_batches(
    shards: Path, tmp_path: Path
) -> None:
    run = tiny.TinyRun(TOY, RECIPE, settings(shards, tmp_path))
    run.average.norm.running_mean += 1.0
    run.save()
    stage = RECIPE.stages[0]
    means = [
        run.arguments(run.batches.batch(number, tiny.SETTLED_ON, stage.window, stage.shown))[0]
        .mean((0, 2, 3)) for number in tiny.SETTLING
    ]  # fmt: skip
    assert len(means) > 1
    torch.testing.assert_close(run.average.norm.running_mean, torch.stack(means).mean(0))
    assert run.average.norm.momentum == nn.BatchNorm2d(3).momentum


# the fully connected layers of eigen take one size only
WINDOWS = {"eigen-tiny": (228, 304)}


@pytest.mark.parametrize("name", tiny.RECIPES)
def test_every_tiny_edition_can_be_trained(name: str, shards: Path, tmp_path: Path) -> None:
    definition = tiny.tiny_definition(name)
    assert definition.name == name
    window = WINDOWS.get(name, (64, 96))
    folder = tmp_path / "frames"
    folder.mkdir()
    depth = np.tile(slope(0), (5, 5))[None, : max(window[0], 70), : max(window[1], 100)]
    rgb = np.repeat((depth * 40.0).astype(np.uint8)[..., None], 3, axis=-1)
    np.savez(folder / "shard_00000.npz", rgb=rgb, depth=depth)
    recipe = tiny.RECIPES[name]
    stages = tuple(replace(stage, window=window, shown=None) for stage in recipe.stages)
    recipe = replace(recipe, stages=stages, batch=2)
    run = tiny.TinyRun(definition, recipe, settings(folder, tmp_path, steps=20))
    batch = run.batch(0)
    before = [parameter.clone() for parameter in run.learnt]
    for stage in range(len(stages)):
        run.step = math.ceil(20 * stages[stage - 1].until) if stage else 0
        # a layer that starts flat lets nothing through to the two in front of it at first
        assert all(np.isfinite(run.learn(batch)) for _ in range(3))
    moved = [not torch.equal(a, b) for a, b in zip(before, run.learnt, strict=True)]
    assert np.mean(moved) > 0.9
    known = run.depth(batch)
    assert known.shape[:2] == (2, 1)
    assert bool(torch.isfinite(known).all())
