"""Rendered frames as training samples: from shards on disk to augmented images and points.

A shard is an .npz file with rgb (N, H, W, 3) uint8 and depth (N, H, W) metres, 0 = unknown.
Sample number i depends only on the seed, on i and on the frames, so a resumed run continues with
the same samples.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator
from os import SEEK_CUR
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from model_zoo_defs.training.learning import priors
from model_zoo_defs.training.learning.patterns import draw
from pnpdepth_cli.models.definition import IMAGENET_MEAN, IMAGENET_STD


class Sample(NamedTuple):
    """A training sample: rgb (3, H, W) normalised; all else (1, H, W) metres, 0 = unknown."""

    rgb: Tensor
    sparse: Tensor
    depth: Tensor
    prior: Tensor


class Frames:
    """All frames of some folders' shards, folder by folder, in the order of their names.

    The arrays are memory-mapped: parallel runs use the same page cache.
    """

    def __init__(self, *folders: Path):
        self.frames: list[tuple[NDArray[np.uint8], NDArray[np.float32]]] = []
        for folder in folders:
            for path in sorted(folder.glob("*.npz")):
                shard = mapped(path)
                self.frames += list(zip(shard["rgb"], shard["depth"], strict=True))
        if not self.frames:
            names = ", ".join(map(str, folders))
            raise FileNotFoundError(f"no shard (*.npz) in {names}: render some first")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        return self.frames[index]


def mapped(path: Path) -> dict[str, NDArray[Any]]:
    """Returns memory-mapped arrays of an uncompressed .npz file, by name.

    A member of the archive is a .npy file as it is, behind a header of 30 bytes and two fields
    whose lengths it ends with (PKWARE APPNOTE.TXT 6.3.10, section 4.3.7).
    """
    arrays = {}
    with zipfile.ZipFile(path) as archive, path.open("rb") as file:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{path.name}: compressed; shards are written with numpy.savez")
            # The header's last four bytes are the lengths of the two fields.
            file.seek(member.header_offset + 26)
            file.seek(sum(struct.unpack("<HH", file.read(4))), SEEK_CUR)
            np.lib.format.read_magic(file)
            shape, columns_first, dtype = np.lib.format.read_array_header_1_0(file)
            arrays[member.filename.removesuffix(".npy")] = np.asarray(
                np.memmap(path, dtype, "c", file.tell(), shape, "F" if columns_first else "C")
            )
    return arrays


class Samples(Dataset[Sample]):
    """Endless augmented samples.

    Args:
        folders: Folders of rendered frames.
        size: (height, width) of the samples.
        seed: Random seed.
        prior_fraction: Fraction of the samples that have a prior.
    """

    def __init__(
        self, folders: tuple[Path, ...], size: tuple[int, int], seed: int,
        prior_fraction: float = priors.PRIOR_FRACTION,
    ):  # fmt: skip
        self.folders = folders
        self.size = size
        self.seed = seed
        self.prior_fraction = prior_fraction
        self.frames: Frames | None = None

    def __getitem__(self, index: int) -> Sample:
        """Returns a sample, the same for the same index and seed, with known depth and points."""
        # A process of the loader opens the shards itself.
        if self.frames is None:
            self.frames = Frames(*self.folders)
        rng = np.random.default_rng((self.seed, index))
        # Again if a random crop has no depth or no points, as one of sky alone.
        while True:
            rgb, depth = self.frames[int(rng.integers(len(self.frames)))]
            _, unrelated = self.frames[int(rng.integers(len(self.frames)))]
            sample = augmented(rng, rgb, depth, self.size, unrelated, self.prior_fraction)
            if bool((sample.depth > 0).any() and (sample.sparse > 0).any()):
                return sample


class Counting(Sampler[int]):
    """The sample numbers from `start` on, `count` of them."""

    def __init__(self, start: int, count: int):
        self.numbers = range(start, start + count)

    def __iter__(self) -> Iterator[int]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)


def normalised(rgb: Tensor) -> Tensor:
    """Returns rgb (3, H, W) in 0..1 normalised with the mean and std of ImageNet."""
    mean = torch.tensor(IMAGENET_MEAN).view(3, 1, 1)
    std = torch.tensor(IMAGENET_STD).view(3, 1, 1)
    return (rgb - mean) / std


def augmented(
    rng: Generator, rgb: NDArray[np.uint8], depth: NDArray[np.float32], size: tuple[int, int],
    other: NDArray[np.float32], prior_fraction: float = priors.PRIOR_FRACTION,
) -> Sample:  # fmt: skip
    """Returns a random crop at a random zoom, mirrored with probability 0.5, with points and prior.

    Args:
        rng: Random numbers.
        rgb: Image of the frame (H, W, 3).
        depth: Depth of the frame (H, W) in metres, 0 = unknown.
        size: (height, width) of the sample.
        other: Depth of an unrelated frame; a useless prior may be drawn from it.
        prior_fraction: Probability of a prior.
    """
    # Image and depth, which may be half or twice as far.
    image, distance = _zoomed_part(rng, rgb, depth, size)
    if rng.random() < 0.5:
        image = image.flip(-1)
        distance = distance.flip(-1)
    distance = distance * float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    # Points, and a prior aligned to them.
    sparse = draw(rng, distance.numpy(), image.mean(0).numpy())
    if rng.random() < 0.15:
        # A small registration error between the colour and the depth camera.
        image = _shifted(image, int(rng.integers(-2, 3)), int(rng.integers(-3, 4)))
    grey = image.mean(0).numpy()
    prior = priors.draw(rng, distance.numpy(), grey, sparse, other, prior_fraction)
    if prior is None:
        prior = np.zeros_like(sparse)
    # What a camera does to the image.
    image = degraded(rng, misregistered(rng, image))
    return Sample(
        normalised(image),
        torch.from_numpy(sparse)[None],
        distance[None],
        torch.from_numpy(prior)[None],
    )


def _shifted(image: Tensor, down: int, right: int) -> Tensor:
    """Returns the image (3, H, W) moved by up to 3 pixels each way, its border repeated."""
    height, width = image.shape[-2:]
    padded = F.pad(image[None], (3, 3, 3, 3), mode="replicate")[0]
    return padded[:, 3 - down : 3 - down + height, 3 - right : 3 - right + width]


def _zoomed_part(
    rng: Generator, rgb: NDArray[np.uint8], depth: NDArray[np.float32], size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Returns a random window of a frame resized to a size: image (3, h, w) 0..1, depth (h, w).

    It is shrunk, and enlarged only if the frame is smaller than the size.

    Args:
        rng: Random numbers.
        rgb: Image of the frame (H, W, 3).
        depth: Depth of the frame (H, W).
        size: (h, w).
    """
    # The window is (h, w) / zoom.
    height, width = depth.shape
    least = max(size[0] / height, size[1] / width)
    most = max(least, min(1.0, 2.5 * least))
    zoom = float(np.exp(rng.uniform(np.log(least), np.log(most))))
    rows = min(height, round(size[0] / zoom))
    columns = min(width, round(size[1] / zoom))
    top = int(rng.integers(height - rows + 1))
    left = int(rng.integers(width - columns + 1))
    window = (slice(top, top + rows), slice(left, left + columns))
    # Colours are averaged; depth is taken from the nearest pixel, as means lie between surfaces.
    image = torch.from_numpy(np.ascontiguousarray(rgb[window])).permute(2, 0, 1).float() / 255.0
    image = F.interpolate(image[None], size, mode="bilinear", align_corners=False, antialias=True)[
        0
    ]
    distance = torch.from_numpy(np.ascontiguousarray(depth[window]))
    distance = F.interpolate(distance[None, None], size, mode="nearest-exact")[0, 0]
    return image.contiguous(), distance.contiguous()


def misregistered(rng: Generator, rgb: Tensor) -> Tensor:
    """Returns the image (3, H, W) misregistered against the depth map.

    70 % of the frames stay aligned, 25 % are off by about a pixel, as after calibration, and 5 %
    by up to 8 % in scale and 5 % in position, as RGB-D images whose registration was not found.
    """
    kind = rng.random()
    if kind > 0.3:
        return rgb
    amount = 1.0 if kind < 0.05 else 0.15
    zoom = 1.0 + amount * float(rng.uniform(-0.08, 0.08))
    right, down = (2 * amount * rng.uniform(-0.05, 0.05, 2)).tolist()
    view = torch.tensor([[[zoom, 0.0, right], [0.0, zoom, down]]])
    grid = F.affine_grid(view, [1, *rgb.shape], align_corners=False)
    return F.grid_sample(rgb[None], grid, padding_mode="border", align_corners=False)[0]


def degraded(rng: Generator, rgb: Tensor) -> Tensor:
    """Returns the image (3, H, W) 0..1 with random exposure, colour, blur, noise, compression."""
    if rng.random() < 0.8:
        gain = float(np.exp(rng.normal(0.0, 0.2))) * np.exp(rng.normal(0.0, 0.06, (3, 1, 1)))
        rgb = rgb * torch.from_numpy(gain).float()
        grey = rgb.mean(0, keepdim=True)
        rgb = grey + (rgb - grey) * float(rng.uniform(0.3, 1.5))
        rgb = 0.5 + (rgb - 0.5) * float(rng.uniform(0.7, 1.3))
        rgb = rgb.clamp(0.0, 1.0) ** float(np.exp(rng.normal(0.0, 0.25)))
    if rng.random() < 0.3:
        rgb = _blurred(rgb, float(rng.uniform(0.3, 1.5)))
    if rng.random() < 0.4:
        noise = rng.standard_normal(rgb.shape, dtype=np.float32) * rng.uniform(0.0, 0.05)
        rgb = rgb + torch.from_numpy(noise.astype(np.float32))
    if rng.random() < 0.3:
        rgb = _block_compressed(rgb, float(rng.uniform(0.005, 0.06)))
    return rgb.clamp(0.0, 1.0)


def _blurred(rgb: Tensor, sigma: float) -> Tensor:
    """Returns the image (3, H, W) blurred by a Gaussian of so many pixels, cut off at 3 pixels."""
    at = torch.arange(-3.0, 4.0)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2)
    kernel = (kernel / kernel.sum()).repeat(3, 1, 1, 1)
    padded = F.pad(rgb[None], (3, 3, 3, 3), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel, groups=3), kernel.transpose(2, 3), groups=3)[0]


def _block_compressed(rgb: Tensor, step: float) -> Tensor:
    """Returns the image after JPEG-like compression: 8 x 8 DCT, coarser steps for high frequencies.

    Args:
        rgb: (3, H, W) 0..1; the sides are multiples of 8.
        step: Quantisation step of the mean of a block.
    """
    # The basis of the discrete cosine transform, frequency by position.
    frequency = torch.arange(8.0)[:, None]
    position = torch.arange(8.0)[None, :]
    basis = torch.cos(torch.pi * (2 * position + 1) * frequency / 16) * 0.5
    basis[0] = 8**-0.5
    _, height, width = rgb.shape
    blocks = rgb.view(3, height // 8, 8, width // 8, 8).transpose(2, 3)
    # Steps by vertical and horizontal frequency.
    steps = step * (1.0 + frequency + position)
    coefficients = torch.round(basis @ blocks @ basis.t() / steps) * steps
    return (basis.t() @ coefficients @ basis).transpose(2, 3).reshape(rgb.shape)
