"""docs/extending.md: the files it shows work from another package, through entry points."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import save_file

from pnpdepth_cli.models.registry import find_definition
from tests.test_readme import YOUR_NETWORK, titled_blocks
from tests.test_readme import run as run_python

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
SHOWN = titled_blocks(ROOT / "docs" / "extending.md")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder that holds the page's files as an installed package, and the samples."""
    folder = tmp_path
    info = folder / "my_package-1.0.dist-info"
    for each in (folder / "my_package", info):
        each.mkdir()
    files = {**SHOWN, "__init__.py": "", "my_net.py": titled_blocks(YOUR_NETWORK)["my_net.py"]}
    for name, text in files.items():
        (folder / "my_package" / name).write_text(text)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    entries = SHOWN["pyproject.toml"].replace('[project.entry-points."', "[").replace('"]\n', "]\n")
    (info / "entry_points.txt").write_text(entries.replace('"', ""))
    shutil.copytree(ROOT / "samples" / "indoor", folder / "indoor")
    network = find_definition(str(folder / "my_package" / "my_net.py")).build()
    save_file(network.state_dict(), folder / "my_net.safetensors")
    return folder


def run(arguments: list[str], folder: Path) -> str:
    return run_python(["-m", "pnpdepth_cli", *arguments], folder, str(folder))


def test_the_files_of_the_page_work_from_another_package(package: Path) -> None:
    files = ["indoor/rgb.png", "--sparse", "indoor/sparse.png"]
    network = ["--model", "my-net", "--checkpoint", "my_net.safetensors", "--align", "none"]
    method = ["--loss", "charbonnier", "--update", "rmsprop", "--lr", "1%"]
    more = ["--propagate", "median", "--baselines", "--format", "raw"]
    frames = "image,sparse,calib\nindoor/rgb.png,indoor/sparse.png,k.txt\n"
    (package / "list.csv").write_text(frames)
    (package / "k.txt").write_text("K: [550, 0, 320, 0, 550, 240, 0, 0, 1]")
    run(["batch", "list.csv", *network, *method, *more, "-o", "out"], package)
    record = json.loads((package / "out" / "rgb.json").read_text())
    assert record["model"]["name"] == "my-net"
    named = [record["settings"][key] for key in ("loss", "update", "propagate")]
    assert named == ["charbonnier", "rmsprop", "median"]
    assert record["errors"]["validation"]["farthest"]["mae"] > 0
    assert record["loss"][-1] < record["loss"][0]
    files_of = [f"my_package/{name}.py" for name in ("charbonnier", "rmsprop")]
    by_file = ["--loss", files_of[0], "--update", files_of[1], "--lr", "1%"]
    by_file += ["--propagate", "median", "-o", "by_file.raw", "--json"]
    again = json.loads(run(["refine", *files, *network, *by_file], package))
    assert again["loss"] == record["loss"]
    measures = ["--columns", "mae,median_error", "--json"]
    scores = json.loads(run(["eval", "out/rgb_depth.raw", "indoor/gt.png", *measures], package))
    assert {"rmse", "median_error"} <= {each["key"] for each in scores["measures"]}
    assert scores["mean"]["median_error"] < scores["mean"]["mae"]
    run(["export", "out", "--to", "arrays", "-o", "exported"], package)
    raw = (package / "out" / "rgb_depth.raw").read_bytes()
    depth = np.load(package / "exported" / "rgb.npy")
    np.testing.assert_array_equal(depth.ravel(), np.frombuffer(raw, "<f4", offset=12))
    # A folder in the layout of the page.
    (package / "data").mkdir()
    shutil.copy(package / "indoor" / "rgb.png", package / "data" / "a_image.png")
    shutil.copy(package / "indoor" / "sparse.png", package / "data" / "a_lidar.png")
    run(["batch", "data", "-o", "flat", "--iterations", "0"], package)
    assert (package / "flat" / "a.json").is_file()
