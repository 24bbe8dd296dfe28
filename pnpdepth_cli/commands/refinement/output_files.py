"""Which files are written for a refined frame, planned before it is computed. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.commands.requests import check_outputs
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.atomic import cannot_write
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES

Outputs = Mapping[str, Path]
"""The files of a result by kind: depth, sigma, preview, …, and last its record."""
IMAGES = frozenset({"preview", "improvement"})
"""Kinds for a person, which may be deleted."""


def outputs_in(
    folder: Path, name: str, request: RefineRequest, *, with_gt: bool
) -> dict[str, Path]:
    """Returns the files of a result in a folder; slashes in the name are subfolders."""
    without = set() if request.hold_out.uncertainty else {"sigma", "valid"}
    without |= set() if request.outputs.view_3d else {"view"}
    without |= set() if with_gt else {"improvement"}
    endings = _endings(f".{request.outputs.format}")
    return {kind: folder / f"{name}{end}" for kind, end in endings.items() if kind not in without}


def _endings(suffix: str) -> dict[str, str]:
    """The ends of the names of all files of a result, by kind."""
    return {
        "depth": f"_depth{suffix}",
        "sigma": f"_sigma{suffix}",
        "valid": "_valid.png",  # mask of the pixels whose depth is valid
        "preview": "_preview.png",
        "improvement": "_improvement.png",
        "view": "_view.json",  # 3D view for a report
        "record": ".json",
    }


def remove_outdated(outputs: Outputs) -> None:
    """Removes the record of an earlier result, and its files that are not written again.

    The record goes first, so that none names files of two runs.
    """
    record = outputs.get("record")
    if record is None:
        return
    endings = (end for suffix in DEPTH_SUFFIXES for end in _endings(suffix).values())
    files = dict.fromkeys(record.with_name(record.stem + end) for end in endings)
    for path in (record, *(path for path in files if path not in outputs.values())):
        try:
            if path.is_file():
                path.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error


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
    # A depth file alone, or all files in a folder.
    if suffix in DEPTH_SUFFIXES:
        if request.hold_out.uncertainty:
            raise UsageError(
                f"--uncertainty writes a second file; name a folder, not {output}, with -o"
            )
        outputs = {"depth": output}
    elif suffix[1:].isalpha() and not output.is_dir():
        raise OutputError(f"{output}: depth is written as {formats}, or into a folder")
    elif output.is_file():
        raise OutputError(f"{output} is a file; name a folder, or a depth file ({formats})")
    else:
        outputs = outputs_in(output, inputs[0].stem, request, with_gt=files.gt is not None)
    # No input is replaced, and no result unless it may be.
    check_outputs(outputs.values(), inputs, overwrite=options.overwrite)
    return outputs
