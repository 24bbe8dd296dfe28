"""What only Unix has is on the way of no command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SAMPLES = Path(__file__).parents[2] / "samples"

REFINE = """
import sys
from pnpdepth_cli.cli.main import main
main(sys.argv[1:])
"""
WITHOUT_UNIX = """
import importlib, pkgutil, sys
import psutil  # has a module for each system; the one for Linux needs `resource`
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
import pnpdepth_cli
for module in pkgutil.walk_packages(pnpdepth_cli.__path__, "pnpdepth_cli."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
"""


@pytest.mark.slow
def test_refine_gives_the_same_where_python_has_neither_fcntl_nor_resource(tmp_path: Path) -> None:
    for name, code in (("with", REFINE), ("without", WITHOUT_UNIX + REFINE)):
        done = subprocess.run(
            [
                *(sys.executable, "-c", code, "refine", SAMPLES / "indoor/rgb.png", "--sparse"),
                *(SAMPLES / "indoor/sparse.png", "-o", tmp_path / name, "--iterations", "1"),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    one, other = (tmp_path / name / "rgb_depth.png" for name in ("with", "without"))
    assert one.read_bytes() == other.read_bytes()
