"""What is refined in Python is written as the command line writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pnpdepth_cli as pnp
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.dataset.frame_record import FrameRecord
from pnpdepth_cli.io.depth import read_depth

SAMPLE = Path(__file__).parents[2] / "samples" / "indoor"


@pytest.fixture(scope="module")
def refined() -> pnp.Refined:
    rgb = np.asarray(Image.open(SAMPLE / "rgb.png"))
    sparse = np.asarray(Image.open(SAMPLE / "sparse.png")) / 1000
    network = pnp.load_network("fcrn-tiny")
    settings = pnp.Settings(method="alone", iterations=1)
    return pnp.refine(network, rgb, sparse, settings, uncertainty=True)


@pytest.mark.parametrize("suffix", [".exr", ".npy", ".tiff", ".pfm"])
def test_formats_of_floats_hold_the_depth_exactly(
    refined: pnp.Refined, suffix: str, tmp_path: Path
) -> None:
    refined.save(tmp_path / f"room{suffix}")
    written = read_depth(tmp_path / f"room{suffix}").values
    assert np.array_equal(written, refined.depth)


def test_a_png_holds_depth_to_half_a_code_of_the_scale_in_its_record(
    refined: pnp.Refined, tmp_path: Path
) -> None:
    refined.save(tmp_path / "room.png")
    scale = FrameRecord.read(tmp_path / "room.json").refined().depth_scale
    assert scale is not None
    codes = np.asarray(Image.open(tmp_path / "room.png"))
    assert np.abs(codes / scale - refined.depth).max() <= 0.5001 / scale


def test_the_record_is_that_of_the_command_line(refined: pnp.Refined, tmp_path: Path) -> None:
    refined.save(tmp_path / "saved.npy")
    saved = FrameRecord.read(tmp_path / "saved.json")
    files = [str(SAMPLE / "rgb.png"), "--sparse", str(SAMPLE / "sparse.png")]
    how = ["--model", "fcrn-tiny", "--method", "alone", "--iterations", "1", "--uncertainty"]
    assert run(["refine", *files, *how, "-o", str(tmp_path / "out")]) == 0
    written = FrameRecord.read(tmp_path / "out" / "rgb.json")
    assert saved.refined().method == written.refined().method
    assert saved.refined().settings == written.refined().settings
    assert saved.refined().weights == written.refined().weights


def test_the_standard_deviation_is_saved_where_it_is_known(
    refined: pnp.Refined, tmp_path: Path
) -> None:
    refined.save(tmp_path / "room.exr")
    assert refined.sigma is not None
    assert np.array_equal(read_depth(tmp_path / "room_sigma.exr").values, refined.sigma)
    assert (tmp_path / "room_valid.png").exists()


def test_what_was_saved_is_evaluated_by_the_command(refined: pnp.Refined, tmp_path: Path) -> None:
    refined.save(tmp_path / "room.png")
    assert run(["eval", str(tmp_path / "room.png"), str(SAMPLE / "gt.png")]) == 0


def test_no_file_is_replaced_unless_it_may_be(refined: pnp.Refined, tmp_path: Path) -> None:
    path = tmp_path / "room.npy"
    refined.save(path)
    before = path.read_bytes()
    with pytest.raises(pnp.OutputError):
        refined.save(path)
    assert path.read_bytes() == before
    refined.save(path, overwrite=True)


def test_nothing_is_written_if_one_file_exists(refined: pnp.Refined, tmp_path: Path) -> None:
    (tmp_path / "room.json").write_text("mine")
    with pytest.raises(pnp.OutputError):
        refined.save(tmp_path / "room.png")
    assert [file.name for file in tmp_path.iterdir()] == ["room.json"]


def test_an_unknown_format_is_refused(refined: pnp.Refined, tmp_path: Path) -> None:
    with pytest.raises(pnp.PnpDepthError):
        refined.save(tmp_path / "room.bmp")
    assert not list(tmp_path.iterdir())
