"""Reports of batches: what is on the page, where it comes from, and where it may not go."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import pytest
from PIL import Image

from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import OutputError
from tests.commands.batches import NAMES, Recorder, batch, done, pairs_on_disk
from tests.commands.report_pages import everything, frames_of, page_data


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive")


@pytest.fixture
def report(tmp_path: Path) -> Path:
    return tmp_path / "report"


def test_the_page_links_panels_of_the_records_and_shows_errors(root: Path, report: Path) -> None:
    batch(root, html=report)
    frame = frames_of(report)["c"]
    record = json.loads((root / "out/c.json").read_text())
    figures, errors = record["result"]["figures"], record["errors"]["ground_truth"]
    for view, kind, title in (
        ("first", "preview", "Depth before"),
        ("second", "preview", "Depth after"),
        ("image", "preview", "Image"),
        ("map", "improvement", "Change of error"),
    ):
        result = root / f"out/c_{kind}.png"
        shown = frame["views"][view]
        assert (report / shown["src"]).samefile(result)
        assert shown["box"] == figures[kind]["panels"][title]
        assert shown["size"] == figures[kind]["size"] == [*Image.open(result).size]
    assert frame["scale_m"] == figures["preview"]["scale_m"]
    assert frame["map"]["footer"] == figures["improvement"]["footer"]
    before, after = (errors[stage]["mae"] for stage in ("before", "after"))
    assert (frame["values"]["mae_before"], frame["values"]["mae_after"]) == (before, after)
    assert frame["values"]["mae_change"] == after / before - 1 != 0


def test_a_report_has_what_all_runs_gave_and_draws_what_changed(root: Path, report: Path) -> None:
    answers = iter([False, True, True, True])
    batch(root, Recorder(lambda: next(answers)), html=report)
    assert list(frames_of(report)) == ["a"]
    assert dict(page_data(report)["facts"])["frames"] == "1 done, 3 pending"
    batch(root, html=report, shard=(1, 2))  # a and c
    shutil.rmtree(report)
    assert done(root, html=report) == ["b", "d"]
    before = everything(report)
    key = {n: f["key"] for n, f in frames_of(report).items()}

    # a frame that is redone has new images, one that is gone has none, and a lost one stays lost
    cv2.imwrite(str(root / "rgb/a.png"), cv2.imread(str(root / "rgb/a.png"))[:, ::-1])
    (root / "rgb/d.png").unlink()
    (root / "out/b_preview.png").unlink()
    assert done(root, html=report) == ["a"]
    after, frames = everything(report), frames_of(report)
    images = [name for name in before if name.endswith(".png")]
    changed = {name.partition("_")[0] for name in images if before[name] != after.get(name)}
    assert changed == {key["a"], key["b"], key["d"]}
    assert {name.partition("_")[0] for name in images if name in after} == {key["a"], key["c"]}
    assert (frames["b"]["key"], frames["c"]["key"]) == (None, key["c"])
    assert frames["b"]["values"]["rmse_change"] is not None


def test_without_ground_truth_changes_are_at_held_out_points(root: Path, report: Path) -> None:
    shutil.rmtree(root / "gt")
    batch(root, html=report)
    data = page_data(report)
    frame = frames_of(report)["a"]
    assert not [column for column in data["columns"] if "change" in column["title"]]
    assert data["columns"][data["sort_by"]]["key"] == "rmse_after"
    (table,) = data["tables"]
    assert "proves nothing" in table["title"]
    assert {row[3] for row in table["rows"]} == {"–"}  # no change
    assert "no error is measured" in data["notes"][0]
    assert any("proves nothing" in note for note in frame["notes"])
    assert {*frame["views"]} == {"first", "second", "image", "sparse"}  # no map of gains
    assert (frame["map"], (root / "out/a_improvement.png").exists()) == (None, False)

    changes = {"holdout": 0.3, "propagate": "gp", "overwrite": True}
    batch(root, output=root / "other", html=report, refine=changes)
    data = page_data(report)
    frame = frames_of(report)["a"]
    facts = {"iterations": "5", "layer": "middle", "align": "none", "holdout": "0.3"}
    assert facts.items() <= dict(data["facts"]).items()
    assert frame["values"]["rmse_change"] is not None
    assert any("at held-out points" in note for note in frame["notes"])
    (table,) = data["tables"]
    assert table["title"] == "means: errors at held-out points, 4 frames"


def test_each_frame_has_its_weights_and_the_errors_all_share(root: Path, report: Path) -> None:
    (root / "gt/b.png").unlink()
    (root / "rgb/d.png").write_bytes(b"no image")
    batch(root, html=report, refine={"method": "fused"})
    data, frames = page_data(report), frames_of(report)
    assert frames["a"]["values"]["rmse_change"] is not None
    assert {*frames["b"]["values"].values()} == {None}
    assert (frames["a"]["tag"], frames["b"]["tag"]) == ("", "at validation points")
    assert [name for name, why in data["without"]] == ["d"]
    weights = FrameRecord.read(root / "out/a.json").refined().weights
    assert all(name in dict(data["facts"])["mean weights"] for name in weights)
    largest = max(weights, key=weights.__getitem__)
    assert f"{largest} {weights[largest]:.0%}" in " ".join(frames["a"]["notes"])


def test_a_report_may_lie_in_results_and_replaces_none_unasked(root: Path, tmp_path: Path) -> None:
    for folder in (root / "rgb", root, root / "out", tmp_path):
        with pytest.raises(OutputError, match=re.escape(str(folder))):
            batch(root, html=folder, refine={"overwrite": True})
    assert not (root / "out").exists()
    report = root / "out" / "report"
    for _ in range(2):
        batch(root, html=report)
        assert tuple(frames_of(report)) == NAMES
    before = everything(report)
    with pytest.raises(OutputError, match="--overwrite"):
        batch(root, output=root / "other", html=report)
    assert everything(report) == before
    batch(root, output=root / "other", html=report, refine={"overwrite": True})
    assert page_data(report)["title"].endswith("other")
