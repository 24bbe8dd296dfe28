"""The record of a frame: what its JSON holds, and what is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.camera import Camera
from pnpdepth_cli.dataset.frame_record import (
    SCHEMA,
    BatchState,
    CameraRecord,
    FrameRecord,
    PointsRecord,
)
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.file_record import FigureRecord, FileRecord, SamplePattern
from pnpdepth_cli.io.file_bytes import Fingerprint
from tests.builders import result_record

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
        "image": FileRecord(path="a.png", kind="image", sha256="1" * 64, read_as="PNG"),
        "sparse": FileRecord(
            path="model",
            kind="sampled",
            sha256={"cameras.bin": "2" * 64},
            camera=0,
            scale=256.0,
            assumed=True,
            dropped={"too far": 3},
            sampled=SamplePattern(kind="uniform", count=30, seed=7),
        ),
    },
    errors={"used": {"before": {"mae": 1.0, "points": 9}, "after": {"mae": None, "points": 9}}},
    notes=["warning: far"],
    result=result_record(
        "net",
        neighbours=[
            FileRecord(path="b.png", kind="neighbour", poses="poses.txt", motion=POSE.tolist())
        ],
        outputs={"depth": "a_depth.png"},
        points=PointsRecord(used=9, held_out=1, nearest=0.5, farthest=4.5, moved=2),
        camera=CameraRecord.of(CAMERA, POSE),
        alignment={"kind": "affine", "coefficients": [1.0, 0.0], "order": None},
        loss=[1.0, None],
        figures={
            "preview": FigureRecord(size=(9, 8), panels={"Image": (0, 1, 2, 3)}, scale_m=(1, 2))
        },
        seconds={"read": 0.1},
    ),
)


def read_again(record: FrameRecord) -> FrameRecord:
    text = json.dumps(record.to_json(), allow_nan=False)
    return FrameRecord.from_json(json.loads(text), Path("a.json"))


@pytest.mark.parametrize("record", [RECORD, FrameRecord()])
def test_a_record_is_read_as_it_was_written_and_keeps_no_empty_entry(record: FrameRecord) -> None:
    entry = record.to_json()
    assert read_again(record) == record
    result = entry.get("result", {})
    sections = [entry, *entry.get("inputs", {}).values(), *result.get("figures", {}).values()]
    for value in (*entry.values(), *result.values()):
        if isinstance(value, dict) and value is not result.get("alignment"):
            sections.append(value)
    for section in sections:
        assert not [name for name, value in section.items() if value in (None, {}, [])]
    assert FrameRecord.from_json(entry | {"of a later version": 1}, Path("a.json")) == record


def test_an_error_that_is_no_finite_number_is_written_as_unknown() -> None:
    errors = {"used": {"after": {"mae": float("nan"), "rmse": float("inf")}}}
    (stages,) = read_again(FrameRecord(errors=errors)).errors.values()
    assert stages == {"after": {"mae": None, "rmse": None}}


def test_the_camera_of_a_record_is_read_as_it_was_written() -> None:
    camera, pose = read_again(RECORD).refined().camera.read()
    assert CameraRecord.of(camera, pose) == RECORD.refined().camera
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
    camera = read_again(RECORD).refined().camera
    with pytest.raises(ValueError, match=r"camera|reshape"):
        replace(camera, **{field: value}).read()


@pytest.mark.parametrize(
    "entry",
    [
        {"status": "unknown"},
        {"errors": {"used": {"before": {"mae": 1.0}}}},
        {"inputs": {"sparse": {"path": "s.png", "sampled": {"kind": "none", "count": 1}}}},
        {"inputs": {"sparse": {"path": "s.bin", "kind": "scan"}}},
        {"inputs": {"sparse": {"path": "s.png", "kind": "of a later version"}}},
        {"status": "\ud800"},
        {"errors": {"\udfff": "\ud800"}},
    ],
)
def test_what_is_no_record_is_refused_with_the_name_of_its_file(entry: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"a\.json"):
        FrameRecord.from_json({"schema": SCHEMA} | entry, Path("a.json"))


@pytest.mark.parametrize("entry", [[], {}, {"schema": SCHEMA - 1}, {"schema": "2"}])
def test_a_record_of_another_schema_is_refused_with_what_to_do(entry: object) -> None:
    with pytest.raises(InputError, match=r"a\.json"):
        FrameRecord.from_json(entry, Path("a.json"))


def test_a_frame_that_failed_has_no_result() -> None:
    failed = read_again(FrameRecord(name="a", status="failed", message="it is too dark"))
    assert failed.result is None
    with pytest.raises(InputError, match="it is too dark"):
        failed.refined()


@pytest.mark.parametrize(
    "lost",
    [
        "result",
        "result method",
        "result method networks",
        "result model",
        "result settings propagate",
        "errors used after points",
    ],
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
