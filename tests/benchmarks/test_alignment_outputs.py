from __future__ import annotations

import numpy as np
import pytest

from benchmarks.alignment_outputs import as_outputs, simulated_depth


def room() -> np.ndarray:
    """Depth (60, 80) of a floor, a wall and a box in metres; some pixels are unknown."""
    rows, columns = np.mgrid[:60, :80]
    depth = np.minimum(4.0, 60 / np.maximum(rows - 20, 1)).astype(np.float32)
    depth[25:45, 30:50] = 2.0
    depth[(rows + columns) % 7 == 0] = 0
    return depth


@pytest.mark.parametrize("error", [0.04, 0.09])
def test_a_simulated_network_has_the_wanted_error(error: float) -> None:
    gt = room()
    depth = simulated_depth(gt, error, np.random.default_rng(1))
    known = gt > 0
    system = np.stack([gt[known] / depth[known], gt[known]], axis=1)
    scale, shift = np.linalg.lstsq(system, np.ones(known.sum()), rcond=None)[0]
    aligned = 1 / (scale / depth[known] + shift)
    assert np.abs(np.log(aligned / gt[known])).mean() == pytest.approx(error, rel=0.1)


def test_outputs_are_of_one_depth() -> None:
    depth = simulated_depth(room(), 0.04, np.random.default_rng(1))
    outputs = as_outputs(depth, np.random.default_rng(2))
    for name, y in {
        "disparity": 1 / depth,
        "metric": depth,
        "relative": depth,
        "log": np.log(depth),
        "sqrt": np.sqrt(depth),
    }.items():
        line = np.polyfit(outputs[name].ravel(), y.ravel(), 1)
        assert np.polyval(line, outputs[name]) == pytest.approx(y)
