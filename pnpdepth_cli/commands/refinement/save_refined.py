"""`Refined.save` of the Python API: the depth file and the record that `pnpdepth refine` writes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pnpdepth_cli.commands.pipeline import peak_memory_mb
from pnpdepth_cli.commands.refinement.outputs import remove, within_range, write_outputs
from pnpdepth_cli.commands.refinement.refine_image import record_of, scored
from pnpdepth_cli.commands.refinement.refine_request import Outputs, RefineRequest, endings_of
from pnpdepth_cli.commands.tables import names_of_depths
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.io.atomic import all_or_none, make_folder
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES


@dataclass(frozen=True, kw_only=True)
class FrameSaver:
    """Writes a refined frame of arrays; it keeps neither the network nor the image."""

    inputs: Frame
    """The frame without its image."""
    record: FrameRecord
    """How the frame was refined."""

    @classmethod
    def of(
        cls, request: RefineRequest, method: Method, frame: Frame, refined: Refined, seconds: float
    ) -> FrameSaver:
        """Returns what writes this frame.

        Args:
            request: Settings that the user gave.
            method: The method that refined the frame.
            frame: The frame.
            refined: The refined frame.
            seconds: How long it took to refine it.
        """
        record = record_of(request, method, frame, refined)
        return cls(
            inputs=replace(frame, rgb=None, predicted=(), register=None),
            record=replace(record, seconds={"refine": round(seconds, 4)}),
        )

    def __call__(self, refined: Refined, path: Path, *, overwrite: bool) -> None:
        """Writes the depth, its record, and σ and its mask if it has them; all or none.

        Raises:
            OutputError: The suffix is of no depth format, a file exists, or one cannot be written.
        """
        # The files: NAME.json is the record of NAME_depth.png and of NAME.png.
        outputs = _files(path, with_sigma=refined.sigma is not None)
        for output in outputs.values():
            if output.exists() and not overwrite:
                raise OutputError(
                    f"{output} exists; overwrite=True replaces it, or name another file"
                )
        # The record is of the depth that is written: clipped to its format, or edited by the user.
        refined = within_range(outputs, self.inputs, refined)
        name = outputs["record"].stem
        record = scored(self.record, self.inputs, refined)
        record = replace(
            record,
            name=name,
            notes=[note for note in refined.notes if note],
            outputs={kind: str(output) for kind, output in outputs.items()},
            peak_memory_mb=peak_memory_mb(torch.device(str(record.settings["device"]))),
        )
        make_folder(path.parent)
        remove(outputs["record"])  # so that none is of two results, whatever happens now
        with all_or_none(outputs.values()):
            write_outputs(outputs, self.inputs, refined, names_of_depths(record))
            record.write(outputs["record"])


def _files(path: Path, *, with_sigma: bool) -> Outputs:
    """The files beside a depth file, by kind."""
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise OutputError(f"{path} names no depth file; end it in {', '.join(DEPTH_SUFFIXES)}")
    kinds = ["sigma", "valid", "record"] if with_sigma else ["record"]
    endings, name = endings_of(path.suffix), path.stem.removesuffix("_depth")
    return {"depth": path, **{kind: path.with_name(name + endings[kind]) for kind in kinds}}
