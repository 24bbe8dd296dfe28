"""The public Python API: its names are pinned, and it refines as the command does."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

import pnpdepth_cli as pnp
from pnpdepth_cli.camera import Camera
from pnpdepth_cli.choices import LOSSES
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.commands.shared.results import result_frames
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb
from pnpdepth_cli.refiner import DECIDED_BY, frame_of_arrays
from tests.completion.unregistered import UNREGISTERED
from tests.completion.unregistered import frame as unregistered

SAMPLE = Path(__file__).parent.parent / "samples" / "indoor"
Frame = tuple[NDArray[np.float32], NDArray[np.float32]]
PART = slice(0, 128), slice(0, 160)
BLACK = np.zeros((4, 4, 3))
OTHER_CAMERA = Camera(intrinsics=np.eye(3), size=(4, 5))


@pytest.fixture(scope="module")
def network() -> pnp.Network:
    return pnp.load_network("compact")


@pytest.fixture(scope="module")
def frame() -> Frame:
    """A part of the sample."""
    return read_rgb(SAMPLE / "rgb.png").values[PART], read_depth(SAMPLE / "sparse.png").values[PART]


@pytest.fixture(scope="module")
def refined(network: pnp.Network, frame: Frame) -> pnp.Refined:
    return pnp.refine(network, *frame)


def test_the_public_names_are_these() -> None:
    assert {*pnp.__all__} == {
        "__version__",
        "load_network",
        "refine",
        "score",
        "Refiner",
        "Refined",
        "Settings",
        "Scores",
        "Split",
        "Network",
        "ModelDefinition",
        "Normalisation",
        "Fixed",
        "Multiple",
        "Near",
        "SparsePoints",
        "Camera",
        "Alignment",
        "ImageRegistration",
        "Validation",
        "UsedNetwork",
        "DepthMap",
        "Pair",
        "Registration",
        "Unit",
        "PnpDepthError",
        "UsageError",
        "InputError",
        "ModelError",
        "NoPointsError",
        "DivergedError",
        "DeviceError",
        "OutputError",
    }


def test_arrays_are_refined_like_files(network: pnp.Network, frame: Frame, tmp_path: Path) -> None:
    refined = pnp.refine(network, *frame)
    for shown in (refined, refined.used, refined.validation):
        assert re.fullmatch(r"\w+\([\w×,. ]+\)", repr(shown))
    files = [str(tmp_path / "rgb.png"), "--sparse", str(tmp_path / "sparse.npy")]
    cv2.imwrite(files[0], np.rint(frame[0][:, :, ::-1] * 255))
    np.save(files[2], frame[1])
    assert run(["refine", *files, "-o", str(tmp_path / "depth.npy")]) == 0
    assert np.array_equal(refined.depth, np.load(tmp_path / "depth.npy"))
    truth = read_depth(SAMPLE / "gt.png").values[PART]
    assert pnp.score(refined.depth, truth)["mae"] < pnp.score(refined.before, truth)["mae"]


@pytest.mark.parametrize("suffix", [".png", ".exr", ".npy", ".npz", ".pfm", ".tiff"])
def test_a_refined_frame_is_saved_as_the_command_line_writes_it(
    refined: pnp.Refined, suffix: str, tmp_path: Path
) -> None:
    path = tmp_path / "new" / f"room_depth{suffix}"
    refined.save(path)
    saved = read_depth(path)
    # Half a code of a 16-bit PNG; the others hold the same numbers.
    half_code = 0.5001 / (saved.reading.scale or np.inf)
    np.testing.assert_allclose(saved.values, refined.depth, rtol=0, atol=half_code)
    assert {file.name for file in path.parent.iterdir()} == {path.name, "room.json"}
    (result,) = result_frames(path.parent)
    assert result.record.name == "room"
    assert result.record.refined().outputs["depth"] == str(path)
    assert result.record.refined().weights == refined.weights
    assert run(["eval", str(path), str(path)]) == 0


class BothWays(NamedTuple):
    """The record of the sample as the command line writes it, and as Python does."""

    command: Any
    python: Any


@pytest.fixture(scope="module")
def both_ways(network: pnp.Network, tmp_path_factory: pytest.TempPathFactory) -> BothWays:
    folder = tmp_path_factory.mktemp("both_ways")
    files = [str(SAMPLE / "rgb.png"), "--sparse", str(SAMPLE / "sparse.png")]
    assert run(["refine", *files, "-o", str(folder / "command")]) == 0
    rgb = read_rgb(SAMPLE / "rgb.png").values
    sparse = read_depth(SAMPLE / "sparse.png").values
    pnp.refine(network, rgb, sparse).save(folder / "rgb_depth.png")
    return BothWays(
        command=FrameRecord.read(folder / "command" / "rgb.json").to_json(),
        python=FrameRecord.read(folder / "rgb.json").to_json(),
    )


def test_the_record_of_a_saved_frame_has_what_that_of_the_command_line_has(
    both_ways: BothWays,
) -> None:
    command, python = both_ways
    # What the two do not share is of files, of notes on them, and of panels for a person.
    assert command.keys() - python.keys() <= {"inputs", "notes"}
    assert python.keys() <= command.keys()
    assert python["name"] == command["name"]
    assert python["status"] == command["status"]
    result, of_command = python["result"], command["result"]
    assert of_command.keys() - result.keys() <= {"figures", "camera", "seconds", "peak_memory_mb"}


@pytest.mark.parametrize("key", ["size", "points", "model", "method", "settings", "versions"])
def test_a_saved_frame_was_made_as_the_command_line_makes_it(key: str, both_ways: BothWays) -> None:
    assert both_ways.python["result"][key] == both_ways.command["result"][key]


def test_a_saved_frame_has_the_loss_and_the_error_of_the_command_line(both_ways: BothWays) -> None:
    command, python = both_ways
    result, of_command = python["result"], command["result"]
    assert result["loss"] == pytest.approx(of_command["loss"], rel=1e-4)
    after = [record["errors"]["validation"]["after"]["mae"] for record in (python, command)]
    assert after[0] == pytest.approx(after[1], rel=1e-3)


def test_no_file_is_replaced_by_a_saved_frame_unless_it_may_be(
    refined: pnp.Refined, tmp_path: Path
) -> None:
    (tmp_path / "room.json").write_text("of the user")
    with pytest.raises(pnp.UsageError, match=r"room\.json exists; overwrite=True"):
        refined.save(tmp_path / "room.png")
    assert [file.name for file in tmp_path.iterdir()] == ["room.json"]
    refined.save(tmp_path / "room.png", overwrite=True)
    assert FrameRecord.read(tmp_path / "room.json").name == "room"


def test_the_record_of_a_saved_frame_is_of_the_depth_that_is_written(
    refined: pnp.Refined, tmp_path: Path
) -> None:
    doubled = replace(refined, depth=2 * refined.depth)
    doubled.save(tmp_path / "doubled.npy")
    refined.save(tmp_path / "refined.npy")
    errors = [
        FrameRecord.read(tmp_path / name).errors["used"]["after"]["mae"]
        for name in ("doubled.json", "refined.json")
    ]
    assert errors[0] == pytest.approx(refined.used.depth.mean().item(), rel=0.1)
    assert errors[1] is not None
    assert errors[1] < 0.1


def test_a_frame_with_standard_deviation_is_saved_with_it_also_by_another_process(
    network: pnp.Network, frame: Frame, tmp_path: Path
) -> None:
    refined = pickle.loads(pickle.dumps(pnp.refine(network, *frame, uncertainty=True)))
    refined.save(tmp_path / "room_depth.npy")
    (result,) = result_frames(tmp_path)
    assert result.sigma is not None
    assert result.valid is not None
    np.testing.assert_array_equal(read_depth(result.sigma).values, refined.sigma)
    np.testing.assert_array_equal(result.read()[1], refined.valid & (refined.depth > 0))


def test_what_cannot_be_saved_leaves_no_file(refined: pnp.Refined, tmp_path: Path) -> None:
    with pytest.raises(pnp.UsageError, match=r"room\.jpg"):
        refined.save(tmp_path / "room.jpg")
    with pytest.raises(pnp.UsageError, match="Refiner"):
        replace(refined, saver=None).save(tmp_path / "room.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(pnp.UsageError, match="no regular file"):
        refined.save(tmp_path / "folder.png", overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["folder.png"]


def test_a_refiner_takes_maps_rows_and_points_alike(network: pnp.Network, frame: Frame) -> None:
    rgb, sparse = frame
    y, x = np.nonzero(sparse)
    rows = np.stack([x, y, sparse[y, x]], axis=1)
    xyz = torch.from_numpy(rows.astype(np.float32))
    points = pnp.SparsePoints(xy=xyz[:, :2], depth=xyz[:, 2], size=sparse.shape)
    before = {name: value.clone() for name, value in network.module.state_dict().items()}
    with pnp.Refiner(network, pnp.Settings(iterations=1)) as refiner:
        depths = [
            refiner.refine(rgb, sparse_depth).depth
            for sparse_depth in (sparse, sparse, rows, points)
        ]
    assert all(np.array_equal(depths[0], depth) for depth in depths[1:])
    assert all(torch.equal(before[n], v) for n, v in network.module.state_dict().items())
    assert not any("forward" in module.__dict__ for module in network.module.modules())


def test_threads_share_one_refiner_but_two_no_network(network: pnp.Network, frame: Frame) -> None:
    rgb, sparse = frame
    fewer = np.where(np.arange(sparse.shape[1]) % 2, sparse, 0)
    with pnp.Refiner(network, pnp.Settings(iterations=1)) as refiner:
        alone = [refiner.refine(rgb, sparse_depth).depth for sparse_depth in (sparse, fewer)]
        with ThreadPoolExecutor(2) as pool:
            given = [sparse, fewer] * 3
            together = list(pool.map(lambda each: refiner.refine(rgb, each).depth, given))
        with pytest.raises(pnp.UsageError, match="Refiner"):
            pnp.refine(network, rgb, sparse)
    assert all(np.array_equal(depth, alone[n % 2]) for n, depth in enumerate(together))
    assert np.array_equal(
        pnp.refine(network, rgb, sparse, pnp.Settings(iterations=1)).depth, alone[0]
    )


def test_a_closed_refiner_refines_nothing_and_its_network_is_free(
    network: pnp.Network, frame: Frame
) -> None:
    with pnp.Refiner(network) as refiner:
        refiner.refine(*frame)
    with pytest.raises(pnp.UsageError, match="closed"):
        refiner.refine(*frame)
    assert pnp.refine(network, *frame).depth.shape == frame[1].shape


def test_the_first_frames_of_a_size_decide_together_how_later_ones_are_moved(
    network: pnp.Network,
) -> None:
    settings = pnp.Settings(method="alone", iterations=0, propagate="none")
    refined = []
    with pnp.Refiner(network, settings) as refiner:
        for seed in range(DECIDED_BY + 2):
            refined.append(refiner.refine(*unregistered(seed, UNREGISTERED, 500)))
    alone, together = refined[: DECIDED_BY - 1], refined[DECIDED_BY - 1 :]
    assert len({str(frame.registration) for frame in alone}) > 1
    (shared,) = {str(frame.registration) for frame in together}
    assert together[0].registration.zoom == pytest.approx(UNREGISTERED.zoom, abs=0.01)
    # The frame that decides says so, and later ones say nothing more.
    said = [[n for n in frame.notes if "share_registration" in n] for frame in together]
    assert [len(notes) for notes in said] == [1, 0, 0]
    assert shared in said[0][0]


def test_frames_that_need_no_move_say_nothing_of_it(network: pnp.Network) -> None:
    settings = pnp.Settings(method="alone", iterations=0, propagate="none")
    with pnp.Refiner(network, settings) as refiner:
        for seed in range(DECIDED_BY + 1):
            refined = refiner.refine(*unregistered(seed, None, 500))
            assert refined.registration is None
            assert not any("share_registration" in note for note in refined.notes)


def test_the_depth_after_each_step_is_returned_if_it_is_asked_for(frame: Frame) -> None:
    network = pnp.load_network("fcrn-tiny")
    assert pnp.refine(network, *frame).stages == {}
    settings = pnp.Settings(iterations=2)
    stages = pnp.refine(network, *frame, settings, stages=True).stages
    assert [*stages] == ["before", "updated", "propagated", "alone"]


def test_a_network_that_takes_intrinsics_is_given_the_camera(frame: Frame) -> None:
    class OfCamera(nn.Module):
        def forward(self, rgb: torch.Tensor, camera: torch.Tensor) -> torch.Tensor:
            return rgb.mean(1, keepdim=True) + camera[0, 0, 0] / 100

    module = OfCamera()
    definition = pnp.ModelDefinition(
        name="of-camera",
        input_kind="rgb",
        size=pnp.Multiple(1),
        takes_intrinsics=True,
        layers=("",),
        build=lambda: module,
    )
    network = pnp.load_network(module, definition=definition)
    settings = pnp.Settings(method="paper", iterations=0, layer="")
    intrinsics = np.array([[150.0, 0, 80], [0, 150, 64], [0, 0, 1]])
    with pytest.raises(pnp.UsageError, match="intrinsics"):
        pnp.refine(network, *frame, settings)
    refined = pnp.refine(network, *frame, settings, camera=intrinsics)
    assert refined.depth == pytest.approx(frame[0].mean(axis=2) + 1.5, abs=1e-5)


def test_a_depth_map_of_another_network_is_given_as_an_array(
    network: pnp.Network, frame: Frame
) -> None:
    truth = read_depth(SAMPLE / "gt.png").values[PART]
    disparity = 0.5 + 2 / truth
    one = pnp.refine(network, *frame, depth=disparity)
    assert pnp.score(one.depth, truth)["mae"] < 0.01
    several = pnp.refine(network, *frame, depth=[disparity, truth])
    assert {"depth map 1", "depth map 2"} <= several.weights.keys()
    for wrong in (disparity[:9], np.full(truth.shape, np.nan), "depth.npy"):
        with pytest.raises(pnp.InputError, match="depth map"):
            pnp.refine(network, *frame, depth=wrong)
    with pnp.Refiner(network) as refiner:
        refiner.refine(*frame)
        with pytest.raises(pnp.UsageError, match="depth maps"):
            refiner.refine(*frame, depth=disparity)


def test_integers_are_scaled_by_their_type_or_unit(network: pnp.Network, frame: Frame) -> None:
    rgb, sparse = frame
    settings = pnp.Settings(iterations=0, align="scale")
    image = np.round(rgb * 255).astype(np.uint8)
    codes = np.round(sparse * 1000).astype(np.uint16)
    as_floats = (image / 255).astype(np.float32), (codes / 1000).astype(np.float32)
    expected = pnp.refine(network, *as_floats, settings).depth
    assert np.array_equal(pnp.refine(network, image, codes, settings, unit="mm").depth, expected)
    rows = np.column_stack([np.argwhere(codes)[:, ::-1], codes[codes > 0]])
    assert np.array_equal(pnp.refine(network, image, rows, settings, unit="mm").depth, expected)
    truth = np.full((2, 2), 1500, np.int32)
    assert pnp.score(np.full((2, 2), 1.25), truth, unit="mm")["mae"] == 0.25


@pytest.mark.parametrize(
    "depth",
    # the last one is too far for metres in the median
    [np.full((4, 4), 3, np.uint16), np.array([[1, 2, 3], [0, 1, 2]]), np.full((4, 4), 3471.0)],
)
def test_depth_of_a_doubtful_unit_needs_one(depth: NDArray[Any], network: pnp.Network) -> None:
    with pytest.raises(pnp.InputError, match="the sparse depth"):
        pnp.refine(network, BLACK, depth)
    with pytest.raises(pnp.UsageError, match="unit must be one of m, mm, got 'cm'"):
        pnp.refine(network, BLACK, depth, unit="cm")  # type: ignore[arg-type]
    with pytest.raises(pnp.InputError, match="the ground truth"):
        pnp.score(np.ones(depth.shape), depth)


@pytest.mark.parametrize(
    ("image", "sparse", "error", "message"),
    [
        (np.zeros((6, 6, 2)), np.ones((6, 6)), pnp.InputError, "image"),
        (np.full((4, 4, 3), 1.5), np.ones((4, 4)), pnp.InputError, "image"),
        ("photo.png", np.ones((4, 4)), pnp.InputError, "image"),
        (BLACK, np.ones((4, 4, 1)), pnp.InputError, "sparse"),
        (BLACK, [[1, 2], [3]], pnp.InputError, "sparse"),
        (BLACK, np.ones((5, 4)), pnp.InputError, "image"),
        (BLACK, np.zeros((4, 4)), pnp.NoPointsError, "sparse"),
        (BLACK, np.array([[9.0, 9, 1]]), pnp.NoPointsError, "image"),
        (None, np.ones((5, 3)), pnp.InputError, "image"),
    ],
)
def test_arrays_that_cannot_be_used_are_named(
    image: Any, sparse: Any, error: type[pnp.PnpDepthError], message: str, network: pnp.Network
) -> None:
    with pytest.raises(error, match=message):
        pnp.refine(network, image, sparse)


def test_every_form_of_an_image_is_read_alike() -> None:
    grey = np.random.default_rng(0).integers(0, 256, (6, 8, 1), np.uint8)
    rgb = grey.repeat(3, axis=2)
    forms = (rgb, rgb / np.float32(255), torch.from_numpy(rgb), grey[:, :, 0])
    expected, *others = (frame_of_arrays(form, [[1.0, 2, 3]]).rgb for form in forms)
    assert all(torch.equal(tensor, expected) for tensor in others)


def test_rows_that_are_no_points_of_the_image_are_counted() -> None:
    rgb = np.zeros((6, 8, 3), np.uint8)
    good, outside = [[1.0, 2, 3], [2, 2, 4]], [[8.0, 2, 3], [1, -3, 3], [100, 100, 1]]
    none = [[1.0, 2, -3], [1, 2, np.nan], [np.nan, 2, 3], [1, np.nan, 3], [1, 2, 0], [1, 2, np.inf]]
    frame = frame_of_arrays(rgb, [*good, *outside, *none])
    assert frame.points.depth.tolist() == [3, 4]
    assert [note.split()[1] for note in frame.notes] == ["3", "6"]
    assert frame_of_arrays(rgb, good).notes == ()


def test_a_module_is_refined_with_its_definition_and_without_one(frame: Frame) -> None:
    torch.manual_seed(0)
    first = nn.Conv2d(3, 4, 3, padding=1)
    last = nn.Conv2d(4, 1, 3, padding=1)
    module = nn.Sequential(first, nn.Tanh(), last, nn.Softplus())
    settings = pnp.Settings(iterations=3, lr="3%")
    named = {"name": "bright", "input_kind": "rgb", "output_scale": "scale"}
    definition = pnp.ModelDefinition(
        **named, size=pnp.Multiple(1), build=lambda: module, layers=("0",)
    )
    for known_definition in (None, definition):
        network = pnp.load_network(module, definition=known_definition)
        assert network.module is module
        refined = pnp.refine(network, *frame, settings)
        assert refined.losses[-1] < refined.losses[0]


@pytest.mark.parametrize(
    ("error", "wrong"),
    [
        (pnp.UsageError, lambda network: pnp.load_network(3)),
        (pnp.UsageError, lambda net: pnp.load_network("compact", definition=net.definition)),
        (pnp.UsageError, lambda network: pnp.Refiner("compact")),
        (pnp.UsageError, lambda network: pnp.Refiner([])),
        (pnp.UsageError, lambda net: pnp.Refiner([net] * 2, pnp.Settings(method="paper"))),
        (pnp.InputError, lambda net: pnp.refine(net, BLACK, np.ones((4, 4)), camera=np.eye(4))),
        (pnp.InputError, lambda net: pnp.refine(net, BLACK, np.ones((4, 4)), camera=-np.eye(3))),
        (pnp.InputError, lambda net: pnp.refine(net, BLACK, np.ones((4, 4)), camera=OTHER_CAMERA)),
        (pnp.UsageError, lambda network: LOSSES["no_such.py"]),
        (pnp.InputError, lambda net: pnp.Refiner(net).share_registration([np.ones(3)])),
        (pnp.InputError, lambda network: pnp.Refiner(network, adapt=[(1, 2, "m")])),
        (pnp.InputError, lambda network: pnp.score(np.ones((2, 2)), np.ones((2, 3)))),
    ],
)
def test_wrong_arguments_have_an_error_of_their_kind(
    error: type[pnp.PnpDepthError], wrong: Callable[[Any], Any], network: pnp.Network
) -> None:
    with pytest.raises(error):
        wrong(network)
