"""nconv and pncnn: their published weights give the published errors on real frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from benchmarks.frames import kitti_dc
from model_zoo_defs.nconv import NConv, NormalisedConv
from model_zoo_defs.pncnn import Pncnn
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints


def test_a_constant_depth_stays_whatever_pixels_are_known() -> None:
    layer = NormalisedConv(1, 1, 5)
    known = torch.rand(1, 1, 12, 14, generator=torch.Generator().manual_seed(0)) < 0.3
    depth, confidence = layer(7.0 * known, known.float())
    assert torch.allclose(depth[confidence > 0], torch.tensor(7.0), atol=1e-5)


@pytest.mark.parametrize("network", [NConv, Pncnn])
def test_a_constant_depth_stays_in_the_whole_network(network: type[nn.Module]) -> None:
    depth = torch.full((1, 1, 32, 48), 7.0)
    with torch.no_grad():
        assert torch.allclose(network().eval()(depth), depth, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "weights", "mae", "rmse"),
    [
        ("pncnn", "pncnn/kitti_model_best.pth.tar", 0.204, 0.688),
        ("nconv", "nconv/CNN_ep0003.pth.tar", 0.29, 1.10),
    ],
)
def test_published_weights_give_about_the_published_errors_on_kitti(
    shared_data: Path, name: str, weights: str, mae: float, rmse: float
) -> None:
    network = load_network(name, shared_data / "weights" / weights)
    frame = next(iter(kitti_dc(shared_data)))
    assert frame.sensor is not None
    rows, columns = np.nonzero(frame.sensor)
    points = SparsePoints(
        xy=torch.from_numpy(np.stack([columns, rows], 1).astype(np.float32)),
        depth=torch.from_numpy(frame.sensor[rows, columns]),
        size=frame.gt.shape,
    )
    fit = FrameMap.fit(network.definition.size, *frame.gt.shape)
    with torch.no_grad():
        output = network.module(*network.arguments_of(None, fit.points_to_network(points)))
    scores = score(fit.depth_to_image(network.depth_of(output)), torch.from_numpy(frame.gt))
    assert scores.mae == pytest.approx(mae, rel=0.1)
    assert scores.rmse == pytest.approx(rmse, rel=0.1)
