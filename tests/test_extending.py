"""docs/extending.md: the files it shows work from another package, through entry points."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import save_file

from pnpdepth_cli.models.registry import find_definition
from tests.pages import ROOT, YOUR_NETWORK, run_python, titled_blocks

pytestmark = pytest.mark.slow

SHOWN = titled_blocks(ROOT / "docs" / "extending.md")


def test_the_files_of_the_page_work_from_another_package(tmp_path: Path) -> None:
    def run(*arguments: str) -> str:
        return run_python(["-m", "pnpdepth_cli", *arguments], tmp_path, str(tmp_path))

    # The page's files as an installed package.
    package, info = tmp_path / "my_package", tmp_path / "my_package-1.0.dist-info"
    package.mkdir()
    info.mkdir()
    shown = {**SHOWN, "__init__.py": "", "my_net.py": titled_blocks(YOUR_NETWORK)["my_net.py"]}
    for name, text in shown.items():
        (package / name).write_text(text)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    entries = SHOWN["pyproject.toml"].replace('[project.entry-points."', "[").replace('"]\n', "]\n")
    (info / "entry_points.txt").write_text(entries.replace('"', ""))

    # A batch with the page's losses and rules, as a user has them.
    shutil.copytree(ROOT / "samples" / "indoor", tmp_path / "indoor")
    net = find_definition(str(package / "my_net.py")).build()
    save_file(net.state_dict(), tmp_path / "my_net.safetensors")
    files = ["indoor/rgb.png", "--sparse", "indoor/sparse.png"]
    network = ["--model", "my-net", "--checkpoint", "my_net.safetensors", "--align", "none"]
    method = ["--loss", "charbonnier", "--update", "rmsprop", "--lr", "1%"]
    more = ["--propagate", "median", "--baselines", "--format", "raw"]
    frames = "image,sparse,calib\nindoor/rgb.png,indoor/sparse.png,k.txt\n"
    (tmp_path / "list.csv").write_text(frames)
    (tmp_path / "k.txt").write_text("K: [550, 0, 320, 0, 550, 240, 0, 0, 1]")
    run("batch", "list.csv", *network, *method, *more, "-o", "out")
    record = json.loads((tmp_path / "out" / "rgb.json").read_text())
    assert record["model"]["name"] == "my-net"
    named = [record["result"]["settings"][key] for key in ("loss", "update", "propagate")]
    assert named == ["charbonnier", "rmsprop", "median"]
    assert record["errors"]["validation"]["farthest"]["mae"] > 0
    assert record["result"]["loss"][-1] < record["result"]["loss"][0]
    files_of = [f"my_package/{name}.py" for name in ("charbonnier", "rmsprop")]
    by_file = ["--loss", files_of[0], "--update", files_of[1], "--lr", "1%"]
    by_file += ["--propagate", "median", "-o", "by_file.raw", "--json"]
    again = json.loads(run("refine", *files, *network, *by_file))
    assert again["result"]["loss"] == record["result"]["loss"]
    measures = ["--columns", "mae,median_error", "--json"]
    scores = json.loads(run("eval", "out/rgb_depth.raw", "indoor/gt.png", *measures))
    assert {"rmse", "median_error"} <= {each["key"] for each in scores["measures"]}
    assert scores["mean"]["median_error"] < scores["mean"]["mae"]
    run("export", "out", "--to", "arrays", "-o", "exported")
    raw = (tmp_path / "out" / "rgb_depth.raw").read_bytes()
    depth = np.load(tmp_path / "exported" / "rgb.npy")
    np.testing.assert_array_equal(depth.ravel(), np.frombuffer(raw, "<f4", offset=12))
    # A folder in the layout of the page.
    (tmp_path / "data").mkdir()
    shutil.copy(tmp_path / "indoor" / "rgb.png", tmp_path / "data" / "a_image.png")
    shutil.copy(tmp_path / "indoor" / "sparse.png", tmp_path / "data" / "a_lidar.png")
    run("batch", "data", "-o", "flat", "--iterations", "0")
    assert (tmp_path / "flat" / "a.json").is_file()
