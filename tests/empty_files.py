"""Empty files, for layouts that are recognised by names alone."""

from __future__ import annotations

import itertools
import re
from pathlib import Path


def touch(*paths: Path) -> None:
    """Creates the files and their folders."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def tree(root: Path, patterns: str) -> None:
    """Creates the files of patterns such as "rgb/{a,b}.png depth/a.png" below a folder."""
    for pattern in patterns.split():
        parts = re.split(r"\{([^}]*)\}", pattern)
        choices = [part.split(",") if index % 2 else [part] for index, part in enumerate(parts)]
        touch(*(root / "".join(path) for path in itertools.product(*choices)))
