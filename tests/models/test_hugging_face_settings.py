"""What the settings of a Hugging Face folder say of its network, and which are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.definition import Fixed, Near
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.hugging_face import hf_definition

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HALF = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
ASPECT = {"keep_aspect_ratio": True, "do_resize": True}
SQUARE = {"height": 56, "width": 56}
PROCESSING: dict[str, dict[str, Any]] = {
    "depth_anything": {**IMAGENET, **ASPECT, "size": SQUARE, "ensure_multiple_of": 14},
    "dpt": {**HALF, "size": {"height": 64, "width": 64}},
    "zoedepth": {**HALF, **ASPECT, "size": {"height": 64, "width": 96}, "ensure_multiple_of": 32},
    "glpn": {"size_divisor": 32, "do_rescale": True},
    "depth_pro": {**HALF, "size": {"height": 64, "width": 64}},
}
"""A preprocessor_config.json by the type of the network."""


def saved(folder: Path, name: str) -> Path:
    """A folder without weights, which are read when the network is built."""
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps({"model_type": name}))
    (folder / "preprocessor_config.json").write_text(json.dumps(PROCESSING[name]))
    (folder / "model.safetensors").touch()
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return saved(tmp_path / "net", "glpn")


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
    assert FrameMap.fit(Near(of=14, height=518, width=518), 480, 640).network == (518, 686)
    assert FrameMap.fit(Near(of=32), 375, 1242).network == (384, 1248)
    assert FrameMap.fit(Near(of=14, height=518, width=518), 5, 9).network == (294, 518)


@pytest.mark.parametrize(
    ("processing", "size"),
    [
        ({"size": {"shortest_edge": 30}}, Fixed(30, 30)),
        ({"size": {"height": 1, "width": 1 << 16}}, Fixed(1, 1 << 16)),
        ({"size": 56, "keep_aspect_ratio": True}, Near(of=32, height=56, width=56)),
        ({**ASPECT, "size": 9, "ensure_multiple_of": 1 / 64}, Near(of=64, height=9, width=9)),
        ({"do_resize": False, "size": 56}, Near(of=32)),
        ({"size_divisor": 1 << 16}, Near(of=1 << 16)),
    ],
)
def test_the_size_is_fixed_or_near_one_or_a_multiple(
    processing: dict[str, Any], size: Fixed | Near, folder: Path
) -> None:
    (folder / "preprocessor_config.json").write_text(json.dumps(processing))
    assert hf_definition(folder).size == size


@pytest.mark.parametrize(
    ("processing", "mean", "std"),
    [
        ({}, 0.0, 1.0),
        ({"do_normalize": True, "rescale_factor": 1 / 127.5}, 0.25, 0.25),
        ({"image_mean": [0.25] * 3, "image_std": [0.2] * 3}, 0.25, 0.2),
        ({"image_mean": [0.25] * 3, "do_normalize": False, "rescale_factor": 2 / 255}, 0.0, 0.5),
        ({"image_mean": [51] * 3, "image_std": [102] * 3, "do_rescale": False}, 0.2, 0.4),
    ],
)
def test_normalisation_is_that_of_an_image_from_0_to_1(
    processing: dict[str, Any], mean: float, std: float, folder: Path
) -> None:
    text = json.dumps({"size_divisor": 32} | processing)
    (folder / "preprocessor_config.json").write_text(text)
    normalisation = hf_definition(folder).normalisation
    assert normalisation is not None
    assert normalisation.mean == pytest.approx((mean,) * 3)
    assert normalisation.std == pytest.approx((std,) * 3)


def test_incomplete_folders_are_refused_with_a_remedy(folder: Path) -> None:
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(CheckpointError, match="save_pretrained"):
        hf_definition(folder)
    (folder / "preprocessor_config.json").unlink()
    with pytest.raises(ModelError, match=r"preprocessor_config\.json"):
        hf_definition(folder)
    nested = '{"a":' + "[" * 100_000 + "]" * 100_000 + "}"
    for text in ('{"model_type": "bert"}', "{", "[]", nested):
        (folder / "config.json").write_text(text)
        with pytest.raises(ModelError, match=str(folder)):
            hf_definition(folder)
    (folder / "config.json").unlink()
    with pytest.raises(ModelError):
        hf_definition(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"size_divisor": "x"},
        {"rescale_factor": 0},
        {"do_normalize": True, "image_std": [10**400] * 3},
        {"size": {"height": "x", "width": 3}},
        *({"size": size} for size in (0, (1 << 16) + 1, 56.0)),
        *({"size_divisor": side} for side in (-1, (1 << 16) + 1, 1 / ((1 << 16) + 1), 1.0)),
    ],
)
def test_settings_that_are_no_numbers_are_refused_in_one_line(
    change: dict[str, Any], folder: Path
) -> None:
    settings = change if "size" in change else {"size_divisor": 32} | change
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    with pytest.raises(ModelError, match=r"preprocessor_config\.json: ") as error:
        hf_definition(folder)
    assert "\n" not in str(error.value)
