"""Open lists of names: found from their folder and from entry points, loaded when asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli import choices
from pnpdepth_cli.choices import OpenList
from pnpdepth_cli.core import losses, update_rules
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OpenList[object]:
    """The files of io/, with the entry points of another package.

    One is such a file, one is elsewhere, and two cannot be loaded."""
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[pnpdepth.test_table]\nelsewhere = other_package:entry\nscans = other_package:entry\n"
        "no-module = no_package:entry\nno-object = other_package:nothing\n"
    )
    (tmp_path / "other_package.py").write_text("entry = 'loaded from elsewhere'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return OpenList("test_table", folder="pnpdepth_cli.io:__name__")


def test_the_names_of_a_list_are_the_files_of_its_folder_and_then_the_entry_points(
    table: OpenList[object],
) -> None:
    names = list(table)
    installed = ["elsewhere", "no-module", "no-object"]
    assert names == [*sorted({*names} - {*installed}), *installed]
    assert "scans" in names
    assert not {"--init--", "bags"} & set(names)  # subpackages are no entries
    assert len(table) == len(names)


def test_an_entry_is_loaded_from_this_package_first(table: OpenList[object]) -> None:
    assert table["scans"] == "pnpdepth_cli.io.scans"
    assert table["elsewhere"] == "loaded from elsewhere"


def test_a_name_that_is_not_in_a_list_is_refused_with_the_names(table: OpenList[object]) -> None:
    with pytest.raises(UsageError, match=r"'scanss' .* scans"):
        table["scanss"]


@pytest.mark.parametrize("name", ["no-module", "no-object"])
def test_an_entry_point_that_cannot_be_loaded_is_named(table: OpenList[object], name: str) -> None:
    with pytest.raises(UsageError, match=rf"{name} = \w+:\w+ of pnpdepth.test_table cannot be"):
        table[name]


@pytest.mark.parametrize(
    "names", [name for name, value in vars(choices).items() if isinstance(value, OpenList)]
)
def test_every_location_is_that_of_an_entry(names: str) -> None:
    entries = getattr(choices, names)
    assert len(entries) == len([*entries.values()]) > 0


def test_an_entry_is_the_object_at_its_location_and_a_format_has_its_suffixes() -> None:
    assert choices.LOSSES["l1"] is losses.l1
    assert choices.UPDATES["adam"] is update_rules.adam
    for name, depth_format in choices.FORMATS.items():
        assert {f".{name}"} <= set(depth_format.suffixes) <= set(DEPTH_SUFFIXES)


@pytest.mark.parametrize("key", [*choices.MEASURES])
def test_a_measure_has_the_key_of_its_name(key: str) -> None:
    assert choices.MEASURES[key].key == key


@pytest.mark.parametrize("name", [*choices.SENSORS])
def test_a_scanner_has_the_name_by_which_it_is_chosen(name: str) -> None:
    assert choices.SENSORS[name].name == name
