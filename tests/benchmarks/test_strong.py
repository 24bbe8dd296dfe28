"""The benchmark of networks of any strength."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.frames import EvalFrame
from benchmarks.strong import STAGES, geometric_mean, measure, print_tables
from benchmarks.strong_maps import can_draw, stored_frames, strong_frames, with_lines
from pnpdepth_cli.measures import AFTER, BEFORE
from pnpdepth_cli.scan_pattern import scan_pattern


def write_stored(folder: Path, values: np.ndarray) -> None:
    """A stored map, an image and a truth of 4 m everywhere."""
    folder.mkdir(parents=True)
    rows, columns = values.shape
    Image.fromarray(np.zeros((rows, columns, 3), np.uint8)).save(folder / "7_rgb.png")
    Image.fromarray(np.full((rows, columns), 4 * 256, np.uint16)).save(folder / "7_gt.png")
    np.save(folder / "7_pred.npy", values)


def test_a_stored_disparity_of_0_is_unknown_where_the_folder_says_so(tmp_path: Path) -> None:
    values = np.full((6, 8), 20.0, np.float16)
    values[0, 0] = 0
    write_stored(tmp_path / "weison_kitti_dav2", values)
    (stored,) = stored_frames(tmp_path / "weison_kitti_dav2")
    given = stored.network.module(None)[0, 0].numpy()
    assert np.isnan(given[0, 0])
    assert (given.ravel()[1:] == 20).all()
    assert (stored.frame.gt == 4).all()


def test_a_stored_inverse_of_disparity_is_given_as_disparity(tmp_path: Path) -> None:
    write_stored(tmp_path / "prior_da_nyu", np.full((6, 8), 0.5, np.float32))
    (stored,) = stored_frames(tmp_path / "prior_da_nyu")
    assert (stored.network.module(None) == 2).all()
    assert stored.network.definition.output_kind == "inverse"


def test_sets_that_are_not_there_are_left_out(tmp_path: Path) -> None:
    assert not list(strong_frames(tmp_path, ("stored", "fastdepth"), ["nyu", "unidepth_nyu"], 3))


def test_points_are_drawn_only_where_most_of_the_truth_is_left_to_score_on() -> None:
    gt = np.zeros((50, 100), np.float32)
    gt[:10] = 2.0
    frame = EvalFrame("few", np.zeros((50, 100, 3), np.float32), gt)
    assert can_draw(frame, 100)
    assert not can_draw(frame, 500)


def test_lines_drawn_from_truth_are_recognised_as_scan_lines() -> None:
    frame = EvalFrame("wall", np.ones((240, 320, 3), np.float32), np.ones((240, 320), np.float32))
    points = with_lines(frame).points(None)
    assert scan_pattern(points.xy, points.size) is not None


@pytest.mark.slow
def test_a_run_scores_every_column_and_the_result_of_an_exact_network_is_better_than_points_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("embreex")
    (case,) = (
        found
        for found in strong_frames(Path("nowhere"), ("simulated",), ["rendered desks"], 1)
        if found.row == "simulated, 2 %"
    )
    run = measure(case, 20, 0)
    assert run["mae"].keys() == set(STAGES)
    assert run["mae"][AFTER] < run["mae"]["linear"]
    assert sum(run["weights"].values()) == pytest.approx(1)
    print_tables([run])
    assert f"{run['mae'][BEFORE]:.4f}" in capsys.readouterr().out


def test_frames_count_alike_in_a_geometric_mean() -> None:
    runs = [{"mae": {AFTER: 0.01}}, {"mae": {AFTER: 1.0}}]
    assert geometric_mean(runs, AFTER) == pytest.approx(0.1)
