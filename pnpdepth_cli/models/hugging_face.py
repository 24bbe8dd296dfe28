"""A local Hugging Face folder as a definition: config.json, preprocessor_config.json, safetensors.

Needs `pip install pnpdepth[hf]`. The network is a class of transformers, with code from that
package only; nothing is downloaded. The image is resized and normalised as preprocessor_config.json
says, by this program's own code.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from pnpdepth_cli.budget import check_network_file
from pnpdepth_cli.choices import OutputKind, OutputScale
from pnpdepth_cli.errors import InputError, ModelError
from pnpdepth_cli.models import definition
from pnpdepth_cli.models.weights.pickle_reader import wrap_content_errors
from pnpdepth_cli.spent import spent_on

_MOST_JSON_BYTES = 1 << 24
"""Bytes of the largest JSON file that is read."""
_MAX_SIDE = 1 << 16
"""Pixels of the longest side of an image that a file may state."""
_LARGEST_NUMBER = 1e6
"""Largest number in a config.json; no network has more of any part."""
_MAX_SHOWN = 60
"""Characters of a wrong value that are shown."""
_MAX_DIGITS = 20
"""Characters of a wrong number that are shown."""
_SHOWN_NAMES = 4
"""Names of missing weights that are shown."""
_PLAIN_ATTENTION = ("eager", "sdpa")
"""Attention that is torch's own code; any other name may be that of a package to fetch."""

_Side = Annotated[int, msgspec.Meta(ge=1, le=_MAX_SIDE)]
_Multiple = _Side | Annotated[float, msgspec.Meta(ge=1 / _MAX_SIDE, lt=1)] | None
"""What sides are multiples of: pixels, or their reciprocal, as ZoeDepth's folders have 1/32."""
_Number = Annotated[float, msgspec.Meta(ge=-_LARGEST_NUMBER, le=_LARGEST_NUMBER)]
_Positive = Annotated[float, msgspec.Meta(gt=0, le=_LARGEST_NUMBER)]

_Kind = TypeVar("_Kind")


class _Processing(msgspec.Struct, frozen=True):
    """What a preprocessor_config.json says of the image."""

    do_resize: bool | None = True
    size: _Side | dict[str, _Side | None] | None = None
    keep_aspect_ratio: bool | None = False
    size_divisor: _Multiple = None
    ensure_multiple_of: _Multiple = None
    do_rescale: bool | None = True
    rescale_factor: _Positive = 1 / 255
    do_normalize: bool | None = None
    image_mean: tuple[_Number, _Number, _Number] | None = None
    image_std: tuple[_Positive, _Positive, _Positive] | None = None

    def size_policy(self, of: int) -> definition.Fixed | definition.Near | None:
        """Returns the image sizes that the network takes; None if the file does not say it.

        Args:
            of: Number that sides are multiples of, or of a larger one that the file states.
        """
        # The image's own size, but for rounding.
        if not self.do_resize or self.size_divisor is not None:
            return definition.Near(of=max(of, _pixels(self.size_divisor)))
        # A height and a width, or one length for both.
        sides = self.size if isinstance(self.size, dict) else {"shortest_edge": self.size}
        shortest_edge = sides.get("shortest_edge")
        height = sides.get("height") or shortest_edge
        width = sides.get("width") or shortest_edge
        if height is None or width is None:
            return None
        if not self.keep_aspect_ratio:
            return definition.Fixed(height, width)
        multiple = max(of, _pixels(self.ensure_multiple_of))
        return definition.Near(of=multiple, height=height, width=width)

    def normalisation(self) -> definition.Normalisation:
        """Returns the normalisation of an image in 0…1 that does what the file says of 0…255."""
        # The file's image is in 0…255 × rescale_factor: 0…white, where ours is in 0…1.
        white = self.rescale_factor * 255 if self.do_rescale else 255.0
        # Where nothing says whether, an image with a mean is normalised; 0.5 is transformers'
        # default.
        is_normalised = self.do_normalize
        if is_normalised is None:
            is_normalised = self.image_mean is not None
        mean = (0.0, 0.0, 0.0)
        std = (1.0, 1.0, 1.0)
        if is_normalised:
            mean = self.image_mean or (0.5, 0.5, 0.5)
            std = self.image_std or (0.5, 0.5, 0.5)
        return definition.Normalisation(
            mean=(mean[0] / white, mean[1] / white, mean[2] / white),
            std=(std[0] / white, std[1] / white, std[2] / white),
        )


def _pixels(side: float | None) -> int:
    """Returns a number of pixels from `_Multiple`; 1 if there is none."""
    if isinstance(side, float):
        return round(1 / side)
    return side or 1


class _Family(NamedTuple):
    """What the networks of a model type predict, and what sides of images are multiples of."""

    network: str
    """Name of the class in transformers."""
    output_kind: OutputKind
    output_scale: OutputScale
    multiple: int
    """Pixels that sides of images are multiples of."""


_FAMILIES = {
    "depth_anything": _Family("DepthAnythingForDepthEstimation", "inverse", "affine", 14),
    # Intel's DPT give inverse depth, Meta's on DINOv2 give depth; their configurations do not say.
    "dpt": _Family("DPTForDepthEstimation", "unknown", "affine", 16),
    "zoedepth": _Family("ZoeDepthForDepthEstimation", "depth", "metric", 32),
    "glpn": _Family("GLPNForDepthEstimation", "depth", "metric", 32),
    # Inverse depth for a canonical camera: a factor away from metres.
    "depth_pro": _Family("DepthProForDepthEstimation", "inverse", "scale", 1),
}
"""The families of networks, by the model type in config.json."""


def hf_definition(folder: Path) -> definition.ModelDefinition:
    """Returns the definition of a depth network in a Hugging Face folder.

    Args:
        folder: Folder with config.json, preprocessor_config.json and model.safetensors.

    Raises:
        ModelError: A file is missing or wrong, the type of network is not known, or its weights are
            missing or pickles.
    """
    # The type of network, which must be known.
    config = _read(folder / "config.json", dict[str, object])
    kind = config.get("model_type")
    if not isinstance(kind, str) or kind not in _FAMILIES:
        known = ", ".join(_FAMILIES)
        raise ModelError(f"{folder}: network type {str(kind)[:_MAX_SHOWN]!r} is not one of {known}")
    with wrap_content_errors(str(folder / "config.json")):
        _check_settings(config)
    # What its numbers are, and how images are prepared.
    family = _FAMILIES[kind]
    output_kind = family.output_kind
    output_scale = family.output_scale
    if config.get("depth_estimation_type") == "metric":
        output_kind = "depth"
        output_scale = "metric"
    file = folder / "preprocessor_config.json"
    processing = _read(file, _Processing)
    size = processing.size_policy(family.multiple)
    if size is None:
        raise ModelError(f"{file}: it says no size")
    weights = folder / "model.safetensors"
    if not weights.is_file():
        raise ModelError(
            f"{folder} has no {weights.name}; have transformers load the network and write it by"
            " save_pretrained"
        )
    # The definition, whose network is built when it is needed.
    return definition.ModelDefinition(
        name=Path(os.path.realpath(folder)).name,
        summary=f"Hugging Face {kind}",
        input_kind="rgb",
        size=size,
        normalisation=processing.normalisation(),
        output_kind=output_kind,
        output_scale=output_scale,
        build=lambda: _build(folder, kind),
        complete=True,
        checkpoint=weights,
        output=lambda output: output.predicted_depth,
        defaults=definition.UNTUNED_DEFAULTS,
    )


def _check_settings(value: object, *, is_attention: bool = False) -> None:
    """Raises InputError for a huge number, or an attention that transformers may fetch and run.

    Args:
        value: Content of config.json, or any value in it.
        is_attention: Whether a text in it names an implementation of attention.
    """
    # Written so that NaN is refused, too.
    if isinstance(value, int | float) and not abs(value) <= _LARGEST_NUMBER:
        raise InputError(f"{str(value)[:_MAX_DIGITS]} is larger than any part of a network")
    if is_attention and isinstance(value, str) and value not in _PLAIN_ATTENTION:
        raise InputError(
            f"attn_implementation {value[:_MAX_SHOWN]!r} may fetch and run code; only"
            f" {' and '.join(_PLAIN_ATTENTION)} are taken, remove the entry"
        )
    if isinstance(value, dict):
        for key, setting in value.items():
            is_of_attention = is_attention or "attn_implementation" in key
            _check_settings(setting, is_attention=is_of_attention)
    if isinstance(value, list):
        for setting in value:
            _check_settings(setting, is_attention=is_attention)


def _read(file: Path, kind: type[_Kind]) -> _Kind:
    """Returns the content of a JSON file of the folder, of the kind that msgspec makes of it.

    Raises:
        ModelError: The file is missing, too large, no JSON, or of another kind.
    """
    if not file.is_file():
        raise ModelError(
            f"{file.parent} is not a Hugging Face folder: {file.name} is missing; take it from the"
            " network's page"
        )
    check_network_file(file, "the settings", _MOST_JSON_BYTES)
    with wrap_content_errors(str(file), msgspec.ValidationError):
        return msgspec.convert(json.loads(file.read_bytes()), kind)


def _build(folder: Path, kind: str) -> nn.Module:
    """Returns the network of a folder with its weights, in float32; nothing is downloaded.

    Args:
        folder: Hugging Face folder.
        kind: Model type in its config.json, a key of `_FAMILIES`.

    Raises:
        ModelError: transformers is missing, or the weights are not those of the network.
    """
    # A folder may name a backbone that is looked for online. huggingface_hub reads the variable
    # when it is imported.
    os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        with spent_on("import"):
            from transformers import utils

            network_class = _network_class(kind)
    except ImportError as error:
        raise ModelError(
            f"reading {folder} needs {error.name}: pip install 'pnpdepth[hf]'"
        ) from None
    # transformers says nothing of its own.
    logging: Any = utils.logging
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    # The network is described without values, and must not be larger than its weights then.
    with _fewer_parameters_than_bytes(folder):
        module, info = network_class.from_pretrained(
            str(folder),
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            output_loading_info=True,
        )
    # Every weight must have been there.
    missing = [*info["missing_keys"], *(str(key) for key in info["mismatched_keys"])]
    if missing:
        raise ModelError(
            f"{folder}: its weights leave {len(missing)} of the network's out or of another shape"
            f" ({', '.join(sorted(missing)[:_SHOWN_NAMES])}); take both files from one page"
        )
    network: nn.Module = module.float()
    return network


def _network_class(kind: str) -> Any:
    """Returns the class of transformers for the depth networks of a model type."""
    module = importlib.import_module(f"transformers.models.{kind}.modeling_{kind}")
    return getattr(module, _FAMILIES[kind].network)


@contextmanager
def _fewer_parameters_than_bytes(folder: Path) -> Iterator[None]:
    """Inside, a network of more parameters than its weights have bytes raises ModelError.

    transformers describes the network on the meta device, and gives it its weights afterwards.
    """
    bytes_left = (folder / "model.safetensors").stat().st_size

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        """Takes a new parameter off the bytes; raises ModelError if there are too few."""
        nonlocal bytes_left
        if parameter is not None and parameter.is_meta:
            bytes_left -= max(1, parameter.numel())  # an element takes a byte at least
        if bytes_left < 0:
            raise ModelError(f"{folder}: config.json describes a larger network than its weights")

    with register_module_parameter_registration_hook(count):
        yield
