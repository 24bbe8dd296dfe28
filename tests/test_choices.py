"""Open lists of names: found from their folder and from entry points, loaded when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from pnpdepth_cli import choices
from pnpdepth_cli.choices import OpenList
from pnpdepth_cli.completion import baselines, propagation
from pnpdepth_cli.core import losses, update_rules
from pnpdepth_cli.core.update_rules import SCHEDULES
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import NORMALISATIONS
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.sensors.simulation import LIDARS


@pytest.fixture
def table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> OpenList:
    """A table over the modules of `io`, and two entry points of another package."""
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[pnpdepth.test_table]\nelsewhere = other_package:entry\nscans = other_package:entry\n"
    )
    (tmp_path / "other_package.py").write_text("entry = 'loaded from elsewhere'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return OpenList("pnpdepth_cli.io", attribute="__name__", group="test_table")


def test_names_come_from_the_folder_and_from_entry_points_and_are_loaded_from_there(
    table: OpenList,
) -> None:
    names = list(table)
    assert names == [*sorted({*names} - {"elsewhere"}), "elsewhere"]
    assert {"scans", "elsewhere"} <= set(names)
    assert not {"--init--", "bags"} & set(names)  # subpackages are no entries
    assert len(table) == len(names)
    assert table["scans"] == "pnpdepth_cli.io.scans"  # of this package first
    assert table["elsewhere"] == "loaded from elsewhere"
    with pytest.raises(UsageError, match=r"'scanss' is none of .* scans"):
        table["scanss"]


@pytest.mark.parametrize(
    ("table", "implemented"),
    [
        (choices.LOSSES, losses.TABLE),
        (choices.UPDATES, update_rules.TABLE),
        (choices.BASELINES, baselines.TABLE),
        (choices.PROPAGATIONS, propagation.TABLE),
    ],
)
def test_a_table_lists_the_names_of_its_module_in_their_order(
    table: OpenList, implemented: Mapping[str, object]
) -> None:
    assert list(table) == list(implemented)
    assert list(table.values()) == list(implemented.values())


def test_every_name_of_a_closed_list_is_implemented() -> None:
    assert tuple(SCHEDULES) == choices.SCHEDULES
    assert tuple(NORMALISATIONS) == choices.NORMALISATIONS
    assert tuple(LIDARS) == choices.SENSORS


def test_every_format_has_a_file_name_made_of_its_own_name() -> None:
    for name, depth_format in choices.FORMATS.items():
        assert f".{name}" in depth_format.suffixes
        assert set(depth_format.suffixes) <= set(DEPTH_SUFFIXES)
