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
    "sweep": f"drive -o out {NETWORK} --plots none",
    "bench": f"{NETWORK} --size 24x32 --points 50 --repeats 1",
    "sample": "drive/gt/a.png -o sparse.png",
    "project": "img.bin --calib calib.txt -o sparse.png",
    "eval": "drive/gt drive/gt",
}


@pytest.mark.parametrize(
    ("command", "more", "code", "message"),
    [
        ("refine", "--layer encod", 4, "encode"),
        ("refine", "--checkpoint missing.pt", 4, "does not exist"),
        ("refine", "--device cuda", 6, "--device cpu"),
        ("batch", "--shard 0/2", 2, "1/4"),
        ("batch", "--workers 0", 2, "'--workers': 0 is not in the range x>=1"),
        ("batch", "--html-3d", 2, "name its folder with --html"),
        ("batch", "--html calib.txt/report", 2, "cannot be written (not a directory)"),
        ("batch", "--sample many", 2, "500"),
        ("batch", "--layer encod", 4, "encode"),
        ("batch", "--device cuda:9", 6, "--device cpu"),
        ("sweep", "--vary points=9 --set colour=red", 2, "no parameter 'colour'"),
        ("sweep", "--vary lr=1 --seeds 0", 2, "--seeds must be >= 1"),
        ("sweep", "--vary lr=1 --layout tum", 3, "does not look like 'tum'"),
        ("sweep", "--vary layer=encod,middle", 4, "encode"),
        ("bench", "--repeats 0", 2, "0 is not in the range x>=1"),
        ("bench", "--layer encod", 4, "did you mean encode"),
        ("bench", "--size big", 2, "HxW"),
        ("sample", "--count many", 2, "neither a number such as 500 nor 5%"),
        ("sample", "--pattern region:1,2,3", 2, "region:X,Y,W,H"),
        ("project", "--size 48", 2, "HxW"),
        ("project", "--size 48x64 --camera 1", 2, "leave out --camera"),
        ("project", "--size 48x64 --scan min-range=9,max-range=2", 2, "is empty"),
        ("project", "--size 48x64 --overlay o.png", 2, "needs the image"),
        ("project", "--image missing.png", 3, "missing.png"),
        ("project", "--size 48x64 --scan min-range=90", 3, "none of the scan's"),
        ("eval", "--protocol kiti", 2, "kitti"),
        ("eval", "--delta 1,2", 2, "--delta"),
        ("eval", "--delta fast", 2, "--delta"),
        ("eval", "--missing max", 2, "scores empty predictions as --max-depth"),
        ("eval", "--json --csv -", 2, "can go to stdout"),
        ("eval drive/gt drive/gt/a.png", "", 2, "two files or two folders"),
        ("eval", "--protocol nyu-eigen", 3, "640×480"),
        ("eval", "--sparse nowhere", 3, "nowhere"),
        ("compare a.json b.json", "", 3, "a.json"),
    ],
)
def test_the_exit_code_is_that_of_the_kind_of_error(
    root: Path, capsys: pytest.CaptureFixture[str], command: str, more: str, code: int, message: str
) -> None:
    scan_on_disk(root.parent)
    before = sorted(root.rglob("*"))
    assert run(f"{command} {COMMANDS.get(command, '')} {more}".split()) == code
    out, err = capsys.readouterr()
    assert message in err.splitlines()[-1]
    assert (out, "Traceback" in err) == ("", False)
    assert sorted(root.rglob("*")) == before
    assert not (root.parent / "sparse.png").exists()
