"""README, docs and the notebook: every command and example runs, on a copy of the samples."""

from __future__ import annotations

import json
import re
import shutil
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import save_file
from scipy.spatial import cKDTree

from pnpdepth_cli.io.scans import read_scan
from pnpdepth_cli.models.registry import find_definition
from tests.pages import ROOT, YOUR_NETWORK, blocks, run_python, shown_commands, titled_blocks

README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
RECONSTRUCTION = ROOT / "docs" / "guides" / "reconstruction.md"
WRITES_FILES = ("refine", "project", "sample", "simulate", "cloud")


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the samples, and the network of the guide with weights."""
    shutil.copytree(ROOT / "samples", tmp_path / "samples")
    (tmp_path / "my_net.py").write_text(titled_blocks(YOUR_NETWORK)["my_net.py"])
    network = find_definition(str(tmp_path / "my_net.py")).build()
    save_file(network.state_dict(), tmp_path / "my_net.safetensors")
    return tmp_path


WITH_COMMANDS = [page for page in PAGES if shown_commands(page) and page != RECONSTRUCTION]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_COMMANDS, ids=named)
def test_the_commands_of_a_page_run(page: Path, folder: Path) -> None:
    for name, code in titled_blocks(page).items():
        (folder / name).write_text(code)
    for arguments in shown_commands(page):
        if arguments[0] == "python":
            run_python(arguments[1:], folder)
            continue
        # those with a * as the shell hands them over
        paths = [map(str, sorted(folder.glob(a))) if "*" in a else [a] for a in arguments]
        overwrite = ["--overwrite"] if arguments[0] in WRITES_FILES else []
        run_python(["-m", "pnpdepth_cli", *chain(*paths), *overwrite], folder)


@pytest.mark.slow
@pytest.mark.parametrize("page", [README, ROOT / "docs" / "python-api.md"], ids=named)
def test_the_python_example_of_a_page_runs(page: Path, folder: Path) -> None:
    (code,) = [block for block in blocks(page, "python") if "import pnpdepth_cli as pnp" in block]
    assert run_python(["-c", code], folder)


@pytest.mark.parametrize("name", ["main-job", "tests"])
def test_the_readme_marks_the_commands_that_ci_runs(name: str) -> None:
    text = README.read_text(encoding="utf-8")
    assert re.search(rf"<!-- {name} -->\n```sh\n.*\.venv/bin/", text)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def test_the_notebook_runs_and_betters_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.chdir(ROOT / "samples")
    names: dict[str, Any] = {}
    for cell in json.loads(Path("tour.ipynb").read_text())["cells"]:
        assert not cell.get("outputs")
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "tour.ipynb", "exec"), names)
    refined = names["refined"]
    truth = names["truth"]
    known = names["truth"] > 0
    before, after = (abs(d - truth)[known].mean() for d in (refined.before, refined.depth))
    assert after < 0.1 * before


@pytest.mark.slow
def test_the_guide_of_reconstruction_gives_the_scene_and_every_export(folder: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    (script,) = blocks(RECONSTRUCTION, "python")
    (folder / "reconstruct.py").write_text(script)
    for program, *arguments in shown_commands(RECONSTRUCTION):
        command = [] if program == "python" else ["-m", "pnpdepth_cli", program]
        run_python([*command, *arguments], folder)
    dense = folder / "room" / "dense"
    # The cloud lies on the points of the model.
    model = pycolmap.Reconstruction(str(dense / "sparse"))
    image = sorted(model.images.values(), key=lambda image: image.name)[1]
    seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
    points = np.array([model.points3D[n].xyz for n in seen if model.points3D[n].track.length() > 2])
    pose = image.cam_from_world()
    depth = (points @ pose.rotation.matrix().T + pose.translation)[:, 2]
    cloud = read_scan(folder / "room" / "scene.ply")[0][:, :3]
    assert len(cloud) > 10_000
    near = depth < 1.5 * np.median(depth)
    off, _ = cKDTree(cloud).query(points[near])
    assert np.median(off / depth[near]) < 0.01
    # COLMAP, Nerfstudio and 3DGS have their files.
    for pattern in ("stereo/depth_maps/*.geometric.bin", "inverse_depths/*.png"):
        assert len(list(dense.glob(pattern))) == 3
    assert len(json.loads((dense / "transforms.json").read_text())["frames"]) == 3
    assert (dense / "sparse" / "0" / "depth_params.json").is_file()
