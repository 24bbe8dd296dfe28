"""`pnpdepth refine` through files: what is written, recorded, warned of and refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from pnpdepth_cli import Refiner
from pnpdepth_cli.dataset.frame_record import FrameRecord, ResultRecord
from pnpdepth_cli.errors import (
    InputError,
    ModelError,
    NoPointsError,
    OutputError,
    PnpDepthError,
    StorageError,
    UsageError,
)
from pnpdepth_cli.io.depth import read_depth, write_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import Settings
from tests.commands.batches import batch
from tests.commands.frames import FrameOnDisk, frame_on_disk, run
from tests.completion.unregistered import SIZE, UNREGISTERED
from tests.completion.unregistered import frame as unregistered


class Refined(NamedTuple):
    """A frame refined in 40 iterations and without any: records, and maps (H, W) in metres."""

    frame: FrameOnDisk
    record: FrameRecord
    plain: FrameRecord
    depth: NDArray[np.float32]
    before: NDArray[np.float32]

    @property
    def truth(self) -> NDArray[np.float64]:
        return read_depth(self.frame.gt).values.astype(np.float64)


@pytest.fixture(scope="module")
def refined_files(tmp_path_factory: pytest.TempPathFactory) -> Refined:
    frame = frame_on_disk(tmp_path_factory.mktemp("refined"))
    asked = {"gt": frame.gt, "lr": "20%", "update": "adam", "format": "npy"}
    record = run(frame, **asked, iterations=40)
    plain = run(frame, **asked, iterations=0, output=frame.folder / "own.npy")
    depth = np.load(frame.folder / "out/img_depth.npy")
    return Refined(frame, record, plain, depth, np.load(frame.folder / "own.npy"))


def test_refinement_lowers_the_error_at_the_points_and_at_the_ground_truth(
    refined_files: Refined,
) -> None:
    record = refined_files.record
    for basis in ("used", "ground_truth"):
        before, after = (record.errors[basis][stage]["mae"] or 0 for stage in ("before", "after"))
        assert after < 0.8 * before
    assert len(record.refined().loss) == 41


def test_no_iterations_give_the_networks_own_prediction_bit_for_bit(
    refined_files: Refined,
) -> None:
    frame = refined_files.frame
    network = load_network(str(frame.model), frame.checkpoint)
    rgb = torch.from_numpy(read_rgb(frame.image).values).permute(2, 0, 1)[None]
    with torch.no_grad():
        padded = network.module(torch.nn.functional.pad(rgb, (0, 2, 0, 2), mode="replicate"))
    predicted = padded[0, 0, : rgb.shape[2], : rgb.shape[3]].numpy()
    assert np.array_equal(refined_files.before, predicted)
    assert refined_files.plain.refined().improved_fraction == 0


def test_the_errors_of_a_record_are_those_of_its_files(refined_files: Refined) -> None:
    error = np.abs(refined_files.depth - refined_files.truth)
    after = refined_files.record.errors["ground_truth"]["after"]
    assert after["mae"] == pytest.approx(error.mean(), abs=1e-9)


def test_the_improved_fraction_is_of_the_pixels_whose_error_fell(refined_files: Refined) -> None:
    error = np.abs(refined_files.depth - refined_files.truth)
    improved = (error < np.abs(refined_files.before - refined_files.truth)).mean()
    assert 0 < improved < 1
    found = refined_files.record.refined().improved_fraction
    assert found == pytest.approx(improved, abs=1e-3)


def test_a_record_has_the_nearest_and_the_farthest_of_its_points(refined_files: Refined) -> None:
    points = refined_files.record.refined().points
    known = read_depth(refined_files.frame.sparse).values
    assert (points.nearest, points.farthest) == (known[known > 0].min(), known.max())


def test_held_out_points_are_a_seeded_share_that_the_loss_never_sees(frame: FrameOnDisk) -> None:
    first, again, other = (
        run(frame, holdout=0.25, seed=seed, output=frame.folder / name)
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    results = [record.refined() for record in (first, again, other)]
    assert (results[0].points.held_out, results[0].points.used) == (15, 45)
    assert first.errors["held_out"]["after"]["points"] == 15
    assert results[0].loss == results[1].loss != results[2].loss
    assert results[0].improved_fraction in [n / 15 for n in range(16)]
    for path in (frame.folder / "a").glob("*.png"):
        assert path.read_bytes() == (frame.folder / "b" / path.name).read_bytes()


def test_a_full_disk_leaves_no_result(frame: FrameOnDisk, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise StorageError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("pnpdepth_cli.dataset.frame_record.write_json", full)
        with pytest.raises(StorageError):
            run(frame)
    assert not list((frame.folder / "out").iterdir())


def test_results_are_replaced_only_if_asked_and_inputs_never(frame: FrameOnDisk) -> None:
    run(frame)
    depth = frame.folder / "out" / "img_depth.png"
    old = depth.read_bytes()
    with pytest.raises(OutputError, match="--overwrite"):
        run(frame, iterations=0)
    assert depth.read_bytes() == old
    run(frame, iterations=0, overwrite=True)
    assert depth.read_bytes() != old
    with pytest.raises(OutputError, match=r"s\.png"):
        run(frame, output=frame.sparse, overwrite=True)


def test_the_networks_crop_leaves_the_rest_unknown_and_unscored(frame: FrameOnDisk) -> None:
    model = frame.folder / "cropped.py"
    text = frame.model.read_text().replace("Multiple(4)", "Fixed(32, 32, fit='crop')")
    model.write_text(text.replace("Multiple,", "Fixed,"))
    record = run(frame, model=str(model), output=frame.folder / "d.npy", gt=frame.gt)
    known = np.load(frame.folder / "d.npy") > 0
    assert (known == ((np.arange(62) >= 8) & (np.arange(62) < 54))).all()
    stages = record.errors["ground_truth"]
    assert stages["linear"]["pixels"] == stages["after"]["pixels"] == known.sum()


BAD: list[tuple[dict[str, Any], type[PnpDepthError], str]] = [
    ({"holdout": 1.0}, UsageError, "--holdout"),
    ({"layer": "midle"}, ModelError, "middle"),
    ({"image": None}, PnpDepthError, "rgb"),
    ({"gt": "small.npy"}, InputError, "62×10 .* 62×46"),
    ({"gt": "codes.png"}, InputError, "--depth-scale .* 1000 "),  # 256 is assumed
    ({"sparse": None}, InputError, "sparse"),
    ({"sparse": "far.csv"}, NoPointsError, "1 points"),
    ({"view_3d": True}, UsageError, "--html-3d .* --calib"),
    ({"uncertainty": True, "output": Path("a.exr")}, UsageError, "--uncertainty"),
]


@pytest.mark.parametrize(("changes", "error", "message"), BAD)
def test_a_mistake_gives_one_clear_line_and_writes_nothing(
    frame: FrameOnDisk, changes: dict[str, Any], error: type[PnpDepthError], message: str
) -> None:
    np.save(frame.folder / "small.npy", frame.depth[:10])
    Image.fromarray(np.rint(frame.depth * 1000).astype(np.uint16)).save(frame.folder / "codes.png")
    (frame.folder / "far.csv").write_text("x,y,depth\n500,5,2\n")
    before = {*frame.folder.iterdir()}
    names = {kind: changes[kind] for kind in ("gt", "sparse") if changes.get(kind)}
    changes = changes | {kind: frame.folder / name for kind, name in names.items()}
    with pytest.raises(error, match=message) as caught:
        run(frame, **changes)
    assert "\n" not in str(caught.value)
    assert {*frame.folder.iterdir()} == before


def test_the_papers_method_is_the_papers_setting_bit_for_bit(frame: FrameOnDisk) -> None:
    paper = {
        "layer": "middle", "update": "sign", "lr": "0.01", "iterations": 5, "loss": "l1",
        "schedule": "constant", "blur": 0.0, "align": "none", "propagate": "none",
    }  # fmt: skip
    of_method = frame.folder / "method.npy"
    of_options = frame.folder / "options.npy"
    by_name = run(frame, method="paper", output=of_method)
    by_options = run(frame, **paper, method="alone", output=of_options)
    assert of_method.read_bytes() == of_options.read_bytes()
    settings = by_options.refined().settings | {"method": "paper"}
    assert by_name.refined().settings == settings


def test_networks_that_are_given_are_fused(frame: FrameOnDisk) -> None:
    second = frame.folder / "second.py"
    text = frame.model.read_text().replace('name="tiny"', 'name="second", complete=True')
    second.write_text(text)
    with pytest.raises(UsageError, match="'paper'"):
        run(frame, more_models=(str(second),))
    record = run(frame, more_models=(str(second),), method="fused", iterations=3)
    method = record.refined().method
    assert method.names == ["tiny", "second", "compact"]
    assert [network.iterations for network in method.networks] == [3, 5, 2]  # two have their own
    own = run(frame, method="alone", overwrite=True)
    assert own.refined().weights == {"tiny": 1.0}


def test_the_standard_deviation_is_positive_and_rounded_in_a_png(frame: FrameOnDisk) -> None:
    asked = {"uncertainty": True, "method": "fused"}
    records = [run(frame, **asked, format=f, output=frame.folder / f) for f in ("png", "npy")]
    sigma, exact = (
        read_depth(Path(record.refined().outputs["sigma"])).values for record in records
    )
    assert sigma.shape == frame.depth.shape
    assert (sigma > 0).all()
    assert np.abs(exact - sigma).max() < 0.00051


def write_frame(root: Path, seed: int, count: int) -> dict[str, Path]:
    """Writes a frame that is not registered into rgb/ and sparse/; returns its files."""
    rgb, points = unregistered(seed, UNREGISTERED, count)
    files = {"image": root / f"rgb/{seed:03}.png", "sparse": root / f"sparse/{seed:03}.png"}
    for path in files.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(files["image"]), np.rint(rgb[..., ::-1] * 255).astype(np.uint8))
    depth = np.zeros(SIZE, np.float32)
    column, row = points.xy.numpy().astype(int).T
    depth[row, column] = points.depth.numpy()
    write_depth(files["sparse"], depth, scale=1000)
    return files


def refined(folder: Path, own: FrameOnDisk, count: int = 500, **options: Any) -> ResultRecord:
    """The record of the frame, refined with these options."""
    files: dict[str, Any] = write_frame(folder, 0, count)
    fields = {"output": folder / "out", "overwrite": True, "method": "alone"}
    return run(own, **files | fields | options).refined()


def test_an_image_that_does_not_fit_the_points_is_moved_and_said(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    moved = refined(tmp_path, frame)
    assert moved.registration is not None
    assert moved.registration["zoom"] == pytest.approx(UNREGISTERED.zoom, abs=0.012)
    notes = FrameRecord.read(Path(moved.outputs["record"])).notes
    assert any(note.startswith("image: moved") for note in notes)


@pytest.mark.parametrize("options", [{"method": "paper"}, {"registration": "off"}])
def test_an_image_is_not_moved_by_the_paper_nor_where_that_is_off(
    options: dict[str, str], tmp_path: Path, frame: FrameOnDisk
) -> None:
    assert refined(tmp_path, frame, **options).registration is None


def test_an_image_is_moved_as_it_is_stated(tmp_path: Path, frame: FrameOnDisk) -> None:
    moved = refined(tmp_path, frame, registration=(0.9, -5.0, 3.0))
    assert moved.registration == {"zoom": 0.9, "right": -5.0, "down": 3.0}


def test_moving_gives_what_an_image_moved_on_disk_gives(tmp_path: Path, frame: FrameOnDisk) -> None:
    refined(tmp_path, frame, registration=(1.0, -4.0, 3.0), output=tmp_path / "a.npy")
    image = cv2.imread(str(write_frame(tmp_path, 0, 500)["image"]))
    moved = np.pad(image, ((0, 3), (4, 0), (0, 0)), mode="edge")[3:, :-4]
    cv2.imwrite(str(tmp_path / "moved.png"), moved)
    changes: dict[str, Any] = {"image": tmp_path / "moved.png", "registration": "off"}
    refined(tmp_path, frame, output=tmp_path / "b.npy", **changes)
    assert np.array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


def test_held_out_points_take_no_part_in_moving_an_image(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    with_all = refined(tmp_path, frame, count=800).registration
    with_half = refined(tmp_path, frame, count=800, holdout=0.5, seed=3)
    assert with_half.points.held_out == 400
    assert None not in (with_all, with_half.registration)
    assert with_half.registration != with_all


def test_a_registration_that_no_frame_shows_alone_is_shared_by_the_frames_of_a_batch(
    tmp_path: Path, frame: FrameOnDisk
) -> None:
    assert refined(tmp_path / "alone", frame, count=80).registration is None
    for seed in range(8):
        write_frame(tmp_path / "in", seed, 80)
    network = {"model": str(frame.model), "checkpoint": frame.checkpoint}
    batch(tmp_path, source=tmp_path / "in", refine=network | {"method": "alone"})
    records = (tmp_path / "out").glob("0*.json")
    first, *others = (FrameRecord.read(path).refined().registration for path in records)
    assert first is not None
    assert first["zoom"] == pytest.approx(UNREGISTERED.zoom, abs=0.02)
    assert others == [first] * 7


def test_a_registration_that_no_frame_shows_alone_is_shared_by_arrays_of_a_sequence() -> None:
    frames = [unregistered(seed, UNREGISTERED, 80) for seed in range(8)]
    moved = []
    for shared in ([], frames):
        with Refiner(load_network("compact", None), Settings(propagate="none")) as refiner:
            refiner.share_registration(shared)
            moved.append(refiner.refine(*frames[0]).registration)
    assert moved[0] is None
    assert moved[1] is not None
    assert moved[1].zoom == pytest.approx(UNREGISTERED.zoom, abs=0.02)
