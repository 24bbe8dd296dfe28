"""Every error a user can cause, as one tree; each class carries its exit code.

A message names the object, the fact and the remedy, on one line. So do the errors made of what a
user's code raises, such as a network's forward.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar


class PnpDepthError(Exception):
    """The root of the tree; `exit_code` is the exit status of the process."""

    exit_code: ClassVar[int] = 1


class UsageError(PnpDepthError):
    """An option or argument makes no sense."""

    exit_code = 2


class OutputError(UsageError):
    """The output path cannot be used."""


class StorageError(OutputError):
    """Nothing more can be written: the disk is full, gone or read-only."""


class InputError(PnpDepthError):
    """A file is missing, damaged or of another kind, or files do not fit each other."""

    exit_code = 3


def unequal_sizes(
    what: str, own: tuple[int, ...], other: str, size: tuple[int, ...], way_out: str = ""
) -> InputError:
    """Returns the error of two things whose sizes (H, W) should be equal."""
    return InputError(f"{what} is {own[1]}×{own[0]} but {other} is {size[1]}×{size[0]}{way_out}")


class NoPointsError(InputError):
    """There is no sparse depth to work with."""


class ModelError(PnpDepthError):
    """The network, its definition, its layer or its weights cannot be used."""

    exit_code = 4


class DivergedError(PnpDepthError):
    """Refinement produced non-finite numbers; `last_good` holds the result before that."""

    exit_code = 5

    def __init__(self, message: str, last_good: Any = None) -> None:
        super().__init__(message)
        self.last_good = last_good


class DeviceError(PnpDepthError):
    """The device or the cluster is absent, or out of memory."""

    exit_code = 6


class FramesFailedError(PnpDepthError):
    """A batch finished, but some of its frames failed."""

    exit_code = 7


@contextmanager
def wrap_user_errors(what: str) -> Iterator[None]:
    """Turns exceptions inside the block into a ModelError "`what` raises …".

    Errors of this program and exhausted memory are raised as they are.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, PnpDepthError) or is_out_of_memory(error):
            raise
        raise ModelError(f"{what} raises {describe(error)}") from error


def describe(error: BaseException, file: Path | None = None) -> str:
    """Returns the exception on one line, with the number of the line of `file` that raised it."""
    text = " ".join(str(error).split())[:300]
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if file and Path(f.filename).resolve() == file.resolve()]
    line = f" (line {lines[-1]})" if lines else ""
    return f"{type(error).__name__}: {text}{line}" if text else f"{type(error).__name__}{line}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch, Python or the loader of libraries report exhausted memory by the exception."""
    messages = ("out of memory", "allocate memory", "ALLOC_FAILED", "bad_alloc", "map segment")
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError | ImportError)
        and any(message in str(error) for message in messages)
    )


@contextmanager
def out_of_memory_is_a_device_error(device: object) -> Iterator[None]:
    """Inside, running out of memory becomes a DeviceError."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise DeviceError(
            f"device {str(device)!r} is out of memory; use a smaller image or another device"
        ) from None
