"""The paper's seven networks, full size, each cut by hand at the paper's z.

`front` and `rear` are what an author would write for this one layer of this one network: the
limit for a cut that works on any network at any layer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs import adnn, eigen, fcrn, sfmlearner
from model_zoo_defs.adnn import Adnn
from model_zoo_defs.eigen import Eigen
from model_zoo_defs.fcrn import FCRN
from model_zoo_defs.latefusion import FARTHEST, LEVELS, LateFusion
from model_zoo_defs.sfmlearner import DispNet
from model_zoo_defs.sparse2dense import SparseToDense
from model_zoo_defs.sparseconv import SparseConvNet
from pnpdepth_cli.models.registry import find_definition


@dataclass(frozen=True)
class Case:
    """A network of the zoo, the layer its `front` ends with, and the inputs' channels and size.

    front(network, *inputs) gives z and what `rear` needs beside it, rear(network, z, kept) what the
    network gives. Inputs are in 0..1; one of one channel is sparse depth.
    """

    name: str
    layer: str
    channels: tuple[int, ...]
    size: tuple[int, int]
    front: Callable[..., Any]
    rear: Callable[..., Tensor]

    def network(self) -> nn.Module:
        """Returns the network with random weights, in eval mode."""
        return find_definition(self.name).build().eval().requires_grad_(False)


def eigen_front(network: Eigen, rgb: Tensor) -> Any:
    """Returns z, the output of `coarse.conv5`, and the fine network's first features."""
    coarse, fine = network.coarse, network.fine
    x = F.max_pool2d(F.relu(coarse.conv1(rgb)), 2)
    x = F.max_pool2d(F.relu(coarse.conv2(x)), 2)
    x = F.relu(coarse.conv4(F.relu(coarse.conv3(x))))
    return coarse.conv5(x), F.max_pool2d(F.relu(fine.conv1(rgb)), 2)


def eigen_rear(network: Eigen, z: Tensor, features: Tensor) -> Tensor:
    """Returns the network's output from z and the fine network's first features."""
    coarse, fine = network.coarse, network.fine
    x = coarse.fc2(coarse.dropout(F.relu(coarse.fc1(F.relu(z).flatten(1)))))
    x = torch.cat([features, x.reshape(-1, 1, *eigen.OUT)], dim=1)
    return fine.conv3(F.relu(fine.conv2(x)))


def fcrn_front(network: FCRN, rgb: Tensor) -> Any:
    """Returns z, the output of `layer1_BN`, and (), as the rear needs nothing else."""
    x = network.pool(network.relu(network.bn_conv1(network.conv1(rgb))))
    for name in network.trunk:
        x = network.get_submodule(name)(x)
    return network.layer1_BN(network.layer1(x)), ()


def fcrn_rear(network: FCRN, z: Tensor, _kept: Any) -> Tensor:
    """Returns the network's output from z alone."""
    for name in fcrn.UP_PROJECTIONS:
        z = network.get_submodule(name)(z)
    return F.relu(network.ConvPred(z))


def sfmlearner_front(network: DispNet, rgb: Tensor) -> Any:
    """Returns z, the output of `conv7`, and the image and the outputs of `conv1` to `conv6`."""
    features = [rgb]
    for level in range(1, 8):
        features.append(network.get_submodule(f"conv{level}")(features[-1]))
    return features.pop(), tuple(features)


def sfmlearner_rear(network: DispNet, z: Tensor, features: tuple[Tensor, ...]) -> Tensor:
    """Returns the largest disparity from z, the image and the outputs of `conv1` to `conv6`."""
    x = z
    disparity = None
    for level in range(7, 0, -1):
        beside = features[level - 1]
        x = sfmlearner.cropped(network.get_submodule(f"upconv{level}")(x), beside)
        # At level 1 the image gives the size only.
        concatenated = [x, beside] if level > 1 else [x]
        if disparity is not None:
            larger = F.interpolate(disparity, scale_factor=2.0, mode="bilinear")
            concatenated.append(sfmlearner.cropped(larger, beside))
        x = network.get_submodule(f"iconv{level}")(torch.cat(concatenated, dim=1))
        if level in sfmlearner.PREDICTED:
            predicted = network.get_submodule(f"predict_disp{level}")(x)
            disparity = sfmlearner.GAIN * predicted + sfmlearner.FLOOR
    assert disparity is not None
    return disparity


def sparseconv_front(network: SparseConvNet, sparse: Tensor) -> Any:
    """Returns z, the features of `sparse_convs.0`, and the mask that they come with."""
    return network.sparse_convs[0]((sparse, (sparse > 0).to(sparse)))


def sparseconv_rear(network: SparseConvNet, z: Tensor, mask: Tensor) -> Tensor:
    """Returns the network's output from z and its mask."""
    features_and_mask = (z, mask)
    for block in network.sparse_convs[1:]:
        features_and_mask = block(features_and_mask)
    return network.mask_conv(torch.cat(features_and_mask, dim=1))


def adnn_front(network: Adnn, sparse: Tensor) -> Any:
    """Returns z, the output of `solve`, and each layer's kernel and input size (rows, columns)."""
    kernels = tuple(getattr(network, name) for name in network.kernels)
    biases = tuple(getattr(network, name) for name in network.biases)
    sizes = [tuple(sparse.shape[-2:])]
    for _ in kernels[1:]:
        # Rounded up, as SAME padding gives it.
        sizes.append(tuple(-(-side // adnn.STRIDE) for side in sizes[-1]))
    return network.solve(sparse, kernels, biases), (kernels, sizes)


def adnn_rear(_network: Adnn, z: Tensor, kept: Any) -> Tensor:
    """Returns the network's output from z, by each layer's kernel and input size."""
    kernels, sizes = kept
    for kernel, size in zip(reversed(kernels), reversed(sizes), strict=True):
        z = adnn.synthesised(z, kernel, size)
    return z


def sparse2dense_front(network: SparseToDense, rgb: Tensor, sparse: Tensor) -> Any:
    """Returns z, the output of `bn2`, and the image's (height, width)."""
    x = torch.cat([rgb, sparse], dim=1)
    x = network.maxpool(network.relu(network.bn1(network.conv1(x))))
    x = network.layer4(network.layer3(network.layer2(network.layer1(x))))
    return network.bn2(network.conv2(x)), rgb.shape[-2:]


def sparse2dense_rear(network: SparseToDense, z: Tensor, size: Any) -> Tensor:
    """Returns the network's output from z, enlarged to the image's (height, width)."""
    x = network.conv3(network.decoder(z))
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


def latefusion_front(network: LateFusion, rgb: Tensor, sparse: Tensor) -> Any:
    """Returns z, the output of `decoder.s8`, and what the finer levels of the decoder need.

    That is both encoders' features at 1/2 and 1/4, the largest first, and the image's size.
    """
    # An encoder's features at 1/2, 1/4, 1/8, 1/16 and 1/32; the decoder takes them from the end.
    image = network.rgb(rgb)
    points = network.sparse(sparse)
    x = network.fuse(torch.cat([image.pop(), points.pop()], dim=1))
    for level in LEVELS[:2]:
        x = network.decoder[level](x, image.pop(), points.pop())
    return x, (image, points, rgb.shape[-2:])


def latefusion_rear(network: LateFusion, z: Tensor, kept: Any) -> Tensor:
    """Returns the network's output from z and what `latefusion_front` gives beside it."""
    image, points, size = kept
    # The last features are those at 1/4.
    for index, level in enumerate(LEVELS[2:], start=1):
        z = network.decoder[level](z, image[-index], points[-index])
    x = F.interpolate(network.inverse(z), size, mode="bilinear", align_corners=False)
    return 1 / (F.softplus(x) + 1 / FARTHEST)


NYU = (228, 304)
"""Rows and columns that the paper's networks for NYU take."""
KITTI = (352, 1216)
"""Rows and columns of the frames of KITTI's depth completion."""

ZOO = (
    Case("eigen", "coarse.conv5", (3,), NYU, eigen_front, eigen_rear),
    Case("fcrn", "layer1_BN", (3,), NYU, fcrn_front, fcrn_rear),
    Case("sfmlearner", "conv7", (3,), (128, 416), sfmlearner_front, sfmlearner_rear),
    Case("sparseconv", "sparse_convs.0[0]", (1,), KITTI, sparseconv_front, sparseconv_rear),
    Case("adnn", "solve", (1,), KITTI, adnn_front, adnn_rear),
    Case("sparse2dense", "bn2", (3, 1), NYU, sparse2dense_front, sparse2dense_rear),
    Case("latefusion", "decoder.s8", (3, 1), (224, 320), latefusion_front, latefusion_rear),
)
