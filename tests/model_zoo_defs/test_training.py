"""Training of `compact`: the drawn points, the losses, and a run that stops and resumes."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from model_zoo_defs.compact import Compact
from model_zoo_defs.training.learning import patterns
from model_zoo_defs.training.learning.dataset import Frames, Samples, augmented, degraded
from model_zoo_defs.training.learning.learner import Schedule
from model_zoo_defs.training.learning.priors import aligned, damaged, filled, nonsense
from model_zoo_defs.training.learning.priors import draw as draw_prior

pytest.importorskip("safetensors")
train = pytest.importorskip("model_zoo_defs.training.learning.train")
validation = pytest.importorskip("model_zoo_defs.training.learning.validation")
encoder_weights = pytest.importorskip("model_zoo_defs.training.learning.encoder_weights")
train_inliers = pytest.importorskip("model_zoo_defs.training.learning.train_inliers")

pytestmark = pytest.mark.slow

SHAPE = (48, 64)
seeds = st.integers(0, 2**32 - 1)
drawn_often = settings(max_examples=40, deadline=None)


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


@drawn_often
@given(seed=seeds, count=st.integers(10, 1000))
def test_points_have_the_requested_number_and_known_depth(seed: int, count: int) -> None:
    depth = room(seed)
    grey = depth / depth.max()
    for mask in (
        patterns.uniform(np.random.default_rng(seed), depth, count),
        patterns.corners(np.random.default_rng(seed), depth, grey, count // 2 + 1),
    ):
        assert mask.sum() in (count, count // 2 + 1)
        assert bool((depth[mask] > 0).all())
    everything = patterns.uniform(np.random.default_rng(seed), depth, 4000)
    assert everything.sum() == np.count_nonzero(depth)
    grid = patterns.jittered_grid(np.random.default_rng(seed), depth, count)
    assert 0.5 * count - 10 <= grid.sum() <= 2 * count + 10


@drawn_often
@given(seed=seeds)
def test_sensors_show_the_depth_of_their_pixel_or_what_is_behind_it(seed: int) -> None:
    depth = room(seed)
    sparse = patterns.scan_lines(np.random.default_rng(seed), depth)
    mask = sparse > 0
    assert bool((sparse[mask] >= depth[mask]).all())
    assert set(np.unique(sparse[mask])) <= set(np.unique(depth))
    assert bool((patterns.leak(np.random.default_rng(seed), depth) >= depth).all())
    triangulated = patterns.triangulated(np.random.default_rng(seed), depth)
    assert np.array_equal(triangulated > 0, depth > 0)
    assert float(np.median(np.abs(triangulated - depth))) < 0.2
    wall = np.full(SHAPE, 3.0, np.float32)
    assert np.array_equal(patterns.leak(np.random.default_rng(seed), wall), wall)
    zones = patterns.zones(np.random.default_rng(seed), depth)
    assert np.count_nonzero(zones) <= 32 * 32
    assert zones.max() <= depth.max() * 1.001
    assert zones[zones > 0].min() >= depth[depth > 0].min() * 0.999
    assert 0.05 < patterns.strip(np.random.default_rng(seed), SHAPE).mean() < 0.75


@drawn_often
@given(seed=seeds)
def test_the_same_state_draws_the_same_and_leaves_the_depth_as_it_is(seed: int) -> None:
    depth, other = room(seed), room(seed + 1)
    before = depth.copy()
    sparse = patterns.draw(np.random.default_rng(seed), depth, depth / 5.0)

    def drawn(rng: np.random.Generator) -> list[NDArray[np.float32] | None]:
        return [
            patterns.draw(rng, depth, depth / 5.0),
            draw_prior(rng, depth, depth / 5.0, sparse, other),
            damaged(rng, depth, depth / 5.0),
            nonsense(rng, depth.shape, depth),
        ]

    first, second = (drawn(np.random.default_rng(seed)) for _ in range(2))
    assert np.array_equal(depth, before)
    for number, (one, again) in enumerate(zip(first, second, strict=True)):
        if one is None or again is None:
            assert one is again
            continue
        assert np.array_equal(one, again)
        assert (one.dtype, one.shape) == (np.float32, SHAPE)
        assert bool(np.isfinite(one).all())
        assert one.min() > 0 if number > 1 else one.min() >= 0


def test_damaged_depth_is_nearer_to_the_ground_truth_than_unrelated_depth() -> None:
    depth = room(3)
    known = depth > 0

    def error(prior: NDArray[np.float32]) -> float:
        fitted = aligned(prior, depth, affine=False)
        return float(np.abs(np.log(fitted[known] / depth[known])).mean())

    rng = np.random.default_rng(0)
    of_damaged = np.mean([error(damaged(rng, depth, depth / 5.0)) for _ in range(20)])
    of_nonsense = np.mean([error(nonsense(rng, depth.shape, room(4))) for _ in range(20)])
    assert of_damaged < 0.5 * of_nonsense


@pytest.mark.parametrize("affine", [False, True])
def test_a_prior_off_by_a_scale_or_a_power_is_aligned_despite_outliers(affine: bool) -> None:
    depth = room(2)
    sparse = patterns.keep(depth, patterns.uniform(np.random.default_rng(0), depth, 200))
    sparse = patterns.outliers(np.random.default_rng(1), sparse, 0.2)
    prior = 7.0 * depth ** (0.8 if affine else 1.0)
    fitted = aligned(prior.astype(np.float32), sparse, affine=affine)
    known = depth > 0
    assert float(np.median(np.abs(np.log(fitted[known] / depth[known])))) < 0.02
    assert bool((fitted[~known] == 0).all())


def test_unknown_depth_is_filled_and_known_depth_kept() -> None:
    depth = room(5)
    dense = filled(depth)[0, 0].numpy()
    known = depth > 0
    np.testing.assert_allclose(dense[known], np.log(depth[known]), rtol=1e-6)
    assert bool(np.isfinite(dense).all())
    assert dense[~known].max() <= np.log(depth.max()) + 1e-6


@drawn_often
@given(seed=seeds, fraction=st.floats(0.0, 1.0))
def test_outliers_change_about_their_fraction_of_the_points_and_nothing_else(
    seed: int, fraction: float
) -> None:
    sparse = patterns.keep(room(seed), patterns.uniform(np.random.default_rng(1), room(seed), 1000))
    noisy = patterns.outliers(np.random.default_rng(seed), sparse, fraction)
    assert np.array_equal(noisy > 0, sparse > 0)
    assert np.count_nonzero(noisy != sparse) <= 1000 * fraction + 80


@drawn_often
@given(seed=seeds, fraction=st.floats(0.0, 1.0))
def test_the_points_of_a_wrong_track_are_neighbours_times_one_factor(
    seed: int, fraction: float
) -> None:
    depth = room(seed)
    sparse = patterns.keep(depth, patterns.uniform(np.random.default_rng(1), depth, 1000))
    wrong = patterns.wrong_tracks(np.random.default_rng(seed), sparse, fraction)
    rows, columns = np.nonzero(wrong != sparse)
    assert np.array_equal(wrong > 0, sparse > 0)
    assert len(rows) <= round(1000 * fraction)
    if len(rows):
        factors = (wrong[rows, columns] / sparse[rows, columns]).round(3)
        square = (rows[:, None] - rows) ** 2 + (columns[:, None] - columns) ** 2
        beside = np.argsort(square, axis=1)[:, 1:13]
        alike = (factors[beside] == factors[:, None]).any(axis=1)
        assert alike.mean() > 0.5  # others lie in a track that a later one overwrote


def test_a_sample_depends_on_its_number_alone(shards: Path) -> None:
    straight, jumping = Samples((shards,), (32, 64), 3), Samples((shards,), (32, 64), 3)
    straight[0], straight[1]
    for one, other in zip(straight[2], jumping[2], strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(straight[2].sparse, Samples((shards,), (32, 64), 4)[2].sparse)


def test_windows_are_never_enlarged_and_degraded_images_stay_images() -> None:
    depth = np.arange(1, 97 * 131 + 1, dtype=np.float32).reshape(97, 131)
    rgb = np.zeros((97, 131, 3), np.uint8)
    for seed in range(20):
        sample = augmented(np.random.default_rng(seed), rgb, depth, (64, 96), depth)
        assert sample.depth.unique().numel() == 64 * 96
        image = degraded(np.random.default_rng(seed), torch.rand(3, 32, 48))
        assert image.shape == (3, 32, 48)
        assert 0.0 <= float(image.min()) < float(image.max()) <= 1.0


def test_new_shards_are_picked_up(shards: Path, tmp_path: Path) -> None:
    first, second = sorted(shards.glob("*.npz"))
    (tmp_path / first.name).write_bytes(first.read_bytes())
    frames = Frames(tmp_path)
    assert len(frames) == 3
    (tmp_path / second.name).write_bytes(second.read_bytes())
    frames.refresh()
    assert len(frames) == 6


def test_folders_that_are_no_shards_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no shard"):
        Frames(tmp_path)
    np.savez_compressed(tmp_path / "shard_0.npz", rgb=np.zeros((1, 2, 2, 3), np.uint8))
    with pytest.raises(ValueError, match=r"shard_0.npz: compressed; .* numpy\.savez"):
        Frames(tmp_path)


def test_linear_interpolation_of_a_plane_is_the_plane_inside_the_hull() -> None:
    rows, columns = np.indices((20, 30))
    plane = (1.0 + 0.1 * rows + 0.05 * columns).astype(np.float32)
    sparse = np.zeros_like(plane)
    sparse[0, 0], sparse[0, -1], sparse[-1, 0], sparse[-1, -1] = plane[
        [0, 0, -1, -1], [0, -1, 0, -1]
    ]
    np.testing.assert_allclose(validation.linear_interpolation(sparse), plane, rtol=1e-5)
    sparse[-1] = 0.0  # a row, which has no hull, gives the nearest point
    dense = validation.linear_interpolation(sparse)
    assert (dense[9, 3], dense[9, 26]) == (plane[0, 0], plane[0, -1])


def test_the_target_of_an_inlier_falls_with_the_error_of_the_point() -> None:
    ground_truth = torch.tensor([2.0, 2.0, 2.0, 0.0])
    sparse = torch.tensor([2.02, 2.0 * math.exp(0.125), 5.0, 2.0])
    target = train_inliers.inlier_targets(sparse, ground_truth)
    torch.testing.assert_close(target[:3], torch.tensor([1.0, 0.5, 0.0]))
    assert bool(target[3].isnan())
    depth, rgb = torch.full((100, 90), 2.0), torch.zeros(3, 100, 90)
    cloud, target = train_inliers.example(depth, depth * 1.3, rgb, where=1.0)
    # many points are cut to a strip of rows
    assert train_inliers.MOST_POINTS <= len(cloud.value) < train_inliers.MOST_POINTS + 2 * 90
    assert torch.equal(target, torch.zeros_like(target))


def test_the_best_sigma_is_the_mean_absolute_error_of_log_depth() -> None:
    ground_truth, depth = torch.ones(1, 1, 4, 4), torch.full((1, 1, 4, 4), 1.1)
    error = float(np.log(1.1))
    losses = {
        factor: float(
            train.sigma_loss(torch.full_like(ground_truth, factor * error), depth, ground_truth)
        )
        for factor in (0.7, 1.0, 1.4)
    }
    assert min(losses, key=lambda factor: losses[factor]) == 1.0


def test_weights_of_the_first_generation_give_the_same_depth_in_the_second() -> None:
    torch.manual_seed(0)
    old, network = Compact(), Compact()
    kept = {
        name: tensor + 0.01
        for name, tensor in old.state_dict().items()
        if not any(layer in name for layer in train.NEW_LAYERS)
    }
    assert train.upgrade(network, kept) == sorted(network.state_dict().keys() - kept.keys())
    for name, tensor in network.state_dict().items():
        if name in kept:
            assert torch.equal(tensor, kept[name])
    with pytest.raises(ValueError, match=r"not weights of compact: fit\.far"):
        train.upgrade(network, {k: v for k, v in kept.items() if not k.startswith("fit.far")})
    with pytest.raises(ValueError, match="not weights of compact: unknown"):
        train.upgrade(network, kept | {"unknown": torch.zeros(1)})


def test_a_constant_rate_falls_in_the_last_steps_alone() -> None:
    schedule = Schedule(lr=1.0, steps=100, decay=20, warm_up=10)
    rates = [schedule.rate(step, 0.0) for step in (0, 9, 50, 80, 90, 100)]
    assert rates == pytest.approx([0.1, 1.0, 1.0, 1.0, 0.5, 0.0])
    endless = Schedule(lr=1.0, steps=100, decay=0, warm_up=10)
    assert endless.rate(99, 0.0) == 1.0


def published_names(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A checkpoint with the published names whose normalisation scales by two and adds one."""
    names = {"stem": ("_conv_stem", "_bn0")}
    number = 0
    for level, rows in encoder_weights.STAGES.items():
        for index in range(sum(row[-1] for row in rows)):
            for part, (conv, norm) in {
                "expand": ("_expand_conv", "_bn0"),
                "depthwise": ("_depthwise_conv", "_bn1"),
                "project": ("_project_conv", "_bn2"),
            }.items():
                key = f"stages.{level}.{index}.{part}"
                names[key] = (f"_blocks.{number}.{conv}", f"_blocks.{number}.{norm}")
            number += 1
    arrays = {}
    for ours, (conv, norm) in names.items():
        if f"{ours}.weight" in state:
            width = len(state[f"{ours}.bias"])
            arrays[f"{conv}.weight"] = state[f"{ours}.weight"]
            arrays[f"{norm}.weight"] = torch.full((width,), 2.0)
            arrays[f"{norm}.bias"] = torch.ones(width)
            arrays[f"{norm}.running_mean"] = torch.zeros(width)
            arrays[f"{norm}.running_var"] = torch.full((width,), 1.0 - encoder_weights.EPSILON)
    return arrays


def test_published_encoder_weights_are_renamed_and_folded_without_rest() -> None:
    encoder = Compact().encoder
    state = encoder.state_dict()
    converted = encoder_weights.converted(published_names(state))
    assert converted.keys() == state.keys()
    for name, tensor in converted.items():
        expected = state[name] * 2.0 if name.endswith("weight") else torch.ones_like(state[name])
        torch.testing.assert_close(tensor, expected)


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


@pytest.fixture
def example() -> Any:
    """40 points on an image of noise."""
    sparse = torch.zeros(8, 10).index_fill(1, torch.tensor([0, 2, 4, 6, 8]), 2.0)
    rgb = torch.rand(3, 8, 10, generator=torch.Generator().manual_seed(0))
    return train_inliers.example(sparse, sparse, rgb, where=0.0)


def test_an_image_that_is_moved_gives_each_point_the_colour_of_another(example: Any) -> None:
    colour = train_inliers.moved(np.random.default_rng(0), example).cloud.colour
    (by,) = (n for n in range(40) if torch.equal(colour.roll(n, 0), example.cloud.colour))
    assert min(by, 40 - by) >= 2


def test_a_flat_image_keeps_its_mean_and_at_most_a_quarter_of_its_contrast(example: Any) -> None:
    colour, contrasts = example.cloud.colour, []
    for seed in range(8):
        flat = train_inliers.flattened(np.random.default_rng(seed), example).cloud.colour
        torch.testing.assert_close(flat.mean(0), colour.mean(0))
        contrasts.append(float((flat - flat.mean(0)).norm() / (colour - colour.mean(0)).norm()))
    assert 0 < sum(contrast < 1e-5 for contrast in contrasts) < 8
    assert 0.01 < max(contrasts) <= 0.25


def test_inlier_weights_learn_to_detect_outliers(
    shards: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_inliers, "MOST_POINTS", 300)
    monkeypatch.setattr(train_inliers, "RATE", 3e-3)  # for 150 steps from scratch
    torch.manual_seed(0)
    layer = Compact().inlier_weights
    examples = train_inliers.drawn((shards,), 24, seed=1, workers=0)
    loss = train_inliers.fit(layer, examples, steps=150, seed=1)
    outliers, inliers = [], []
    with torch.no_grad():
        for cloud, target in examples:
            log_odds = layer.log_odds(cloud)
            outliers.append(log_odds[target == 0])
            inliers.append(log_odds[target == 1])
    assert loss < 0.7
    assert float(torch.cat(outliers).mean()) < float(torch.cat(inliers).mean()) - 0.5
