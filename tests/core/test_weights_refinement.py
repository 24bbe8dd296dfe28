"""Moving weights by hidden points, against a loop that runs the whole network every time."""

from __future__ import annotations

import copy
import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pnpdepth_cli.core import weights_refinement
from pnpdepth_cli.core.masks import MASKS, Masks, set_aside
from pnpdepth_cli.core.refine import Refinement
from pnpdepth_cli.core.split import InputSplit, Split
from pnpdepth_cli.core.weights import MovingWeights, rank_of
from pnpdepth_cli.core.weights_refinement import MIN_POINTS, FrameOfPoints, refine_weights
from pnpdepth_cli.errors import DivergedError, LayerError, UsageError
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings
from tests.completion.naive import plain
from tests.core.networks import build, conv, depth_of, image
from tests.core.split.test_split import Failing, same, state_of

SETTINGS = Settings(
    iterations=4, lr=0.01, loss="log", update="sgd", parameters="weights", target="masked"
)


class TwoInputs(nn.Module):
    """An image encoder and points that enter behind it, as in late fusion."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.encoder = nn.Sequential(conv(3, 8), nn.BatchNorm2d(8), nn.ReLU(inplace=True))
        self.enter, self.head = conv(9, 8), conv(8, 1)
        self.runs = 0

    def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
        features = self.encoder(rgb)
        return F.softplus(self.head(F.relu(self.enter(torch.cat([features, sparse], 1))))) + 1


def points(count: int = 40, seed: int = 0) -> SparsePoints:
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randperm(256, generator=generator)[:count]
    xy = torch.stack([cells % 16, cells // 16], 1).float()
    depth = 2 + torch.rand(count, generator=generator)
    return SparsePoints(xy=xy, depth=depth, size=(16, 16))


def refined(
    network: nn.Module, settings: Settings = SETTINGS, at: SparsePoints | None = None
) -> Refinement:
    at, rgb = at or points(), image()
    with InputSplit(network) as split:
        frame = FrameOfPoints(
            points=at,
            inliers=at,
            output=split.first(rgb, at.scatter(), varying=(1,)),
            predict=lambda shown: split.again(rgb, shown.scatter()),
            predict_in_steps=lambda shown: split.again(rgb, shown.scatter()),
            depth_of=lambda output: output,
        )
        weights = MovingWeights(network, settings.parameters, settings.seed)
        return refine_weights(frame, weights, settings)


def naive(network: nn.Module, at: SparsePoints) -> Tensor:
    """The last step's depth by plain gradient descent on a copy of the network."""
    network, generator = copy.deepcopy(network).eval(), torch.Generator().manual_seed(0)
    shown = at.select(~set_aside(at, 0.1, generator))
    masks = Masks(shown, SETTINGS.complete(), generator)
    moved = [*network.enter.parameters(), *network.head.parameters()]
    network.encoder.requires_grad_(False)
    for _ in range(SETTINGS.iterations):
        away = masks.next()
        hidden = shown.select(away)
        depth = network(image(), shown.select(~away).scatter())
        loss = (hidden.sample(depth).log() - hidden.depth.log()).abs().mean()
        gradients = torch.autograd.grad(loss, moved)
        with torch.no_grad():
            for parameter, gradient in zip(moved, gradients, strict=True):
                parameter -= SETTINGS.lr * gradient
    depth = network(image(), at.scatter())
    return depth.detach()


# ------------------------------------------------------------------ the cut at the points


def test_what_does_not_depend_on_the_points_runs_once_and_nothing_changes() -> None:
    network, rgb = TwoInputs().eval(), image()
    calls: list[int] = []
    network.encoder[0].forward = _counted(network.encoder[0].forward, calls)  # type: ignore
    frames = [points(40, seed).scatter() for seed in range(3)]
    with torch.no_grad():
        whole = [network(rgb, sparse) for sparse in frames]
    calls.clear()
    with InputSplit(network) as split, torch.no_grad():
        first = split.first(rgb, frames[0], varying=(1,))
        again = [split.again(rgb, sparse) for sparse in frames]
        assert len(calls) == 1
        other = split.first(rgb * 0.5, frames[0], varying=(1,))
        assert len(calls) == 2
        assert split.static_graph
    assert torch.equal(first, whole[0])
    assert all(torch.equal(one, other) for one, other in zip(again, whole, strict=True))
    with torch.no_grad():
        assert torch.equal(other, network(rgb * 0.5, frames[0]))


@pytest.mark.parametrize("name", ["resnet", "unet", "in place", "branching", "updating"])
def test_a_network_whose_only_input_varies_runs_as_a_whole(name: str) -> None:
    network, x = build(name), image()
    wholes = [depth_of(plain(network, frame)) for frame in (x, x * 0.7)]
    with InputSplit(network) as split, torch.no_grad():
        assert torch.equal(depth_of(split.first(x, varying=(0,))), wholes[0])
        assert torch.equal(depth_of(split.again(x * 0.7)), wholes[1])


def _counted(forward: Any, calls: list[int]) -> Any:
    def counted(*args: Any) -> Any:
        calls.append(1)
        return forward(*args)

    return counted


# ------------------------------------------------------------------ the equation


def test_the_steps_are_those_of_running_the_whole_network_every_time() -> None:
    network = TwoInputs()
    result = refined(network, at=points(60))
    assert result.kept == SETTINGS.iterations
    assert torch.allclose(result.after, naive(network, points(60)), rtol=1e-6, atol=0)
    assert len(result.losses) == SETTINGS.iterations


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others() -> None:
    results = [refined(TwoInputs(), replace(SETTINGS, seed=seed)).after for seed in (3, 3, 4)]
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_a_step_that_makes_held_out_points_worse_is_not_taken() -> None:
    result = refined(TwoInputs(), replace(SETTINGS, update="sign", lr=1e3))
    assert result.kept == 0
    assert torch.equal(result.after, result.before)
    assert len(result.losses) < SETTINGS.iterations


def test_low_rank_weights_start_as_the_network_and_move() -> None:
    settings = replace(SETTINGS, parameters="lora:2", update="adam")
    result = refined(TwoInputs(), settings)
    assert torch.equal(result.before, refined(TwoInputs(), replace(settings, iterations=0)).after)
    assert result.kept > 0
    assert not torch.equal(result.after, result.before)


def test_with_target_given_the_loss_at_all_points_falls() -> None:
    network, at = TwoInputs(), points()
    settings = replace(SETTINGS, target="given", update="adam", lr=0.01)
    with Split(network, "enter") as split:
        z = split.front(image(), at.scatter())
        frame = FrameOfPoints(
            points=at,
            inliers=at,
            output=split.rear(z),
            predict=lambda _: split.rear(z),
            predict_in_steps=lambda _: split.rear(z),
            depth_of=lambda output: output,
        )
        result = refine_weights(frame, MovingWeights(network, "weights"), settings)
    assert result.losses == tuple(sorted(result.losses, reverse=True))
    assert result.kept == settings.iterations


def test_points_set_aside_are_looked_at_before_the_steps_and_three_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked: list[int] = []
    of_class = weights_refinement._WeightsRefinement
    check = of_class._check

    def counted(state: Any) -> None:
        looked.append(len(state.losses) if hasattr(state, "losses") else 0)
        check(state)

    monkeypatch.setattr(of_class, "_check", counted)
    refined(TwoInputs(), replace(SETTINGS, iterations=10))
    assert looked == [0, 4, 7, 10]


def test_a_budget_ends_the_steps() -> None:
    assert len(refined(TwoInputs(), replace(SETTINGS, time_budget_s=1e-9)).losses) == 1


def test_a_budget_shortens_the_schedule_and_the_last_step_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = itertools.count()
    monkeypatch.setattr(weights_refinement.time, "monotonic", lambda: float(next(clock)))
    settings = replace(SETTINGS, iterations=100, schedule="linear", time_budget_s=10.0)
    result = refined(TwoInputs(), settings)  # the clock is read twice a step: 2 s each
    assert (len(result.losses), result.kept) == (4, 4)


# ------------------------------------------------------------------ leaving no trace


@pytest.mark.parametrize("parameters", ["weights", "lora:2"])
def test_the_network_is_as_before(parameters: str) -> None:
    network = TwoInputs()
    before = state_of(network)
    refined(network, replace(SETTINGS, parameters=parameters))
    assert same(before, state_of(network))


@pytest.mark.parametrize("kind", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("call", [1, 2, 3, 4, 6])
def test_the_network_is_as_before_after_an_exception(kind: type[BaseException], call: int) -> None:
    network = TwoInputs()
    network.head = Failing(network.head, call, kind)
    before = state_of(network)
    with pytest.raises(Exception if kind is RuntimeError else kind):
        refined(network)
    assert same(before, state_of(network))


def test_a_divergence_gives_what_was_reached() -> None:
    with pytest.raises(DivergedError, match="try a smaller --lr") as caught:
        refined(TwoInputs(), replace(SETTINGS, lr=1e30))
    assert isinstance(caught.value.last_good, Refinement)


def test_a_network_without_weights_behind_the_points_is_refused() -> None:
    class Interpolates(nn.Module):
        def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
            return sparse.mean() + 0 * rgb[:, :1]

    with pytest.raises(LayerError, match="no weight can move"):
        refined(Interpolates())


@pytest.mark.parametrize("text", ["lora", "lora:0", "lora:x", "heads"])
def test_what_cannot_move_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="none of elements, channels, weights"):
        rank_of(text)


@pytest.mark.parametrize("count", [1, 3, MIN_POINTS - 1])
def test_a_few_points_leave_the_plain_depth(count: int) -> None:
    result = refined(TwoInputs(), at=points(count))
    assert (result.kept, result.losses) == (0, ())
    assert torch.equal(result.after, result.before)


# ------------------------------------------------------------------ masks


@pytest.mark.parametrize("kind", ["points", "blocks", "lines"])
@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.5, 0.8])
@pytest.mark.parametrize("count", [2, 5, 40])
def test_a_mask_hides_some_and_shows_some(kind: str, fraction: float, count: int) -> None:
    row = SparsePoints(
        xy=torch.arange(count)[:, None] * torch.tensor([0.3, 0.0]) + 1,
        depth=torch.ones(count),
        size=(16, 16),
    )
    for at in (points(count), row):
        masks = _masks(at, kind, fraction)
        for _ in range(7):
            assert 0 < int(masks.next().sum()) < count


@pytest.mark.parametrize(
    ("fraction", "sizes"), [(0.5, [20, 20]), (0.34, [13, 13, 14]), (0.25, [10] * 4)]
)
def test_every_point_is_hidden_once_before_any_is_hidden_again(
    fraction: float, sizes: list[int]
) -> None:
    masks = _masks(points(40), "points", fraction)
    for _ in range(2):
        hidden = torch.stack([masks.next() for _ in sizes]).int()
        assert hidden.sum(dim=0).tolist() == [1] * 40
        assert sorted(hidden.sum(dim=1).tolist()) == sizes


def test_no_block_is_joined_with_another(seeded: torch.Generator) -> None:
    xy = torch.cartesian_prod(torch.arange(64.0), torch.arange(128.0))
    at = SparsePoints(xy=xy, depth=torch.ones(len(xy)), size=(128, 64))
    groups = MASKS["blocks"](at, seeded)
    for group in groups.unique():
        block = xy[groups == group]
        assert bool((block.amax(0) - block.amin(0) < torch.tensor([8, 16])).all())


@pytest.mark.parametrize(("kind", "rows", "columns"), [("blocks", 16, 8), ("lines", 2, 64)])
def test_a_block_or_a_line_is_hidden_as_a_whole_and_lies_elsewhere_each_time(
    kind: str, rows: int, columns: int
) -> None:
    y, x = torch.meshgrid(torch.arange(128.0), torch.arange(64.0), indexing="ij")
    xy = torch.stack([x.flatten(), y.flatten()], 1)
    masks = _masks(SparsePoints(xy=xy, depth=torch.ones(len(xy)), size=(128, 64)), kind, 0.5)
    starts = set()
    for _ in range(4):
        hidden, _ = masks.next().reshape(128, 64), masks.next()
        down = (hidden[1:] != hidden[:-1]).any(dim=1).nonzero().flatten() % rows
        across = (hidden[:, 1:] != hidden[:, :-1]).any(dim=0).nonzero().flatten() % columns
        assert len(down.unique()) == 1
        assert len(across.unique()) == (kind == "blocks")
        starts.add((*down.unique().tolist(), *across.unique().tolist()))
    assert len(starts) > 1


def _masks(at: SparsePoints, kind: str, fraction: float) -> Masks:
    mask = Settings(mask=kind, mask_fraction=fraction)
    return Masks(at, mask, torch.Generator().manual_seed(0))


def test_points_set_aside_are_a_tenth_but_at_least_a_few() -> None:
    generator = torch.Generator()
    counts = [int(set_aside(points(count), 0.1, generator).sum()) for count in (2, 8, 40, 200)]
    assert counts == [0, 2, 4, 20]
    assert not set_aside(points(40), 0.0, generator).any()


def test_a_network_that_reads_values_of_the_points_runs_as_a_whole() -> None:
    class Reads(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.image = nn.Conv2d(3, 1, 1)

        def forward(self, rgb: Tensor, sparse: Tensor) -> Tensor:
            return self.image(rgb * float(sparse.max())) + sparse

    torch.manual_seed(0)
    network, rgb = Reads(), image()
    near, far = (torch.full((1, 1, *rgb.shape[2:]), depth) for depth in (1.0, 5.0))
    with InputSplit(network) as split, torch.no_grad():
        assert torch.equal(split.first(rgb, near, varying=(1,)), network(rgb, near))
        assert torch.equal(split.again(rgb, far), network(rgb, far))
