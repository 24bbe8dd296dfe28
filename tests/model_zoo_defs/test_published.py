"""Layouts of published checkpoints, and what the networks compute with weights of a formula.

The values were computed when each network agreed with one written from its published tensors alone.
"""

from __future__ import annotations

import hashlib
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from model_zoo_defs.eigen import Eigen
from model_zoo_defs.fcrn import FCRN, module_of
from model_zoo_defs.sfmlearner import DispNet
from model_zoo_defs.sparse2dense import SparseToDense
from model_zoo_defs.sparseconv import SparseConvNet
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.models.weights import load_checkpoint
from tests.models.weights.files import npy_of, pickled

LAYOUTS = {
    "eigen": "feb3263c6005e44b",
    "fcrn": "4e9883663fa7356d",
    "sparse2dense": "c6604bee0864b0a6",
    "sparse2dense-kitti": "46b2121203d11cda",
    "sfmlearner": "e374360515857b42",
    "sparseconv": "aac5134b74f69962",
    "adnn": "931c11a6002ac7f6",
    "nconv": "ec540b7fa8d53202",
    "pncnn": "f80ccbd3e95ffde6",
}
"""Digests of the names and shapes of all tensors."""
NARROW: dict[str, Callable[[], nn.Module]] = {
    "eigen": lambda: Eigen(channels=(6, 8, 10, 9, 7), hidden=20, fine=12),
    "fcrn": lambda: FCRN(8),
    "sparse2dense": lambda: SparseToDense(50, width=16),
    "sparse2dense-kitti": lambda: SparseToDense(18, width=16),
    "sfmlearner": lambda: DispNet(width=4),
    "sparseconv": SparseConvNet,
}
FILES: dict[str, Callable[[dict[str, Tensor]], dict[str, object]]] = {
    "sparse2dense-kitti": lambda s: {"args": Namespace(arch="resnet18"), "epoch": 9, "model": s},
    "sfmlearner": lambda s: {"epoch": 200, "state_dict": s},
    "sparseconv": lambda s: {"epoch": 20, "rmse": 1777.0, "optimizer": {}, "state_dict": s},
}
"""What lies in the published file around the state."""
COMPUTED = {
    ("eigen", 228, 304): [5.306, 4.414, 3.537, 4.885, 5.314, 4.539],
    ("fcrn", 228, 304): [0.985, 0.0, 0.838, 2.244, 1.512, 3.467],
    ("fcrn", 97, 130): [0.0, 1.017, 1.938, 0.0, 1.469, 0.076],
    ("sparse2dense", 100, 130): [2.507, 2.262, 0.931, -1.293, -4.631, 0.754],
    ("sparse2dense-kitti", 100, 130): [-0.525, -2.84, -1.909, -3.253, -3.432, -2.55],
    ("sfmlearner", 130, 420): [4.143, 2.894, 3.598, 1.077, 1.767, 3.966],
    ("sfmlearner", 65, 71): [3.701, 4.207, 3.684, 4.282, 3.782, 4.453],
    ("sparseconv", 40, 60): [29.717, 29.393, 30.246, 31.079, 29.211, 30.872],
}
"""Six values of the output by height and width of the image, in its standard deviations."""


def uniform(shape: torch.Size, seed: int) -> Tensor:
    """Numbers between 0 and 1 that look random and are the same everywhere."""
    phase = torch.arange(shape.numel(), dtype=torch.float64) * 12.9898 + seed * 78.233
    return (phase.sin() * 43758.5453).remainder(1).reshape(shape).float()


def by_formula(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights with which activations neither vanish nor grow."""
    filled = {}
    for seed, (name, tensor) in enumerate(sorted(state.items())):
        values = uniform(tensor.shape, seed) - 0.5
        fan_in = tensor[0].numel() if tensor.ndim > 1 else 1
        if name.endswith("num_batches_tracked"):
            values = torch.tensor(7)
        elif tensor.ndim > 1:
            values *= (16 / fan_in) ** 0.5
        elif name.endswith(("weight", "running_var")):
            values += 1
        filled[name] = values
    return filled


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_network_has_the_published_names_and_shapes(name: str) -> None:
    with torch.device("meta"):
        state = find_definition(name).build().state_dict()
    lines = sorted(f"{name} {tuple(tensor.shape)}" for name, tensor in state.items())
    assert hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16] == LAYOUTS[name]


@pytest.mark.parametrize(("name", "height", "width"), COMPUTED)
def test_a_network_computes_what_published_tensors_say(name: str, height: int, width: int) -> None:
    network = NARROW[name]().eval()
    state = by_formula(network.state_dict())
    if name == "sparseconv":  # whose sums are means only with weights above 0
        state = {key: value + 1 for key, value in state.items()}
    network.load_state_dict(state)
    image = uniform(torch.Size((1, 3, height, width)), 1000)
    points = uniform(torch.Size((1, 1, height, width)), 1001)
    sparse = torch.where(points < 0.1, 1 + 40 * points, 0.0)
    with torch.no_grad():
        inputs = {"rgb": (image,), "sparse": (sparse,), "rgb+sparse": (image, sparse)}
        output = network(*inputs[find_definition(name).input_kind])
    rows, columns = (
        side * torch.arange(1, n) // n for side, n in zip(output.shape[2:], (3, 4), strict=True)
    )
    values = (output[0, 0][rows][:, columns] / output.std()).flatten()
    assert values.tolist() == pytest.approx(COMPUTED[name, height, width], rel=2e-3, abs=2e-3)


def test_a_folder_with_eigens_two_published_files_loads_whole(tmp_path: Path) -> None:
    network = NARROW["eigen"]()
    state = by_formula(network.state_dict())
    for stage in ("coarse", "fine"):
        own = {n.removeprefix(f"{stage}."): t for n, t in state.items() if n.startswith(stage)}
        torch.save(own, tmp_path / f"{stage}_model_12.pth")
    (note,) = load_checkpoint(network, find_definition("eigen"), tmp_path)
    assert "coarse_model_12.pth, fine_model_12.pth" in note
    assert all(torch.equal(network.state_dict()[name], tensor) for name, tensor in state.items())


@pytest.mark.parametrize("counters", [True, False], ids=["now", "before PyTorch 0.4.1"])
@pytest.mark.parametrize("name", FILES)
def test_a_published_file_loads_whole(name: str, counters: bool, tmp_path: Path) -> None:
    with torch.device("meta"):
        unfilled = find_definition(name).build().state_dict()
    state = by_formula(unfilled)
    kept = {n: t for n, t in state.items() if counters or not n.endswith("num_batches_tracked")}
    path = tmp_path / "model_best.pth.tar"
    torch.save(FILES[name](kept), path, _use_new_zipfile_serialization=counters)
    own = load_network(name, path).module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in kept.items())


NORM = {"weight": "scale", "bias": "offset", "running_mean": "mean", "running_var": "variance"}


def layers_of_fcrn() -> Iterator[tuple[str, str]]:
    """The convolutions of NYU_ResNet-UpProj.npy with their normalisations; either may be ""."""
    yield from (("conv1", "bn_conv1"), ("layer1", "layer1_BN"), ("ConvPred", ""))
    for stage, letters in ((2, "abc"), (3, "abcd"), (4, "abcdef"), (5, "abc")):
        yield f"res{stage}a_branch1", f"bn{stage}a_branch1"
        for place in (f"{letter}_branch2{branch}" for letter in letters for branch in "abc"):
            yield f"res{stage}{place}", f"bn{stage}{place}"
    for up in ("layer2x", "layer4x", "layer8x", "layer16x"):
        yield f"{up}_Conv", f"{up}_BN"
        for branch in (f"{up}_br1", f"{up}_br2"):
            yield "", f"{branch}_BN"
            yield from ((f"{branch}_Conv{letter}", "") for letter in "ABCD")


def test_the_arrays_of_fcrns_authors_are_read_in_torchs_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    network = FCRN(4)
    expected = {
        name: torch.from_numpy(rng.normal(size=tensor.shape).astype(np.float32))
        for name, tensor in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    arrays: dict[str, dict[str, np.ndarray]] = {}
    for conv, norm in layers_of_fcrn():
        if conv:  # rows, columns, channels in and out
            kernel = expected[f"{module_of(conv)}.weight"].permute(2, 3, 1, 0)
            arrays[conv] = {"weights": kernel.numpy()}
            if f"{module_of(conv)}.bias" in expected:
                arrays[conv]["biases"] = expected[f"{module_of(conv)}.bias"].numpy()
        if norm:
            own = module_of(norm)
            arrays[norm] = {kind: expected[f"{own}.{n}"].numpy() for n, kind in NORM.items()}
    load_checkpoint(
        network, find_definition("fcrn"), npy_of(tmp_path / "x.npy", pickled(arrays, 2))
    )
    for name, tensor in expected.items():
        assert torch.equal(network.state_dict()[name], tensor)
