"""Hugging Face folders, saved by save_pretrained with random weights, load, list and refine."""

from __future__ import annotations

import json
import shutil
import socket
from pathlib import Path
from typing import Any

import pytest
import torch

from pnpdepth_cli.core.refine import refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.models.test_hugging_face_settings import PROCESSING, changed
from tests.models.weights.files import little

transformers = pytest.importorskip("transformers", reason="needs the extra [hf]")

pytestmark = pytest.mark.slow

NECK = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8}
VIT = {"hidden_size": 24, "num_hidden_layers": 4, "num_attention_heads": 2}
STAGES = {"out_indices": [1, 2, 3, 4], "reshape_hidden_states": False}


def depth_anything() -> Any:
    dino = transformers.Dinov2Config(
        **VIT, **STAGES, image_size=56, patch_size=14, apply_layernorm=True
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=dino, reassemble_hidden_size=24, head_hidden_size=8, patch_size=14, **NECK
    )
    return transformers.DepthAnythingForDepthEstimation(config)


def dpt() -> Any:
    config = transformers.DPTConfig(
        **VIT, intermediate_size=32, image_size=64, patch_size=16,
        backbone_out_indices=[0, 1, 2, 3], **NECK,
    )  # fmt: skip
    return transformers.DPTForDepthEstimation(config)


def zoedepth() -> Any:
    backbone = transformers.BeitConfig(
        **VIT, **STAGES, intermediate_size=32, image_size=64, patch_size=16,
        use_relative_position_bias=True,
    )  # fmt: skip
    config = transformers.ZoeDepthConfig(
        backbone_config=backbone, backbone_hidden_size=24, bottleneck_features=8,
        num_attractors=[4, 2, 2, 2], bin_embedding_dim=8, num_relative_features=8,
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10, "name": "nyu"}],
        **NECK,
    )  # fmt: skip
    network: Any = transformers.ZoeDepthForDepthEstimation(config)
    with torch.no_grad():  # as initialised, the output does not depend on the image
        for parameter in network.parameters():
            if parameter.ndim > 1:
                parameter.normal_(std=0.3)
    return network


def glpn() -> Any:
    config = transformers.GLPNConfig(
        depths=[1, 1, 1, 1], hidden_sizes=[8, 8, 16, 16], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )  # fmt: skip
    return transformers.GLPNForDepthEstimation(config)


def depth_pro() -> Any:
    parts = ("image_model_config", "patch_model_config", "fov_model_config")
    config = transformers.DepthProConfig(
        patch_size=32, fusion_hidden_size=8, intermediate_hook_ids=[2, 1],
        intermediate_feature_dims=[8, 8], scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.25], scaled_images_feature_dims=[8, 8],
        use_fov_model=False,
        **{part: transformers.Dinov2Config(**VIT, patch_size=8, image_size=32) for part in parts},
    )  # fmt: skip
    return transformers.DepthProForDepthEstimation(config)


MAKERS = {each.__name__: each for each in (depth_anything, dpt, zoedepth, glpn, depth_pro)}


def saved(folder: Path, name: str) -> Path:
    torch.manual_seed(0)
    MAKERS[name]().save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(PROCESSING[name]))
    return folder


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a network connection is tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize("name", MAKERS)
def test_a_folder_loads_lists_layers_and_refines_without_network_access(
    tmp_path: Path, name: str
) -> None:
    network = load_network(str(saved(tmp_path / name, name)), None)
    definition = network.definition
    assert definition.layers
    frame = FrameMap.fit(definition.size, 60, 90)
    chosen = torch.randperm(60 * 90, generator=torch.Generator().manual_seed(0))[:100]
    points = SparsePoints(
        xy=torch.stack([chosen % 90, chosen // 90], dim=1).float(),
        depth=1 + 3 * (chosen // 90).float() / 60, size=(60, 90),
    )  # fmt: skip
    at = frame.points_to_network(points)
    rgb = torch.rand(1, 3, 60, 90, generator=torch.Generator().manual_seed(0))
    arguments = network.arguments_of(network.image_of(frame, rgb), at)
    with torch.no_grad():
        whole = network.raw_of(network.module(*arguments))
    metric = definition.output_scale == "metric"
    depth_of = AlignedDepth(network, at, "none" if metric else "affine")
    with Split(network.module, definition.layers[0]) as split:
        with torch.no_grad():
            assert torch.equal(network.raw_of(split.rear(split.front(*arguments))), whole)
        settings = ClosedSettings(iterations=4, lr="30%", update="adam")
        result = refine(split, arguments, at, settings, depth_of=depth_of)
    assert not torch.equal(result.before, result.after)
    assert min(result.losses[1:]) < result.losses[0]
    assert bool((result.after > 0).all())


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(tmp_path_factory.mktemp("original") / "net", "glpn")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A folder of a GLPN."""
    return Path(shutil.copytree(original, tmp_path / "net"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depths": [1_000_000_000, 1, 1, 1]}, "1000000000 is larger than any part of a network"),
        ({"depths": [90_000, 1, 1, 1]}, "describes a larger network than its weights"),
        ({"hidden_sizes": [8, 8, 16, 1_000_000]}, "describes a larger network than its weights"),
        ({"decoder_hidden_size": 4}, "transformers cannot load it|its weights leave"),
        ({"_attn_implementation": "org/kernel"}, "may fetch and run code"),
        ({"attn_implementation": {"backbone_config": "org/kernel"}}, "may fetch and run code"),
        ({"x": {"_attn_implementation_internal": "flash_attention_2"}}, "may fetch and run code"),
    ],
)
def test_a_network_larger_than_its_weights_or_of_fetched_code_is_not_built(
    change: dict[str, Any], message: str, folder: Path
) -> None:
    changed(folder, "config.json", change)
    with (
        little(megabytes=900, seconds=30),
        pytest.raises((CheckpointError, ModelError), match=message),
    ):
        load_network(str(folder), None)


def test_code_in_a_folder_is_never_run(folder: Path, tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    (folder / "code.py").write_text(f"open({str(marker)!r}, 'w')")
    code = {"AutoModelForDepthEstimation": "code.Net", "AutoConfig": "code.Config"}
    load_network(str(changed(folder, "config.json", {"auto_map": code})), None)
    assert not marker.exists()
