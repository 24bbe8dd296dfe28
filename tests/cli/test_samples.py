"""Commands on the samples: exit code, names of the files, and a figure or two.

The errors are of the project's own weights, so they move only with the method; the tolerance is far
above what another processor changes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pnpdepth_cli.io.depth import read_depth
from tests.command_line import printed, working_in

SAMPLES = Path(__file__).parents[2] / "samples"
INDOOR = f"refine {SAMPLES}/indoor/rgb.png --sparse {SAMPLES}/indoor/sparse.png"
FILES = {"rgb.json", "rgb_depth.png", "rgb_improvement.png", "rgb_preview.png"}
SIGMA = {"rgb_sigma.png", "rgb_valid.png"}
STREET = f"{SAMPLES}/street"
SCAN = f"{STREET}/rgb.png --sparse {STREET}/000000.bin --calib {STREET}/calib.txt --iterations 1"


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def output(line: str) -> str:
    done = printed(*line.split())
    assert done.code == 0, done.err
    return done.out


def result(line: str) -> Any:
    return json.loads(output(f"{line} --json"))


@pytest.mark.parametrize(
    ("options", "before", "after", "more"),
    [
        ("", 0.075, 0.070, set()),
        ("--model sparse2dense-tiny", 0.451, 0.070, set()),
        ("--model fcrn-tiny --uncertainty", 1.041, 0.070, SIGMA),
        ("--model fcrn-tiny --method alone --propagate none", 1.056, 0.894, set()),
        ("--model fcrn-tiny --method paper", 1.386, 1.317, set()),
        (f"--depth {SAMPLES}/indoor/predicted.npy", 0.120, 0.030, set()),
    ],
)
def test_refine_writes_its_files_and_lowers_the_error(
    options: str, before: float, after: float, more: set[str]
) -> None:
    record = result(f"{INDOOR} --gt {SAMPLES}/indoor/gt.png -o out {options}")
    assert {path.name for path in Path("out").iterdir()} == FILES | more
    mae = [record["errors"]["ground_truth"][stage]["mae"] for stage in ("before", "after")]
    assert mae == pytest.approx([before, after], rel=0.02)


class Street(NamedTuple):
    """The street with unsupported depth kept and at 0: records, and maps (H, W) in metres."""

    kept: Any
    zero: Any
    whole_depth: NDArray[np.float32]
    depth: NDArray[np.float32]
    valid: NDArray[np.bool_]
    truth: NDArray[np.float32]

    @property
    def scored(self) -> NDArray[np.bool_]:
        """The pixels of ground truth whose depth is kept."""
        return (self.truth > 0) & self.valid


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    line = f"refine {SCAN} --gt {STREET}/gt.png --uncertainty"
    with working_in(tmp_path_factory.mktemp("street")):
        return Street(
            kept=result(f"{line} --unknown keep -o keep"),
            zero=result(f"{line} --unknown zero -o zero"),
            whole_depth=read_depth(Path("keep/rgb_depth.png")).values,
            depth=read_depth(Path("zero/rgb_depth.png")).values,
            valid=cv2.imread("zero/rgb_valid.png", cv2.IMREAD_GRAYSCALE) > 0,
            truth=read_depth(Path(STREET, "gt.png")).values,
        )


def test_unsupported_depth_is_0_if_asked_and_the_rest_as_it_was(street: Street) -> None:
    assert (street.depth == np.where(street.valid, street.whole_depth, 0)).all()


def test_errors_of_all_stages_are_of_the_pixels_whose_depth_is_kept(street: Street) -> None:
    errors = street.zero["errors"]["ground_truth"]
    mae = np.abs(street.depth - street.truth)[street.scored].mean()
    assert errors["after"]["mae"] == pytest.approx(mae, abs=0.01)
    coverage = street.scored.sum() / (street.truth > 0).sum()
    assert errors["after"]["coverage"] == pytest.approx(coverage)
    of_all = street.kept["errors"]["ground_truth"]
    assert errors["linear"]["mae"] < of_all["linear"]["mae"]


def test_the_improvement_is_counted_over_the_pixels_whose_depth_is_kept(street: Street) -> None:
    footer = street.zero["result"]["figures"]["improvement"]["footer"]
    assert f" {street.scored.sum():,} pixels" in footer


def test_depth_outside_of_the_scan_is_said_where_no_mask_is_written() -> None:
    record = result(f"refine {SCAN}")
    assert {*record["result"]["outputs"]} == {"depth", "preview", "improvement", "record"}
    assert any("--unknown zero" in note for note in record["notes"])
    assert record["result"]["points"]["used"] == pytest.approx(16007, abs=5)


BATCH = f"batch {SAMPLES}/frames.csv -o out --model fcrn-tiny --method paper"


@pytest.fixture(scope="module")
def batch_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose out/ has the batch of the samples."""
    folder = tmp_path_factory.mktemp("batch")
    with working_in(folder):
        output(BATCH)
    return folder


def maes(folder: Path) -> dict[str, float]:
    frames = json.loads((folder / "out/summary.json").read_text())["frames"]
    return {frame["name"]: frame["errors"]["ground_truth"]["after"]["mae"] for frame in frames}


def test_a_batch_writes_the_files_of_each_frame_and_a_summary_of_their_errors(
    batch_folder: Path,
) -> None:
    assert maes(batch_folder) == pytest.approx({"indoor": 1.317, "street": 11.92}, rel=0.02)
    shown = [path for path in (batch_folder / "out").iterdir() if not path.name.startswith(".")]
    ends = (".json", "_depth.png", "_improvement.png", "_preview.png")
    expected = {name + end for name in ("indoor", "street") for end in ends}
    assert {path.name for path in shown} == expected | {"summary.csv", "summary.json"}


def test_a_batch_that_is_done_is_not_done_again(batch_folder: Path) -> None:
    depth = batch_folder / "out/indoor_depth.png"
    before = depth.stat().st_mtime_ns
    with working_in(batch_folder):
        output(BATCH)
    assert depth.stat().st_mtime_ns == before


def test_eval_gives_the_error_that_the_batch_gave(batch_folder: Path) -> None:
    scored = result(f"eval {batch_folder}/out/indoor_depth.png {SAMPLES}/indoor/gt.png")
    assert scored["mean"]["mae"] == pytest.approx(maes(batch_folder)["indoor"], rel=1e-3)


def test_a_batch_is_compared_with_itself(batch_folder: Path) -> None:
    summary = f"{batch_folder}/out/summary.json"
    assert "MAE" in output(f"compare {summary} {summary} --csv table.csv")
    rows = [row.split(",") for row in Path("table.csv").read_text().splitlines()]
    assert rows[0][:4] == ["measure", "run", "mean", "percent"]
    assert [row[3] for row in rows if row[0] == "mae"] == ["", "0.0"]


def test_a_depth_of_a_batch_becomes_a_cloud_with_the_colours_of_its_image(
    batch_folder: Path,
) -> None:
    Path("k.txt").write_text("554 0 320 0 554 240 0 0 1")
    told = output(f"cloud {batch_folder}/out/indoor_depth.png --calib k.txt -o cloud.ply")
    assert "307,200 points, coloured" in told


@pytest.mark.parametrize(
    ("line", "count"),
    [
        (f"project {STREET}/000000.bin --calib {STREET}/calib.txt --image {STREET}/rgb.png", 16007),
        (f"sample {SAMPLES}/indoor/gt.png --count 100", 100),
        (f"simulate {SAMPLES}/indoor/gt.png --sensor vlp-16 --calib {STREET}/calib.txt", 3052),
    ],
    ids=["project", "sample", "simulate"],
)
def test_made_points_are_counted(line: str, count: int) -> None:
    output(f"{line} -o sparse.png")
    record = json.loads(Path("sparse.json").read_text())
    assert record["points"]["count"] == pytest.approx(count, rel=1e-3)
    assert {"sparse.png", "sparse.json"} <= {path.name for path in Path().iterdir()}
