"""Damaged calibrations, poses, scans and models raise our own errors of one line, or are read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pnpdepth_cli.errors import PnpDepthError
from pnpdepth_cli.io.calibration import read_calibration
from pnpdepth_cli.io.colmap import read_model
from pnpdepth_cli.io.extrinsics import read_extrinsics
from pnpdepth_cli.io.scans import read_scan
from tests.colmap_models import write_binary_model, write_text_model
from tests.fuzz.mutations import mutated
from tests.io.test_calibration import KALIBR, KITTI, PLAIN, POSES, TOPIC
from tests.io.test_scans import FILES, POINTS

Reader = Callable[[Path], Any]
CALIBRATIONS = {"kitti.txt": KITTI, "plain.txt": PLAIN, "ros.yaml": TOPIC, "kalibr.yaml": KALIBR}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Reader]]:
    """Valid files, and what reads each."""
    folder = tmp_path_factory.mktemp("valid")
    inputs: list[tuple[Path, Reader]] = []
    for name, text in CALIBRATIONS.items():
        (folder / name).write_text(text)
        inputs.append((folder / name, read_calibration))
    for number, text in enumerate(POSES.values()):
        (folder / f"{number}.txt").write_text(text)
        inputs.append((folder / f"{number}.txt", read_extrinsics))
    for name, content in FILES.items():
        (folder / name).write_bytes(content(POINTS))
        inputs.append((folder / name, read_scan))
    write_text_model(folder / "text", points=3)
    write_binary_model(folder / "binary")
    models = [*(folder / "text").iterdir(), *(folder / "binary").iterdir()]
    return inputs + [(path, lambda file: read_model(file.parent)) for path in sorted(models)]


@settings(deadline=None, max_examples=120)
@given(number=st.integers(0, 1000), seed=st.integers(0, 2**32 - 1), cut=st.booleans())
def test_a_damaged_file_is_read_or_refused_in_one_line(
    number: int, seed: int, cut: bool, inputs: list[tuple[Path, Reader]]
) -> None:
    path, read = inputs[number % len(inputs)]
    whole, rng = path.read_bytes(), np.random.default_rng(seed)
    path.write_bytes(whole[: rng.integers(len(whole))] if cut else mutated(whole, rng))
    message, got = str(path.parent), None
    try:
        got = read(path)
    except PnpDepthError as error:
        message = str(error)
    finally:
        path.write_bytes(whole)
    assert "\n" not in message
    assert str(path.parent) in message
    for name in ("points", "intrinsics", "translation"):
        values = getattr(got, name, 0.0)
        assert not isinstance(values, np.ndarray) or np.isfinite(values).all()
