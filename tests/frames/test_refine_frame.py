"""One frame refined by every method: its steps, and what is said of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.frames.experts import weighted_mean
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.fuse import OWN_SCANNER
from pnpdepth_cli.frames.open_network import OpenNetwork
from pnpdepth_cli.frames.refine_frame import (
    Pipeline,
    outliers_beside_strong,
    refine_frame,
    without_outliers,
)
from pnpdepth_cli.frames.validation import MIN_POINTS
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
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


class Sharp(Brightness):
    """The scene's own depth, of the image alone."""

    def forward(self, rgb: Tensor) -> Tensor:
        return self.layer(depth_of_scene()[None, None] + 0 * rgb[:, :1])


def refined(frame: Frame, *members: OpenNetwork, **options: Any) -> Refined:
    """The frame by the default method with these networks."""
    with opened(*members) as networks:
        return refine_frame(networks, frame, Pipeline(), **options)


def scan_frame() -> Frame:
    """The scene with a scanner's lines."""
    y, x = np.mgrid[2 : SIZE[0] : 8, 0 : SIZE[1] : 2]
    xy = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32))
    every = SparsePoints(xy=xy, depth=torch.ones(len(xy)), size=SIZE)
    points = replace(every, depth=every.sample(depth_of_scene()))
    return replace(frame_in_memory(), points=points)


FRAMES_AND_KINDS = pytest.mark.parametrize(
    ("make_frame", "kind"),
    [
        pytest.param(lambda: frame_in_memory(60), "gp", id="random points"),
        pytest.param(scan_frame, "local", id="a scanner's lines"),
    ],
)


def refined_alone(frame: Frame) -> Refined:
    """The frame by one network that is always updated."""
    always_updated = member(Brightness, settings=UPDATES, always_updated=True)
    return refined(frame, always_updated, with_stages=True)


@FRAMES_AND_KINDS
def test_a_network_alone_is_updated_and_propagated(
    make_frame: Callable[[], Frame], kind: str
) -> None:
    frame = make_frame()
    result = refined_alone(frame)
    assert list(result.stages) == ["before", "updated", "propagated"]
    updated = torch.from_numpy(result.stages["updated"])
    expected = ResidualField(updated, result.used, frame.rgb).depth(kind=kind)
    assert np.allclose(result.depth, expected.numpy(), rtol=1e-5)


@FRAMES_AND_KINDS
def test_the_first_stage_is_the_depth_before_and_the_last_the_result(
    make_frame: Callable[[], Frame], kind: str
) -> None:
    result = refined_alone(make_frame())
    assert np.array_equal(result.before, result.stages["before"])
    assert np.array_equal(result.depth, result.stages["propagated"])


@FRAMES_AND_KINDS
def test_a_network_alone_has_all_of_the_weight(make_frame: Callable[[], Frame], kind: str) -> None:
    assert refined_alone(make_frame()).weights == {"brightness": 1.0}


@FRAMES_AND_KINDS
def test_the_result_of_a_network_alone_is_nearer_to_the_truth(
    make_frame: Callable[[], Frame], kind: str
) -> None:
    result = refined_alone(make_frame())
    gt = depth_of_scene().numpy()
    assert np.abs(result.depth - gt).mean() < np.abs(result.before - gt).mean()


def test_the_dense_depth_is_fused_by_the_weights_that_the_result_names() -> None:
    frame = frame_in_memory(60)
    own = member(Brightness, settings=ALIGNED)
    result = refined(frame, own, compact())
    assert sum(result.weights.values()) == pytest.approx(1)
    assert list(result.weights) == ["brightness", "compact with brightness", "compact", "linear"]
    with opened(own, compact()) as networks:
        of_own = networks[0].refine(frame)
        prior = replace(frame, prior=of_own.aligned)
        once = [networks[1].refine(input_frame).updated for input_frame in (prior, frame)]
        networks[1].next_image()
        turned = [
            networks[1].refine(input_frame.mirrored()).updated.flip(-1)
            for input_frame in (prior, frame)
        ]
    both = [(a * b).sqrt() for a, b in zip(once, turned, strict=True)]
    depths = [of_own.updated, *both, linear(frame.points)]
    fused = weighted_mean(list(zip(depths, result.weights.values(), strict=True)))
    expected = ResidualField(fused, frame.points, frame.rgb).depth()
    assert np.allclose(result.depth, expected.numpy(), rtol=1e-4)


def test_a_useless_network_has_no_part_which_is_said() -> None:
    frame = frame_in_memory(100)
    useless = refined(frame, member(Noise, settings=ALIGNED), compact())
    alone = refined(frame, compact())
    assert useless.weights["noise"] < 0.01
    assert np.allclose(useless.depth, alone.depth, rtol=1e-4)
    (note,) = [note for note in useless.notes if note.startswith("noise has no part")]
    checked = useless.validation
    for stage in ("propagated", "alone"):
        off = (checked.predicted[stage] - checked.points.depth).abs().numpy()
        assert f"{np.average(off, weights=checked.weights.numpy()):.4f}" in note
    assert not [note for note in alone.notes if "no part" in note]


@pytest.mark.parametrize(("kind", "least", "most"), [(Sharp, 0.15, 1.0), (Noise, 0.0, 0.01)])
def test_between_scan_lines_a_good_image_network_has_a_least_part_and_a_useless_one_none(
    kind: type[Brightness], least: float, most: float
) -> None:
    result = refined(scan_frame(), member(kind, settings=ALIGNED), compact())
    assert least <= result.weights[kind.__name__.lower()] <= most
    assert sum(result.weights.values()) == pytest.approx(1)


@pytest.mark.parametrize(("stated", "updates"), [(False, 0), (True, 3)])
def test_z_of_a_useless_network_is_updated_only_if_the_user_says_so(
    stated: bool, updates: int
) -> None:
    settings = ClosedSettings(iterations=3, lr="5%", align="affine")
    network = member(Noise, settings=settings, always_updated=stated)
    result = refined(frame_in_memory(100), network, compact())
    assert len(result.losses) - 1 == updates
    assert result.weights["noise"] == 0
    said = [note for note in result.notes if note.startswith("z of noise is not updated")]
    assert bool(said) is not stated


@pytest.mark.parametrize(
    "network",
    [
        member(Noise, settings=ALIGNED),  # it is never updated
        member(Brightness, settings=UPDATES),  # its updates are used
        member(Exact, settings=UPDATES),  # it takes the points
    ],
)
def test_nothing_is_said_of_trust_where_it_does_not_decide_about_updates(
    network: OpenNetwork,
) -> None:
    result = refined(frame_in_memory(100), network, compact())
    assert not [note for note in result.notes if "is not updated" in note]


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


@pytest.fixture
def judged_frame(monkeypatch: pytest.MonkeyPatch) -> Frame:
    """A frame of enough points that its image is judged by them."""
    monkeypatch.setattr("pnpdepth_cli.completion.outliers.FAR", 1.0)
    return frame_in_memory(400)


def of_another_scene(frame: Frame) -> Frame:
    """The frame with an image that has nothing to do with its depth."""
    stripes = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(3)).round()
    return replace(frame, rgb=stripes)


def image_warnings(result: Refined) -> list[str]:
    return [note for note in result.notes if note.startswith("warning: the image")]


def test_an_image_of_the_same_scene_is_not_warned_of(judged_frame: Frame) -> None:
    assert image_warnings(refined(judged_frame, compact())) == []


def test_an_image_of_another_scene_is_warned_of_with_the_points_that_show_it(
    judged_frame: Frame,
) -> None:
    (note,) = image_warnings(refined(of_another_scene(judged_frame), compact()))
    assert "80 validation points" in note


def test_beside_an_image_of_another_scene_the_network_is_tried_without_it(
    judged_frame: Frame,
) -> None:
    result = refined(of_another_scene(judged_frame), compact())
    assert "compact without the image" in result.weights
    assert "alone" not in result.validation.predicted  # there is nothing but compact


def test_an_image_that_the_user_states_to_be_of_the_same_view_is_believed(
    judged_frame: Frame,
) -> None:
    stated = refined(replace(of_another_scene(judged_frame), one_view=True), compact())
    assert "compact without the image" not in stated.weights
    assert image_warnings(stated) == []


def test_a_completion_network_of_the_scanner_has_most_of_the_result() -> None:
    frame = scan_frame()
    poor, good = (refined(frame, member(network), compact()) for network in (Nearest, Exact))
    assert poor.weights["nearest"] == 0
    assert good.weights["exact"] == pytest.approx(OWN_SCANNER)
    assert sum(good.weights.values()) == pytest.approx(1)
    assert np.abs(good.depth - depth_of_scene().numpy()).max() < 0.25


def test_networks_that_take_no_prior_are_fused_from_equal_prior_weights() -> None:
    result = refined(frame_in_memory(4), member(Brightness), member(Nearest))
    assert result.weights == {"brightness": 0.5, "nearest": 0.5}


@pytest.mark.parametrize("weighs", [True, False])
def test_a_wrong_track_is_left_out_where_a_network_gave_it_no_weight(weighs: bool) -> None:
    frame = frame_in_memory(100)
    generator = torch.Generator().manual_seed(0)
    noise = 0.26 * torch.rand(SIZE, generator=generator) - 0.13
    frame = replace(frame, rgb=(depth_of_scene() * noise.exp() - 1).expand(3, -1, -1))
    track = (frame.points.xy - 60).norm(dim=1) < 20  # points that agree with each other
    wrong = replace(frame.points, depth=torch.where(track, 1.5, 1.0) * frame.points.depth)
    blind = member(Brightness, weighs_points=weighs)  # sees the image alone
    result = refined(replace(frame, points=wrong), blind)
    assert int(track.sum()) > 5
    assert torch.equal(result.used.xy, wrong.select(~(track & weighs)).xy)
    assert any("outliers: " in note for note in result.notes) == weighs


@pytest.mark.parametrize("count", [1, MIN_POINTS - 1, MIN_POINTS, 7])
@pytest.mark.parametrize("positions", [1, 2, 3, 7])
def test_few_points_at_few_positions_are_enough(count: int, positions: int) -> None:
    frame = frame_in_memory(count)
    at = torch.arange(count) % positions
    close = frame.points.xy[at] + 0.01 * torch.arange(count)[:, None]
    points = replace(frame.points, xy=close, depth=frame.points.depth[at])
    result = refined(replace(frame, points=points), member(Brightness))
    assert (result.validation is None) == (count < MIN_POINTS)
    off = (torch.from_numpy(result.depth) / depth_of_scene()).log().abs()
    assert float(off.mean()) < 0.5


def test_the_same_frame_gives_the_same_depth_whatever_was_refined_before() -> None:
    frames = [frame_in_memory(60), frame_in_memory(60, seed=2)]
    with opened(member(Brightness, settings=UPDATES), compact()) as networks:
        first, _, again = (refine_frame(networks, frames[n], Pipeline()) for n in (0, 1, 0))
    assert np.array_equal(first.depth, again.depth)
    assert np.array_equal(first.depth, refined(frames[0], *networks).depth)


class Tally(nn.Module):
    """Gives what it is given, and counts how often."""

    def __init__(self) -> None:
        super().__init__()
        self.passes = 0

    def forward(self, x: Tensor) -> Tensor:
        self.passes += 1
        return x * 1.0


class Counted(Noise):
    """The same depth, by a front and a rear that count their passes."""

    def __init__(self) -> None:
        super().__init__()
        self.front = Tally()
        self.rear = Tally()

    def forward(self, rgb: Tensor) -> Tensor:
        return self.rear(super().forward(self.front(rgb)))


@pytest.mark.parametrize("outlying", [0, 10])
@pytest.mark.parametrize(
    ("is_strong", "fused", "updates"),
    [
        (True, True, 0),
        (True, False, 0),
        (False, True, 0),  # it has no part in the result
        (False, False, 3),
    ],
)
def test_a_network_that_takes_the_image_alone_runs_no_more_often_than_its_updates_need(
    is_strong: bool, fused: bool, updates: int, outlying: int
) -> None:
    frame = frame_in_memory(120)
    depth = frame.points.depth
    if is_strong:
        depth = frame.points.sample(Noise()(frame.rgb[None])[0, 0])
    wrong = torch.arange(120) < outlying
    depth = torch.where(wrong, 5.0, 1.0) * depth
    frame = replace(frame, points=replace(frame.points, depth=depth))
    own = member(Counted, settings=replace(UPDATES, align="scale"))
    result = refined(frame, own, *([compact()] if fused else []))
    assert result.validation is not None
    assert len(result.losses) == 1 + updates
    assert len(result.used) <= 120 - outlying
    # The plain pass serves all points and validation points; each of the two is updated by itself,
    # unless the network is strong, or, beside `compact`, not trusted.
    assert own.network.module.front.passes == 1
    assert own.network.module.rear.passes == (1 + 2 * (1 + updates) if updates else 1)


def test_outliers_are_set_aside_and_the_other_points_stay() -> None:
    frame = frame_in_memory(60)
    bad = torch.arange(60) % 5 == 0
    depth = torch.where(bad, 2.5, 1.0) * frame.points.depth
    with member(Brightness) as judge:
        clean = without_outliers(judge, frame).inliers
        frame = replace(frame, points=replace(frame.points, depth=depth))
        inliers = without_outliers(judge, frame).inliers
    assert torch.equal(inliers.outliers.xy, frame.points.xy[bad])
    assert torch.equal(inliers.points.xy, frame.points.xy[~bad])
    assert clean.outliers is None
    assert len(clean.points) == 60


def test_a_point_that_agrees_with_a_strong_network_is_no_outlier(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = frame_in_memory(30)
    network = member(Brightness, settings=ALIGNED)
    monkeypatch.setattr(network.network.module, "forward", lambda rgb: depth_of_scene()[None, None])
    wrong = frame.points.depth.clone()
    wrong[3] *= 3
    frame = replace(frame, points=replace(frame.points, depth=wrong))
    called_out = torch.zeros(30, dtype=torch.bool)
    called_out[[3, 4, 5]] = True
    constant = ResidualField(torch.ones(SIZE), frame.points, frame.rgb)
    with opened(network) as networks:
        kept = called_out & outliers_beside_strong(networks, frame, constant)
    assert kept.nonzero().flatten().tolist() == [3]
