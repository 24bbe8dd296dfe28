"""fcrn: every array of the authors' file loads, in torch's order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from model_zoo_defs.fcrn import FCRN, definitions, module_of
from pnpdepth_cli.models.weights import load_checkpoint
from tests.models.weights.files import npy_of, pickled

NORM = {"weight": "scale", "bias": "offset", "running_mean": "mean", "running_var": "variance"}


def authors() -> Iterator[tuple[str, str]]:
    """The convolutions of NYU_ResNet-UpProj.npy with their normalisations; either may be ""."""
    yield from (("conv1", "bn_conv1"), ("layer1", "layer1_BN"), ("ConvPred", ""))
    for stage, letters in ((2, "abc"), (3, "abcd"), (4, "abcdef"), (5, "abc")):
        yield f"res{stage}a_branch1", f"bn{stage}a_branch1"
        for place in (f"{letter}_branch2{part}" for letter in letters for part in "abc"):
            yield f"res{stage}{place}", f"bn{stage}{place}"
    for up in ("layer2x", "layer4x", "layer8x", "layer16x"):
        yield f"{up}_Conv", f"{up}_BN"
        for branch in (f"{up}_br1", f"{up}_br2"):
            yield "", f"{branch}_BN"
            yield from ((f"{branch}_Conv{letter}", "") for letter in "ABCD")


def test_the_authors_arrays_are_read_in_torchs_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    network = FCRN(4)
    expected = {
        name: torch.from_numpy(rng.normal(size=tensor.shape).astype(np.float32))
        for name, tensor in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    arrays: dict[str, dict[str, np.ndarray]] = {}
    for conv, norm in authors():
        if conv:  # rows, columns, channels in and out
            kernel = expected[f"{module_of(conv)}.weight"].permute(2, 3, 1, 0)
            arrays[conv] = {"weights": kernel.numpy()}
            if f"{module_of(conv)}.bias" in expected:
                arrays[conv]["biases"] = expected[f"{module_of(conv)}.bias"].numpy()
        if norm:
            own = module_of(norm)
            arrays[norm] = {kind: expected[f"{own}.{n}"].numpy() for n, kind in NORM.items()}
    definition = replace(definitions["fcrn"], build=lambda: FCRN(4))
    load_checkpoint(network, definition, npy_of(tmp_path / "x.npy", pickled(arrays, 2)))
    for name, tensor in expected.items():
        assert torch.equal(network.state_dict()[name], tensor)
