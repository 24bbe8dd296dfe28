"""Hugging Face folders: what their settings say, and how they load and refine."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pnpdepth_cli.core.refine_z import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.aligned_depth import AlignedDepth
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Near, Normalisation
from pnpdepth_cli.models.frame_map import FrameMap, synthetic_frame
from pnpdepth_cli.models.hugging_face import hf_definition
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import ClosedSettings
from tests.models.weights.files import little

transformers = pytest.importorskip("transformers", reason="needs the extra [hf]")

HALF = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
ASPECT = {"keep_aspect_ratio": True, "do_resize": True}
PROCESSING: dict[str, dict[str, Any]] = {
    "depth_anything": {**HALF, **ASPECT, "size": 56, "ensure_multiple_of": 14},
    "dpt": {**HALF, "size": {"height": 64, "width": 64}},
    "zoedepth": {**HALF, **ASPECT, "size": {"height": 64, "width": 96}, "ensure_multiple_of": 32},
    "glpn": {"size_divisor": 32, "do_rescale": True},
    "depth_pro": {**HALF, "size": {"height": 64, "width": 64}},
}
"""A preprocessor_config.json by the type of the network."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder without weights, which are read when the network is built."""
    (tmp_path / "config.json").write_text('{"model_type": "glpn"}')
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(PROCESSING["glpn"]))
    (tmp_path / "model.safetensors").touch()
    return tmp_path


def prepared(folder: Path, processing: dict[str, Any]) -> ModelDefinition:
    (folder / "preprocessor_config.json").write_text(json.dumps(processing))
    return hf_definition(folder)


def changed(folder: Path, change: dict[str, Any]) -> Path:
    """The folder with settings of its config.json replaced."""
    settings = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(settings | change))
    return folder


def test_a_folder_says_what_the_numbers_mean(folder: Path) -> None:
    relative = hf_definition(changed(folder, {"model_type": "depth_anything"}))
    assert (relative.output_kind, relative.default_alignment) == ("inverse", "auto")
    metric = hf_definition(changed(folder, {"depth_estimation_type": "metric"}))
    assert (metric.output_kind, metric.default_alignment) == ("depth", "none")


def normalised(mean: float, std: float) -> Normalisation:
    return Normalisation(mean=(mean, mean, mean), std=(std, std, std))


@pytest.mark.parametrize(
    ("processing", "expected"),
    [
        ({"size": {"shortest_edge": 30}}, Fixed(30, 30)),
        ({**ASPECT, "size": 9, "ensure_multiple_of": 1 / 64}, Near(of=64, height=9, width=9)),
        ({"do_resize": False, "size": 56}, Near(of=32)),
        ({"size_divisor": 1 << 16}, Near(of=1 << 16)),
        ({"size": 9, "do_normalize": True, "rescale_factor": 1 / 127.5}, normalised(0.25, 0.25)),
        ({"size": 9, "do_normalize": False, "rescale_factor": 2 / 255}, normalised(0.0, 0.5)),
        ({"size": 9, "image_mean": [51] * 3, "do_rescale": False}, normalised(0.2, 0.5 / 255)),
    ],
)
def test_preprocessing_is_read(processing: dict[str, Any], expected: object, folder: Path) -> None:
    definition = prepared(folder, processing)
    assert expected in (definition.size, definition.normalisation)


def test_incomplete_folders_are_refused_with_a_remedy(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(ModelError, match="save_pretrained"):
        hf_definition(folder)
    (folder / "preprocessor_config.json").unlink()
    with pytest.raises(ModelError, match=r"preprocessor_config\.json"):
        hf_definition(folder)
    nested = '{"a":' + "[" * 100_000 + "]" * 100_000 + "}"
    for text in ('{"model_type": "bert"}', "{", "[]", nested):
        (folder / "config.json").write_text(text)
        with pytest.raises(ModelError, match=str(folder)):
            hf_definition(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"size_divisor": "x"},
        {"size_divisor": (1 << 16) + 1},
        {"rescale_factor": 0},
        {"do_normalize": True, "image_std": [10**400] * 3},
        {"size": {"height": "x", "width": 3}},
    ],
)
def test_settings_that_are_no_numbers_are_refused(change: dict[str, Any], folder: Path) -> None:
    with pytest.raises(ModelError, match=r"\A.*preprocessor_config\.json: .*\Z"):
        prepared(folder, change)


NECK = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8}
VIT = {"hidden_size": 24, "num_hidden_layers": 4, "num_attention_heads": 2}
STAGES = {"out_indices": [1, 2, 3, 4], "reshape_hidden_states": False}
SMALL_DINO = {"model_type": "dinov2", **VIT, "patch_size": 8, "image_size": 32}
CONFIGS: dict[str, dict[str, Any]] = {
    "depth_anything": {
        "backbone_config": {
            "model_type": "dinov2", **VIT, **STAGES, "image_size": 56, "patch_size": 14,
            "apply_layernorm": True,
        },
        "reassemble_hidden_size": 24, "head_hidden_size": 8, "patch_size": 14, **NECK,
    },
    "dpt": {
        **VIT, "intermediate_size": 32, "image_size": 64, "patch_size": 16,
        "backbone_out_indices": [0, 1, 2, 3], **NECK,
    },
    "zoedepth": {
        "backbone_config": {
            "model_type": "beit", **VIT, **STAGES, "intermediate_size": 32, "image_size": 64,
            "patch_size": 16, "use_relative_position_bias": True,
        },
        "backbone_hidden_size": 24, "bottleneck_features": 8, "num_attractors": [4, 2, 2, 2],
        "bin_embedding_dim": 8, "num_relative_features": 8, **NECK,
        "bin_configurations": [{"n_bins": 8, "min_depth": 1e-3, "max_depth": 10, "name": "nyu"}],
    },
    "glpn": {
        "depths": [1, 1, 1, 1], "hidden_sizes": [8, 8, 16, 16],
        "num_attention_heads": [1, 1, 2, 2], "decoder_hidden_size": 8,
    },
    "depth_pro": {
        "patch_size": 32, "fusion_hidden_size": 8, "intermediate_hook_ids": [2, 1],
        "intermediate_feature_dims": [8, 8], "scaled_images_ratios": [0.5, 1.0],
        "scaled_images_overlap_ratios": [0.0, 0.25], "scaled_images_feature_dims": [8, 8],
        "use_fov_model": False, "image_model_config": SMALL_DINO,
        "patch_model_config": SMALL_DINO, "fov_model_config": SMALL_DINO,
    },
}  # fmt: skip


def saved(folder: Path, name: str) -> Path:
    torch.manual_seed(0)
    config = transformers.AutoConfig.for_model(name, **CONFIGS[name])
    network = transformers.AutoModelForDepthEstimation.from_config(config)
    if name == "zoedepth":  # whose output, as initialised, does not depend on the image
        for parameter in network.parameters():
            if parameter.ndim > 1:
                torch.nn.init.normal_(parameter, std=0.3)
    network.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(PROCESSING[name]))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
def test_folders_refine_offline(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for owner, function in ((socket.socket, "connect"), (socket, "getaddrinfo")):
        monkeypatch.setattr(owner, function, None)  # a call raises
    folder = saved(tmp_path / name, name)
    (folder / "code.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    code = {"AutoModelForDepthEstimation": "code.Net", "AutoConfig": "code.Config"}
    network = load_network(str(changed(folder, {"auto_map": code})), None)
    assert not (tmp_path / "ran").exists()
    definition = network.definition
    frame = FrameMap.fit(definition.size, 60, 90)
    _, points, _ = synthetic_frame(frame.image)
    at = frame.points_to_network(points)
    arguments = network.synthetic_arguments(frame)
    with torch.no_grad():
        whole = network.raw_of(network.module(*arguments))
    metric = definition.output_scale == "metric"
    if not metric:  # points that random weights agree with, but for a tenth of the depth
        output = at.sample(whole)
        nearness = ((output - output.mean()) / output.std()).clamp(-3, 3)
        noise = torch.randn(len(at), generator=torch.Generator().manual_seed(0))
        at = replace(at, depth=(0.1 * noise).exp() / (1 + 0.2 * nearness))
    depth_of = AlignedDepth(network, at, "none" if metric else "affine")
    with Split(network.module, definition.layers[0]) as split:
        with torch.no_grad():
            assert torch.equal(network.raw_of(split.rear(split.front(*arguments))), whole)
        settings = ClosedSettings(iterations=4, lr="30%", update="adam")
        result = refine(split, arguments, at, settings, depth_of=depth_of)
    assert not torch.equal(result.before, result.after)
    assert min(result.losses[1:]) < result.losses[0]
    assert bool((result.after > 0).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depths": [1_000_000_000, 1, 1, 1]}, "1000000000 is larger than any part of a network"),
        ({"depths": [90_000, 1, 1, 1]}, "describes a larger network than its weights"),
        ({"hidden_sizes": [8, 8, 16, 1_000_000]}, "describes a larger network than its weights"),
        ({"decoder_hidden_size": 4}, "raises|its weights leave"),
        ({"_attn_implementation": "org/kernel"}, "may fetch and run code"),
        ({"x": {"attn_implementation": {"backbone": "org/kernel"}}}, "may fetch and run code"),
    ],
)
def test_a_harmful_folder_is_refused(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    folder = changed(saved(tmp_path / "net", "glpn"), change)
    with little(megabytes=900, seconds=30), pytest.raises(ModelError, match=message):
        load_network(str(folder), None)
