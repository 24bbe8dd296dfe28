"""Reports of batches: what is on the page, where it comes from, and where it may not go."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.batch import batch_report as report_batch
from pnpdepth_cli.commands.batch.batch_request import BatchRequest
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.depth import read_depth
from tests.commands.batches import NAMES, RecordingListener, batch, done, pairs_on_disk, refinement
from tests.commands.report_pages import everything, frames_of, page_data


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return pairs_on_disk(tmp_path / "drive")


@pytest.fixture
def report(tmp_path: Path) -> Path:
    return tmp_path / "report"


def test_the_page_links_the_panels_that_a_frames_record_names_and_shows_their_errors(
    root: Path, report: Path
) -> None:
    batch(root, html=report)
    frame = frames_of(report)["c"]
    figures = json.loads((root / "out/c.json").read_text())["figures"]
    for view, kind, title in (
        ("first", "preview", "Depth before"),
        ("second", "preview", "Depth after"),
        ("image", "preview", "Image"),
        ("map", "improvement", "Change of error"),
    ):
        result = root / f"out/c_{kind}.png"
        figure, shown = figures[kind], frame["views"][view]
        assert (report / shown["src"]).samefile(result)
        assert shown["box"] == figure["panels"][title]
        assert shown["size"] == figure["size"] == list(cv2.imread(str(result)).shape[1::-1])
    assert frame["scale_m"] == figures["preview"]["scale_m"]
    assert frame["map"]["footer"] == figures["improvement"]["footer"]

    batch(root, output=root / "plain", refine={"iterations": 0})
    gt = read_depth(root / "gt/b.png").values
    before, after = (
        np.abs(read_depth(root / out / "b_depth.png").values - gt).mean()
        for out in ("plain", "out")
    )
    values = frames_of(report)["b"]["values"]
    assert values["mae_before"] == pytest.approx(before, abs=3e-3)  # the files are 16-bit
    assert values["mae_after"] == pytest.approx(after, abs=3e-3)
    assert values["mae_change"] == values["mae_after"] / values["mae_before"] - 1
    assert values["mae_change"] != 0


def test_a_report_has_what_runs_before_and_other_shards_gave_and_draws_only_what_changed(
    root: Path, report: Path
) -> None:
    answers = iter([False, True, True, True])
    batch(root, RecordingListener(lambda: next(answers)), html=report)
    assert list(frames_of(report)) == ["a"]
    assert dict(page_data(report)["facts"])["frames"] == "1 done, 3 pending"
    batch(root, html=report, shard=(1, 2))  # a and c
    shutil.rmtree(report)
    assert done(root, html=report) == ["b", "d"]
    before, key = everything(report), {n: f["key"] for n, f in frames_of(report).items()}
    (report / "images" / f"{key['b']}_preview.png").unlink()
    batch(root, html=report)
    assert before == everything(report)

    # a frame that is redone has new images, one that is gone has none, and a lost one stays lost
    cv2.imwrite(str(root / "rgb/a.png"), cv2.imread(str(root / "rgb/a.png"))[:, ::-1])
    (root / "rgb/d.png").unlink()
    (root / "out/b_preview.png").unlink()
    assert done(root, html=report) == ["a"]
    after, frames = everything(report), frames_of(report)
    images = {name: name.partition("_")[0] for name in before if name.endswith(".png")}
    assert {own for name, own in images.items() if name not in after} == {key["b"], key["d"]}
    left = images.keys() & after.keys()
    assert {images[name] for name in left if before[name] != after[name]} == {key["a"]}
    assert (frames["b"]["key"], frames["c"]["key"]) == (None, key["c"])
    assert frames["b"]["values"]["rmse_change"] is not None


def test_weights_of_all_experts_are_shown_for_each_frame_and_in_the_mean(
    root: Path, report: Path
) -> None:
    batch(root, html=report, limit=2, refine={"propagate": None})
    shown = dict(page_data(report)["facts"])["mean weights"]
    weights = FrameRecord.read(root / "out/a.json").weights
    assert all(name in shown for name in weights)
    largest = max(weights, key=weights.__getitem__)
    notes = " ".join(frames_of(report)["a"]["notes"])
    assert f"{largest} {weights[largest]:.0%}" in notes


def test_without_ground_truth_changes_are_those_at_held_out_points_and_else_there_are_none(
    root: Path, report: Path
) -> None:
    shutil.rmtree(root / "gt")
    batch(root, html=report)
    data, frame = page_data(report), frames_of(report)["a"]
    assert not [column for column in data["columns"] if "change" in column["title"]]
    assert data["columns"][data["sort_by"]]["key"] == "rmse_after"
    assert "proves nothing" in data["tables"][0]["title"]
    assert {row[3] for row in data["tables"][0]["rows"]} == {"–"}  # no change
    assert "no error is measured" in data["notes"][0]
    assert any("proves nothing" in note for note in frame["notes"])
    assert {*frame["views"]} == {"first", "second", "image", "sparse"}  # no map of gains
    assert (frame["map"], (root / "out/a_improvement.png").exists()) == (None, False)

    changes = {"holdout": 0.3, "propagate": "gp", "overwrite": True}
    batch(root, output=root / "other", html=report, refine=changes)
    data, frame = page_data(report), frames_of(report)["a"]
    names = ("iterations", "layer", "lr", "update", "loss", "align", "propagate", "holdout")
    settings = ["5", "middle", "0.01", "sign", "l1", "none", "gp", "0.3"]
    assert [dict(data["facts"])[name] for name in names] == settings
    assert frame["values"]["rmse_change"] is not None
    assert any("at held-out points" in note for note in frame["notes"])
    assert [each["title"] for each in data["tables"]] == [
        "means: errors at held-out points, 4 frames"
    ]


def test_frames_without_the_scores_of_others_have_no_figures_beside_them(
    root: Path, report: Path
) -> None:
    (root / "gt/b.png").unlink()
    (root / "rgb/d.png").write_bytes(b"no image")
    summary = batch(root, html=report)
    frames = frames_of(report)
    assert frames["a"]["values"]["rmse_change"] is not None
    assert {*frames["b"]["values"].values()} == {None}
    assert (frames["a"]["tag"], frames["b"]["tag"]) == ("", "at points used")
    assert [name for name, why in page_data(report)["without"]] == ["d"]
    records = [replace(FrameRecord.read(root / f"out/{name}.json"), errors={}) for name in "abc"]
    request = BatchRequest(source=root, output=root / "out", html=report, refine=refinement(root))
    report_batch.write_batch_report(request, report, summary, records)
    assert {*frames_of(report)["a"]["values"].values()} == {None}


def test_a_report_may_lie_in_the_results_but_holds_nothing_and_replaces_none_unasked(
    root: Path, tmp_path: Path
) -> None:
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
