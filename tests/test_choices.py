"""Open lists of names: found from their folder and from entry points, loaded when asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli import choices
from pnpdepth_cli.choices import OpenList
from pnpdepth_cli.core import losses, update_rules
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import NORMALISATIONS
from pnpdepth_cli.io.depth import DEPTH_SUFFIXES
from pnpdepth_cli.sensors.simulation import LIDARS


def test_folders_and_entry_points_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Two entry points of another package.
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[pnpdepth.test_table]\nelsewhere = other_package:entry\nscans = other_package:entry\n"
    )
    (tmp_path / "other_package.py").write_text("entry = 'loaded from elsewhere'\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    table = OpenList("test_table", folder="pnpdepth_cli.io:__name__")
    names = list(table)
    assert names == [*sorted({*names} - {"elsewhere"}), "elsewhere"]
    assert "scans" in names
    assert not {"--init--", "bags"} & set(names)  # subpackages are no entries
    assert len(table) == len(names)
    assert table["scans"] == "pnpdepth_cli.io.scans"  # of this package first
    assert table["elsewhere"] == "loaded from elsewhere"
    with pytest.raises(UsageError, match=r"'scanss' is none of .* scans"):
        table["scanss"]


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


def test_every_name_of_a_closed_list_is_implemented_in_its_order() -> None:
    for names, implemented in (
        (choices.SCHEDULES, update_rules.SCHEDULES),
        (choices.NORMALISATIONS, NORMALISATIONS),
        (choices.SENSORS, LIDARS),
    ):
        assert tuple(names) == tuple(implemented)
