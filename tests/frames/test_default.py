"""The default method for one frame, and its check at hidden points."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.completion.propagation import propagate
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.frames import default
from pnpdepth_cli.frames.default import FOLDS, MIN_POINTS, refine_default, split_hidden
from pnpdepth_cli.frames.frame import Check, Frame, Refined
from pnpdepth_cli.frames.fuse import Fusion, Member, weighted_mean
from pnpdepth_cli.frames.uncertainty import calibration, relative_shape, with_uncertainty
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings
from tests.frames.scenes import (
    SIZE,
    Brightness,
    Nearest,
    TwicePrior,
    depth_of_scene,
    frame_in_memory,
    member,
)

UPDATES = Settings(iterations=3, lr="5%", update="sign", align="scale")


def refined(frame: Frame, *members: Member, seed: int = 0) -> Refined:
    """The frame by the default method with these networks."""
    with Fusion(members) as fusion:
        return refine_default(fusion, frame, seed=seed)


def test_the_stages_follow_each_other_and_the_last_is_the_result() -> None:
    frame = frame_in_memory(60)
    result = refined(frame, member(Brightness, settings=UPDATES))
    assert list(result.stages) == ["aligned", "fused", "updated", "propagated"]
    updated = torch.from_numpy(result.stages["updated"])
    expected = propagate(updated, frame.points, frame.rgb, kind="gp").depth
    assert np.array_equal(result.after, expected.numpy())
    assert np.array_equal(result.before, result.stages["aligned"])
    errors = [float(np.abs(d - depth_of_scene().numpy()).mean()) for d in result.stages.values()]
    assert errors[-1] < errors[0]


def test_the_residual_of_scan_lines_is_propagated_by_lines_through_the_nearest_points() -> None:
    y, x = np.mgrid[2 : SIZE[0] : 8, 0 : SIZE[1] : 2]
    xy = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32))
    every = SparsePoints(xy=xy, depth=torch.ones(len(xy)), size=SIZE)
    points = replace(every, depth=every.sample(depth_of_scene()))
    frame = replace(frame_in_memory(), points=points)
    result = refined(frame, member(Brightness, settings=UPDATES))
    updated = torch.from_numpy(result.stages["updated"])
    expected = propagate(updated, result.used, frame.rgb, kind="local").depth
    assert np.array_equal(result.stages["propagated"], expected.numpy())


@pytest.mark.parametrize("weighs", [True, False])
def test_a_wrong_track_is_left_out_where_a_network_gave_it_no_weight(weighs: bool) -> None:
    frame, generator = frame_in_memory(100), torch.Generator().manual_seed(0)
    noise = 0.26 * torch.rand(SIZE, generator=generator) - 0.13
    frame = replace(frame, rgb=(depth_of_scene() * noise.exp() - 1).expand(3, -1, -1))
    track = (frame.points.xy - 60).norm(dim=1) < 20  # points that agree with each other
    wrong = replace(frame.points, depth=torch.where(track, 1.5, 1.0) * frame.points.depth)
    blind = member(Brightness, weighs_points=weighs)  # sees the image alone
    result = refined(frame.with_points(wrong), blind)
    assert int(track.sum()) > 5
    assert torch.equal(result.used.xy, wrong.select(~(track & weighs)).xy)
    assert any("outliers: " in note for note in result.notes) == weighs


def test_without_a_check_the_uncertainty_has_the_typical_scale() -> None:
    result = refined(frame_in_memory(MIN_POINTS - 1), member(Brightness))
    got = with_uncertainty(result)
    depths = (torch.from_numpy(depth) for depth in (result.before, result.after))
    typical = calibration(torch.empty(0), torch.empty(0), MIN_POINTS - 1)
    expected = typical * relative_shape(result.used, *depths).numpy() * result.after
    assert np.array_equal(got.sigma, expected.astype(np.float32))
    assert "too few points to calibrate it with" in got.notes[-1]


def test_a_network_farther_off_than_the_result_or_without_depth_is_rejected() -> None:
    points = frame_in_memory(60).points
    hidden = replace(points, depth=torch.full((60,), 2.0))
    alone = {
        name: SimpleNamespace(before=np.full(SIZE, depth, np.float32))
        for name, depth in (("near", 1.0), ("far", 2.3), ("exact", 2.1))
    }
    fused: Any = SimpleNamespace(after=torch.full(SIZE, 2.2), alone=alone)
    names: list[Any] = [*alone, "failed"]
    assert default._rejected(fused, names, points, hidden) == ("near", "far", "failed")


@pytest.mark.parametrize("fold", [0, 1])
def test_nothing_is_hidden_where_a_fold_is_everything_or_nothing(
    fold: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(default, "spatial_folds", lambda p, *_, **__: torch.full((len(p),), fold))
    assert split_hidden(frame_in_memory(60).points, 0) is None


def test_hidden_points_are_a_fifth_and_the_others_are_kept() -> None:
    points = frame_in_memory(60).points
    parts = split_hidden(points, 0)
    assert parts is not None
    kept, hidden = parts
    assert len(hidden) == 60 // FOLDS
    rows = {tuple(xy) for xy in points.xy.tolist()}
    assert {tuple(xy) for part in parts for xy in part.xy.tolist()} == rows
    assert len(kept) + len(hidden) == 60


def test_of_many_hidden_points_a_part_is_predicted_and_none_is_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(default, "MOST_HIDDEN", 7)
    parts = split_hidden(frame_in_memory(60).points, 0)
    assert parts is not None
    assert [len(part) for part in parts] == [48, 7]


def test_hidden_points_have_no_influence_on_their_prediction() -> None:
    frame = frame_in_memory(60)
    first = refined(frame, member(Brightness)).check
    assert first is not None
    held = (frame.points.xy[:, None] == first.hidden.xy[None]).all(dim=2).any(dim=1)
    changed = torch.where(held, 1.01 * frame.points.depth, frame.points.depth)
    other = frame.with_points(replace(frame.points, depth=changed))
    again = refined(other, member(Brightness)).check
    assert again is not None
    assert torch.equal(again.hidden.xy, first.hidden.xy)
    for name in ("aligned", "fused", "linear"):
        assert torch.equal(again.predicted[name], first.predicted[name])


@pytest.mark.parametrize("count", [1, MIN_POINTS - 1, MIN_POINTS, 7])
@pytest.mark.parametrize("positions", [1, 2, 3, 7])
def test_few_points_at_few_positions_are_enough(count: int, positions: int) -> None:
    frame = frame_in_memory(count)
    at = torch.arange(count) % positions
    close = frame.points.xy[at] + 0.01 * torch.arange(count)[:, None]
    points = replace(frame.points, xy=close, depth=frame.points.depth[at])
    result = refined(frame.with_points(points), member(Brightness))
    assert (result.check is None) == (count < MIN_POINTS)
    off = (torch.from_numpy(result.after) / depth_of_scene()).log().abs()
    assert float(off.mean()) < 0.5


def check_of(predicted: dict[str, Tensor], depth: Tensor) -> Check:
    """A check of these predictions at as many points of depth 2 m."""
    xy = torch.stack([torch.arange(len(depth)) % 128, torch.arange(len(depth)) // 128], 1).float()
    points = SparsePoints(xy=xy, depth=depth, size=SIZE)
    return Check(
        hidden=points,
        kept=points,
        network=torch.ones(SIZE),
        weights=torch.ones(len(depth)),
        predicted=predicted,
    )


def test_the_gain_counts_standard_errors_of_the_log_error() -> None:
    depth = torch.full((4,), 2.0)
    off = torch.tensor([0.1, 0.2, 0.3, 0.4])
    check = check_of({"a": depth * off.exp(), "b": depth * (off + 0.1).exp()}, depth)
    uneven = check.with_prediction("c", depth * (off + torch.tensor([0.0, 0.2, 0.0, 0.2])).exp())
    assert uneven.gain("a", "c") == pytest.approx(0.1 / (0.1 / 4**0.5), rel=1e-3)
    assert uneven.gain("c", "a") == pytest.approx(-2.0, rel=1e-3)
    assert check.error("a") == pytest.approx(float((2 * off.exp() - 2).mean()))


def test_a_point_without_weight_decides_nothing() -> None:
    depth = torch.full((3,), 2.0)
    check = check_of({"a": torch.tensor([2.1, 2.1, 90.0])}, depth)
    check = replace(check, weights=torch.tensor([1.0, 1.0, 0.0]))
    assert check.error("a") == pytest.approx(0.1, rel=1e-5)


def compact() -> Member:
    """`compact` without updates of z."""
    network = load_network("compact", None)
    return Member(network=network, layer="decoder.s8", settings=Settings(iterations=0))


def test_an_image_that_does_not_belong_to_its_points_is_used_less(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("pnpdepth_cli.completion.outliers.FAR", 1.0)
    frame = frame_in_memory(400)  # used in full with either image
    stripes = torch.rand(3, *SIZE, generator=torch.Generator().manual_seed(3)).round()
    wrong = replace(frame, rgb=stripes)
    right, moved = refined(frame, compact()), refined(wrong, compact())
    assert not any("does not seem to belong" in note for note in right.notes)
    assert np.array_equal(right.after, right.stages["propagated"])
    (note,) = [note for note in moved.notes if "does not seem to belong" in note]
    assert note.startswith("warning: ")
    assert "half of the result leaves the image out" in note
    grey = refined(replace(frame, rgb=torch.full_like(stripes, 0.5)), compact())
    kept = torch.from_numpy(moved.stages["propagated"])
    blind = torch.from_numpy(grey.stages["propagated"])
    half = weighted_mean([(kept, 1.0), (blind, 1.0)])
    if "linear" in note.rsplit(";", 2)[1]:
        half = weighted_mean([(half, 1.0), (linear(frame.points), 1.0)])
    assert np.allclose(moved.after, half.numpy(), rtol=1e-5)


def test_an_image_whose_edges_lie_where_depth_changes_by_chance_is_used_by_half(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = replace(frame_in_memory(400), unrelated=True)
    assert frame.rgb is not None
    clear = refined(frame, compact())  # what the hidden points show overrules the edges
    assert clear.check is not None
    assert clear.check.gain("propagated", "linear") > default.CLEAR_GAIN
    assert np.array_equal(clear.after, clear.stages["propagated"])
    monkeypatch.setattr(default, "CLEAR_GAIN", 1 + clear.check.gain("propagated", "linear"))
    result = refined(frame, compact())
    grey = refined(replace(frame, rgb=torch.full_like(frame.rgb, 0.5)), compact())
    depths = [(torch.from_numpy(r.stages["propagated"]), 1.0) for r in (result, grey)]
    assert np.allclose(result.after, weighted_mean(depths).numpy(), rtol=1e-5)
    (note,) = [note for note in result.notes if "does not seem to belong" in note]
    assert "depth changes at its edges no more often than by chance; half of the result" in note


@pytest.mark.parametrize(
    ("off", "hidden", "half_linear"),
    [(0.30, 80, True), (0.30, 20, True), (0.30, 19, False), (0.0, 80, False)],
)
def test_a_method_that_is_worse_beyond_chance_gives_half_to_linear_interpolation(
    monkeypatch: pytest.MonkeyPatch, off: float, hidden: int, half_linear: bool
) -> None:
    frame, user = frame_in_memory(hidden * 5), member(Brightness)
    factor = 1 + off * torch.rand(hidden, generator=torch.Generator().manual_seed(0))
    depth = torch.full((hidden,), 2.0)
    check = check_of({"propagated": depth * factor, "linear": depth * 1.001}, depth)
    check = check.with_prediction("result", check.predicted["propagated"])
    monkeypatch.setattr(default, "_check", lambda *_: check)
    result = refined(frame, user)
    kept = torch.from_numpy(result.stages["propagated"])
    expected = weighted_mean([(kept, 1.0), (linear(frame.points), 1.0)]) if half_linear else kept
    assert np.allclose(result.after, expected.numpy(), rtol=1e-6)
    assert any("half is linear interpolation" in note for note in result.notes) == half_linear


@pytest.mark.parametrize(("outliers", "moved"), [(20, True), (21, False)])
def test_a_method_without_gain_uses_the_image_less_unless_many_points_were_outliers(
    monkeypatch: pytest.MonkeyPatch, outliers: int, moved: bool
) -> None:
    hidden = 80
    depth = torch.full((hidden,), 2.0)
    check = check_of(dict.fromkeys(("propagated", "linear", "result"), depth * 1.01), depth)
    monkeypatch.setattr(default, "_check", lambda *_: check)
    frame = frame_in_memory(5 * hidden)
    left_out = frame.points.select(torch.arange(5 * hidden) < outliers)
    result = refined(replace(frame, outliers=left_out), compact())
    assert any("half of the result leaves the image out" in note for note in result.notes) == moved
    assert np.array_equal(result.after, result.stages["propagated"]) != moved


def test_a_completion_network_is_no_prior_where_the_hidden_points_speak_against_it() -> None:
    frame = frame_in_memory(60)
    poor = refined(frame, member(Nearest), compact())
    alone = refined(frame, compact())
    assert np.allclose(poor.stages["updated"], alone.stages["updated"], rtol=1e-5)


def test_a_completion_network_that_serves_as_a_prior_has_most_of_the_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame, poor = frame_in_memory(60), member(Nearest)
    monkeypatch.setattr(default, "_rejected", lambda *_: ())
    result = refined(frame, poor, compact())
    updated = torch.from_numpy(result.stages["updated"])
    rest = propagate(updated, frame.points, frame.rgb, kind="gp").depth
    expected = weighted_mean([(rest, 0.25), (torch.from_numpy(result.before), 0.75)])
    assert np.allclose(result.after, expected.numpy(), rtol=1e-6)


def test_a_further_network_that_fails_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, other = frame_in_memory(60), member(TwicePrior)

    def fail(*_: object, **__: object) -> Tensor:
        raise ModelError("no depth")

    monkeypatch.setattr(other.network.module, "forward", fail)
    result = refined(frame, member(Brightness), other)
    alone = refined(frame, member(Brightness))
    assert np.array_equal(result.after, alone.after)


def test_the_same_frame_gives_the_same_depth_whatever_was_refined_before() -> None:
    frames = [frame_in_memory(60), frame_in_memory(60, seed=2)]
    with Fusion([member(Brightness, settings=UPDATES), compact()]) as fusion:
        first, _, again = (refine_default(fusion, frames[n]) for n in (0, 1, 0))
    assert np.array_equal(first.after, again.after)
    assert np.array_equal(first.after, refined(frames[0], *fusion.members).after)
