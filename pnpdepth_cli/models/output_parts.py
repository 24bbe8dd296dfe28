"""A part of what a network gives, named behind its file: `net.onnx:points[z]`, `net.pt2:[1]`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from pnpdepth_cli.errors import ModelError

_AXES = ("x", "y", "z")
"""Names of the channels of a map of points."""
_NAMED = re.compile(r"(.+:[^:\[\]]*?)((?:\[[^\[\]]+\])+)", re.DOTALL)
_PART = re.compile(r"\[([^\[\]]+)\]")


class NamedOutput(NamedTuple):
    """A network as it is named, without the parts of its output, and these."""

    spec: str
    parts: tuple[str, ...]


def split_parts(spec: str) -> NamedOutput:
    """Returns `net.onnx:points` and ("z",) of `net.onnx:points[z]`."""
    found = _NAMED.fullmatch(spec)
    if found is None:
        return NamedOutput(spec, ())
    return NamedOutput(found[1].removesuffix(":"), tuple(_PART.findall(found[2])))


def part_of(output: Any, part: str) -> Any:
    """Returns the element of a list or a mapping, or the channel of a tensor, of this name.

    Channels are counted from 0, or are x, y and z of a map of points. The axis of channels is the
    first or the last behind those of length 1, whichever is shorter.

    Raises:
        ModelError: There is no such part.
    """
    number = int(part) if part.isdecimal() else None
    if isinstance(output, Mapping):
        if part in output:
            return output[part]
        raise ModelError(f"the output has no part {part!r}; it has {', '.join(map(str, output))}")
    if isinstance(output, (list, tuple)):
        if number is not None and number < len(output):
            return output[number]
        raise ModelError(f"the output has no part {part!r}; it has 0 to {len(output) - 1}")
    if not isinstance(output, Tensor):
        raise ModelError(f"a {type(output).__name__} has no part {part!r}")
    return _channel_of(output, part, number)


def _channel_of(output: Tensor, part: str, number: int | None) -> Tensor:
    """The channel as a map (1, 1, h, w)."""
    shape = "×".join(map(str, output.shape))
    maps = output
    while maps.ndim > 3 and maps.shape[0] == 1:
        maps = maps[0]
    if maps.ndim == 2:
        maps = maps[None]
    if maps.ndim != 3:
        raise ModelError(f"an output of {shape} has no channel {part!r}")
    if maps.shape[2] < maps.shape[0]:
        maps = maps.permute(2, 0, 1)
    if part in _AXES and len(maps) == len(_AXES):
        number = _AXES.index(part)
    if number is None or number >= len(maps):
        named = ", or x, y, z" if len(maps) == len(_AXES) else ""
        listed = f"0 to {len(maps) - 1}{named}"
        raise ModelError(
            f"an output of {shape} has no channel {part!r}; name one of those that it has: {listed}"
        )
    return maps[number][None, None]
