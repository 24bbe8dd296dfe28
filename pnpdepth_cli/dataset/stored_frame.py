"""The files of a frame as they are stored: image, ground truth and sparse depth, each read once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.dataset import arrays, stored_depth
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.dataset.stored_depth import StoredDepth
from pnpdepth_cli.file_record import FileRecord
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.points import Size


class NotedFile(NamedTuple):
    """What a record keeps of a file, and lines on it for a person."""

    record: FileRecord
    notes: Sequence[str]


@dataclass(frozen=True, kw_only=True)
class StoredFrame:
    """What the files of a frame hold. Nothing is decided of it."""

    rgb: NDArray[np.float32] | None
    """(H, W, 3) in 0…1. None without an image."""
    image: NotedFile | None
    """The file of the image. None without an image."""
    truth: StoredDepth | None
    """None without ground truth."""
    sparse: StoredDepth | None
    """None where points are sampled from the ground truth."""

    @property
    def size(self) -> Size | None:
        """(H, W) of the image. None without an image."""
        return None if self.rgb is None else (self.rgb.shape[0], self.rgb.shape[1])


def read_stored_frame(files: FrameFiles, options: ReadOptions) -> StoredFrame:
    """Returns what the files of a frame hold: the image, the ground truth and the sparse depth.

    Raises:
        InputError: A file cannot be read.
        UsageError: An option does not apply to the file.
    """
    rgb = image = truth = sparse = None
    if files.image is not None:
        notes = list[str]()
        if isinstance(files.image, Path):
            # COLMAP reads photos as they are stored.
            is_model = files.sparse is not None and files.sparse.is_dir()
            picture = read_rgb(files.image, upright=not is_model)
            rgb = picture.values
            if picture.note:
                notes.append(f"image: {picture.note}")
        else:
            rgb = arrays.read_image(files.image)
        image = NotedFile(arrays.record_of(files.image, kind="image"), notes)
    if files.gt is not None:
        truth = stored_depth.read_stored_truth(files.gt, files.image)
    if files.sparse is not None:
        sparse = stored_depth.read_stored_sparse(files.sparse, options.scan.over(files))
    return StoredFrame(rgb=rgb, image=image, truth=truth, sparse=sparse)


def rgb_of_file(files: FrameFiles, stored: StoredFrame) -> NDArray[np.float32] | None:
    """Returns the image (H, W, 3) in 0…1 of a frame that has an image file of its own.

    None without an image, and for a frame of a video. A scan is compared with the edges of this
    image.
    """
    return None if files.image_file is None else stored.rgb
