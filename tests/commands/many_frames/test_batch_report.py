"""Reports of batches: what is on the page, where it comes from, and where it may not go."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

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


class Reported(NamedTuple):
    """A folder of four frames with their results in out/, and the report of them."""

    root: Path
    report: Path


def reported(folder: Path) -> Reported:
    return Reported(root=pairs_on_disk(folder / "drive"), report=folder / "report")


@pytest.fixture(scope="module")
def with_truth(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    found = reported(tmp_path_factory.mktemp("with_truth"))
    batch(found.root, html=found.report)
    return found


@pytest.fixture(scope="module")
def record(with_truth: Reported) -> Any:
    return json.loads((with_truth.root / "out/c.json").read_text())


@pytest.mark.parametrize(
    ("view", "kind", "title"),
    [
        ("first", "preview", "Depth before"),
        ("second", "preview", "Depth after"),
        ("image", "preview", "Image"),
        ("map", "improvement", "Change of error"),
    ],
)
def test_a_view_of_the_page_is_a_panel_of_a_figure_of_the_record(
    with_truth: Reported, record: Any, view: str, kind: str, title: str
) -> None:
    figure = with_truth.root / f"out/c_{kind}.png"
    of_record = record["result"]["figures"][kind]
    shown = frames_of(with_truth.report)["c"]["views"][view]
    assert (with_truth.report / shown["src"]).samefile(figure)
    assert shown["box"] == of_record["panels"][title]
    assert shown["size"] == of_record["size"] == [*Image.open(figure).size]


def test_the_page_has_the_scale_and_the_footer_of_the_figures(
    with_truth: Reported, record: Any
) -> None:
    frame = frames_of(with_truth.report)["c"]
    figures = record["result"]["figures"]
    assert frame["scale_m"] == figures["preview"]["scale_m"]
    assert frame["map"]["footer"] == figures["improvement"]["footer"]


def test_the_page_has_the_errors_of_the_record_and_their_change(
    with_truth: Reported, record: Any
) -> None:
    values = frames_of(with_truth.report)["c"]["values"]
    errors = record["errors"]["ground_truth"]
    before, after = (errors[stage]["mae"] for stage in ("before", "after"))
    assert (values["mae_before"], values["mae_after"]) == (before, after)
    assert values["mae_change"] == after / before - 1 != 0


def test_a_report_of_a_stopped_batch_has_what_was_done(root: Path, report: Path) -> None:
    answers = iter([False, True, True, True])
    batch(root, Recorder(lambda: next(answers)), html=report)
    assert list(frames_of(report)) == ["a"]
    assert dict(page_data(report)["facts"])["frames"] == "1 done, 3 pending"


def test_a_report_that_was_removed_comes_back_with_what_all_runs_gave(
    root: Path, report: Path
) -> None:
    batch(root, html=report, shard=(1, 2))  # a and c
    shutil.rmtree(report)
    assert done(root, html=report) == ["b", "d"]
    assert tuple(frames_of(report)) == NAMES


class Changed(NamedTuple):
    """The files of a report before and after a change, the frames' keys before, and the frames."""

    before: dict[str, bytes]
    after: dict[str, bytes]
    key: dict[str, str]
    frames: dict[str, Any]

    def frames_with(self, names: Iterable[str]) -> set[str]:
        """The keys of the frames of these images."""
        return {name.partition("_")[0] for name in names if name.endswith(".png")}


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> Changed:
    """Frame a is redone, the depth of b lost its preview, and d is gone."""
    root, report = reported(tmp_path_factory.mktemp("changed"))
    batch(root, html=report)
    before = everything(report)
    key = {name: frame["key"] for name, frame in frames_of(report).items()}
    cv2.imwrite(str(root / "rgb/a.png"), cv2.imread(str(root / "rgb/a.png"))[:, ::-1])
    (root / "rgb/d.png").unlink()
    (root / "out/b_preview.png").unlink()
    assert done(root, html=report) == ["a"]
    return Changed(before=before, after=everything(report), key=key, frames=frames_of(report))


def test_a_frame_that_is_redone_has_new_images_and_one_that_is_gone_has_none(
    changed: Changed,
) -> None:
    before, after, key = changed.before, changed.after, changed.key
    differing = changed.frames_with(name for name in before if before[name] != after.get(name))
    assert differing == {key["a"], key["b"], key["d"]}
    assert changed.frames_with(before.keys() & after.keys()) == {key["a"], key["c"]}


def test_an_image_that_was_lost_stays_lost_and_its_errors_stay(changed: Changed) -> None:
    assert changed.frames["b"]["key"] is None
    assert changed.frames["c"]["key"] == changed.key["c"]
    assert changed.frames["b"]["values"]["rmse_change"] is not None


@pytest.fixture(scope="module")
def without_truth(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    found = reported(tmp_path_factory.mktemp("without_truth"))
    shutil.rmtree(found.root / "gt")
    batch(found.root, html=found.report)
    return found


def test_without_ground_truth_no_change_is_in_the_table_and_frames_are_sorted_by_the_rmse(
    without_truth: Reported,
) -> None:
    data = page_data(without_truth.report)
    assert not [column for column in data["columns"] if "change" in column["title"]]
    assert data["columns"][data["sort_by"]]["key"] == "rmse_after"
    (table,) = data["tables"]
    assert {row[3] for row in table["rows"]} == {"–"}


def test_without_ground_truth_the_page_says_what_would_measure_an_error(
    without_truth: Reported,
) -> None:
    assert "--holdout" in page_data(without_truth.report)["notes"][0]
    assert frames_of(without_truth.report)["a"]["notes"]


def test_without_ground_truth_there_is_no_map_of_improvement(without_truth: Reported) -> None:
    frame = frames_of(without_truth.report)["a"]
    assert {*frame["views"]} == {"first", "second", "image", "sparse"}
    assert frame["map"] is None
    assert not (without_truth.root / "out/a_improvement.png").exists()


@pytest.fixture(scope="module")
def held_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of frames without ground truth of whose points some are held out."""
    root, report = reported(tmp_path_factory.mktemp("held_out"))
    shutil.rmtree(root / "gt")
    batch(root, html=report, refine={"holdout": 0.3, "propagate": "gp"})
    return report


def test_the_settings_that_decide_the_results_are_on_the_page(held_out: Path) -> None:
    facts = {"iterations": "5", "layer": "middle", "align": "none", "holdout": "0.3"}
    assert facts.items() <= dict(page_data(held_out)["facts"]).items()


def test_without_ground_truth_changes_are_at_held_out_points(held_out: Path) -> None:
    frame = frames_of(held_out)["a"]
    assert frame["values"]["rmse_change"] is not None
    assert any("held-out points" in note for note in frame["notes"])
    (table,) = page_data(held_out)["tables"]
    assert "held-out points, 4 frames" in table["title"]


@pytest.fixture(scope="module")
def unlike_frames(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    """The report of frames of which b has no ground truth and d no image."""
    found = reported(tmp_path_factory.mktemp("unlike_frames"))
    (found.root / "gt/b.png").unlink()
    (found.root / "rgb/d.png").write_bytes(b"no image")
    batch(found.root, html=found.report, refine={"method": "fused"})
    return found


def test_errors_of_a_frame_are_those_that_all_frames_share(unlike_frames: Reported) -> None:
    frames = frames_of(unlike_frames.report)
    assert frames["a"]["values"]["rmse_change"] is not None
    assert {*frames["b"]["values"].values()} == {None}
    assert (frames["a"]["tag"], frames["b"]["tag"]) == ("", "at validation points")


def test_a_frame_that_failed_is_on_the_page_with_its_reason(unlike_frames: Reported) -> None:
    ((name, why),) = page_data(unlike_frames.report)["without"]
    assert name == "d"
    assert "d.png" in why


def test_the_page_has_the_weights_of_each_frame_and_their_mean(unlike_frames: Reported) -> None:
    weights = FrameRecord.read(unlike_frames.root / "out/a.json").refined().weights
    mean = dict(page_data(unlike_frames.report)["facts"])["mean weights"]
    assert all(name in mean for name in weights)
    largest = max(weights, key=weights.__getitem__)
    notes = frames_of(unlike_frames.report)["a"]["notes"]
    assert f"{largest} {weights[largest]:.0%}" in " ".join(notes)


def test_a_report_may_not_take_the_place_of_inputs_or_results(root: Path, tmp_path: Path) -> None:
    for folder in (root / "rgb", root, root / "out", tmp_path):
        with pytest.raises(OutputError, match=re.escape(str(folder))):
            batch(root, html=folder, refine={"overwrite": True})
    assert not (root / "out").exists()


def test_a_report_may_lie_in_the_folder_of_the_results(root: Path) -> None:
    report = root / "out" / "report"
    for _ in range(2):
        batch(root, html=report)
        assert tuple(frames_of(report)) == NAMES


def test_a_report_of_another_batch_is_replaced_only_if_asked(root: Path, report: Path) -> None:
    batch(root, html=report)
    before = everything(report)
    with pytest.raises(OutputError, match="--overwrite"):
        batch(root, output=root / "other", html=report)
    assert everything(report) == before
    batch(root, output=root / "other", html=report, refine={"overwrite": True})
    assert page_data(report)["title"].endswith("other")
