"""How a place to cut is written."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pnpdepth_cli.errors import LayerError


@dataclass(frozen=True)
class LayerName:
    """A place to cut: `module`, `module#2` for its second call, `module[key]` for one output."""

    module: str
    call: int | None = None
    key: tuple[str, ...] | None = None

    @classmethod
    def parse(cls, text: str) -> LayerName:
        """The name in its parts. LayerError if it has no such form."""
        match = re.fullmatch(
            r"(?P<module>[^#\[\]]*)(?:#(?P<call>\d+))?(?P<keys>(?:\[[^\[\]]+\])*)", text
        )
        if match is None or match["call"] == "0":
            raise LayerError(f"layer {text!r}: the form is NAME, NAME#CALL or NAME[OUTPUT]")
        keys = tuple(re.findall(r"\[([^\[\]]+)\]", match["keys"]))
        return cls(match["module"], int(match["call"]) if match["call"] else None, keys or None)

    def of_output(self, path: tuple[str, ...]) -> str:
        """The name of one output of this module."""
        return self.module + "".join(f"[{key}]" for key in path)
