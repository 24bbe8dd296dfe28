from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.paper_figures import ROWS, PaperRow, networks_of
from benchmarks.paper_report import bars_of, reason
from benchmarks.paper_sets import ROOMS, data_set, rendered, scan_of, shared
from benchmarks.paper_tables import checkpoints_in, main, scores_of
from model_zoo_defs.adnn import Adnn
from model_zoo_defs.sparseconv import SparseConvNet
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.models.registry import names

LENS = np.array([721.3, 721.3, 455.5, 36.4], np.float32)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.name}-{row.street}")
def test_the_papers_figures_give_the_gains_printed_beside_them(row: PaperRow) -> None:
    for measure, printed in enumerate(row.gains):
        gain = 100 * (1 - row.after[measure] / row.before[measure])
        assert gain == pytest.approx(printed, abs=0.12)  # four decimals are printed of the errors


def test_every_tiny_network_has_its_rows() -> None:
    tiny = [name for name in names() if "-tiny" in name]
    rows = [(row.street, row.name, networks_of(row, tiny)) for row in ROWS]
    assert rows == [
        (False, "Eigen", ["eigen-tiny"]),
        (False, "FCRN", ["fcrn-tiny"]),
        (False, "Uhrig", ["sparseconv-tiny"]),
        (False, "Ma", ["sparse2dense-tiny"]),
        (False, "Jaritz", ["latefusion-tiny"]),
        (True, "Eigen", []),
        (True, "Zhou", ["sfmlearner-tiny"]),
        (True, "Uhrig", ["sparseconv-tiny"]),
        (True, "Chodosh", ["adnn-tiny"]),
        (True, "Ma", ["sparse2dense-tiny-kitti"]),
    ]


def test_all_depths_are_scored_on_the_same_pixels() -> None:
    gt = np.array([[2.0, 2.0, 2.0, 0.0]], np.float32)
    before = np.array([[2.0, 2.2, 9.0, 9.0]], np.float32)
    after = np.array([[2.0, 2.0, -1.0, 9.0]], np.float32)
    scores, coverage = scores_of({"before": before, "after": after}, gt)
    assert scores["before"]["mae"] == pytest.approx(0.1)
    assert scores["before"]["delta1"] == 100
    assert scores["before"]["fine1"] == 50
    assert scores["after"]["mae"] == 0
    assert coverage == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    ("std_z", "losses", "cause"),
    [
        (10.0, (0.5, 0.4), "too short"),
        (0.05, (0.5, 0.6), "too long"),
        (1.0, (0.5, 0.4), "between them"),
        (1.0, (0.5, 0.6), "too far"),
    ],
)
def test_the_reason_follows_from_the_step_and_the_loss(
    std_z: float, losses: tuple[float, float], cause: str
) -> None:
    setting = {"loss_before": losses[0], "loss_after": losses[1]}
    assert cause in reason({"std_z": std_z, "settings": {"paper": setting}}, "paper")


def test_the_scan_of_a_wall_lies_on_it_in_lines() -> None:
    wall = np.full((228, 912), 20.0, np.float32)
    scan = scan_of(wall, LENS, seed=0)
    known = scan > 0
    assert 0.02 < known.mean() < 0.1
    assert np.abs(scan[known] - 20).max() < 0.2


def test_rendered_frames_come_from_the_cache_and_end_at_the_kinects_range(tmp_path: Path) -> None:
    depth = np.full((4, 228, 304), 3.0, np.float32)
    depth[:, :, :100] = 11.0
    ROOMS.folder(tmp_path).mkdir()
    np.savez(
        ROOMS.folder(tmp_path) / "shard_00000.npz",
        rgb=np.full((4, 228, 304, 3), 51, np.uint8),
        depth=depth,
        intrinsics=np.tile(LENS, (4, 1)),
    )
    frames = list(rendered(ROOMS, tmp_path, 3, workers=1).frames())
    assert len(frames) == 3
    assert frames[0].rgb.max() == np.float32(0.2)
    assert set(np.unique(frames[0].gt)) == {0, 3}
    assert frames[0].scan is None


def test_the_same_number_of_points_of_a_frame_is_the_same_points(tmp_path: Path) -> None:
    frame = next(data_set(f"nyu={nyu(tmp_path)}", None).frames())
    first, second, other = (frame.points(100, seed) for seed in (7, 7, 8))
    assert torch.equal(first.xy, second.xy)
    assert not torch.equal(first.xy, other.xy)


def test_in_kitti_odometry_the_scan_is_the_ground_truth(tmp_path: Path) -> None:
    frame = next(data_set(f"kitti={odometry(tmp_path)}", None).frames())
    assert frame.rgb.shape == (228, 912, 3)
    assert frame.scan is None
    assert (frame.gt > 0).sum() > 1000
    assert np.array_equal(frame.gt, frame.pool)


def test_frames_that_networks_are_trained_on_are_left_out(tmp_path: Path) -> None:
    one = nyu(tmp_path) / "00001.h5"
    for folder in ("train/basement", "val/official"):
        (tmp_path / "ma" / folder).mkdir(parents=True)
        shutil.copy(one, tmp_path / "ma" / folder)
    data = data_set(f"nyu={tmp_path / 'ma'}", None)
    assert data.count == 1
    assert data.notes == ("ma: 1 of 1 frames of val or test; 1 of train left out",)
    only = data_set(f"nyu={tmp_path / 'ma' / 'train'}", None)
    assert only.count == 1
    assert "all of train: networks may have been trained on them" in only.notes[0]


def test_odometry_is_tested_on_the_sequences_without_public_poses(tmp_path: Path) -> None:
    root = odometry(tmp_path)
    source = next(path.parent for path in root.rglob("calib.txt"))
    shutil.copytree(source, source.parent / "17")
    data = data_set(f"kitti={root}", None)
    assert data.count == 1
    assert "1 of sequences 00 to 10 left out" in data.notes[0]


@pytest.mark.parametrize("modality", ["-rgb", "-d", "-rgb-kitti", "-d-kitti"])
def test_editions_with_only_image_or_depth_as_input_have_no_row(modality: str) -> None:
    assert not any(row.takes(f"sparse2dense-r18-deconv2{modality}") for row in ROWS)


def test_files_beside_weights_are_no_weights_and_two_are_one_too_many(tmp_path: Path) -> None:
    for suffix in (".ckpt.index", ".ckpt.meta", ".ckpt.data-00000-of-00001"):
        (tmp_path / f"fcrn{suffix}").touch()
    (tmp_path / "adnn.txt").touch()
    assert checkpoints_in(tmp_path) == {"fcrn": tmp_path / "fcrn.ckpt.index"}
    (tmp_path / "fcrn.npy").touch()
    with pytest.raises(UsageError, match="both for fcrn; keep one of them"):
        checkpoints_in(tmp_path)


@pytest.mark.parametrize("what", ["nyu", "kitti=", "sun=there"])
def test_data_of_no_known_kind_is_refused(what: str) -> None:
    with pytest.raises(UsageError, match="give nyu=PATH or kitti=PATH"):
        data_set(what, None)


def test_data_under_the_name_of_the_other_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is read as 'nyu' frames"):
        data_set(f"kitti={nyu(tmp_path)}", None)


def test_real_frames_at_hand_are_cut_as_the_paper_cuts_them(shared_data: Path) -> None:
    sizes = {one.name: next(one.frames()).gt.shape for one in shared(shared_data, 1)}
    assert sizes == {"7scenes": (228, 304), "icl_nuim": (228, 304), "kitti_dc": (375, 1242)}


def test_published_weights_are_scored_on_data_sets_on_disk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tmp_path / "weights"
    weights.mkdir()
    torch.manual_seed(0)
    torch.save({"state_dict": SparseConvNet().state_dict()}, weights / "sparseconv.pth.tar")
    kernels = {name: value.numpy() for name, value in Adnn().state_dict().items()}
    np.savez(weights / "adnn.npz", **kernels)
    out = tmp_path / "t.json"
    sets = [f"nyu={nyu(tmp_path)}", f"kitti={completion(tmp_path)}", f"kitti={odometry(tmp_path)}"]
    code = main(["--data", *sets, "--checkpoints", str(weights), "--json", str(out)])
    printed = capsys.readouterr().out
    assert code == 0
    tables = json.loads(out.read_text())["tables"]
    rows = [[(row["network"], row["points"]) for row in table["rows"]] for table in tables]
    scans = 40 * 200
    assert rows == [[("sparseconv", 3466)], [("sparseconv", scans), ("adnn", scans)], []]
    for table in tables[:2]:
        assert len(bars_of(table)["published"]) == len(table["rows"])
        assert all(row["std_z"] > 0 and row["frames"] == 1 for row in table["rows"])
    assert "*Chodosh, published*" in printed
    assert "`adnn` needs a LiDAR and a ground truth besides it" in printed


def nyu(folder: Path) -> Path:
    """A frame of NYU Depth v2 as Ma et al. have it."""
    (folder / "nyu").mkdir()
    rows = np.arange(480, dtype=np.float32)[:, None] / 480
    with h5py.File(folder / "nyu" / "00001.h5", "w") as file:
        file["rgb"] = np.zeros((3, 480, 640), np.uint8)
        file["depth"] = np.broadcast_to(4 - 2 * rows, (480, 640))
    return folder / "nyu"


def completion(folder: Path) -> Path:
    """A frame of KITTI's depth completion selection."""
    depth = np.full((100, 400), 15 * 256, np.uint16)
    scan = np.zeros_like(depth)
    scan[20:, :][::2, ::2] = 15 * 256
    for name, values in (
        ("image", np.zeros((100, 400, 3), np.uint8)),
        ("velodyne_raw", scan),
        ("groundtruth_depth", depth),
    ):
        (folder / "completion" / name).mkdir(parents=True)
        Image.fromarray(values).save(folder / "completion" / name / "0000000005.png")
    return folder / "completion"


def odometry(folder: Path) -> Path:
    """A frame of KITTI odometry, in front of a wall 12 m away."""
    sequence = folder / "odometry" / "sequences" / "00"
    for name in ("image_2", "velodyne"):
        (sequence / name).mkdir(parents=True)
    Image.fromarray(np.zeros((376, 1241, 3), np.uint8)).save(sequence / "image_2" / "000000.png")
    projection = "7.2e2 0 6.07e2 0 0 7.2e2 1.85e2 0 0 0 1 0"
    lines = [f"P{camera}: {projection}" for camera in range(4)]
    lines.append("Tr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27")
    (sequence / "calib.txt").write_text("\n".join(lines) + "\n")
    left, up = np.meshgrid(np.linspace(-9, 9, 200), np.linspace(-3, 1, 30))
    scan = np.stack([np.full_like(left, 12.0), left, up, np.zeros_like(left)], axis=-1)
    scan.astype(np.float32).tofile(sequence / "velodyne" / "000000.bin")
    return folder / "odometry"
