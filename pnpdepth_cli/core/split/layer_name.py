"""The notation of a layer to cut at."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pnpdepth_cli.errors import LayerError


@dataclass(frozen=True)
class LayerName:
    """A layer: `module`, `module#2` for its second call, `module[key]` for one of its outputs."""

    module: str
    """Name of the submodule."""
    call: int | None = None
    """Number of the call, from 1; None if there is one call."""
    key: tuple[str, ...] | None = None
    """Path of the output in nested containers; None if there is one."""

    @classmethod
    def parse(cls, text: str) -> LayerName:
        """Returns the parts of a name. Raises LayerError if it is not of this form."""
        match = re.fullmatch(
            r"(?P<module>[^#\[\]]*)(?:#(?P<call>\d+))?(?P<keys>(?:\[[^\[\]]+\])*)", text
        )
        if match is None or match["call"] == "0":
            raise LayerError(f"layer {text!r}: the form is NAME, NAME#CALL or NAME[OUTPUT]")
        keys = tuple(re.findall(r"\[([^\[\]]+)\]", match["keys"]))
        return cls(match["module"], int(match["call"]) if match["call"] else None, keys or None)

    def of_output(self, path: tuple[str, ...]) -> str:
        """Returns the name of the output of this module at a path."""
        return self.module + "".join(f"[{key}]" for key in path)
