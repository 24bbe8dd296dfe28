"""The networks of the default method, fused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.frames import fuse
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.frames.fuse import FEW_POINTS, IMAGE_WEIGHT, PRIOR_WEIGHT, Fusion, weighted_mean
from pnpdepth_cli.frames.opened import OpenNetwork
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import Settings
from tests.core.split.test_split import same, state_of
from tests.frames.scenes import SIZE, Brightness, Nearest, TwicePrior, frame_in_memory, member

UPDATES = Settings(iterations=3, lr="5%", update="sign", align="none")
ALIGNED = Settings(iterations=0, align="affine")


def test_the_weighted_mean_is_geometric_and_skips_unknown_depth() -> None:
    mean = weighted_mean(
        [(torch.tensor([4.0, 0.0, 0.0]), 0.25), (torch.tensor([1.0, 3.0, 0.0]), 0.75)]
    )
    assert torch.allclose(mean, torch.tensor([4.0**0.25, 3.0, 0.0]))
    alone = torch.tensor([2.0, 0.0])
    assert torch.equal(weighted_mean([(alone, 0.3)]), alone)


def test_a_network_that_takes_a_prior_is_given_the_others_aligned_depth() -> None:
    frame = frame_in_memory(60)
    with Fusion([member(Brightness, settings=ALIGNED), member(TwicePrior)]) as fusion:
        fused = fusion.fuse(frame)
    own = torch.from_numpy(fused.user.before)
    expected = weighted_mean([(own, IMAGE_WEIGHT), (2 * own, 1 - IMAGE_WEIGHT)])
    assert torch.equal(fused.after, expected)


def test_with_few_points_the_depth_without_a_prior_is_fused_too() -> None:
    frame = frame_in_memory(FEW_POINTS - 1)
    with Fusion([member(Brightness, settings=ALIGNED), member(TwicePrior)]) as fusion:
        fused = fusion.fuse(frame)
    own, rest = torch.from_numpy(fused.user.before), 1 - IMAGE_WEIGHT
    parts = [
        (own, IMAGE_WEIGHT),
        (torch.full_like(own, 5.0), rest * (1 - PRIOR_WEIGHT)),
        (2 * own, rest * PRIOR_WEIGHT),
    ]
    assert torch.allclose(fused.after, weighted_mean(parts))


def test_a_completion_network_has_its_say_as_a_prior_alone() -> None:
    frame = frame_in_memory(60)
    completion, taker = member(Nearest), member(TwicePrior)
    with Fusion([completion, taker]) as fusion:
        fused, rejected = fusion.fuse(frame), fusion.fuse(frame, rejected=[completion])
    assert torch.equal(fused.after, 2 * torch.from_numpy(fused.user.before))
    assert bool((rejected.after == 5.0).all())


def test_networks_that_take_no_prior_are_fused_alike() -> None:
    frame = frame_in_memory(60)
    with Fusion([member(Brightness), member(Nearest)]) as fusion:
        fused = fusion.fuse(frame)
    depths = [torch.from_numpy(refined.after) for refined in fused.alone.values()]
    assert torch.allclose(fused.after, (depths[0] * depths[1]).sqrt())


@pytest.mark.parametrize(
    ("count", "updated"), [(FEW_POINTS - 1, False), (FEW_POINTS, True), (48 * 64 // 20, False)]
)
def test_networks_with_points_are_updated_where_that_gains(count: int, updated: bool) -> None:
    settings = replace(UPDATES, lr=0.05)
    frame = frame_in_memory(count)
    with Fusion([member(Nearest, settings=settings)]) as fusion:
        fused = fusion.fuse(frame)
        without = fusion.fuse(frame, updates=False)
    assert (len(fused.user.refinement.losses) - 1 == UPDATES.iterations) == updated
    assert torch.equal(without.after, fused.before)
    assert torch.equal(fused.after, fused.before) != updated


def test_a_member_gives_what_its_refinement_alone_gives() -> None:
    frame, one = frame_in_memory(60), member(Brightness, settings=UPDATES)
    with one.network.cut_at("layer") as split:
        alone = refine_frame(one.network, split, UPDATES, frame)
    with Fusion([one]) as fusion:
        fused = fusion.fuse(frame)
    assert torch.equal(fused.after, torch.from_numpy(alone.after))
    assert torch.equal(fused.before, torch.from_numpy(alone.before))


def test_the_front_runs_once_for_all_sets_of_points_of_an_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame, fronts, front = frame_in_memory(60), [], Split.front
    monkeypatch.setattr(Split, "front", lambda *args: fronts.append(args) or front(*args))
    fewer = frame.with_points(frame.points.select(torch.arange(60) < 40))
    with Fusion([member(Brightness, settings=UPDATES)]) as fusion:
        together = [fusion.fuse(each).after for each in (frame, fewer)]
        assert len(fronts) == 1
        fusion.next_image()
        again = fusion.fuse(fewer).after
        assert len(fronts) == 2
    assert torch.equal(together[1], again)


def test_the_image_encoder_runs_once_for_all_sets_of_points_and_the_network_stays() -> None:
    network, runs = load_network("compact", None), list[int]()
    before = state_of(network.module)
    first = next(network.module.encoder.children())
    handle = first.register_forward_hook(lambda *_: runs.append(1))
    frame, settings = frame_in_memory(60), Settings(iterations=1, lr="5%")
    fewer = frame.with_points(frame.points.select(torch.arange(60) < 55))
    with OpenNetwork(network, "decoder.s8") as opened:
        opened.refine(frame, settings)
        count = len(runs)
        shared = opened.refine(fewer, settings)
        plain = opened.refine(fewer, replace(settings, iterations=0))
        assert len(runs) == count > 0
        opened.next_image()
        alone = opened.refine(fewer, settings)
    handle.remove()
    assert (shared.after == alone.after).all()
    assert (plain.after == alone.before).all()
    assert same(before, state_of(network.module))


def spoiled(frame: Frame) -> tuple[Frame, torch.Tensor]:
    """The frame with every fifth point 2.5 times as far, and which these are."""
    bad = torch.arange(len(frame.points)) % 5 == 0
    depth = torch.where(bad, 2.5 * frame.points.depth, frame.points.depth)
    return frame.with_points(replace(frame.points, depth=depth)), bad


def test_outliers_are_set_aside_and_the_other_points_stay() -> None:
    frame, bad = spoiled(frame_in_memory(60))
    with Fusion([member(Brightness)]) as fusion:
        inliers, user = fusion.without_outliers(frame)
        clean, _ = fusion.without_outliers(frame_in_memory(60))
    assert inliers.outliers is not None
    assert torch.equal(inliers.outliers.xy, frame.points.xy[bad])
    assert torch.equal(inliers.points.xy, frame.points.xy[~bad])
    assert torch.equal(user.used.xy, inliers.points.xy)
    assert clean.outliers is None
    assert len(clean.points) == 60


@pytest.mark.parametrize("count", [FEW_POINTS - 1, FEW_POINTS])
@pytest.mark.parametrize(("alone", "beside"), [(False, True), (True, False), (True, True)])
def test_outliers_among_few_points_are_those_beside_the_network_and_else_those_of_either_check(
    count: int, alone: bool, beside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, bad = spoiled(frame_in_memory(count))
    found = iter([bad & alone, bad & beside])
    monkeypatch.setattr(fuse, "outliers", lambda *_: next(found))
    with Fusion([member(Brightness)]) as fusion:
        inliers, user = fusion.without_outliers(frame)
    expected = frame.points.select(~(bad & (beside or count >= FEW_POINTS)))
    assert torch.equal(inliers.points.xy, expected.xy)
    assert torch.equal(user.used.xy, expected.xy)


def test_a_network_that_explains_nothing_at_the_points_has_no_say() -> None:
    frame = frame_in_memory(60)
    noise = torch.from_numpy(np.random.default_rng(5).random((3, *SIZE), dtype=np.float32))
    unrelated = replace(frame, rgb=noise)
    with Fusion([member(Brightness, settings=ALIGNED), member(TwicePrior)]) as fusion:
        says = fusion.fuse(frame)
        fusion.next_image()
        silent = fusion.fuse(unrelated)
    assert not bool((says.after == 5.0).any())
    assert bool((silent.after == 5.0).all())
    assert not bool((torch.from_numpy(silent.user.before) == 5.0).any())
