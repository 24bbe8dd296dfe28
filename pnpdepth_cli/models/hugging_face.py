"""A local Hugging Face folder as a definition: config.json, preprocessor_config.json, safetensors.

Needs `pip install pnpdepth[hf]`. The network is a class of transformers, with code from that
package only; nothing is downloaded. The image is resized and normalised as preprocessor_config.json
says, or as networks of the type usually are, by this program's own code.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from pnpdepth_cli.budget import check_claim
from pnpdepth_cli.choices import OutputKind, OutputScale
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.definition import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    UNTUNED_DEFAULTS,
    Fixed,
    ModelDefinition,
    Near,
    Normalisation,
)
from pnpdepth_cli.points import SparsePoints

_MOST_JSON_BYTES = 1 << 24
_WEIGHTS = ("model.safetensors", "model.safetensors.index.json")
_PICKLED = ("pytorch_model.bin", "pytorch_model.bin.index.json")

_MAX_SIDE = 1 << 16  # pixels
_LARGEST_NUMBER = 1e6  # in a config.json; no network has more of any part
_PLAIN_ATTENTION = ("eager", "sdpa")
_IMAGENET = {"image_mean": IMAGENET_MEAN, "image_std": IMAGENET_STD}


@dataclass(frozen=True)
class _Family:
    """What the networks of one model type predict, and how their image is prepared.

    of: what sides of images are multiples of. size, keeps_aspect, statistics: as transformers
    prepares the image by default.
    """

    kind: OutputKind
    scale: OutputScale
    of: int = 1
    size: tuple[int, int] | None = None
    keeps_aspect: bool = True
    statistics: Mapping[str, Any] = field(default_factory=dict)

    def processing(self) -> Mapping[str, Any]:
        """Returns the settings that a preprocessor_config.json would have."""
        if self.size is None:
            return {"size_divisor": self.of}
        size = dict(zip(("height", "width"), self.size, strict=True))
        return {
            "size": size,
            "keep_aspect_ratio": self.keeps_aspect,
            "do_normalize": True,
            **self.statistics,
        }


PROMPT_SIZE = (192, 256)
"""Rows and columns of the depth that Prompt Depth Anything was trained with, a phone's LiDAR."""

_FAMILIES = {
    "depth_anything": _Family("inverse", "affine", 14, (518, 518), statistics=_IMAGENET),
    "prompt_depth_anything": _Family("depth", "metric", 14, (756, 756), statistics=_IMAGENET),
    # Intel's DPT give inverse depth, Meta's on DINOv2 give depth; their configurations do not say.
    "dpt": _Family("unknown", "affine", 16, (384, 384), keeps_aspect=False),
    "zoedepth": _Family("depth", "metric", 32, (384, 512)),
    "glpn": _Family("depth", "metric", 32),
    # Inverse depth for a canonical camera: a factor away from metres.
    "depth_pro": _Family("inverse", "scale", size=(1536, 1536), keeps_aspect=False),
}


def hf_definition(folder: Path) -> ModelDefinition:
    """Returns the definition of a depth network in a Hugging Face folder.

    Args:
        folder: Folder with config.json and model.safetensors, and preprocessor_config.json if it
            was saved.

    Raises:
        ModelError: A file is missing or wrong, or the type of network is not known.
        CheckpointError: Its weights are missing, or are pickles.
    """
    # The type of network, which must be known.
    config = _json(folder / "config.json", "it says which network this is")
    kind = config.get("model_type")
    if not isinstance(kind, str) or kind not in _FAMILIES:
        raise ModelError(
            f"{folder}: networks of type {str(kind)[:60]!r} are not known; known:"
            f" {', '.join(_FAMILIES)}"
        )
    _check_settings(config, folder / "config.json")
    # What its numbers are.
    family, assumed = _FAMILIES[kind], ""
    if config.get("depth_estimation_type") == "metric":
        family = replace(family, kind="depth", scale="metric")
    # How images are prepared, as stated or as usual for the type.
    if (folder / "preprocessor_config.json").is_file():
        processing = _json(folder / "preprocessor_config.json", "it says how images are prepared")
    else:
        processing = family.processing()
        size = "×".join(map(str, family.size or ("its own",)))
        mean = "ImageNet's mean and deviation" if family.statistics else "rgb in −1…1"
        assumed = (
            f"{folder.name} has no preprocessor_config.json; assumed, as usual for {kind}: size"
            f" {size}, {mean if family.size else 'rgb in 0…1'}"
        )
    # The definition, whose network is built when it is needed.
    weights, prompted = _weights(folder), kind == "prompt_depth_anything"
    return ModelDefinition(
        name=folder.resolve().name,
        summary=f"Hugging Face {kind}",
        input_kind="rgb+sparse" if prompted else "rgb",
        size=_size(processing, family.of, folder),
        normalisation=_normalisation(processing, folder),
        output_kind=family.kind,
        output_scale=family.scale,
        build=lambda: _build(folder),
        complete=True,
        checkpoint=weights,
        arguments=_with_prompt if prompted else None,
        output=lambda output: output.predicted_depth,
        defaults=UNTUNED_DEFAULTS,
        assumed=assumed,
    )


def _check_settings(config: Mapping[str, Any], file: Path) -> None:
    """ModelError for a huge number, or an attention that transformers may fetch and run."""
    pending: list[Any] = [config]
    while pending:
        value = pending.pop()
        if isinstance(value, int | float) and not abs(value) <= _LARGEST_NUMBER:
            raise ModelError(f"{file}: {str(value)[:20]} is larger than any part of a network")
        for key, setting in value.items() if isinstance(value, Mapping) else ():
            names = setting.values() if isinstance(setting, Mapping) else (setting,)
            for name in names if "attn_implementation" in key else ():
                if isinstance(name, str) and name not in _PLAIN_ATTENTION:
                    raise ModelError(
                        f"{file}: {key} {name[:60]!r} may fetch and run code; only"
                        f" {' and '.join(_PLAIN_ATTENTION)} are taken, remove the entry"
                    )
            pending.append(setting)
        pending += value if isinstance(value, list) else []


def _with_prompt(rgb: Tensor | None, sparse: Tensor | None) -> tuple[Tensor, ...]:
    """The image and coarse dense depth (1, 1, 192, 256), interpolated linearly from the points."""
    assert rgb is not None
    assert sparse is not None
    rows, columns = torch.nonzero(sparse[0, 0], as_tuple=True)
    points = SparsePoints(
        xy=torch.stack([columns, rows], dim=1).float(),
        depth=sparse[0, 0, rows, columns],
        size=(sparse.shape[-2], sparse.shape[-1]),
    )
    return rgb, linear(points.resized(*PROMPT_SIZE))[None, None].to(sparse)


def _json(file: Path, why: str) -> Mapping[str, Any]:
    if not file.is_file():
        raise ModelError(
            f"{file.parent} is not a Hugging Face folder: {file.name} is missing, and {why};"
            " take it from the network's page"
        )
    size = file.stat().st_size
    check_claim(f"{file} has {size:,} bytes", size, _MOST_JSON_BYTES, error=ModelError)
    try:
        settings = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{file} is not JSON: {describe(error)[:160]}") from None
    if not isinstance(settings, dict):
        raise ModelError(f"{file} holds no settings")
    return settings


def _weights(folder: Path) -> Path:
    single, index = (folder / name for name in _WEIGHTS)
    if single.is_file():
        return single
    if index.is_file():
        parts = _json(index, "it names the files of weights").get("weight_map")
        for name in parts.values() if isinstance(parts, Mapping) else [parts]:
            file = folder / str(name)
            if file.parent != folder or file.suffix != single.suffix or not file.is_file():
                raise CheckpointError(f"{index}: {file} is no safetensors file beside it")
        return index
    if any((folder / name).is_file() for name in _PICKLED):
        raise CheckpointError(
            f"{folder} has its weights as a pickle only; have transformers load it and write"
            f" {_WEIGHTS[0]} by save_pretrained"
        )
    raise CheckpointError(f"{folder} has no {_WEIGHTS[0]}")


def _size(processing: Mapping[str, Any], of: int, folder: Path) -> Fixed | Near:
    if not processing.get("do_resize", True) or "size_divisor" in processing:
        return Near(of=max(of, _side(processing, "size_divisor", folder)))
    size = processing.get("size")
    if isinstance(size, Mapping):
        height = size.get("height") or size.get("shortest_edge")
        width = size.get("width") or size.get("shortest_edge")
    else:
        height = width = size
    if not all(isinstance(side, int) and 1 <= side <= _MAX_SIDE for side in (height, width)):
        raise _wrong(folder, f"size must be a height and a width, got {str(size)[:60]}")
    assert isinstance(height, int)
    assert isinstance(width, int)
    if not processing.get("keep_aspect_ratio", False):
        return Fixed(height, width)
    return Near(
        of=max(of, _side(processing, "ensure_multiple_of", folder)), height=height, width=width
    )


def _side(processing: Mapping[str, Any], key: str, folder: Path) -> int:
    """A number of pixels; 1 if there is none."""
    value = processing.get(key) or 1
    if isinstance(value, float) and 1 / _MAX_SIDE <= value < 1:  # as ZoeDepth's folders have 1/32
        value = round(1 / value)
    if not isinstance(value, int) or not 1 <= value <= _MAX_SIDE:
        raise _wrong(folder, f"{key} must be a number of pixels, got {str(value)[:60]!r}")
    return value


def _normalisation(processing: Mapping[str, Any], folder: Path) -> Normalisation:
    # An image that is not rescaled is in 0…255: a standard deviation of 1/255 does the same.
    factor = processing.get("rescale_factor", 1 / 255)
    mean, std = processing.get("image_mean", (0.5,) * 3), processing.get("image_std", (0.5,) * 3)
    try:
        unit = float(factor) * 255 if processing.get("do_rescale", True) else 255.0
        if not processing.get("do_normalize", "image_mean" in processing):
            return Normalisation(std=(1 / unit, 1 / unit, 1 / unit))
        (m0, m1, m2), (s0, s1, s2) = mean, std
        return Normalisation(
            mean=(m0 / unit, m1 / unit, m2 / unit), std=(s0 / unit, s1 / unit, s2 / unit)
        )
    except (TypeError, ValueError, ArithmeticError, ModelError):
        raise _wrong(
            folder,
            f"rescale_factor {str(factor)[:60]}, image_mean {str(mean)[:60]} and image_std"
            f" {str(std)[:60]} are not a number and three numbers each, the first and last above 0",
        ) from None


def _wrong(folder: Path, fact: str) -> ModelError:
    return ModelError(f"{folder / 'preprocessor_config.json'}: {fact}")


def _build(folder: Path) -> nn.Module:
    # Read when huggingface_hub is imported; a folder may name a backbone that is looked for online.
    os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        import transformers
    except ImportError as error:
        raise ModelError(
            f"{folder} is a Hugging Face folder, which needs the package {error.name!r}:"
            " pip install 'pnpdepth[hf]'"
        ) from None
    # transformers says nothing of its own.
    logging: Any = transformers.utils.logging
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        # The network must not be larger than its weights, which are read last.
        config = transformers.AutoConfig.from_pretrained(str(folder), local_files_only=True)
        with _fewer_parameters_than_bytes(folder), torch.device("meta"):
            networks: Any = transformers.AutoModelForDepthEstimation
            networks.from_config(config)
        module, info = transformers.AutoModelForDepthEstimation.from_pretrained(
            str(folder),
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            output_loading_info=True,
        )
    except (OSError, ValueError, LookupError, TypeError, RuntimeError, ImportError) as error:
        raise ModelError(f"{folder}: transformers cannot load it: {describe(error)}") from None
    # Every weight must have been there.
    missing = [*info["missing_keys"], *(str(key) for key in info["mismatched_keys"])]
    if missing:
        raise CheckpointError(
            f"{folder}: its weights leave {len(missing)} of the network's out or of another shape"
            f" ({', '.join(sorted(missing)[:4])})"
        )
    network: nn.Module = module.float()
    return network


@contextmanager
def _fewer_parameters_than_bytes(folder: Path) -> Iterator[None]:
    """Inside, a network of more parameters than its weights have bytes raises ModelError."""
    left = sum(file.stat().st_size for file in folder.glob("*.safetensors"))

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal left
        left -= 0 if parameter is None else max(1, parameter.numel())
        if left < 0:
            raise ModelError(f"{folder}: config.json describes a larger network than its weights")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()
