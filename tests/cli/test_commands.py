from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from pnpdepth_cli.cli.main import main
from pnpdepth_cli.cli.options import request_of
from pnpdepth_cli.cli.refine import refine as refine_command
from pnpdepth_cli.io.depth import read_depth
from tests.commands.frames import FrameOnDisk


def code_of(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    return int(stop.value.code or 0)


def refine(frame: FrameOnDisk, *more: str) -> list[str]:
    model = [] if "--model" in more else ["--model", str(frame.model)]
    return [
        "refine", str(frame.image), "--sparse", str(frame.sparse), "-o", str(frame.folder / "out"),
        *model, "--checkpoint", str(frame.checkpoint),
        "--propagate", "none", *more,
    ]  # fmt: skip


def test_refine_talks_on_stderr_and_only_json_is_on_stdout(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(refine(frame, "--gt", str(frame.gt))) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "60 points, 1.6–3.0 m" in err
    assert "this depth is worse than linear interpolation" in err
    for word in ("RMSE", "δ1", "before", "after", "wrote", "peak"):
        assert word in err
    (line,) = [text for text in err.splitlines() if text.startswith("gt: ")]
    assert "--depth-scale" not in line
    assert code_of(refine(frame, "--json", "--overwrite")) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["settings"]["layer"], record["settings"]["iterations"]) == ("middle", 5)
    assert len(record["model"]["checkpoint_sha256"]) == 64


def test_a_divergence_ends_with_code_5_after_writing(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = frame.folder / "bad.py"
    source = frame.model.read_text()
    bad.write_text(
        source.replace("return 2 + 3 * self.decode(torch.tanh(", "return torch.exp(self.decode(")
    )
    assert code_of(refine(frame, "--model", str(bad), "--lr", "1e4")) == 5
    assert "not finite after" in capsys.readouterr().err
    assert read_depth(frame.folder / "out" / "img_depth.png").values.min() > 0


@pytest.mark.parametrize(
    ("output", "message"),
    [("gt.png/out", ""), ("depth.jpg", "depth is written as .png"), ("depth.hdr", "written as")],
)
def test_an_output_that_cannot_be_written_is_refused_in_one_line(
    output: str, message: str, frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of([*refine(frame), "-o", str(frame.folder / output)]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert not (frame.folder / output).exists()


def test_layers_lists_shape_stride_cost_and_field_and_why_some_cannot_be_cut(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["layers", "--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    assert code_of([*arguments, "--json", "--size", "40x48"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert list(rows) == ["encode", "middle"]
    assert (rows["encode"]["shape"], rows["encode"]["stride"]) == ([1, 8, 20, 24], 2)
    assert rows["encode"]["cost_behind"] > rows["middle"]["cost_behind"] > 0
    # a 4×4 transposed convolution of stride 2 reads 2×2 elements, the 3×3 before it 4×4
    assert [row["field_in_z"] for row in rows.values()] == [[4, 4], [2, 2]]
    assert [row["field_in_output"] for row in rows.values()] == [[14, 14], [6, 6]]
    assert code_of([*arguments, "--json", "--all"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(rows) == {"encode", "encode.0", "encode.1", "middle", "unused", "decode"}
    problem = rows["unused"]["problem"]
    assert "never runs" in problem
    assert code_of([*arguments, "--all", "--size", "40x48"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = {words[0]: words[1:] for words in map(str.split, lines) if words}
    assert shown["middle"][:5] == ["1×8×20×24", "2", "1", "k", "14%"]
    assert shown["middle"][6:] == ["ms", "2×2", "6×6"]
    assert int(shown["middle"][5]) < 1000
    assert shown["unused"] == ["–", *problem.split()]
    assert code_of(["layers", "--model", "eigen-tiny", "--all"]) == 0
    assert "fine.relu – fine.relu#1, fine.relu#2" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("command", ["sample", "simulate", "compare"])
@pytest.mark.parametrize("seed", ["-1", "99999999999999999999"])
def test_a_seed_that_no_generator_takes_is_refused(
    command: str, seed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of([command, "a", "b", "--seed", seed]) == 2
    assert "--seed" in capsys.readouterr().err


def test_a_stdout_that_cannot_show_every_character_shows_the_others(frame: FrameOnDisk) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pnpdepth_cli", "eval", frame.gt, frame.gt],
        env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    assert b"?1 ?  " in done.stdout


@pytest.mark.parametrize(
    ("variables", "spins"),
    [({}, "3000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, "None")],
)
def test_idle_threads_sleep_soon_unless_the_user_sets_how_they_wait(
    variables: dict[str, str], spins: str
) -> None:
    code = (
        "import os\nfrom pnpdepth_cli.cli.main import main\n"
        "try:\n    main(['--version'])\nexcept SystemExit:\n    pass\n"
        "print(os.environ.get('GOMP_SPINCOUNT'))\n"
    )
    others = {k: v for k, v in os.environ.items() if k not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=others | variables, capture_output=True, check=True)
    assert done.stdout.decode().splitlines()[-1] == spins


def test_the_default_method_prints_its_stages_beside_linear_interpolation(
    frame: FrameOnDisk, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--model", str(frame.model), "--checkpoint", str(frame.checkpoint)]
    command = ["refine", str(frame.image), "--sparse", str(frame.sparse), *options]
    assert code_of([*command, "--gt", str(frame.gt), "-o", str(frame.folder / "gt")]) == 0
    rows = capsys.readouterr().err
    order = ["tiny aligned", "with points, fused", "z updated", "residual propagated"]
    order.append("linear interpolation")
    assert sorted(order, key=rows.index) == order
    assert "updates (sign" not in rows
    assert code_of([*command, "-o", str(frame.folder / "no")]) == 0
    rows = capsys.readouterr().err
    assert "at 12 points that were hidden from the method" in " ".join(rows.split())
    assert "z updated" not in rows


def test_several_models_are_the_first_and_more() -> None:
    context = refine_command.make_context(
        "refine", ["a.png", "--sparse", "s.png", "--model", "fcrn-tiny", "--model", "eigen-tiny"]
    )
    values = {name: value for name, value in context.params.items() if name != "as_json"}
    network = request_of(values).network
    assert (network.model, network.more_models) == ("fcrn-tiny", ("eigen-tiny",))
