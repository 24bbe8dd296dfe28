"""Code that is not ours: what a network or a model file raises, said on one line."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from pnpdepth_cli.errors import ModelError, PnpDepthError


@contextmanager
def wrap_user_errors(what: str) -> Iterator[None]:
    """An exception inside becomes ModelError(`what` raises …); memory running out stays itself."""
    try:
        yield
    except PnpDepthError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise ModelError(f"{what} raises {describe(error)}") from error


def describe(error: BaseException, file: Path | None = None) -> str:
    """The exception on one line, with the line of `file` it came through, if it did."""
    text = " ".join(str(error).split())[:300]
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if file and Path(f.filename).resolve() == file.resolve()]
    place = f" (line {lines[-1]})" if lines else ""
    return f"{type(error).__name__}: {text}{place}" if text else f"{type(error).__name__}{place}"


def is_out_of_memory(error: BaseException) -> bool:
    """True for the several ways torch and Python say so."""
    said = ("out of memory", "can't allocate memory", "ALLOC_FAILED")
    return isinstance(error, torch.cuda.OutOfMemoryError | MemoryError) or (
        isinstance(error, RuntimeError) and any(words in str(error) for words in said)
    )
