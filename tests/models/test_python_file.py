"""A Python file as a definition, or one line that says why not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.models.registry import find_definition

GOOD = """
from torch import nn
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from beside import WIDTH

definition = ModelDefinition(
    name="mine", input_kind="rgb", size=Multiple(8), build=lambda: nn.Conv2d(3, WIDTH, 1)
)
other = ModelDefinition(name="other", input_kind="rgb", size=Multiple(8), build=nn.Identity)
"""

INVALID = """from pnpdepth_cli.models.definition import ModelDefinition
definition = ModelDefinition(name="mine", input_kind="rgb", size=32, build=int)
"""


def written(folder: Path, text: str, name: str = "mine.py") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def test_a_file_gives_its_definition_and_may_import_what_is_beside_it(tmp_path: Path) -> None:
    written(tmp_path, "WIDTH = 7", "beside.py")
    file = written(tmp_path, GOOD)
    assert find_definition(str(file)).name == "mine"
    assert find_definition(f"{file}:other").name == "other"
    assert isinstance(find_definition(str(file)), ModelDefinition)
    assert find_definition(str(file)).build().out_channels == 7


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("x = 1\n\nraise ValueError('a\\nb')\n", "line 3"),
        ("def f():\n    return 1 / 0\n\nf()\n", "line 2"),
        ("def (:\n", "line 1"),
        ("import sys\nsys.exit(0)\n", "line 2"),
        (INVALID, "line 2"),
        ("x = 1\n", "mine.py"),
        ("definition = 'text'\n", "mine.py"),
        ("definition = None\n", "mine.py"),
    ],
)
@pytest.mark.parametrize("relative", [True, False])
def test_an_error_in_a_model_file_names_its_line(
    text: str, place: str, relative: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path, text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError) as error:
        find_definition("mine.py" if relative else str(file))
    assert "mine.py" in str(error.value)
    assert place in str(error.value)
    assert "\n" not in str(error.value)
    assert error.value.exit_code == 4


def test_what_is_missing_or_no_definition_is_named_and_the_search_path_stays(
    tmp_path: Path,
) -> None:
    before = list(sys.path)
    file = written(tmp_path, "x = 1\n")
    for spec, message in (
        (tmp_path / "absent.py", "does not exist"),
        (f"{file}:network", "defines no 'network'"),
        (f"{file}:x", r"'x' in model file .* is a int"),
        (written(tmp_path, "raise ValueError", "raising.py"), "raises ValueError"),
        (written(tmp_path, "import sys; sys.path.pop(0)", "popping.py"), "defines no 'definition'"),
    ):
        with pytest.raises(ModelError, match=message):
            find_definition(str(spec))
        assert sys.path == before
