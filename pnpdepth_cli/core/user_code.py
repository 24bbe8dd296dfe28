"""Exceptions of user code, such as a network's forward, as errors with one-line messages."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from pnpdepth_cli.errors import DeviceError, ModelError, PnpDepthError


@contextmanager
def wrap_user_errors(what: str) -> Iterator[None]:
    """Turns exceptions inside the block into a ModelError "`what` raises …".

    Errors of this program and exhausted memory are raised as they are.
    """
    try:
        yield
    except PnpDepthError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
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
    """Whether the exception is one of those by which torch and Python report exhausted memory."""
    messages = ("out of memory", "can't allocate memory", "ALLOC_FAILED")
    return isinstance(error, torch.cuda.OutOfMemoryError | MemoryError) or (
        isinstance(error, RuntimeError) and any(message in str(error) for message in messages)
    )


@contextmanager
def out_of_memory_is_a_device_error(device: torch.device) -> Iterator[None]:
    """Inside, running out of memory becomes a DeviceError."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise DeviceError(
            f"device {str(device)!r} is out of memory; use a smaller image or another device"
        ) from None
