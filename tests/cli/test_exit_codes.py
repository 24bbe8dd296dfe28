"""Every command ends with the code of the kind of its error, and says it in a line on stderr."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.cli.main import run
from tests.commands.scan_frames import scan_on_disk

NETWORK = "--model drive/net/my_net.py --checkpoint drive/net/my_net.safetensors"
COMMANDS = {
    "refine": f"drive/rgb/a.png --sparse drive/sparse/a.png -o out {NETWORK}",
    "batch": f"drive -o out {NETWORK}",
    "sample": "drive/gt/a.png -o sparse.png",
    "simulate": "drive/gt/a.png --calib calib.txt --sensor vlp-16 -o sparse.png",
    "project": "img.bin --calib calib.txt -o sparse.png",
    "eval": "drive/gt drive/gt",
}


@pytest.mark.parametrize(
    ("command", "more", "code", "message"),
    [
        ("refine", f"--layer {'n' * 5000}", 4, "layers --all"),
        ("refine", f"--model {'n' * 5000}.onnx", 3, ": "),
        ("refine", "--checkpoint missing.pt", 4, "does not exist"),
        ("refine", "--device cuda:9", 6, "device cpu"),
        ("batch", "--shard 0/2", 2, "1/4"),
        ("batch", "--poses one_pose.txt", 3, "has 1 poses for 2 frames"),
        ("batch", "--accumulate -1", 2, "-1 is not in the range x>=0"),
        ("batch", "--adapt --shard 1/2", 2, "--adapt does not go with --shard"),
        ("--max-pixels 10 sample", "--count 5", 3, "pixels"),
        ("sample", "--count many", 2, "neither a number such as 500 nor 5%"),
        ("project", "--image missing.png", 3, "missing.png"),
        ("eval", "--protocol kiti", 2, "kitti"),
        ("eval", "--columns rmse,none", 2, "--columns none is not one of rmse, mae"),
        ("compare a.json b.json", "--csv x --latex ./x", 2, "--csv and --latex are the same file"),
        ("eval", "--json --csv -", 2, "can go to stdout"),
        ("eval", "--protocol nyu-eigen", 3, "640×480"),
        ("compare a.json b.json", "", 3, "a.json"),
    ],
)
def test_the_exit_code_is_that_of_the_kind_of_error(
    root: Path, capsys: pytest.CaptureFixture[str], command: str, more: str, code: int, message: str
) -> None:
    scan_on_disk(root.parent)
    Path("one_pose.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    before = sorted(root.rglob("*"))
    assert run(f"{command} {COMMANDS.get(command.split()[-1], '')} {more}".split()) == code
    out, err = capsys.readouterr()
    last = err.splitlines()[-1]
    assert message in last
    assert len(last) < 2100
    assert (out, "Traceback" in err) == ("", False)
    assert sorted(root.rglob("*")) == before
    # a network is loaded in the folder of its results, which stays
    outputs = ("sparse.png", "w.safetensors", "x", *(["out"] if code < 4 else []))
    assert not any(Path(name).exists() for name in outputs)
