"""VOID, DIODE, iBims-1, ScanNet, ARKitScenes and Hypersim in small synthetic files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pnpdepth_cli.commands.batch.frames import task_of
from pnpdepth_cli.commands.batch.request import BatchRequest
from pnpdepth_cli.commands.refinement.inputs import Inputs, read_inputs
from pnpdepth_cli.commands.refinement.request import RefineRequest, sample_pattern
from pnpdepth_cli.errors import FileFormatError, SizeError
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.dataset.reading import masked, moved_to
from pnpdepth_cli.io.layouts import list_frames, read_frames

HEIGHT, WIDTH = 24, 32


def image(path: Path, height: int = HEIGHT, width: int = WIDTH) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))


def codes(path: Path, value: int, height: int = HEIGHT, width: int = WIDTH, every: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.zeros((height, width), np.uint16)
    depth[::every, ::every] = value
    cv2.imwrite(str(path), depth)


def mask(path: Path) -> None:
    """The left half is valid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    valid = np.zeros((HEIGHT, WIDTH), np.uint8)
    valid[:, : WIDTH // 2] = 255
    cv2.imwrite(str(path), valid)


def void(root: Path) -> None:
    sequence = root / "data" / "desktop"
    for stem in ("1552.25", "1553.25"):
        image(sequence / f"image/{stem}.png")
        codes(sequence / f"sparse_depth/{stem}.png", 512, every=4)
        codes(sequence / f"ground_truth/{stem}.png", 512)
    np.savetxt(sequence / "K.txt", np.eye(3))
    (root / "test_image.txt").write_text("void_1500/data/desktop/image/1553.25.png\n")


def diode(root: Path) -> None:
    name = root / "indoors/scene_00019/scan_00183/00019_00183_indoors_000_010"
    image(name.with_suffix(".png"))
    np.save(f"{name}_depth.npy", np.full((HEIGHT, WIDTH, 1), 2.0, np.float32))
    valid = np.zeros((HEIGHT, WIDTH), np.float32)
    valid[:, : WIDTH // 2] = 1
    np.save(f"{name}_depth_mask.npy", valid)


def ibims(root: Path) -> None:
    image(root / "rgb/corridor_01.png")
    codes(root / "depth/corridor_01.png", round(2 * 65535 / 50))
    mask(root / "mask_invalid/corridor_01.png")
    cv2.imwrite(str(root / "transp.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    (root / "mask_transp").mkdir()
    (root / "transp.png").rename(root / "mask_transp/corridor_01.png")


def scannet(root: Path) -> None:
    for scene in ("scene0000_00", "scene0001_00"):
        for number in (0, 2, 10):
            image(root / scene / f"color/{number}.jpg", 2 * HEIGHT, 2 * WIDTH)
            codes(root / scene / f"depth/{number}.png", 2000)
        (root / scene / "intrinsic").mkdir()


def arkitscenes(root: Path) -> None:
    video = root / "Validation" / "41069021"
    image(video / "wide/41069021_305.244.png")
    codes(video / "lowres_depth/41069021_305.244.png", 2000, HEIGHT // 4, WIDTH // 4)
    codes(video / "highres_depth/41069021_305.244.png", 2000)


def hypersim(root: Path) -> None:
    h5py = pytest.importorskip("h5py")
    images = root / "ai_001_001" / "images"
    image(images / "scene_cam_00_final_preview/frame.0000.tonemap.jpg")
    (images / "scene_cam_00_geometry_hdf5").mkdir()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.sqrt((x - 15.5) ** 2 + (y - 11.5) ** 2 + 886.81**2) / 886.81
    path = images / "scene_cam_00_geometry_hdf5/frame.0000.depth_meters.hdf5"
    with h5py.File(path, "w") as file:
        file["dataset"] = (2 * ray).astype(np.float64)


Maker = Callable[[Path], None]
MAKERS: dict[str, tuple[Maker, list[str]]] = {
    "void": (void, ["data/desktop/1553.25"]),
    "diode": (diode, ["indoors/scene_00019/scan_00183/00019_00183_indoors_000_010"]),
    "ibims": (ibims, ["corridor_01"]),
    "scannet": (scannet, [f"scene000{s}_00/{n}" for s in (0, 1) for n in (0, 2, 10)]),
    "arkitscenes": (arkitscenes, ["41069021/41069021_305.244"]),
    "hypersim": (hypersim, ["ai_001_001/cam_00_frame.0000"]),
}


def inputs_of(frame: Frame, root: Path) -> Inputs:
    """The frame as a batch reads it; points are sampled where it has none."""
    pattern = None if frame.sparse is not None else sample_pattern("uniform", 20, None)
    refine = RefineRequest.from_fields(sample=pattern)
    request = BatchRequest(source=root, output=root / "out", refine=refine)
    return read_inputs(task_of(request, frame).request)


@pytest.mark.parametrize("name", MAKERS)
def test_depth_is_read_in_metres_where_it_is_valid(name: str, tmp_path: Path) -> None:
    MAKERS[name][0](tmp_path)
    inputs = inputs_of(read_frames(tmp_path)[0], tmp_path)
    assert inputs.gt is not None
    known = inputs.gt > 0
    np.testing.assert_allclose(inputs.gt[known], 2, rtol=1e-3)
    np.testing.assert_allclose(inputs.points.depth, 2, rtol=1e-3)
    assert inputs.image is not None
    assert inputs.image.shape[:2] == inputs.gt.shape == inputs.points.size
    expected = HEIGHT * WIDTH // (2 if name in ("diode", "ibims") else 1)
    assert int(known.sum()) == expected
    assert not known[:, WIDTH // 2 :].any() or name not in ("diode", "ibims")


def test_the_low_resolution_depth_of_arkitscenes_keeps_its_points(tmp_path: Path) -> None:
    arkitscenes(tmp_path)
    inputs = inputs_of(read_frames(tmp_path)[0], tmp_path)
    assert len(inputs.points) == HEIGHT * WIDTH // 16
    assert inputs.points.xy[0].tolist() == [1.5, 1.5]


def test_all_of_void_is_taken_without_a_list_of_the_test_split(tmp_path: Path) -> None:
    void(tmp_path)
    (tmp_path / "test_image.txt").unlink()
    assert len(read_frames(tmp_path)) == 2


def test_ground_truth_is_moved_and_never_interpolated(tmp_path: Path) -> None:
    depth = np.array([[1, 2], [3, 0]], np.float32)
    larger = moved_to(tmp_path, depth, (4, 4))
    assert sorted(larger[larger > 0].tolist()) == [1, 2, 3]
    assert moved_to(tmp_path, depth, (1, 1)).tolist() == [[1]]
    with pytest.raises(SizeError, match="do not show the same view"):
        moved_to(tmp_path, depth, (4, 9))
    with pytest.raises(SizeError, match="one is turned by 90°, turn it back"):
        moved_to(tmp_path, depth[:1], (4, 2))


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    mask(tmp_path / "mask.png")
    with pytest.raises(SizeError, match=r"mask\.png is 32×24 but the ground truth is 5×5"):
        masked(np.ones((5, 5), np.float32), (tmp_path / "mask.png",))


def test_a_manifest_names_masks_and_ground_truth_of_another_size(tmp_path: Path) -> None:
    image(tmp_path / "a.png", 2 * HEIGHT, 2 * WIDTH)
    codes(tmp_path / "gt.png", 512)
    mask(tmp_path / "mask.png")
    (tmp_path / "list.csv").write_text(
        "image,gt,mask,gt_size_ok,group\na.png,gt.png,mask.png,true,room\n"
    )
    (frame,) = list_frames(tmp_path / "list.csv")[1].frames
    assert (frame.masks, frame.gt_other_size, frame.group) == (
        (tmp_path / "mask.png",),
        True,
        "room",
    )
    inputs = inputs_of(frame, tmp_path)
    assert inputs.gt is not None
    assert int((inputs.gt > 0).sum()) == HEIGHT * WIDTH // 2
    (tmp_path / "list.csv").write_text("image,gt,gt_size_ok\na.png,gt.png,maybe\n")
    with pytest.raises(FileFormatError, match="gt_size_ok is 'maybe', not true or false"):
        list_frames(tmp_path / "list.csv")
