"""Hugging Face folders, saved by save_pretrained with random weights, load, list and refine."""

from __future__ import annotations

import json
import os
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
from pnpdepth_cli.models.definition import Fixed, Near
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.hugging_face import hf_definition
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import Settings
from tests.models.weights.files import little

transformers = pytest.importorskip("transformers", reason="needs the extra [hf]")

pytestmark = pytest.mark.slow

DINO = {
    "hidden_size": 24, "num_hidden_layers": 4, "num_attention_heads": 2, "image_size": 56,
    "patch_size": 14, "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False,
    "apply_layernorm": True,
}  # fmt: skip
NECK = {"neck_hidden_sizes": [8, 8, 16, 16], "fusion_hidden_size": 8}


def depth_anything(kind: str = "relative") -> Any:
    config = transformers.DepthAnythingConfig(
        backbone_config=transformers.Dinov2Config(**DINO), reassemble_hidden_size=24,
        head_hidden_size=8, depth_estimation_type=kind, max_depth=20, patch_size=14, **NECK,
    )  # fmt: skip
    return transformers.DepthAnythingForDepthEstimation(config)


def prompt_depth_anything() -> Any:
    config = transformers.PromptDepthAnythingConfig(
        backbone_config=transformers.Dinov2Config(**DINO), reassemble_hidden_size=24,
        head_hidden_size=8, depth_estimation_type="metric", max_depth=20, patch_size=14, **NECK,
    )  # fmt: skip
    return lively(transformers.PromptDepthAnythingForDepthEstimation(config), 0.1)


def lively(network: Any, deviation: float = 0.3) -> Any:
    """As initialised, the output does not depend on the image."""
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.ndim > 1:
                parameter.normal_(std=deviation)
    return network


def dpt() -> Any:
    config = transformers.DPTConfig(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32,
        image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3], **NECK,
    )  # fmt: skip
    return transformers.DPTForDepthEstimation(config)


def zoedepth() -> Any:
    backbone = transformers.BeitConfig(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, intermediate_size=32,
        image_size=64, patch_size=16, out_indices=[1, 2, 3, 4], reshape_hidden_states=False,
        use_relative_position_bias=True,
    )  # fmt: skip
    config = transformers.ZoeDepthConfig(
        backbone_config=backbone, backbone_hidden_size=24, bottleneck_features=8,
        num_attractors=[4, 2, 2, 2], bin_embedding_dim=8, num_relative_features=8,
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10, "name": "nyu"}],
        **NECK,
    )  # fmt: skip
    return lively(transformers.ZoeDepthForDepthEstimation(config))


def glpn() -> Any:
    config = transformers.GLPNConfig(
        depths=[1, 1, 1, 1], hidden_sizes=[8, 8, 16, 16], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )  # fmt: skip
    return transformers.GLPNForDepthEstimation(config)


def depth_pro() -> Any:
    dino = {"hidden_size": 24, "num_hidden_layers": 4, "num_attention_heads": 2, "patch_size": 8,
            "image_size": 32}  # fmt: skip
    config = transformers.DepthProConfig(
        patch_size=32, fusion_hidden_size=8, intermediate_hook_ids=[2, 1],
        intermediate_feature_dims=[8, 8], scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.25], scaled_images_feature_dims=[8, 8],
        use_fov_model=False,
        image_model_config=transformers.Dinov2Config(**dino),
        patch_model_config=transformers.Dinov2Config(**dino),
        fov_model_config=transformers.Dinov2Config(**dino),
    )  # fmt: skip
    return transformers.DepthProForDepthEstimation(config)


IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HALF = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
ASPECT = {"keep_aspect_ratio": True, "do_resize": True}
NETWORKS: dict[str, tuple[Any, dict[str, Any], tuple[str, str]]] = {
    "depth_anything": (
        depth_anything,
        {**IMAGENET, **ASPECT, "size": {"height": 56, "width": 56}, "ensure_multiple_of": 14},
        ("inverse", "affine"),
    ),
    "prompt_depth_anything": (
        prompt_depth_anything,
        {**IMAGENET, **ASPECT, "size": {"height": 56, "width": 56}, "ensure_multiple_of": 14},
        ("depth", "metric"),
    ),
    "dpt": (dpt, {**HALF, "size": {"height": 64, "width": 64}}, ("unknown", "affine")),
    "zoedepth": (
        zoedepth,
        {**HALF, **ASPECT, "size": {"height": 64, "width": 96}, "ensure_multiple_of": 32},
        ("depth", "metric"),
    ),
    "glpn": (glpn, {"size_divisor": 32, "do_rescale": True}, ("depth", "metric")),
    "depth_pro": (depth_pro, {**HALF, "size": {"height": 64, "width": 64}}, ("inverse", "scale")),
}


def saved(folder: Path, name: str) -> Path:
    make, processing, _ = NETWORKS[name]
    torch.manual_seed(0)
    make().save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processing))
    return folder


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a network connection is tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize("name", NETWORKS)
def test_a_folder_loads_lists_layers_and_refines_without_network_access(
    tmp_path: Path, name: str
) -> None:
    network = load_network(str(saved(tmp_path / name, name)), None)
    definition = network.definition
    assert (definition.output_kind, definition.output_scale) == NETWORKS[name][2]
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
        settings = Settings(iterations=4, lr="30%", update="adam")
        result = refine(split, arguments, at, settings, depth_of=depth_of)
    assert not torch.equal(result.before, result.after)
    assert min(result.losses[1:]) < result.losses[0]
    assert bool((result.after > 0).all())


def test_prompt_depth_anything_receives_the_points_as_coarse_dense_depth(tmp_path: Path) -> None:
    definition = hf_definition(saved(tmp_path / "p", "prompt_depth_anything"))
    assert definition.input_kind == "rgb+sparse"
    sparse = torch.zeros(1, 1, 384, 512)  # twice the prompt's size: a plane that rises to the right
    for row, column in ((0, 0), (0, 511), (383, 0), (383, 511), (100, 300)):
        sparse[0, 0, row, column] = 1 + column / 511
    _, prompt = definition.call_arguments(torch.rand(1, 3, 384, 512), sparse)
    assert prompt.shape == (1, 1, 192, 256)
    rising = 1 + (2 * torch.arange(256) + 0.5) / 511
    assert torch.allclose(prompt[0, 0, 1:-1, 1:-1], rising[1:-1].expand(190, -1), atol=1e-3)


def changed(folder: Path, name: str, change: dict[str, Any]) -> Path:
    settings = json.loads((folder / name).read_text())
    (folder / name).write_text(json.dumps(settings | change))
    return folder


def test_the_folder_says_what_the_numbers_mean_and_how_the_image_is_resized(tmp_path: Path) -> None:
    folder = saved(tmp_path / "a", "depth_anything")
    assert hf_definition(folder).size == Near(of=14, height=56, width=56)
    definition = hf_definition(changed(folder, "config.json", {"depth_estimation_type": "metric"}))
    assert (definition.output_kind, definition.default_alignment) == ("depth", "none")
    assert hf_definition(saved(tmp_path / "d", "dpt")).size == Fixed(64, 64)
    folder = saved(tmp_path / "z", "zoedepth")
    changed(folder, "preprocessor_config.json", {"ensure_multiple_of": 1 / 32})  # of the image
    assert hf_definition(folder).size == Near(of=32, height=64, width=96)
    assert FrameMap.fit(Near(of=14, height=518, width=518), 480, 640).network == (518, 686)
    assert FrameMap.fit(Near(of=32), 375, 1242).network == (384, 1248)
    assert FrameMap.fit(Near(of=14, height=518, width=518), 5, 9).network == (294, 518)


@pytest.mark.parametrize(
    ("name", "size", "mean"),
    [
        ("depth_anything", Near(of=14, height=518, width=518), 0.485),
        ("prompt_depth_anything", Near(of=14, height=756, width=756), 0.485),
        ("dpt", Fixed(384, 384), 0.5),
        ("zoedepth", Near(of=32, height=384, width=512), 0.5),
        ("glpn", Near(of=32), 0.0),
        ("depth_pro", Fixed(1536, 1536), 0.5),
    ],
)
def test_a_folder_as_transformers_saves_it_is_prepared_as_usual_for_its_type(
    name: str, size: Fixed | Near, mean: float, tmp_path: Path
) -> None:
    folder = saved(tmp_path / "net", name)
    (folder / "preprocessor_config.json").unlink()
    definition = hf_definition(folder)
    assert definition.size == size
    assert definition.normalisation is not None
    assert definition.normalisation.mean[0] == mean
    assert f"no preprocessor_config.json; assumed, as usual for {name}" in definition.assumed


# ------------------------------------------------------------------ what is refused


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(tmp_path_factory.mktemp("original") / "net", "glpn")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A folder of a GLPN."""
    return Path(shutil.copytree(original, tmp_path / "net"))


def test_incomplete_folders_are_refused_with_a_remedy(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(CheckpointError, match=r"pnpdepth models convert .*pytorch_model\.bin"):
        hf_definition(folder)
    (folder / "pytorch_model.bin").unlink()
    with pytest.raises(CheckpointError, match="no model"):
        hf_definition(folder)
    for text, message in (
        ('{"model_type": "bert"}', "'bert' are not known"),
        ("{", "is not JSON"),
        ('{"a":' + "[" * 100_000 + "]" * 100_000 + "}", "is not JSON"),
    ):
        (folder / "config.json").write_text(text)
        with pytest.raises(ModelError, match=message):
            hf_definition(folder)
    (folder / "config.json").unlink()
    with pytest.raises(ModelError, match=r"config\.json is missing"):
        hf_definition(folder)


@pytest.mark.parametrize(
    "name",
    [
        "../original.safetensors",
        "/dev/zero",
        "/etc/passwd",
        5,
        "pytorch_model.bin",
        "pipe.safetensors",
    ],
)
def test_an_index_names_files_of_its_folder_only(name: object, folder: Path) -> None:
    shutil.copy(folder / "model.safetensors", folder.parent / "original.safetensors")
    (folder / "model.safetensors").rename(folder / "part.safetensors")
    (folder / "pytorch_model.bin").write_bytes(b"x")
    os.mkfifo(folder / "pipe.safetensors")
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "part.safetensors"}}))
    assert hf_definition(folder).checkpoint == index
    index.write_text(json.dumps({"weight_map": {"a": "part.safetensors", "b": name}}))
    with pytest.raises(CheckpointError, match="is no safetensors file beside it"):
        hf_definition(folder)


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


def test_plain_attention_is_taken(folder: Path) -> None:
    assert hf_definition(changed(folder, "config.json", {"attn_implementation": "sdpa"}))


@pytest.mark.parametrize(
    "change",
    [
        {"size_divisor": "x"},
        {"size_divisor": [32]},
        {"size_divisor": 10**12},
        {"rescale_factor": None},
        {"rescale_factor": 0},
        {"rescale_factor": 10**400},
        {"do_normalize": True, "image_mean": {"r": 1}},
        {"do_normalize": True, "image_std": [10**400] * 3},
        {"size": [1, 2]},
        {"size": {"height": "x", "width": 3}},
        {"size": 10**9},
    ],
)
def test_settings_that_are_no_numbers_are_refused_in_one_line(
    change: dict[str, Any], folder: Path
) -> None:
    (folder / "preprocessor_config.json").write_text(json.dumps({"size_divisor": 32} | change))
    if "size" in change:
        (folder / "preprocessor_config.json").write_text(json.dumps(change))
    with pytest.raises(ModelError, match=r"preprocessor_config\.json: ") as error:
        hf_definition(folder)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


def test_code_in_a_folder_is_never_run(folder: Path, tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    (folder / "code.py").write_text(f"open({str(marker)!r}, 'w')")
    code = {"AutoModelForDepthEstimation": "code.Net", "AutoConfig": "code.Config"}
    load_network(str(changed(folder, "config.json", {"auto_map": code})), None)
    assert not marker.exists()
