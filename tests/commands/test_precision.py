from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.batch.records import settings_of
from pnpdepth_cli.commands.refinement.refine import refine_image
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.io.depth import read_depth
from tests.commands.frames import frame_on_disk


@pytest.fixture
def request_of_frame(tmp_path: Path) -> RefineRequest:
    frame = frame_on_disk(tmp_path)
    return RefineRequest.from_fields(
        image=frame.image,
        sparse=frame.sparse,
        model=str(frame.model),
        checkpoint=frame.checkpoint,
        output=tmp_path / "out",
        format="npy",
        overwrite=True,
    )


def test_bf16_refines_to_nearly_the_depth_of_fp32_and_is_recorded(
    request_of_frame: RefineRequest,
) -> None:
    records, depths = {}, {}
    for precision in ("fp32", "bf16"):
        record = refine_image(request_of_frame.with_fields(precision=precision)).record
        records[precision] = json.loads(json.dumps(record))["settings"]["precision"]
        depths[precision] = read_depth(Path(record["outputs"]["depth"])).values
        assert record["sparse_error"]["after"]["mae"] < record["sparse_error"]["before"]["mae"]
    assert records == {"fp32": "fp32", "bf16": "bf16"}
    apart = np.abs(depths["bf16"] / depths["fp32"] - 1)
    assert 0 < apart.mean() < 0.02


def test_a_batch_in_another_precision_is_done_again(request_of_frame: RefineRequest) -> None:
    other = request_of_frame.with_fields(precision="bf16")
    assert settings_of(request_of_frame, {}) != settings_of(other, {})
