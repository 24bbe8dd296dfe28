"""Networks of a wanted strength, and networks that return a stored map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.simulated import (
    as_outputs,
    error_aligned,
    simulated_network,
    stored_network,
    weakened,
)
from benchmarks.strong_maps import rendered
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.models.network import Network


@pytest.fixture(scope="module")
def room() -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) and image (H, W, 3) of a rendered room."""
    pytest.importorskip("embreex")
    (frame,) = rendered("room", 1)
    return frame.gt, frame.rgb


def output_of(network: Network, rgb: np.ndarray) -> torch.Tensor:
    return network.module(torch.from_numpy(rgb.transpose(2, 0, 1))[None])[0, 0]


@pytest.mark.parametrize("error", [0.02, 0.04, 0.09])
def test_weakened_depth_is_off_by_the_wanted_error_after_alignment(
    room: tuple[np.ndarray, np.ndarray], error: float
) -> None:
    depth = weakened(room[0], error, np.random.default_rng(0))
    assert error_aligned(depth, room[0]) == pytest.approx(error, rel=0.05)


def test_another_scale_and_shift_of_inverse_depth_is_aligned_away(
    room: tuple[np.ndarray, np.ndarray],
) -> None:
    gt = room[0]
    known = np.where(gt > 0, gt, 1.0)
    assert error_aligned(1 / (3 / known + 0.5), gt) == pytest.approx(0.0, abs=1e-4)


def test_a_simulated_network_gives_the_weakened_depth_as_disparity(
    room: tuple[np.ndarray, np.ndarray],
) -> None:
    gt, rgb = room
    disparity = output_of(simulated_network("strong", gt, rgb, 0.04, 0), rgb).numpy()
    # A line of the output is the inverse of a depth that is off by 4 %.
    known = gt > 0
    slope, shift = np.polyfit(disparity[known], 1 / gt[known], 1, w=gt[known])
    depth = 1 / np.maximum(slope * disparity + shift, 1e-3)
    assert error_aligned(depth, gt) == pytest.approx(0.04, rel=0.1)


def test_a_change_of_the_feature_map_changes_the_depth_of_a_simulated_network(
    room: tuple[np.ndarray, np.ndarray],
) -> None:
    network = simulated_network("strong", *room, 0.04, 0)
    plain = output_of(network, room[1])
    with network.cut_at("encode") as split:
        image = torch.from_numpy(room[1].transpose(2, 0, 1))[None]
        z = split.front(image)
        changed = split.rear(z + 0.1 * z.std())
    assert isinstance(changed, torch.Tensor)
    assert float((changed[0, 0] - plain).abs().mean()) > 1e-3 * float(plain.std())


def test_a_stored_map_is_what_the_network_gives_for_any_image() -> None:
    values = np.linspace(1, 5, 12, dtype=np.float32).reshape(3, 4)
    values[0, 0] = np.nan
    network = stored_network("map", values, "depth", "metric")
    given = output_of(network, np.zeros((3, 4, 3), np.float32)).numpy()
    np.testing.assert_array_equal(given, values)


def test_the_predicted_depth_of_the_sample_is_off_by_4_per_cent_after_alignment() -> None:
    sample = Path(__file__).parents[2] / "samples" / "indoor"
    gt = read_depth(sample / "gt.png").values
    stored = np.load(sample / "predicted.npy").astype(np.float64)
    known = gt > 0
    # A line of the stored numbers is inverse depth.
    slope, shift = np.polyfit(stored[known], 1 / gt[known], 1, w=gt[known])
    depth = 1 / (slope * stored + shift)
    assert error_aligned(depth, gt) == pytest.approx(0.04, rel=0.05)


def test_all_outputs_of_a_network_are_of_one_depth() -> None:
    rows, _ = np.mgrid[:60, :80]
    depth = np.minimum(4.0, 60 / np.maximum(rows - 20, 1)).astype(np.float32)
    depth[25:45, 30:50] = 2.0
    outputs = as_outputs(depth, np.random.default_rng(2))
    quantities = {
        "disparity": 1 / depth,
        "metric": depth,
        "relative": depth,
        "log": np.log(depth),
        "sqrt": np.sqrt(depth),
    }
    for name, quantity in quantities.items():
        line = np.polyfit(outputs[name].ravel(), quantity.ravel(), 1)
        assert np.polyval(line, outputs[name]) == pytest.approx(quantity, rel=1e-5)


def test_unknown_truth_does_not_change_the_error_of_a_simulated_network() -> None:
    rows, columns = np.mgrid[:60, :80]
    gt = np.minimum(4.0, 60 / np.maximum(rows - 20, 1)).astype(np.float32)
    gt[25:45, 30:50] = 2.0
    gt[(rows + columns) % 7 == 0] = 0
    depth = weakened(gt, 0.09, np.random.default_rng(1))
    assert error_aligned(depth, gt) == pytest.approx(0.09, rel=0.05)
