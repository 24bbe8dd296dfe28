"""Which files are written for a refined frame, planned before it is computed. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.io.dataset import IMAGE_SUFFIXES, SCAN_ONLY_SUFFIXES
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES

_FILE_SUFFIXES = {
    *(*IMAGE_SUFFIXES, *DEPTH_SUFFIXES, *SCAN_ONLY_SUFFIXES),
    *(".hdr", ".bmp", ".mat", ".h5", ".csv", ".json"),
}
"""Suffixes that are taken for those of a file, though a folder's name may have a dot in it."""


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """Paths of a frame's results. All but the depth are None when only a depth file is wanted."""

    depth: Path
    sigma: Path | None = None
    sigma_preview: Path | None = None
    valid: Path | None = None
    """Mask of the pixels whose depth is valid."""
    preview: Path | None = None
    """Image of the depth before and after."""
    improvement: Path | None = None
    """Image of what became better and worse."""
    cloud: Path | None = None
    view: Path | None = None
    """3D view for a report."""
    record: Path | None = None
    """JSON of settings and scores."""
    scale: float | None = None
    """Codes per metre of an integer depth file. None: what suits the frame."""
    colors: str = "blue-orange"
    """Colours of better and worse, one of `choices.COLORS`."""
    previews: str = "all"
    """Which results get their images, one of `choices.PREVIEWS`."""

    @classmethod
    def in_folder(cls, folder: Path, name: str, request: RefineRequest) -> Outputs:
        """Returns the paths in a folder, those of σ if wanted; slashes in names are subfolders."""
        sigma = request.hold_out.uncertainty
        return cls(
            depth=folder / f"{name}_depth.{request.outputs.format}",
            sigma=folder / f"{name}_sigma.{request.outputs.format}" if sigma else None,
            valid=folder / f"{name}_valid.png" if sigma else None,
            sigma_preview=folder / f"{name}_sigma_preview.png" if sigma else None,
            preview=folder / f"{name}_preview.png",
            improvement=folder / f"{name}_improvement.png",
            previews=request.outputs.previews,
            cloud=folder / f"{name}.ply" if request.outputs.ply else None,
            view=folder / f"{name}_view.json" if request.outputs.view_3d else None,
            record=folder / f"{name}.json",
            scale=request.outputs.output_scale,
            colors=request.outputs.colors,
        )

    def by_kind(self) -> dict[str, Path]:
        """Returns every file that will be written, by its kind."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {kind: path for kind, path in values.items() if isinstance(path, Path)}

    def paths(self) -> list[Path]:
        """Returns every file that will be written."""
        return list(self.by_kind().values())

    def optional(self) -> list[Path]:
        """Returns the images that some results lack."""
        images = (self.preview, self.improvement, self.sigma_preview)
        return [path for path in images if path is not None and self.previews != "all"]

    def without_previews(self, *, worse: bool) -> Outputs:
        """Returns the files to write for a result, without the images that it does not get.

        Args:
            worse: Whether it is worse than linear interpolation.
        """
        if self.previews == "all" or (self.previews == "worst" and worse):
            return self
        return replace(self, preview=None, improvement=None, sigma_preview=None)


def plan_outputs(request: RefineRequest) -> Outputs:
    """Returns the paths of the results: `-o FILE.exr` for the depth alone, a folder for all.

    Raises:
        OutputError: One exists and may not be replaced, or is one of the inputs.
    """
    files, options = request.files, request.outputs
    sources = [files.image, files.sparse, files.gt, files.scan.calib]
    inputs = [path for path in sources if isinstance(path, Path)]
    output = options.output or Path(f"{inputs[0].stem}_refined")
    suffix, formats = output.suffix.lower(), " ".join(DEPTH_SUFFIXES)
    if f".{options.format}" not in DEPTH_SUFFIXES:
        raise UsageError(f"format {options.format!r} is not one of {formats}")
    if suffix in DEPTH_SUFFIXES:
        for flag, asked in (
            ("--uncertainty", request.hold_out.uncertainty),
            ("--ply", options.ply),
        ):
            if asked:
                raise UsageError(
                    f"{flag} writes a second file; name a folder, not {output}, with -o"
                )
        outputs = Outputs(depth=output, scale=options.output_scale)
    elif suffix in _FILE_SUFFIXES and not output.is_dir():
        raise OutputError(f"{output}: depth is written as {formats}, or into a folder")
    elif output.is_file():
        raise OutputError(f"{output} is a file; name a folder, or a depth file ({formats})")
    else:
        outputs = Outputs.in_folder(output, inputs[0].stem, request)
    resolved = {path.resolve() for path in inputs}
    for path in outputs.paths():
        if path.resolve() in resolved:
            raise OutputError(f"{path} is one of the inputs; name another output with -o")
        if path.exists() and not options.overwrite:
            raise OutputError(f"{path} exists; --overwrite replaces it, -o names another path")
    return outputs
