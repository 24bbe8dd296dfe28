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

_LONGEST_TEXT = 300  # characters that are shown of the message of a user's exception

_OUT_OF_MEMORY = (
    "out of memory",  # torch, on a GPU
    "allocate memory",  # torch, on the CPU
    "ALLOC_FAILED",  # cuBLAS and cuDNN
    "bad_alloc",  # C++
    "map segment",  # the loader of shared libraries
)
"""Parts of messages by which exhausted memory is known."""


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
    name: str,
    size: tuple[int, ...],
    other_name: str,
    other_size: tuple[int, ...],
    way_out: str = "",
) -> InputError:
    """Returns the error of two images whose sizes differ but should be equal.

    Args:
        name: Name of the first image in the message.
        size: Its shape, which begins with H and W.
        other_name: Name of the second image in the message.
        other_size: Its shape, which begins with H and W.
        way_out: End of the message: what the user can do.
    """
    return InputError(
        f"{name} is {size[1]}×{size[0]} but {other_name} is {other_size[1]}×{other_size[0]}"
        f"{way_out}"
    )


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

    Args:
        what: Name of the user's code in the message, such as "the network's forward".
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, PnpDepthError) or is_out_of_memory(error):
            raise
        raise ModelError(f"{what} raises {describe(error)}") from error


def describe(error: BaseException, file: Path | None = None) -> str:
    """Returns the exception's type and message on one line, the message cut if it is long.

    Args:
        error: Exception that was raised.
        file: Python file of a user. The number of its line that raised the exception is added.
    """
    line = ""
    if file is not None:
        calls = traceback.extract_tb(error.__traceback__)  # the innermost call is the last
        lines = [call.lineno for call in calls if Path(call.filename).resolve() == file.resolve()]
        if lines:
            line = f" (line {lines[-1]})"
    name = type(error).__name__
    text = " ".join(str(error).split())[:_LONGEST_TEXT]
    return f"{name}: {text}{line}" if text else f"{name}{line}"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the exception says that memory is exhausted.

    Python raises a MemoryError. torch raises a RuntimeError, and the loader of shared libraries
    makes an import fail; both say it only in their message.
    """
    if isinstance(error, MemoryError):
        return True
    if not isinstance(error, RuntimeError | ImportError):
        return False
    return any(message in str(error) for message in _OUT_OF_MEMORY)


@contextmanager
def out_of_memory_is_a_device_error(device: object) -> Iterator[None]:
    """Turns exhausted memory inside the block into a DeviceError that names the device."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise DeviceError(
            f"device {str(device)!r} is out of memory; use a smaller image or another device"
        ) from None
