"""The public Python API: its names are pinned, and it refines as the command does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import pnpdepth_cli as pnp
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.io.rgb import read_rgb

SAMPLE = Path(__file__).parent.parent / "samples" / "indoor"
Frame = tuple[NDArray[np.float32], NDArray[np.float32]]


@pytest.fixture(scope="module")
def network() -> pnp.Network:
    return pnp.load_network("compact")


@pytest.fixture(scope="module")
def frame() -> Frame:
    return read_rgb(SAMPLE / "rgb.png").values, read_depth(SAMPLE / "sparse.png").values


def test_the_public_names_are_these() -> None:
    assert sorted(pnp.__all__) == [
        "CheckpointError", "DeviceError", "DivergedError", "InputError", "LayerError", "ModelError",
        "Network", "NoPointsError", "PnpDepthError", "Refined", "Refiner",
        "Scores", "Settings", "SizeError", "SparsePoints", "Split", "UsageError", "__version__",
        "load_network", "refine", "score",
    ]  # fmt: skip
    assert all(getattr(pnp, name) is not None for name in pnp.__all__)
    assert set(pnp.__all__) <= set(dir(pnp))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = pnp.nothing


def test_arrays_are_refined_as_the_command_refines_files(
    network: pnp.Network, frame: Frame, tmp_path: Path
) -> None:
    from pnpdepth_cli.cli.main import main

    refined = pnp.refine(network, *frame)
    files = [str(SAMPLE / "rgb.png"), "--sparse", str(SAMPLE / "sparse.png")]
    with pytest.raises(SystemExit) as ended:
        main(["refine", *files, "-o", str(tmp_path / "depth.npy")])
    assert ended.value.code in (None, 0)
    assert np.array_equal(refined.depth, np.load(tmp_path / "depth.npy"))
    truth = read_depth(SAMPLE / "gt.png").values
    assert pnp.score(refined.depth, truth).mae < pnp.score(refined.before, truth).mae


def test_a_refiner_stays_open_and_leaves_the_network_as_it_was(
    network: pnp.Network, frame: Frame
) -> None:
    rgb, sparse = frame
    before = {name: value.clone() for name, value in network.module.state_dict().items()}
    with pnp.Refiner(network) as refiner:
        first, again = refiner.refine(rgb, sparse), refiner.refine(rgb, sparse)
    assert np.array_equal(first.depth, again.depth)
    assert all(torch.equal(before[n], v) for n, v in network.module.state_dict().items())
    assert not any("forward" in module.__dict__ for module in network.module.modules())


def test_maps_rows_and_points_are_the_same(network: pnp.Network, frame: Frame) -> None:
    rgb, sparse = frame
    y, x = np.nonzero(sparse)
    rows = np.stack([x, y, sparse[y, x]], axis=1)
    points = pnp.SparsePoints(
        xy=torch.from_numpy(rows[:, :2].astype(np.float32)),
        depth=torch.from_numpy(rows[:, 2].astype(np.float32)),
        size=sparse.shape,
    )
    settings = pnp.Settings(iterations=1)
    with pnp.Refiner(network, settings=settings) as refiner:
        depths = [
            refiner.refine(rgb, sparse_depth).depth for sparse_depth in (sparse, rows, points)
        ]
    assert np.array_equal(depths[0], depths[1])
    assert np.array_equal(depths[0], depths[2])


def test_integer_images_are_scaled(network: pnp.Network, frame: Frame) -> None:
    rgb, sparse = frame
    coarse = np.round(rgb * 255).astype(np.uint8)
    settings = pnp.Settings(iterations=0)
    ours = pnp.refine(network, coarse, sparse, settings=settings).depth
    as_float = (coarse / 255).astype(np.float32)
    assert np.array_equal(ours, pnp.refine(network, as_float, sparse, settings=settings).depth)


@pytest.mark.parametrize(
    ("image", "sparse", "error", "message"),
    [
        (np.zeros((4, 4)), np.ones((4, 4)), pnp.InputError, r"shape \(H, W, 3\)"),
        (np.full((4, 4, 3), 200.0), np.ones((4, 4)), pnp.InputError, "float in 0..1"),
        (np.zeros((4, 4, 3)), np.ones((5, 4)), pnp.SizeError, "but the image is"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4)), pnp.NoPointsError, "no value above 0"),
        (np.zeros((4, 4, 3)), np.array([[9.0, 9, 1]]), pnp.NoPointsError, "lies in the image"),
        (None, np.ones((5, 3)), pnp.SizeError, "need an image"),
    ],
)
def test_arrays_that_cannot_be_used_are_named(
    image: NDArray[np.float64] | None,
    sparse: NDArray[np.float64],
    error: type[pnp.PnpDepthError],
    message: str,
    network: pnp.Network,
) -> None:
    with pytest.raises(error, match=message):
        pnp.refine(network, image, sparse)


def test_scores_of_different_shapes_are_refused() -> None:
    with pytest.raises(pnp.SizeError, match=r"\(2, 2\) but ground truth is \(2, 3\)"):
        pnp.score(np.ones((2, 2)), np.ones((2, 3)))
