"""The default method for one frame: its experts, their weights, and what it says of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.frames import fuse
from pnpdepth_cli.frames.default import refine_default, without_outliers
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.fuse import (
    FOLDS,
    MIN_POINTS,
    MIRRORED_BELOW,
    OWN_SCANNER,
    Expert,
    ValidatedFrame,
    fit_weights,
    split_frame,
    trust,
    weighted_mean,
    with_mirrored,
)
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.core.split.test_split import state_of
from tests.frames.scenes import (
    SIZE,
    Brightness,
    Nearest,
    compact,
    depth_of_scene,
    frame_in_memory,
    member,
    opened,
)

UPDATES = ClosedSettings(iterations=3, lr="5%", update="sign", align="scale")
ALIGNED = ClosedSettings(iterations=0, align="affine")


class Exact(Nearest):
    """The scene's own depth."""

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        return self.layer(depth_of_scene()[None, None] + 0 * sparse)


class Noise(Brightness):
    """Depth that has nothing to do with the image."""

    def forward(self, rgb: Tensor) -> Tensor:
        random = torch.rand(1, 1, *rgb.shape[2:], generator=torch.Generator().manual_seed(4))
        return self.layer(1 + random)


def refined(frame: Frame, *members: OpenNetwork, seed: int = 0) -> Refined:
    """The frame by the default method with these networks."""
    with opened(*members) as networks:
        return refine_default(networks, frame, seed=seed)


def scan_frame() -> Frame:
    """The scene with a scanner's lines."""
    y, x = np.mgrid[2 : SIZE[0] : 8, 0 : SIZE[1] : 2]
    xy = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32))
    every = SparsePoints(xy=xy, depth=torch.ones(len(xy)), size=SIZE)
    points = replace(every, depth=every.sample(depth_of_scene()))
    return replace(frame_in_memory(), points=points)


def expert(name: str, at: Tensor, weight: float = 1.0) -> Expert:
    """An expert with these predictions at the validation points."""
    return Expert(name=name, weight=weight, at=at, updated=at)


def split_of(depth: Tensor) -> ValidatedFrame:
    """A frame with validation points of these depths."""
    xy = torch.stack([torch.arange(len(depth)) % 128, torch.arange(len(depth)) // 128], 1).float()
    points = SparsePoints(xy=xy, depth=depth, size=SIZE)
    frame = frame_in_memory(60)
    return ValidatedFrame(whole=frame, kept=frame, points=points, weights=torch.ones(len(depth)))


@pytest.mark.parametrize(("of_scanner", "kind"), [(False, "gp"), (True, "local")])
def test_a_network_alone_is_aligned_updated_and_propagated(of_scanner: bool, kind: str) -> None:
    frame, gt = scan_frame() if of_scanner else frame_in_memory(60), depth_of_scene().numpy()
    result = refined(replace(frame, gt=gt), member(Brightness, settings=UPDATES))  # with stages
    assert list(result.stages) == ["before", "updated", "propagated"]
    updated = torch.from_numpy(result.stages["updated"])
    expected = propagate(updated, result.used, frame.rgb, kind=kind)
    assert np.allclose(result.after, expected.numpy(), rtol=1e-5)
    assert np.array_equal(result.after, result.stages["propagated"])
    assert np.array_equal(result.before, result.stages["before"])
    assert result.weights == {"brightness": 1.0}
    errors = [np.abs(depth - gt).mean() for depth in result.stages.values()]
    assert errors[-1] < errors[0]


def test_the_dense_depth_is_fused_by_the_weights_that_the_result_names() -> None:
    frame, own = frame_in_memory(60), member(Brightness, settings=ALIGNED)
    result = refined(frame, own, compact())
    assert sum(result.weights.values()) == pytest.approx(1)
    assert list(result.weights) == ["brightness", "compact with brightness", "compact", "linear"]
    with opened(own, compact()) as networks:
        of_own = networks[0].refine(frame)
        prior = replace(frame, prior=of_own.before)
        once = [networks[1].refine(each).after for each in (prior, frame)]
        networks[1].next_image()
        turned = [networks[1].refine(each.mirrored()).after.flip(-1) for each in (prior, frame)]
    both = [(a * b).sqrt() for a, b in zip(once, turned, strict=True)]
    depths = [of_own.after, *both, linear(frame.points)]
    fused = weighted_mean(list(zip(depths, result.weights.values(), strict=True)))
    expected = propagate(fused, frame.points, frame.rgb, kind="gp")
    assert np.allclose(result.after, expected.numpy(), rtol=1e-4)


def test_a_useless_network_has_no_part_which_is_said() -> None:
    frame = frame_in_memory(100)
    useless = refined(frame, member(Noise, settings=ALIGNED), compact())
    alone = refined(frame, compact())
    assert useless.weights["noise"] < 0.01
    assert np.allclose(useless.after, alone.after, rtol=1e-4)
    (note,) = [note for note in useless.notes if note.startswith("noise has no part")]
    checked = useless.validation
    for stage in ("propagated", "alone"):
        off = (checked.predicted[stage] - checked.points.depth).abs().numpy()
        assert f"{np.average(off, weights=checked.weights.numpy()):.4f}" in note
    assert not [note for note in alone.notes if "no part" in note]


@pytest.mark.parametrize(("known", "noise"), [(4, 0.1), (5, 0.1), (40, 0.18), (40, 0.3), (40, 9)])
def test_trust_is_what_lines_through_the_other_points_explain(known: int, noise: float) -> None:
    frame, rng = frame_in_memory(60), np.random.default_rng(known)
    pixels = tuple(frame.points.xy.long().numpy().T[::-1, :known])
    y = frame.points.depth.double().log().numpy()[:known]
    x = 0.3 * y + noise * 0.3 * rng.normal(size=known)
    predicted = torch.zeros(SIZE, dtype=torch.float64)
    predicted[pixels] = torch.from_numpy(x).exp()
    one = replace(expert("net", torch.ones(60)), whole=SimpleNamespace(before=predicted))
    split = replace(split_of(frame.points.depth), whole=frame, kept=frame)
    press = total = 0.0
    for left_out in range(known):
        rest = np.arange(known) != left_out
        line = np.polyfit(x[rest], y[rest], 1)
        press += (y[left_out] - np.polyval(line, x[left_out])) ** 2
        total += (y[left_out] - y[rest].mean()) ** 2
    rises = np.polyfit(x, y, 1)[0] > 0 and known >= MIN_POINTS
    expected = np.clip((1 - press / total - 0.25) / 0.5, 0, 1) if rises else 0
    alone = expert("compact", torch.ones(60))
    assert trust(member(Brightness), one, split, alone) == pytest.approx(expected, abs=1e-6)


def test_a_gain_is_in_standard_errors_of_the_weighted_mean() -> None:
    rng = np.random.default_rng(0)
    (truth, at, other), shares = rng.uniform(1, 4, (3, 50)), rng.uniform(size=50)
    split = replace(split_of(torch.from_numpy(truth)), weights=torch.from_numpy(shares))
    gains = np.abs(np.log(other / truth)) - np.abs(np.log(at / truth))
    mean = np.average(gains, weights=shares)
    error = np.sqrt((shares**2 * (gains - mean) ** 2).sum()) / shares.sum()
    found = split.gain(torch.from_numpy(at), torch.from_numpy(other))
    assert found == pytest.approx(mean / error)


def test_trust_in_a_network_that_takes_points_falls_with_its_error_at_validation_points() -> None:
    depth = torch.full((50,), 2.0)
    split, alone = split_of(depth), expert("compact", depth + 0.1)
    found = [
        trust(member(Nearest), expert("own", depth + off), split, alone)
        for off in (0.05, 0.1, 0.15, 0.2, 0.4)
    ]
    assert found == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-4)


def test_weights_are_those_that_predict_the_validation_points_best_beside_the_prior() -> None:
    rng = np.random.default_rng(3)
    truth = torch.from_numpy(rng.uniform(1, 4, 300))
    noisy = [truth * torch.from_numpy(np.exp(s * rng.normal(size=300))) for s in (0.1, 0.2, 0.3)]
    experts = [
        expert(str(k), at, w) for k, (at, w) in enumerate(zip(noisy, (0.2, 0.3, 0.5), strict=True))
    ]
    shares = rng.uniform(0.1, 1, 300)
    split = replace(split_of(truth), weights=torch.from_numpy(shares))
    found = np.array(list(fit_weights(experts, split).values()))
    logs = np.stack([at.log().numpy() for at in noisy], axis=1)
    prior, y = np.array([0.2, 0.3, 0.5]), truth.log().numpy()
    first = y - logs @ prior
    scale = 1.25 * np.average(np.abs(first), weights=shares)

    def loss(weights: np.ndarray) -> float:
        size = np.abs(y - logs @ weights)
        huber = shares @ np.where(size < scale, size**2, 2 * scale * size - scale**2)
        return float(huber + fuse.STRENGTH * scale**2 * ((weights - prior) ** 2).sum())

    for _ in range(200):  # no other weights near by, or anywhere, are better
        other = np.abs(found + rng.choice([0.01, 0.3]) * rng.normal(size=3))
        assert loss(other / other.sum()) > loss(found) - 1e-6


def test_an_expert_without_prior_weight_or_prediction_decides_nothing() -> None:
    depth = torch.full((50,), 2.0)
    none, exact = expert("none", depth, weight=0.0), expert("exact", depth * 1.001)
    weights = fit_weights([none, exact, expert("poor", depth * 1.2)], split_of(depth))
    assert weights["none"] == 0
    blank = fit_weights([expert("a", depth * 0), expert("b", depth * 0)], split_of(depth))
    assert blank == {"a": pytest.approx(0.5), "b": pytest.approx(0.5)}


def test_the_result_at_a_validation_point_does_not_depend_on_its_depth() -> None:
    frame = frame_in_memory(60)
    members = (member(Brightness, settings=ALIGNED), compact())
    first = refined(frame, *members).validation
    held = (frame.points.xy[:, None] == first.points.xy[None]).all(dim=2).any(dim=1)
    numbers = held.nonzero(as_tuple=True)[0]
    changed = frame.points.depth.clone()
    changed[numbers[0]] *= 1.01
    other = replace(frame, points=replace(frame.points, depth=changed))
    again = refined(other, *members).validation
    assert torch.equal(again.points.xy, first.points.xy)
    one = (again.points.xy == frame.points.xy[numbers[0]]).all(dim=1)
    for name in ("before", "propagated", "alone", "linear", "after"):
        assert torch.allclose(again.predicted[name][one], first.predicted[name][one], rtol=1e-3)


def test_an_image_of_another_scene_is_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pnpdepth_cli.completion.outliers.FAR", 1.0)
    frame = frame_in_memory(400)
    stripes = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(3)).round()
    right, wrong = refined(frame, compact()), refined(replace(frame, rgb=stripes), compact())
    assert not any(note.startswith("warning: the image") for note in right.notes)
    (note,) = [note for note in wrong.notes if note.startswith("warning: the image")]
    assert "80 validation points" in note
    assert "compact without the image" in wrong.weights
    assert "alone" not in wrong.validation.predicted  # there is nothing but compact
    stated = refined(replace(frame, rgb=stripes, one_view=True), compact())
    assert "compact without the image" not in stated.weights
    assert not any(note.startswith("warning: the image") for note in stated.notes)


def test_a_completion_network_of_the_scanner_has_most_of_the_result() -> None:
    frame = scan_frame()
    poor, good = (refined(frame, member(each), compact()) for each in (Nearest, Exact))
    assert poor.weights["nearest"] == 0
    assert good.weights["exact"] == pytest.approx(OWN_SCANNER)
    assert sum(good.weights.values()) == pytest.approx(1)
    assert np.abs(good.after - depth_of_scene().numpy()).max() < 0.25


def test_networks_that_take_no_prior_are_fused_from_equal_prior_weights() -> None:
    result = refined(frame_in_memory(4), member(Brightness), member(Nearest))
    assert result.weights == {"brightness": 0.5, "nearest": 0.5}


def test_the_weighted_mean_is_geometric_and_skips_unknown_depth() -> None:
    one, other = torch.tensor([[4.0, 0.0, 0.0], [1.0, 3.0, 0.0]])
    mean = weighted_mean([(one, 0.25), (other, 0.75)])
    assert torch.allclose(mean, torch.tensor([4.0**0.25, 3.0, 0.0]))
    alone = torch.tensor([2.0, 3.0, 7.0, 0.0])
    assert torch.equal(weighted_mean([(alone, 0.3), (alone + 1, 0.0)]), alone)


@pytest.mark.parametrize("weighs", [True, False])
def test_a_wrong_track_is_left_out_where_a_network_gave_it_no_weight(weighs: bool) -> None:
    frame, generator = frame_in_memory(100), torch.Generator().manual_seed(0)
    noise = 0.26 * torch.rand(SIZE, generator=generator) - 0.13
    frame = replace(frame, rgb=(depth_of_scene() * noise.exp() - 1).expand(3, -1, -1))
    track = (frame.points.xy - 60).norm(dim=1) < 20  # points that agree with each other
    wrong = replace(frame.points, depth=torch.where(track, 1.5, 1.0) * frame.points.depth)
    blind = member(Brightness, weighs_points=weighs)  # sees the image alone
    result = refined(replace(frame, points=wrong), blind)
    assert int(track.sum()) > 5
    assert torch.equal(result.used.xy, wrong.select(~(track & weighs)).xy)
    assert any("outliers: " in note for note in result.notes) == weighs


@pytest.mark.parametrize("count", [60, 5500])
def test_validation_points_are_a_fifth_and_the_others_are_kept(count: int) -> None:
    frame, judged = frame_in_memory(count), depth_of_scene()
    judged[:, 100:] = 0
    split = split_frame(frame, judged, 0)
    kept, held, whole = (
        {tuple(xy) for xy in points.xy.tolist()}
        for points in (split.kept.points, split.points, frame.points)
    )
    assert len(kept) == count - count // FOLDS
    assert len(held) == min(count // FOLDS, 1000)
    assert kept | held <= whole
    assert not kept & held
    assert torch.equal(split.weights != 0, split.points.xy[:, 0] < 100)  # where a depth is known


@pytest.mark.parametrize("count", [1, MIN_POINTS - 1, MIN_POINTS, 7])
@pytest.mark.parametrize("positions", [1, 2, 3, 7])
def test_few_points_at_few_positions_are_enough(count: int, positions: int) -> None:
    frame = frame_in_memory(count)
    at = torch.arange(count) % positions
    close = frame.points.xy[at] + 0.01 * torch.arange(count)[:, None]
    points = replace(frame.points, xy=close, depth=frame.points.depth[at])
    result = refined(replace(frame, points=points), member(Brightness))
    assert (result.validation is None) == (count < MIN_POINTS)
    off = (torch.from_numpy(result.after) / depth_of_scene()).log().abs()
    assert float(off.mean()) < 0.5


def test_the_same_frame_gives_the_same_depth_whatever_was_refined_before() -> None:
    frames = [frame_in_memory(60), frame_in_memory(60, seed=2)]
    with opened(member(Brightness, settings=UPDATES), compact()) as networks:
        first, _, again = (refine_default(networks, frames[n]) for n in (0, 1, 0))
    assert np.array_equal(first.after, again.after)
    assert np.array_equal(first.after, refined(frames[0], *networks).after)


def test_the_image_encoder_runs_once_for_all_sets_of_points_and_the_network_stays() -> None:
    network, runs = load_network("compact", None), list[int]()
    before = state_of(network.module)
    first = next(network.module.encoder.children())
    handle = first.register_forward_hook(lambda *_: runs.append(1))
    frame, settings = frame_in_memory(60), ClosedSettings(iterations=1, lr="5%")
    fewer = replace(frame, points=frame.points.select(torch.arange(60) < 55))
    with OpenNetwork(network, "decoder.s8", settings, coarse=True) as one:
        one.refine(frame)
        count = len(runs)
        shared = one.refine(fewer)
        plain = one.refine(fewer, updates=False)
        assert len(runs) == count > 0
        one.next_image()
        alone = one.refine(fewer)
    handle.remove()
    assert (shared.after == alone.after).all()
    assert (plain.after == alone.before).all()
    assert before == state_of(network.module)


def test_outliers_are_set_aside_and_the_other_points_stay() -> None:
    frame, bad = frame_in_memory(60), torch.arange(60) % 5 == 0
    depth = torch.where(bad, 2.5, 1.0) * frame.points.depth
    with member(Brightness) as judge:
        clean, _ = without_outliers(judge, frame)
        frame = replace(frame, points=replace(frame.points, depth=depth))
        inliers, _ = without_outliers(judge, frame)
    assert torch.equal(inliers.outliers.xy, frame.points.xy[bad])
    assert torch.equal(inliers.points.xy, frame.points.xy[~bad])
    assert clean.outliers is None
    assert len(clean.points) == 60


@pytest.mark.parametrize("of_points", [True, False])
def test_the_loss_is_that_of_finite_depth(of_points: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, build = frame_in_memory(60), Nearest if of_points else Brightness
    sky = torch.where(torch.arange(SIZE[0])[:, None] < 30, torch.inf, 1.5 * depth_of_scene())
    monkeypatch.setattr(build, "forward", lambda *_: sky[None, None])
    rows = frame.points.xy[:, 1].numpy()
    settings = ClosedSettings(iterations=0, align="none", loss="l2")
    with member(build, settings=settings) as network:
        found = network.refine(frame)
    expected = np.square(0.5 * frame.points.depth.numpy()[rows >= 30]).mean()
    assert found.losses == (pytest.approx(expected),)
    assert found.step == 0
    assert torch.equal(found.after, sky.where(sky.isfinite(), 0))


def seen_twice(frame: Frame, weight: float = 1.0) -> tuple[Expert, Expert]:
    """An expert of `compact`, before and after it sees the mirrored frame, if it does."""
    at = frame.points.depth[:0]
    with opened(compact()) as networks:
        whole = networks[0].refine(frame)
        expert = Expert(name="compact", at=at, updated=at, whole=whole, frame=frame)
        (again,) = with_mirrored(networks, [expert], {"compact": weight})
    return expert, again


def test_a_mirrored_frame_has_left_and_right_exchanged_and_mirrored_again_is_the_frame() -> None:
    frame = replace(frame_in_memory(), prior=depth_of_scene())
    mirrored, width = frame.mirrored(), frame.size[1]
    x, y = frame.points.xy.unbind(1)
    assert torch.equal(mirrored.points.xy, torch.stack([width - 1 - x, y], 1))
    assert torch.equal(mirrored.rgb[..., 0], frame.rgb[..., -1])
    assert torch.equal(mirrored.points.sample(mirrored.prior), frame.points.depth)
    twice = mirrored.mirrored()
    assert torch.equal(twice.points.xy, frame.points.xy)
    assert torch.equal(twice.rgb, frame.rgb)


def test_few_points_give_the_geometric_mean_of_the_frame_and_the_mirrored_one() -> None:
    frame = frame_in_memory(count=MIRRORED_BELOW - 1)
    split = split_frame(frame, depth_of_scene(), 0)
    once, twice = seen_twice(frame)
    turned, _ = seen_twice(frame.mirrored())
    left, right = once.whole.after.numpy(), turned.whole.after.numpy()[:, ::-1]
    assert np.abs(left - right).max() > 1e-3
    np.testing.assert_allclose(twice.dense(split), np.sqrt(left * right), rtol=1e-4)


@pytest.mark.parametrize(("count", "weight"), [(MIRRORED_BELOW, 1.0), (20, 0.0)])
def test_many_points_or_no_weight_show_an_expert_the_frame_alone(count: int, weight: float) -> None:
    once, twice = seen_twice(frame_in_memory(count), weight)
    assert twice is once
