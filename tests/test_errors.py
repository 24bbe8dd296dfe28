"""What code that is not ours raises, on one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from pnpdepth_cli.errors import ModelError, describe, wrap_user_errors


def test_an_exception_inside_is_blamed_on_one_line_and_kept_as_the_cause() -> None:
    with pytest.raises(ModelError) as error, wrap_user_errors("the network's forward"):
        raise ValueError("a\n  b\n\n c")
    assert str(error.value) == "the network's forward raises ValueError: a b c"
    assert isinstance(error.value.__cause__, ValueError)


@pytest.mark.parametrize(
    "error",
    [
        ModelError("our own"),
        KeyboardInterrupt(),
        MemoryError(),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB"),
        RuntimeError("MPS backend out of memory (MPS allocated: 1 GB)"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to"),
    ],
)
def test_our_own_errors_ends_and_exhausted_memory_pass_through(error: BaseException) -> None:
    with pytest.raises(type(error)) as raised, wrap_user_errors("x"):
        raise error
    assert raised.value is error


def test_the_line_of_an_error_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "raises.py"
    file.write_text("def f():\n    return 1 / 0\n\n\nf()\n")
    with pytest.raises(ZeroDivisionError) as error:
        exec(compile(file.read_text(), str(file), "exec"), {})
    monkeypatch.chdir(tmp_path)
    for named in (file, Path("raises.py"), Path(os.curdir) / "raises.py"):
        assert describe(error.value, named) == "ZeroDivisionError: division by zero (line 2)"
    assert describe(error.value) == "ZeroDivisionError: division by zero"
    assert describe(ValueError()) == "ValueError"
    assert len(describe(ValueError("x" * 9999))) < 400
