"""A valid file, and the command line that reads it."""

from __future__ import annotations

from dataclasses import dataclass, field

HEIGHT, WIDTH = 24, 32
IMAGE = ("--image", "rgb.png")
"""Of HEIGHT × WIDTH pixels."""
OUT = ("-o", "out.png", "--overwrite")
LISTING = ("-o", "batch", "--limit", "1", "--shard", "2/2")
"""Of a batch that lists its frames and refines none."""


@dataclass(frozen=True, kw_only=True)
class Seed:
    """A valid file, and a command that reads it."""

    file: str
    """The file that is damaged, relative to the working folder."""
    command: tuple[str, ...]
    """Arguments of `pnpdepth`."""
    scratch: tuple[str, ...] = field(
        default=(
            *("out.png", "out.png.json", "out.json", "out.ply", "out.ply.json"),
            *("batch", "frames", "refined"),
        )
    )
    """Files and folders that the command may write."""
