"""A sparse model from its folder, read once and kept for the other images of a batch."""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from pnpdepth_cli.errors import FileFormatError, InputError
from pnpdepth_cli.io.colmap import binary, text
from pnpdepth_cli.io.colmap.parts import ColmapModel
from pnpdepth_cli.io.file_bytes import size_of_regular_file

_PARTS = ("cameras", "images", "points3D")
_SUFFIXES = (".bin", ".txt")
_LOCK = threading.Lock()
"""So that threads that read frames of one model wait for it instead of reading it again."""


def model_files(folder: Path) -> list[Path]:
    """Returns the three files of a model; none if this is no folder with a model."""
    for suffix in _SUFFIXES:  # binary first, as COLMAP itself
        files = [folder / f"{part}{suffix}" for part in _PARTS]
        if all(file.is_file() for file in files):
            return files
    return []


def find_model(path: Path) -> Path:
    """Returns the folder of the model: this folder or its 0/, sparse/0/ or sparse/.

    Raises:
        InputError: There is none.
    """
    for folder in (path, path / "0", path / "sparse" / "0", path / "sparse"):
        if model_files(folder):
            return folder
    raise InputError(
        f"{path} is a folder without a COLMAP model; give the one with cameras, images and"
        " points3D as .bin or .txt, usually sparse/0"
    )


def read_model(path: Path) -> ColmapModel:
    """Returns the sparse model in a folder, or in its 0/, sparse/0/ or sparse/.

    Raises:
        InputError: There is none.
        FileFormatError: It is damaged or cut short.
    """
    files = model_files(find_model(path))
    states = tuple((file, size_of_regular_file(file), file.stat().st_mtime_ns) for file in files)
    with _LOCK:
        return _read(states)


@functools.lru_cache(maxsize=2)
def _read(states: tuple[tuple[Path, int, int], ...]) -> ColmapModel:
    cameras, images, points = (state[0] for state in states)
    reader = binary if cameras.suffix == ".bin" else text
    model = ColmapModel(
        folder=cameras.parent,
        cameras=reader.read_cameras(cameras),
        images=reader.read_images(images),
        points=reader.read_points(points),
    )
    lost = next((i for i in model.images.values() if i.camera not in model.cameras), None)
    if lost is not None:
        raise FileFormatError(
            f"{images}: an image has camera {lost.camera}, which {cameras.name} lacks; create the"
            " model again"
        )
    return model


def name_in_model(model: ColmapModel, image: Path) -> str:
    """Returns the name under which the model has a photo: the longest that ends its path.

    Raises:
        InputError: The model lacks it, or has several of its name.
    """
    whole = PurePosixPath(image.absolute().as_posix()).parts
    ending = [n for n in model.images if _ends(whole, PurePosixPath(n).parts)]
    if ending:
        return max(ending, key=len)
    alike = [name for name in model.images if PurePosixPath(name).name == image.name]
    if len(alike) == 1:
        return alike[0]
    if alike:
        raise InputError(
            f"{image} could be any of {_listing(alike)} of {model.folder}; give it in the image"
            " folder of the model"
        )
    raise InputError(
        f"{image} is not among the {len(model.images):,} images of {model.folder}"
        f" ({_listing(model.images)}); COLMAP did not register it, or its name has changed"
    )


def _ends(whole: tuple[str, ...], part: tuple[str, ...]) -> bool:
    return bool(part) and whole[-len(part) :] == part


def _listing(names: Iterable[str]) -> str:
    first = sorted(names)
    return ", ".join(first[:3]) + (", …" if len(first) > 3 else "")
