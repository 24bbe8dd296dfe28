"""Checkpoints in every format, and networks that are not Python files."""

from __future__ import annotations

import contextlib
import warnings
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import nn

from tests.fuzz.seeds.seed import HEIGHT, WIDTH, Seed
from tests.models.weights.test_tensor_bundle import written

_ANY_WEIGHTS = """
import torch
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="any-weights",
    input_kind="rgb",
    size=Multiple(1),
    build=lambda: nn.Conv2d(3, 1, 1, bias=False),
    read_checkpoint=lambda stored: {"weight": torch.ones(1, 3, 1, 1)},
)
"""
"""A network that every checkpoint fits."""


def write_seeds(folder: Path, depth: np.ndarray, rng: np.random.Generator) -> list[Seed]:
    """Returns checkpoints, and networks of the formats whose packages are installed."""
    return [*_checkpoints(folder, rng), *_networks(folder), *_hugging_face(folder)]


def _checkpoints(folder: Path, rng: np.random.Generator) -> list[Seed]:
    tensors = {"a.weight": rng.normal(size=(4, 3)).astype(np.float32), "a.bias": np.zeros(4)}
    save_file(tensors, str(folder / "net.safetensors"))
    state = {name: torch.from_numpy(value) for name, value in tensors.items()}
    torch.save({"state_dict": state, "epoch": 3}, folder / "net.pt")
    torch.save(state, folder / "old.pth", _use_new_zipfile_serialization=False)
    np.savez(folder / "net.npz", **tensors)
    np.save(folder / "net.npy", np.array(tensors, dtype=object), allow_pickle=True)
    names = ["net.safetensors", "net.pt", "old.pth", "net.npz", "net.npy", written(folder).name]
    (folder / "any_weights.py").write_text(_ANY_WEIGHTS)
    return [
        Seed(file=name, command=("models", "check", "any_weights.py", "--checkpoint", name))
        for name in names
    ]


def _networks(folder: Path) -> list[Seed]:
    _write_exported(folder / "net.pt2")
    names = ["net.pt2"]
    with contextlib.suppress(ImportError):  # the extra is not installed
        from tests.models.onnx.onnx_files import write_network

        names.append(write_network(folder / "net.onnx", shape=(1, 3, HEIGHT, WIDTH)).name)
    return [Seed(file=name, command=("models", "check", name)) for name in names]


def _write_exported(path: Path) -> None:
    network = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(), nn.Conv2d(4, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(network.eval(), (torch.rand(1, 3, HEIGHT, WIDTH),))
        torch.export.save(program, path)


def _hugging_face(folder: Path) -> list[Seed]:
    try:
        import transformers
    except ImportError:  # the extra is not installed
        return []
    config = transformers.GLPNConfig(
        depths=[1, 1, 1, 1], hidden_sizes=[8, 8, 16, 16], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )  # fmt: skip
    transformers.GLPNForDepthEstimation(config).save_pretrained(folder / "glpn")
    processing = '{"size_divisor": 32, "do_rescale": true}\n'
    (folder / "glpn/preprocessor_config.json").write_text(processing)
    return [
        Seed(file=f"glpn/{name}", command=("models", "check", "glpn"))
        for name in ("config.json", "preprocessor_config.json", "model.safetensors")
    ]
