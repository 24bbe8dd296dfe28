"""Depths of an integer file: its codes per metre, and what is clipped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pnpdepth_cli.commands.refinement.outputs import output_scale, within_range
from pnpdepth_cli.frames.frame import Frame, Refined
from pnpdepth_cli.io.depth import read_depth
from pnpdepth_cli.points import SparsePoints
from tests.commands.frames import frame_on_disk, run

PNG = {"depth": Path("depth.png")}


def inputs_at(*depths: float, scale: float | None = None) -> Frame:
    xy = torch.tensor([[float(column), 0.0] for column in range(len(depths))])
    points = SparsePoints(xy=xy, depth=torch.tensor(depths), size=(1, 4))
    return Frame(rgb=None, points=points, depth_scale=scale)


def refined_to(*depths: float, inputs: Frame) -> Refined:
    depth = np.array([depths], np.float32)
    return Refined(
        before=depth,
        after=depth,
        used=inputs.points,
        held_out=inputs.points.select(slice(0)),
        losses=(0.0,),
        step=0.0,
        diverged=None,
    )


@pytest.mark.parametrize(
    ("depths", "scale", "expected"),
    [
        ((0.4, 80.0), None, 256),
        ((0.4, 80.0), 1000.0, 1000),
        ((5.0, 400.0), None, 100),
        ((900.0, 3000.0), None, 10),
        ((0.005, 0.02), None, 1_000_000),
        ((0.005, 80.0), None, 256),
    ],
)
def test_the_scale_is_the_sparse_files_else_one_that_holds_the_points(
    depths: tuple[float, ...], scale: float | None, expected: float
) -> None:
    assert output_scale(inputs_at(*depths, scale=scale)) == expected


def test_depths_beyond_16_bits_are_clipped_and_counted() -> None:
    inputs = inputs_at(10.0, 80.0)
    frame = refined_to(0.0, 1e-9, 50.0, 800.0, inputs=inputs)
    clipped = within_range(PNG, inputs, frame)
    assert clipped.after.tolist() == [[0.0, 1 / 256, 50.0, 65534 / 256]]
    assert " 2 of 4 pixels clipped" in clipped.notes[0]
    assert within_range({"depth": Path("depth.exr")}, inputs, frame) is frame
    plain = replace(frame, after=np.full((1, 4), 50, np.float32))
    assert within_range(PNG, inputs, plain) is plain


def test_a_refinement_beyond_the_format_is_written_with_a_note(tmp_path: Path) -> None:
    frame = frame_on_disk(tmp_path)
    text = frame.model.read_text()
    frame.model.write_text(text.replace("2 + 3 *", "400 + 3 *"))
    record = run(frame, iterations=0)
    assert any("pixels clipped" in note for note in record.notes)
    assert read_depth(tmp_path / "out" / "img_depth.png").values.max() == np.float32(65.534)
    assert json.loads((tmp_path / "out" / "img.json").read_text())["notes"] == record.notes
