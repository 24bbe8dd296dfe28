"""Updates of weights by points hidden from the network's input, through files and options."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli import Refiner, load_network
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.models.definition import MASKED_DEFAULTS, WEIGHTS_DENSE_DEFAULTS
from pnpdepth_cli.settings import Settings
from tests.commands.frames import FrameOnDisk, run
from tests.core.split.test_split import same, state_of

MASKED = {"model": "compact", "checkpoint": None, "target": "masked", "iterations": 3}


def depth_bytes(frame: FrameOnDisk) -> bytes:
    return (frame.folder / "out" / "img_depth.png").read_bytes()


def test_masked_points_change_the_depth_and_are_recorded(frame: FrameOnDisk) -> None:
    record = run(frame, gt=frame.gt, **MASKED).record
    settings = record["settings"]
    assert (settings["target"], settings["parameters"]) == ("masked", "weights")
    masks = [settings[name] for name in ("mask", "mask_fraction", "mask_scale", "seed")]
    assert masks == ["points", 0.5, 0.5, 0]
    assert (settings["iterations"], settings["update"]) == (3, MASKED_DEFAULTS.update)
    assert len(record["loss"]) == 3
    assert record["scores"]["before"] != record["scores"]["after"]


def test_the_same_seed_gives_the_same_bytes(frame: FrameOnDisk) -> None:
    results, losses = [], []
    for seed in (1, 1, 2):
        losses.append(run(frame, seed=seed, overwrite=True, **MASKED).record["loss"])
        results.append(depth_bytes(frame))
    assert results[0] == results[1]
    assert losses[0] == losses[1] != losses[2]


def test_the_steps_may_see_a_reduced_image(frame: FrameOnDisk) -> None:
    losses = [run(frame, mask_scale=s, overwrite=True, **MASKED).record["loss"] for s in (0.5, 1.0)]
    assert losses[0] != losses[1]


def test_no_iterations_give_the_plain_depth(frame: FrameOnDisk) -> None:
    run(frame, **MASKED | {"iterations": 0})
    masked = depth_bytes(frame)
    run(frame, overwrite=True, model="compact", checkpoint=None, iterations=0)
    assert masked == depth_bytes(frame)


@pytest.mark.parametrize("parameters", ["weights", "lora:2"])
def test_a_network_of_images_moves_weights_behind_the_cut_by_all_points(
    frame: FrameOnDisk, parameters: str
) -> None:
    record = run(frame, parameters=parameters, lr="0.01").record
    assert record["settings"]["layer"] == "middle"
    assert record["loss"][-1] < record["loss"][0]
    assert len(record["loss"]) == WEIGHTS_DENSE_DEFAULTS.iterations


def test_a_network_is_as_before_after_the_refiner_closes(frame: FrameOnDisk) -> None:
    network = load_network("compact")
    before = state_of(network.module)
    rgb, sparse = torch.rand(46, 62, 3).numpy(), read_depth(frame.sparse).values
    with Refiner(network, Settings(target="masked")) as refiner:
        refined = refiner.refine(rgb, sparse)
    assert same(before, state_of(network.module))
    assert 0 < len(refined.losses) <= MASKED_DEFAULTS.iterations


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"parameters": "channels"}, "--target masked updates weights"),
        ({"parameters": "lora:0"}, "none of elements, channels, weights"),
        ({"layer": "decoder.s8"}, "--layer is where z is"),
        ({"preset": "paper"}, "--preset paper updates z"),
        ({"line_search": True}, "--set line-search is for updates of z"),
        ({"mask_fraction": 1.0}, "mask-fraction must be between 0 and 1, got 1.0"),
        ({"mask_scale": 1.5}, "mask-scale must be above 0 and at most 1"),
        ({"target": "given", "mask": "lines"}, "--set mask is for points hidden"),
    ],
)
def test_what_does_not_go_together_is_refused(
    frame: FrameOnDisk, wrong: dict[str, object], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        run(frame, **MASKED | wrong)


def test_points_cannot_be_hidden_from_a_network_of_images(frame: FrameOnDisk) -> None:
    with pytest.raises(UsageError, match="takes no sparse depth"):
        run(frame, target="masked")


def test_dense_points_have_defaults_of_their_own(frame: FrameOnDisk) -> None:
    definition = load_network("compact").definition
    method = Settings(target="masked")
    settings = resolve_settings(definition, method, dense=True)
    assert (settings.iterations, settings.lr, settings.mask_scale) == (6, 3e-4, 0.5)
    assert run(frame, **MASKED | {"iterations": None}).record["settings"]["lr"] == 3e-4


@pytest.mark.parametrize(("dense", "expected"), [(False, (16, 5e-4)), (True, (8, 2e-4))])
def test_weights_moved_by_given_points_keep_their_defaults(
    dense: bool, expected: tuple[int, float]
) -> None:
    definition = load_network("compact").definition
    settings = resolve_settings(definition, Settings(parameters="weights"), dense=dense)
    assert (settings.iterations, settings.lr) == expected
    assert (settings.update, settings.schedule, settings.loss) == ("adam", "cosine", "log")
    assert (settings.target, settings.mask_scale) == ("given", 1.0)


def test_seed_and_budget_reach_the_settings() -> None:
    definition = load_network("compact").definition
    asked = Settings(target="masked", seed=5, time_budget_s=2.0)
    settings = resolve_settings(definition, asked)
    assert (settings.seed, settings.time_budget_s) == (5, 2.0)
    assert resolve_settings(definition, Settings()).time_budget_s is None
