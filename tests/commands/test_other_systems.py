"""What only Unix has is on the way of no command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[2] / "samples/indoor"
WITHOUT_UNIX = """
import importlib, pkgutil, sys
import psutil  # has a module for each system; the one for Linux needs `resource`
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
import pnpdepth_cli
for module in pkgutil.walk_packages(pnpdepth_cli.__path__, "pnpdepth_cli."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from pnpdepth_cli.cli.main import main
main(sys.argv[1:])
"""


@pytest.mark.slow
def test_refine_works_where_python_has_neither_fcntl_nor_resource(tmp_path: Path) -> None:
    files = [str(SAMPLE / "rgb.png"), "--sparse", str(SAMPLE / "sparse.png")]
    options = ["--iterations", "1", "-o", str(tmp_path / "depth.npy")]
    command = [sys.executable, "-c", WITHOUT_UNIX, "refine", *files, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "depth.npy").is_file()
