"""The record of a frame: what its JSON holds, and what is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.frame_record import (
    BatchState,
    CameraRecord,
    FrameRecord,
    ModelRecord,
    PointsRecord,
)
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.file_record import FigureRecord, FileRecord, SamplePattern
from pnpdepth_cli.io.file_bytes import Fingerprint
from tests.builders import method_record

CAMERA = Camera(
    intrinsics=np.array([[50.1, 0, 31.3], [0, 51, 22], [0, 0, 1]]),
    distortion=(0.1, 0.2, 0.0, 0.0),
    lens="fisheye",
    source="s",
)
FILE = Fingerprint(size=3, sha256="1" * 64, mtime_ns=4, ctime_ns=5)
POSE = np.column_stack([np.eye(3), [0.1, 0.2, 0.3]])
RECORD = FrameRecord(
    name="a/ü 1",
    group="a",
    status="diverged",
    message="the loss is not finite",
    batch=BatchState(settings="0" * 64, inputs={"image": FILE}),
    inputs={
        "image": FileRecord(path="a.png", sha256="1" * 64, read_as="PNG"),
        "sparse": FileRecord(
            path="model",
            sha256={"cameras.bin": "2" * 64},
            camera=0,
            scale=256.0,
            assumed=True,
            dropped={"too far": 3},
            sampled=SamplePattern(kind="uniform", count=30, seed=7),
        ),
    },
    neighbours=[FileRecord(path="b.png", poses="poses.txt", motion=POSE.tolist())],
    outputs={"depth": "a_depth.png"},
    size=(64, 48),
    points=PointsRecord(used=9, held_out=1, nearest=0.5, farthest=4.5, moved=2),
    camera=CameraRecord.of(CAMERA, POSE),
    model=ModelRecord(name="net", spec="net.py", checkpoint=None, checkpoint_sha256=None),
    method=method_record("net", name="paper", propagation="none"),
    settings={"layer": "middle", "iterations": 5, "align": "affine", "propagate": "none"},
    alignment={"kind": "affine", "coefficients": [1.0, 0.0], "order": None},
    loss=[1.0, None],
    errors={"used": {"before": {"mae": 1.0, "points": 9}, "after": {"mae": None, "points": 9}}},
    notes=["warning: far"],
    figures={"preview": FigureRecord(size=(9, 8), panels={"Image": (0, 1, 2, 3)}, scale_m=(1, 2))},
    seconds={"read": 0.1},
)


def read_again(record: FrameRecord) -> FrameRecord:
    text = json.dumps(record.to_json(), allow_nan=False)
    return FrameRecord.from_json(json.loads(text), Path("a.json"))


@pytest.mark.parametrize("record", [RECORD, FrameRecord()])
def test_a_record_is_read_as_it_was_written_and_keeps_no_empty_entry(record: FrameRecord) -> None:
    entry = record.to_json()
    assert read_again(record) == record
    parts = [section for section in entry.values() if isinstance(section, dict)]
    parts += [*entry.get("inputs", {}).values(), *entry.get("figures", {}).values(), entry]
    own = [section for section in parts if section is not entry.get("alignment")]
    assert not [
        name for section in own for name, value in section.items() if value in (None, {}, [])
    ]
    assert FrameRecord.from_json(entry | {"of a later version": 1}, Path("a.json")) == record


def test_an_error_that_is_no_finite_number_is_written_as_unknown() -> None:
    errors = {"used": {"after": {"mae": float("nan"), "rmse": float("inf")}}}
    (stages,) = read_again(FrameRecord(errors=errors)).errors.values()
    assert stages == {"after": {"mae": None, "rmse": None}}


def test_the_camera_of_a_record_is_read_as_it_was_written() -> None:
    camera, pose = read_again(RECORD).camera.read()
    assert CameraRecord.of(camera, pose) == RECORD.camera
    assert (camera.intrinsics == CAMERA.intrinsics).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("intrinsics", [[0.0] * 3] * 3),
        ("intrinsics", [[1.0, 2.0]]),
        ("pose", [[1.0, 2.0]]),
        ("lens", "pinhole"),
    ],
)
def test_a_record_of_no_camera_is_refused(field: str, value: object) -> None:
    camera = read_again(RECORD).camera
    with pytest.raises(ValueError, match=r"camera|reshape"):
        replace(camera, **{field: value}).read()


@pytest.mark.parametrize(
    "entry",
    [
        [],
        {"status": "unknown"},
        {"errors": {"used": {"before": {"mae": 1.0}}}},
        {"inputs": {"sparse": {"path": "s.png", "sampled": {"kind": "none", "count": 1}}}},
        {"size": "\ud800"},
        {"errors": {"\udfff": "\ud800"}},
    ],
)
def test_what_is_no_record_is_refused_with_the_name_of_its_file(entry: object) -> None:
    with pytest.raises(InputError, match=r"a\.json"):
        FrameRecord.from_json(entry, Path("a.json"))


@pytest.mark.parametrize(
    "lost", ["method", "model", "settings propagate", "errors used after points"]
)
def test_half_a_record_of_a_batch_is_refused(lost: str) -> None:
    entry = RECORD.to_json()
    assert FrameRecord.from_json(entry, Path("a.json")) == RECORD
    part = entry
    (*outer, name) = lost.split()
    for key in outer:
        part = part[key]
    del part[name]
    with pytest.raises(InputError, match=r"a\.json"):
        FrameRecord.from_json(entry, Path("a.json"))


@pytest.mark.parametrize(
    ("own", "linear", "basis", "worse"),
    [
        (2.0, 1.0, "ground_truth", True),
        (1.0, 1.0, "ground_truth", False),
        (1.0, 2.0, "validation", False),
        (2.0, 1.0, "held_out", True),
        (2.0, 1.0, "used", None),
        (2.0, None, "ground_truth", None),
        (None, 1.0, "ground_truth", None),
    ],
)
def test_a_result_is_worse_than_linear_by_what_measures_it_best(
    own: float | None, linear: float | None, basis: str, worse: bool | None
) -> None:
    errors = {"before": {}, "after": {"mae": own}, "linear": {"mae": linear}}
    assert FrameRecord(errors={basis: errors}).worse_than_linear is worse
