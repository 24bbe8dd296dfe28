"""Tensors saved for later passes, protected from in-place operations of the network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pnpdepth_cli.core.split.structure import map_tensors


@dataclass(eq=False)
class SavedTensors:
    """Tensors in nested containers, as they were when saved."""

    value: Any = None
    """The tensors in their containers."""
    copied: bool = False
    """Whether the network changes them in place, so that `fresh` returns clones."""

    def fresh(self) -> Any:
        """Returns the tensors in new containers; whatever is done to them leaves `value` as is."""
        return map_tensors(
            self.value, lambda _, t: t.clone() if self.copied or t.is_inference() else t
        )
