"""docs/extending.md: the files it shows work from another package, through entry points."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import save_file

from pnpdepth_cli.models.registry import find_definition
from tests.pages import ROOT, YOUR_NETWORK, run_python, titled_blocks

pytestmark = pytest.mark.slow

SHOWN = titled_blocks(ROOT / "docs" / "extending.md")
NETWORK = ["--model", "my-net", "--checkpoint", "my_net.safetensors", "--align", "none"]


def pnpdepth(folder: Path, *arguments: str) -> str:
    """What the command printed, with the packages in the folder."""
    return run_python(["-m", "pnpdepth_cli", *arguments], folder, str(folder))


def install(folder: Path) -> None:
    """Writes the page's files as an installed package."""
    package = folder / "my_package"
    info = folder / "my_package-1.0.dist-info"
    package.mkdir()
    info.mkdir()
    shown = {**SHOWN, "__init__.py": "", "my_net.py": titled_blocks(YOUR_NETWORK)["my_net.py"]}
    for name, text in shown.items():
        (package / name).write_text(text)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    entries = SHOWN["pyproject.toml"].replace('[project.entry-points."', "[").replace('"]\n', "]\n")
    (info / "entry_points.txt").write_text(entries.replace('"', ""))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package, a sample, and the batch of it by the objects of the package."""
    folder = tmp_path_factory.mktemp("extended")
    install(folder)
    shutil.copytree(ROOT / "samples" / "indoor", folder / "indoor")
    network = find_definition(str(folder / "my_package" / "my_net.py")).build()
    save_file(network.state_dict(), folder / "my_net.safetensors")
    frames = "image,sparse,calib\nindoor/rgb.png,indoor/sparse.png,k.txt\n"
    (folder / "list.csv").write_text(frames)
    (folder / "k.txt").write_text("K: [550, 0, 320, 0, 550, 240, 0, 0, 1]")
    method = ["--loss", "charbonnier", "--update", "rmsprop", "--lr", "1%"]
    more = ["--propagate", "median", "--baselines", "--format", "raw"]
    pnpdepth(folder, "batch", "list.csv", *NETWORK, *method, *more, "-o", "out")
    return folder


@pytest.fixture(scope="module")
def record(folder: Path) -> Any:
    return json.loads((folder / "out" / "rgb.json").read_text())


def test_a_network_a_loss_a_rule_and_a_propagation_are_used_by_name(record: Any) -> None:
    assert record["result"]["model"]["name"] == "my-net"
    named = [record["result"]["settings"][key] for key in ("loss", "update", "propagate")]
    assert named == ["charbonnier", "rmsprop", "median"]
    assert record["result"]["loss"][-1] < record["result"]["loss"][0]


def test_a_baseline_is_scored(record: Any) -> None:
    assert record["errors"]["validation"]["farthest"]["mae"] > 0


def test_a_loss_and_a_rule_in_files_do_what_they_do_by_name(folder: Path, record: Any) -> None:
    files = ["indoor/rgb.png", "--sparse", "indoor/sparse.png"]
    method = ["--loss", "my_package/charbonnier.py", "--update", "my_package/rmsprop.py"]
    more = ["--lr", "1%", "--propagate", "median", "-o", "by_file.raw", "--json"]
    again = json.loads(pnpdepth(folder, "refine", *files, *NETWORK, *method, *more))
    assert again["result"]["loss"] == record["result"]["loss"]


def test_a_measure_is_a_column_of_depth_in_a_format_of_the_package(folder: Path) -> None:
    columns = ["--columns", "mae,median_error", "--json"]
    printed = pnpdepth(folder, "eval", "out/rgb_depth.raw", "indoor/gt.png", *columns)
    scores = json.loads(printed)
    assert {"rmse", "median_error"} <= {measure["key"] for measure in scores["measures"]}
    assert scores["mean"]["median_error"] < scores["mean"]["mae"]


def test_an_export_writes_the_depth_of_the_results(folder: Path) -> None:
    pnpdepth(folder, "export", "out", "--to", "arrays", "-o", "exported")
    raw = (folder / "out" / "rgb_depth.raw").read_bytes()
    depth = np.load(folder / "exported" / "rgb.npy")
    np.testing.assert_array_equal(depth.ravel(), np.frombuffer(raw, "<f4", offset=12))


def test_a_folder_in_a_layout_of_the_package_is_a_batch(folder: Path) -> None:
    (folder / "data").mkdir()
    shutil.copy(folder / "indoor" / "rgb.png", folder / "data" / "a_image.png")
    shutil.copy(folder / "indoor" / "sparse.png", folder / "data" / "a_lidar.png")
    pnpdepth(folder, "batch", "data", "-o", "flat", "--iterations", "0")
    assert (folder / "flat" / "a.json").is_file()
