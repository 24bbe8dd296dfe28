"""Pages of the documentation: the commands and files that they show, and Python to run them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
YOUR_NETWORK = ROOT / "docs" / "guides" / "your-network.md"
BLOCK = re.compile(r'^```(\w+)(?: title="(.+?)")?\n(.*?)^```', re.DOTALL | re.MULTILINE)


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in this language, with or without a title."""
    return [
        text for of_block, _, text in BLOCK.findall(page.read_text("utf-8")) if of_block == language
    ]


def shown_commands(page: Path) -> list[list[str]]:
    """The arguments of the `pnpdepth …` lines of the console blocks, continued lines joined."""
    lines = "\n".join(blocks(page, "console")).replace("\\\n", " ").splitlines()
    commands = (line.removeprefix("$ ").split("  #")[0] for line in lines)
    return [shlex.split(text.removeprefix("pnpdepth ")) for text in commands if text.strip()]


def titled_blocks(page: Path) -> dict[str, str]:
    """The files that a page shows, by their name."""
    return {title: text for _, title, text in BLOCK.findall(page.read_text("utf-8")) if title}


def run_python(arguments: list[str], folder: Path, *path: str) -> str:
    """What the finished Python process printed. Fails with its stderr if it failed."""
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *path])},
        capture_output=True, text=True, check=False, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout
