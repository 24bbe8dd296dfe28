"""The `pnpdepth` command: its subcommands, and the one place where errors become text."""

from __future__ import annotations

import ctypes
import errno
import gc
import importlib
import io
import os
import sys
import traceback
import warnings
from contextlib import suppress
from typing import NoReturn

import click

from pnpdepth_cli import errors
from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.cli.terminal import INTERRUPTED, printable, say
from pnpdepth_cli.version import __version__

_EXIT_CODES = """\b
Exit codes: 0 done · 1 a bug of this program · 2 wrong usage or output · 3 input file · 4 network,
layer or checkpoint · 5 refinement diverged · 6 device or memory · 7 some frames failed ·
130 interrupted. Networks in .py files are code and are run."""

_TRIM_THRESHOLD = -1
"""Parameter of mallopt, as in malloc.h: free bytes at the end of the heap that stay there."""
_MMAP_MAX = -4
"""Parameter of mallopt, as in malloc.h: how many large blocks may lie outside of the heap."""
_KEPT_BYTES = 1 << 30
"""Free bytes at the end of the heap that are not given back: 1 GiB."""

_LONGEST = 2000
"""Most characters of a message; a longer one loses its middle."""

_OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
"""What the operating system says of a disk that takes no more; anything else is of an input."""

COMMANDS = (
    "refine",
    "batch",
    "models",
    "layers",
    "project",
    "frames",
    "sample",
    "simulate",
    "cloud",
    "export",
    "eval",
    "compare",
    "doctor",
)
"""The subcommands in the order of the help: each is `command` of its file in `pnpdepth_cli.cli`."""


class _Commands(click.Group):
    """Imports a subcommand only when it is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Returns the names of the subcommands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Returns the subcommand of this name, imported; None if there is none."""
        if cmd_name not in COMMANDS:
            return None
        command = importlib.import_module(f"pnpdepth_cli.cli.{cmd_name}").command
        assert isinstance(command, click.Command)
        return command


@click.group(
    cls=_Commands,
    epilog=_EXIT_CODES,
    # Every command knows both; where the two differ, a command has its own --help-all.
    context_settings={"help_option_names": ["-h", "--help", "--help-all"]},
)
@click.version_option(__version__, prog_name="pnpdepth")
@click.option(
    "--max-pixels",
    type=click.IntRange(1),
    metavar="N",
    help="Largest image to read; files may have 4 N bytes.  [default: memory / 64, at most 64e6]",
)
def cli(max_pixels: int | None) -> None:
    """Refine the depth of any depth network with sparse depth, without training."""
    set_max_pixels(max_pixels)


def main(arguments: list[str] | None = None) -> NoReturn:
    """Runs the command line and raises SystemExit with the exit code of what happened."""
    # Looking for garbage among imported modules, and once more at the end, takes 0.5 s of 2 s. So
    # Python looks for it less often, and not at all at the end.
    gc.set_threshold(10_000)
    _keep_freed_memory()
    _let_idle_threads_sleep()
    code = run(sys.argv[1:] if arguments is None else arguments)
    gc.freeze()
    sys.exit(code)


def _keep_freed_memory() -> None:
    """glibc keeps the memory of freed tensors for the next ones.

    Else it gives large blocks back at once, and the system clears them again, page by page: half of
    the processor's time of a pass of a network. Other systems are left as they are.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # a libc without mallopt
            libc = ctypes.CDLL(None)
            libc.mallopt(_MMAP_MAX, 0)
            libc.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)


def _let_idle_threads_sleep() -> None:
    """Idle threads of OpenMP sleep, unless the user says otherwise; read when torch is imported.

    Else they spin, and where other programs take the cores a command takes six times as long
    (docs/notes/updates.md).
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def run(arguments: list[str]) -> int:
    """Returns the exit code. Every error becomes one line on stderr, a bug its traceback too.

    Args:
        arguments: Words of the command line behind `pnpdepth`.
    """
    # The command.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal without σ still shows the rest
    try:
        with warnings.catch_warnings():
            # NumPy's warnings of inf and NaN tell a user nothing; the program's own checks do.
            warnings.simplefilter("ignore", RuntimeWarning)
            return cli.main(arguments, prog_name="pnpdepth", standalone_mode=False) or 0
    # Errors that have a message of their own, and ends that are no errors.
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except errors.PnpDepthError as error:
        return _end(error, error.exit_code)
    except SystemExit:  # after a completion, or of a reader that stopped: `pnpdepth models | head`
        return 0
    except click.Abort:
        return _end("interrupted", INTERRUPTED)
    # What the operating system refuses: of a disk that takes no more, else of an input.
    except OSError as error:
        reason = error.strerror or str(error)
        if error.filename is not None:
            reason = f"{os.fsdecode(error.filename)}: {reason}"
        is_of_output = error.errno in _OUTPUT_ERRORS
        error_class = errors.OutputError if is_of_output else errors.InputError
        return _end(reason, error_class.exit_code)
    # Memory, or a bug.
    except Exception as error:
        if errors.is_out_of_memory(error):
            return _end("memory is exhausted; use a smaller image", errors.DeviceError.exit_code)
        traceback.print_exception(error)
        return _end(
            f"internal error ({type(error).__name__}: {error}); it is a bug of this program, please"
            " report it",
            1,
        )


def _end(message: object, code: int) -> int:
    """Prints the message as one line, after what was printed before it. Returns the code."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    # Nothing more can be written there, and Python must not try it again when it ends.
    except OSError:
        sys.stdout = None
    text = printable(message)
    if len(text) > _LONGEST:
        half = _LONGEST // 2
        text = f"{text[:half]} … {text[-half:]}"
    say(f"pnpdepth: {text}")
    return code
