from __future__ import annotations

import pytest

from tests.cli.test_commands import code_of
from tests.commands.frames import FrameOnDisk


def bench(frame: FrameOnDisk, *more: str) -> list[str]:
    return [
        "bench", "--model", str(frame.model), "--checkpoint", str(frame.checkpoint),
        "--size", "24x32", "--points", "50", "--repeats", "1", *more,
    ]  # fmt: skip


def test_the_table_goes_to_stdout_and_what_it_was_measured_with_to_stderr(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(bench(frame, "--layer", "encode", "--iterations", "2")) == 0
    out, err = capsys.readouterr()
    assert "cut at encode, 32×24, 50 points, K = 2, fp32" in " ".join(out.split())
    for part in ("forward", "rear and gradient", "refinement"):
        assert part in out
    assert "the limit is" in out
    assert "torch" in err


@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        (["--repeats", "0"], 2, "0 is not in the range x>=1"),
        (["--layer", "encod"], 4, "did you mean encode"),
        (["--size", "big"], 2, "HxW"),
    ],
)
def test_the_exit_code_is_that_of_the_kind_of_error(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str], more: list[str], code: int, message: str
) -> None:
    assert code_of(bench(frame, *more)) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert "Traceback" not in err
