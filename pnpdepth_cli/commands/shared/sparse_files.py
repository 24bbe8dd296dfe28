"""The files of sparse depth that is made from other depth, for `project`, `sample`, `simulate`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.dataset.plausible import plausible_map
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.file_record import FileRecord, what_applies
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.depth import describe_range, read_depth
from pnpdepth_cli.io.file_bytes import plain, write_json
from pnpdepth_cli.io.point_files import SPARSE_SUFFIXES, write_sparse
from pnpdepth_cli.io.visualisation import overlay
from pnpdepth_cli.sensors.projection import Points, as_depth_image
from pnpdepth_cli.version import __version__


class Written(NamedTuple):
    """What a command wrote that makes sparse depth."""

    points: Points
    notes: list[str]
    """Lines for a person."""
    files: list[Path]
    """The sparse depth, its record, and an image of it where one was drawn."""


def sparse_outputs(
    output: Path, inputs: Iterable[Path | None], overwrite: bool, *, drawn: bool = False
) -> dict[str, Path]:
    """Returns the files to write, by kind: "sparse", "record", and "overlay" if it is drawn.

    Args:
        output: File of the sparse depth.
        inputs: Files that are read, which no output may replace; None where one is not given.
        overwrite: Whether existing files may be replaced.
        drawn: Whether an image with the points drawn on it is written, too.

    Raises:
        OutputError: The suffix is of no format of sparse depth, or a file cannot be written.
    """
    if output.suffix.lower() not in SPARSE_SUFFIXES:
        raise OutputError(
            f"{output}: sparse depth is written as one of {', '.join(SPARSE_SUFFIXES)}"
        )
    files = {"sparse": output, "record": output.with_suffix(".json")}
    if drawn:
        files["overlay"] = output.with_name(f"{output.stem}_overlay.png")
    check_outputs(files.values(), [path for path in inputs if path], overwrite=overwrite)
    return files


def write_sparse_files(
    files: dict[str, Path],
    points: Points,
    settings: Mapping[str, object],
    inputs: Mapping[str, FileRecord],
    notes: list[str],
    *,
    rgb: NDArray[np.float32] | None = None,
) -> Written:
    """Writes the sparse depth, its record, and an image with the points drawn on it if asked for.

    Args:
        files: The files of `sparse_outputs`, by kind.
        points: The sparse depth.
        settings: Entries of the record that say what decided the points.
        inputs: Records of the files that the points were made of, by a word such as "depth".
        notes: Lines for a person.
        rgb: (H, W, 3) in 0…1, the image to draw on. None if no overlay was asked for.

    Returns:
        The points, the notes and the files.
    """
    # The points, and an image of them.
    make_folder(files["sparse"].parent)
    image = as_depth_image(points)
    write_sparse(files["sparse"], points.xy, points.depth, image)
    if rgb is not None:
        overlay(rgb, points.xy, points.depth, files["overlay"])
    # The record; `what_applies` leaves out entries of a file that are None, False or empty.
    content = {
        "version": __version__,
        **settings,
        "inputs": {name: asdict(file, dict_factory=what_applies) for name, file in inputs.items()},
        "points": {
            "count": len(points),
            "fraction_of_pixels": len(points) / image.size,
            "nearest": float(points.depth.min()),
            "farthest": float(points.depth.max()),
            "dropped": dict(points.dropped),
        },
        "size": [points.size[1], points.size[0]],  # width, height
        "notes": notes,
        "outputs": plain(files),
    }
    write_json(files["record"], content)
    return Written(points=points, notes=notes, files=[*files.values()])


def read_dense(path: Path, scale: float | None) -> tuple[NDArray[np.float32], list[str]]:
    """Returns the dense depth (H, W) metres in a file, 0 where unknown, and lines for a person.

    Args:
        path: The depth file.
        scale: Numbers per metre that the user states. None: as the file says.

    Raises:
        InputError: The file cannot be read, or its depths are implausible in metres.
    """
    dense = read_depth(path, scale=scale)
    # Empty: the scale is stated of this very file, and not of the integers of another one.
    of_integers = ""
    values, notes = plausible_map(
        dense.values, dense.reading, "depth", "--depth-scale", scale, of_integers=of_integers
    )
    return values, [f"depth: {describe_range(values, dense.reading, noun='pixels')}", *notes]
