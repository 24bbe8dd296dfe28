"""Which files are written for a refined frame, planned before it is computed. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import IMAGE_SUFFIXES, SCAN_ONLY_SUFFIXES
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES

_FILE_SUFFIXES = {
    *(*IMAGE_SUFFIXES, *DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES),
    *(".hdr", ".bmp", ".mat", ".h5", ".csv", ".json"),
}
"""Suffixes that are taken for those of a file, though a folder's name may have a dot in it."""


Outputs = Mapping[str, Path]
"""The files of a result by kind: depth, sigma, preview, …, and last its record."""
IMAGES = frozenset({"preview", "improvement", "sigma_preview"})
"""Kinds for a person, which may be deleted."""


def outputs_in(folder: Path, name: str, request: RefineRequest) -> dict[str, Path]:
    """Returns the files of a result in a folder; slashes in the name are subfolders."""
    options, sigma = request.outputs, request.hold_out.uncertainty
    endings = {
        "depth": f"_depth.{options.format}",
        "sigma": f"_sigma.{options.format}" if sigma else "",
        "sigma_preview": "_sigma_preview.png" if sigma else "",
        "valid": "_valid.png" if sigma else "",  # mask of the pixels whose depth is valid
        "preview": "_preview.png",
        "improvement": "_improvement.png",
        "view": "_view.json" if options.view_3d else "",  # 3D view for a report
        "record": ".json",
    }
    return {kind: folder / f"{name}{ending}" for kind, ending in endings.items() if ending}


def stale_outputs(folder: Path, name: str, planned: Mapping[str, Path]) -> list[Path]:
    """Returns the files that a run with other options has left beside a result."""
    endings = [f"_{kind}{suffix}" for kind in ("depth", "sigma") for suffix in DEPTH_SUFFIXES]
    endings += ["_sigma_preview.png", "_valid.png", "_preview.png", "_improvement.png"]
    paths = (folder / f"{name}{ending}" for ending in (*endings, "_view.json"))
    return [path for path in paths if path not in planned.values() and path.is_file()]


def plan_outputs(request: RefineRequest) -> dict[str, Path]:
    """Returns the paths of the results: `-o FILE.exr` for the depth alone, a folder for all.

    Raises:
        OutputError: One exists and may not be replaced, or is one of the inputs.
    """
    # Where results go without -o.
    files, options = request.files, request.outputs
    sources = [files.image, files.sparse, files.gt, request.reading.scan.calib]
    inputs = [path for path in sources if isinstance(path, Path)]
    output = options.output or Path(f"{inputs[0].stem}_refined")
    suffix, formats = output.suffix.lower(), " ".join(DEPTH_SUFFIXES)
    if f".{options.format}" not in DEPTH_SUFFIXES:
        raise UsageError(f"format {options.format!r} is not one of {formats}")
    # A depth file alone, or all files in a folder.
    if suffix in DEPTH_SUFFIXES:
        if request.hold_out.uncertainty:
            raise UsageError(
                f"--uncertainty writes a second file; name a folder, not {output}, with -o"
            )
        outputs = {"depth": output}
    elif suffix in _FILE_SUFFIXES and not output.is_dir():
        raise OutputError(f"{output}: depth is written as {formats}, or into a folder")
    elif output.is_file():
        raise OutputError(f"{output} is a file; name a folder, or a depth file ({formats})")
    else:
        outputs = outputs_in(output, inputs[0].stem, request)
    # No input is replaced, and no result unless it may be.
    resolved = {path.resolve() for path in inputs}
    for path in outputs.values():
        if path.resolve() in resolved:
            raise OutputError(f"{path} is one of the inputs; name another output with -o")
        if path.exists() and not options.overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another path")
    return outputs
