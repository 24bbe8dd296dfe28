"""Where the process starts and ends: Ctrl-C at any moment is one line and code 130."""

from __future__ import annotations

import contextlib
import os
import signal
import sys


def main() -> None:
    """Runs the command line with the process's arguments and exits."""
    code = 128 + signal.SIGINT
    try:
        from pnpdepth_cli.cli.main import run

        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):
            os.write(2, b"pnpdepth: interrupted\n")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the results are written; end with their code
    sys.exit(code)
