"""From a name or a Python file to a definition, or to one line that says why not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

import model_zoo_defs
from pnpdepth_cli import choices
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.registry import all_definitions, find_definition

ONE = """
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="NAME", input_kind="rgb", size=Multiple(8), build=lambda: nn.Conv2d(3, 1, 1)
)
"""
SEVERAL = ONE.replace("definition =", "one =") + "definitions = {one.name: one}\n"


@pytest.fixture
def open_list(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder whose files count as files of model_zoo_defs, and whose packages are installed."""
    folders = [*model_zoo_defs.__path__, str(tmp_path)]
    monkeypatch.setattr(model_zoo_defs, "__path__", folders)
    monkeypatch.setattr(model_zoo_defs.__spec__, "submodule_search_locations", folders)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(choices, "NETWORKS", choices.OpenList("models", folder="model_zoo_defs"))
    return tmp_path


@pytest.mark.parametrize("text", [ONE, SEVERAL])
def test_one_new_file_in_model_zoo_defs_adds_a_network(text: str, open_list: Path) -> None:
    stem = f"my_net{len(text)}"
    name = stem.replace("_", "-")
    (open_list / f"{stem}.py").write_text(text.replace("NAME", name))
    assert list(all_definitions())[-1] == name
    assert find_definition(name).build().out_channels == 1


ENTRY_POINTS = """[pnpdepth.models]
object = other_nets:definition
a-dict = other_nets:definitions
lost = missing_package:definition
others = os.path:sep
"""


def test_entry_points_add_networks_or_are_reported_when_they_are_named(open_list: Path) -> None:
    one = ONE.replace("NAME", "theirs-object")
    several = SEVERAL.replace("NAME", "theirs-in-a-dict")
    (open_list / "other_nets.py").write_text(one + several)
    info = open_list / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    for name in ("theirs-object", "theirs-in-a-dict"):
        assert all_definitions()[name] == find_definition(name)
    named = {"lost": "missing_package", "others": "gives a str", "fcrn-tyni": "fcrn-tiny"}
    for name, reason in named.items():
        with pytest.raises(ModelError, match=reason):
            find_definition(name)


@pytest.mark.parametrize("name", ["script.pt", "w.safetensors", "w.pth.tar"])
def test_weights_and_programs_that_are_not_run_are_no_network(name: str) -> None:
    with pytest.raises(ModelError, match=r"TorchScript.*checkpoint.*ONNX"):
        find_definition(name)


GOOD = f"""
{ONE.replace("NAME", "mine").replace("3, 1, 1", "3, WIDTH, 1")}
from beside import WIDTH

def bare():
    layers = nn.Conv2d(3, 4, 3, 2, 1), nn.Conv2d(4, 4, 3, 2, 1), nn.Softplus(), nn.PixelShuffle(2)
    return nn.Sequential(*layers)
"""


def test_a_file_gives_its_definition_or_a_function_and_imports_neighbours(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(GOOD)
    (tmp_path / "beside.py").write_text("WIDTH = 7")
    assert find_definition(str(file)).build().out_channels == 7
    torch.save(find_definition(f"{file}:bare").build().state_dict(), tmp_path / "w.pt")
    network = load_network(f"{file}:bare", tmp_path / "w.pt")
    assert network.definition.layers[0] == "2"
    assert network.definition.default_alignment == "auto"
    assert "assumed: one rgb image in" in network.notes[0]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("x = 1\n\nraise ValueError('a\\nb')\n", "line 3"),
        ("def (:\n", "line 1"),
        ("import sys\nsys.exit(0)\n", "line 2"),
    ],
)
def test_an_error_in_a_model_file_names_its_line(text: str, place: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(ModelError, match=rf"^[^\n]*mine\.py[^\n]*{place}[^\n]*$"):
        find_definition(str(tmp_path / "mine.py"))


@pytest.mark.parametrize("spec", ["absent.py", "mine.py:network", "mine.py:x", "popping.py"])
def test_what_is_no_definition_is_refused_and_the_path_stays(spec: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("x = 1\n")
    (tmp_path / "popping.py").write_text("import sys; sys.path.pop(0)")
    before = list(sys.path)
    with pytest.raises(ModelError, match=spec.partition(":")[0]):
        find_definition(str(tmp_path / spec))
    assert sys.path == before
