"""sparse2dense: the authors' files load whole."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch

from model_zoo_defs.sparse2dense import definitions
from pnpdepth_cli.models.network import load_network
from tests.model_zoo_defs.test_published import by_formula


@pytest.mark.parametrize("counters", [True, False], ids=["now", "before PyTorch 0.4.1"])
def test_a_published_file_loads_whole(counters: bool, tmp_path: Path) -> None:
    with torch.device("meta"):
        layout = definitions["sparse2dense-kitti"].build().state_dict()
    state = by_formula(layout)
    kept = {n: t for n, t in state.items() if counters or not n.endswith("num_batches_tracked")}
    args = argparse.Namespace(data="nyudepthv2", arch="resnet18", modality="rgbd")
    path = tmp_path / "model_best.pth.tar"
    torch.save(
        {"args": args, "epoch": 9, "model": kept}, path, _use_new_zipfile_serialization=counters
    )
    network = load_network("sparse2dense-kitti", path)
    own = network.module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in kept.items())
