"""What the user asks of an adaptation. Imports neither numpy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pnpdepth_cli.commands.batch.request import FrameSelection
from pnpdepth_cli.errors import OutputError, UsageError
from pnpdepth_cli.settings import option


@dataclass(frozen=True, kw_only=True)
class AdaptRequest(FrameSelection):
    """Which frames a network learns from, and how. `output` is the file of its weights."""

    steps: int = option(
        200, "Number of updates of the weights.", metavar="N", least=1, show_default=True
    )
    lr: float = option(4e-4, "Step size at the start.", metavar="NUMBER", show_default=True)

    validated: int = 10
    """One frame in this many is for validation; of fewer frames, the last."""

    checks: int = 5
    """How often the validation frames are looked at, besides before the first update."""

    def __post_init__(self) -> None:
        if self.output.suffix != ".safetensors":
            raise UsageError(f"{self.output}: name the file of the weights NAME.safetensors")
        for path in (self.output, self.card):
            if path.exists() and not self.refine.outputs.overwrite:
                raise OutputError(f"{path} exists; --overwrite replaces it, -o names another file")

    @property
    def card(self) -> Path:
        """The file that describes the weights."""
        return self.output.with_suffix(".md")
