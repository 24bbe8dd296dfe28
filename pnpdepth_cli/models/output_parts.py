"""The one tensor that is depth in what a network gives: `net.onnx:points[z]`, `net.pt2:[1]`.

Each name in square brackets behind the network chooses an entry, or a channel of a tensor.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor

from pnpdepth_cli.errors import ModelError

_AXES = ("x", "y", "z")
"""Names of the channels of a map of points."""
_NETWORK_AND_PARTS = re.compile(r"(.+:[^:\[\]]*?)((?:\[[^\[\]]+\])+)", re.DOTALL)
"""FILE:OUTPUT or FILE: in the first group, all of the brackets behind it in the second."""
_PART = re.compile(r"\[([^\[\]]+)\]")


class NamedOutput(NamedTuple):
    """A network as a user names it, and which part of its output is meant."""

    spec: str
    """The network without the parts, such as `net.onnx:points`."""
    parts: tuple[str, ...]
    """Names of entries or channels, the outermost first, such as ("z",); empty for the whole."""


def split_parts(spec: str) -> NamedOutput:
    """Returns a network as it is named without brackets, and the names in these; () without any.

    `net.onnx:points[z]` gives `net.onnx:points` and ("z",); `net.pt2:[1]` gives `net.pt2` and
    ("1",).
    """
    match = _NETWORK_AND_PARTS.fullmatch(spec)
    if match is None:
        return NamedOutput(spec, ())
    network, brackets = match.groups()
    # FILE: before brackets names no output.
    return NamedOutput(network.removesuffix(":"), tuple(_PART.findall(brackets)))


def part_of(output: Any, part: str) -> Any:
    """Returns the element of a list or a mapping, or the channel (1, 1, h, w) of a tensor.

    Args:
        output: What a network gives, or a part of that.
        part: Key in a mapping, or number from 0 in a list or of a channel; or x, y or z, the
            channels of a tensor that has three.

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
    """Returns a channel of a tensor as a map (1, 1, h, w).

    Args:
        output: (c, h, w) or (h, w, c), whichever has the shorter axis of channels, or (h, w), with
            any number of axes of length 1 before.
        part: Name of the channel.
        number: The name as a number; None if it is none.

    Raises:
        ModelError: There is no such channel.
    """
    shape = "×".join(map(str, output.shape))
    # As (c, h, w).
    maps = output
    while maps.ndim > 3 and maps.shape[0] == 1:
        maps = maps[0]
    if maps.ndim == 2:
        maps = maps[None]
    if maps.ndim != 3:
        raise ModelError(f"an output of {shape} has no channel {part!r}")
    is_channels_last = maps.shape[2] < maps.shape[0]
    if is_channels_last:
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
