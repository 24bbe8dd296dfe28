"""The drawing of the imports of a package."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.structure import circles, drawing, file_graph, floors, room_graph

HOUSE = {
    "__init__.py": "",
    "errors.py": "import os",
    "io/__init__.py": "",
    "io/depth.py": "from house.errors import InputError",
    "io/rgb.py": "from house.io import depth",
    "cli/__init__.py": "",
    "cli/main.py": "def run():\n    import house.io.rgb",
    "cli/talk.py": (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house.cli.main import run"
    ),
}


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A package of three rooms: errors, io and cli."""
    for name, text in HOUSE.items():
        file = tmp_path / "house" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path / "house"


def test_a_file_imports_the_file_that_a_name_comes_from_also_within_a_function(
    house: Path,
) -> None:
    files = file_graph(house)
    assert files["io.depth"] == {"errors"}
    assert files["io.rgb"] == {"io.depth"}
    assert files["cli.main"] == {"io.rgb"}


def test_imports_for_type_checkers_count_only_if_asked_for(house: Path) -> None:
    assert file_graph(house)["cli.talk"] == set()
    assert file_graph(house, with_types=True)["cli.talk"] == {"cli.main"}


def test_a_room_stands_above_the_highest_room_that_it_imports(house: Path) -> None:
    rooms = room_graph(file_graph(house))
    assert floors(rooms) == {"house": 0, "errors": 0, "io": 1, "cli": 2}


def test_files_that_import_each_other_are_a_circle_and_share_a_floor(house: Path) -> None:
    (house / "errors.py").write_text("import house.io.rgb")
    files = file_graph(house)
    circle = {"errors", "io.depth", "io.rgb"}
    assert circle in circles(files)
    assert {floors(files)[name] for name in circle} == {0}
    assert floors(files)["cli.main"] == 1
    assert "circle of 3: errors, io.depth, io.rgb" in list(drawing(files))


def test_the_drawing_has_a_line_for_each_floor_from_the_highest(house: Path) -> None:
    assert list(drawing(room_graph(file_graph(house)))) == [
        "  2  cli",
        "  1  io",
        "  0  errors, house",
    ]
