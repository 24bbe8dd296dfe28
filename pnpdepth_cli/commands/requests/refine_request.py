"""What the user asks of a refinement, and the files of its result.

None means the network's own default. Command line options and batch cache keys are derived from
these declarations (`pnpdepth_cli.settings`). Imports neither numpy nor torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli import choices
from pnpdepth_cli.dataset.frame_files import FrameFiles, ReadOptions
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.file_record import SamplePattern
from pnpdepth_cli.settings import Settings, option

Outputs = Mapping[str, Path]
"""The files of a result by kind: depth, sigma, preview, …, and last its record."""

GROUPS = ("files", "reading", "method")
"""Fields of a `RefineRequest` that hold fields."""


@dataclass(frozen=True, kw_only=True)
class RefineRequest:
    """Everything the user asks of the refinement of one frame."""

    files: FrameFiles = field(default_factory=FrameFiles)
    """The image, its sparse depth and its ground truth."""
    reading: ReadOptions = field(default_factory=ReadOptions)
    """How the files are read, as the user states it."""
    # Which network, with which weights, and where it runs.
    model: str = option(
        "compact",
        "A name of `pnpdepth models`, FILE.onnx[:OUTPUT], FILE.pt2, a Hugging Face folder, or"
        " FILE.py[:ATTR], which is Python code and is run. FILE:[1] or FILE:[z] is a part of its"
        " output.",
        metavar="NETWORK",
    )
    more_models: tuple[str, ...] = ()
    """Further networks, with their own weights, which are fused with the first."""
    checkpoint: Path | None = option(
        None,
        "Weights: a safetensors, torch, numpy or TensorFlow (.index) file, or a folder; FILE:KEY"
        " chooses one of several state dictionaries. No code in it is run.",
    )
    normalise: str | None = option(
        None,
        "RGB range of the network's input: 0…1, ImageNet's mean and std, −1…1, 0…255."
        "  [default: the network's, else the one that fits best]",
        choices=choices.NORMALISATIONS,
    )
    device: str = option("cpu", "cpu, cuda, cuda:1, mps, …", metavar="NAME")
    # How it is refined; what is measured and estimated.
    method: Settings = field(default_factory=Settings)
    baselines: bool = option(False, "Also print every baseline, such as linear interpolation.")
    uncertainty: bool = option(
        False, "Write the depth's standard deviation and a mask of valid depth."
    )
    keep_measured: bool = option(
        False, "Keep the measured depth at its pixels, as of a depth camera whose holes are filled."
    )
    holdout: float = option(0.0, "Hold out this fraction of the points to score at.", metavar="F")
    # Where results go, and in which form.
    output: Path | None = None
    """A folder, or one depth file. None: a folder named after the image."""
    format: str = option(
        "png", "Format of the depth file in an output folder.", choices=choices.FORMATS
    )
    unknown: str = option(
        "keep",
        "Depth that the points do not support, such as of the sky above a scan: keep it, or zero.",
        choices=choices.UNKNOWN,
    )
    view_3d: bool = False
    """Whether the 3D view of a report is written."""
    overwrite: bool = option(False, "Replace existing results.")

    @property
    def read_options(self) -> ReadOptions:
        """How the frame's files are read, as the method needs it.

        With the paper's method no occluded point is dropped, and no image is moved to the points
        because they say so ("auto").
        """
        if not self.method.is_paper:
            return self.reading
        registration = self.reading.registration
        return replace(
            self.reading,
            registration="off" if registration == "auto" else registration,
            scan=replace(self.reading.scan, keep_occluded=True),
        )

    def with_fields(self, **values: Any) -> RefineRequest:
        """Returns a copy with other values of these fields, its own or of any of `GROUPS`."""
        changes = {}
        for group in GROUPS:
            value = getattr(self, group)
            names = values.keys() & {declared.name for declared in fields(value)}
            changes[group] = replace(value, **{name: values.pop(name) for name in names})
        return replace(self, **changes, **values)

    def outputs_in(self, folder: Path, name: str) -> Outputs:
        """Returns the files of a result in a folder, by kind.

        Args:
            folder: The folder.
            name: Name of the frame; a slash in it stands for a subfolder.
        """
        endings = endings_of(f".{self.format}")
        if not self.view_3d:
            del endings["view"]
        if not self.uncertainty:
            del endings["sigma"]
            del endings["valid"]
        return {kind: folder / f"{name}{ending}" for kind, ending in endings.items()}


def endings_of(suffix: str) -> dict[str, str]:
    """Returns the ends of the names of all files of a result, by kind.

    Args:
        suffix: Suffix of the depth file, such as `.png`; that of its standard deviation, too.
    """
    return {
        "depth": f"_depth{suffix}",
        "sigma": f"_sigma{suffix}",
        "valid": "_valid.png",  # mask of the pixels whose depth is valid
        "preview": "_preview.png",
        "improvement": "_improvement.png",
        "view": "_view.json",  # 3D view for a report
        "record": ".json",
    }


def parse_sample(text: str) -> SamplePattern:
    """Returns the pattern of `500`, `5%` or `lines:16`. Raises UsageError for any other text."""
    kind, _, amount = text.rpartition(":")
    amount_without_space = amount.strip()
    try:
        if amount_without_space.endswith("%"):
            count = None
            fraction = float(amount_without_space[:-1]) / 100
        else:
            count = int(amount)
            fraction = None
    # Python's own error says nothing to a user.
    except ValueError:
        raise UsageError(f"count {amount!r} is neither a number such as 500 nor 5%") from None
    return SamplePattern(kind=kind or "uniform", count=count, fraction=fraction)
