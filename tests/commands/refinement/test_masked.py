"""Updates of weights by points hidden from the network's input, through files and options."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from pnpdepth_cli import Refiner, load_network
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


def test_the_seed_and_the_scale_of_the_image_decide_the_steps(frame: FrameOnDisk) -> None:
    first, again, other, whole = (
        (run(frame, overwrite=True, **MASKED, **asked).record["loss"], depth_bytes(frame))
        for asked in ({"seed": 1}, {"seed": 1}, {"seed": 2}, {"seed": 1, "mask_scale": 1.0})
    )
    assert first == again
    assert first[0] not in (other[0], whole[0])


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
    ("asked", "dense", "iterations", "lr", "mask_scale"),
    [
        ({"target": "masked"}, True, 6, 3e-4, 0.5),
        ({"parameters": "weights"}, False, 16, 5e-4, 1.0),
        ({"parameters": "weights"}, True, 8, 2e-4, 1.0),
    ],
)
def test_dense_and_sparse_points_have_defaults_of_their_own(
    asked: dict[str, Any], dense: bool, iterations: int, lr: float, mask_scale: float
) -> None:
    definition = load_network("compact").definition
    settings = resolve_settings(definition, Settings(seed=5, **asked), dense=dense)
    assert (settings.iterations, settings.lr, settings.seed) == (iterations, lr, 5)
    assert (settings.mask_scale, settings.loss) == (mask_scale, "log")
    update = ("adam-short", "linear") if "target" in asked else ("adam", "cosine")
    assert (settings.update, settings.schedule) == update


def test_a_budget_is_of_hidden_points_only() -> None:
    definition = load_network("compact").definition
    asked = Settings(target="masked", time_budget_s=2.0)
    assert resolve_settings(definition, asked).time_budget_s == 2.0
    assert resolve_settings(definition, Settings(time_budget_s=2.0)).time_budget_s is None
