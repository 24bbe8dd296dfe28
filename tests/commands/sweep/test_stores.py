"""Sweeps and evaluations with frames in a store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pnpdepth_cli.commands.evaluation.evaluate import evaluate
from pnpdepth_cli.commands.evaluation.request import EvalRequest
from pnpdepth_cli.commands.sweep.axes import read_axis, studies_of
from pnpdepth_cli.commands.sweep.points import read_sampling
from pnpdepth_cli.commands.sweep.sweep import SweepRequest, run_sweep
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.remote import path_of
from tests.commands.batches import RecordingListener, pairs_on_disk, refinement
from tests.stores import Bucket, s3_server

pytest.importorskip("s3fs")
pytest.importorskip("moto")

pytestmark = pytest.mark.slow
NAMES = ("a", "b")


@pytest.fixture(scope="module")
def bucket() -> Iterator[Bucket]:
    with s3_server() as endpoint:
        yield Bucket(endpoint)


@pytest.fixture
def root(tmp_path: Path, bucket: Bucket) -> Path:
    """Frames on disk and in the bucket, and lists of both."""
    root = pairs_on_disk(tmp_path / "drive", NAMES)
    bucket.put_folder(root, "drive")
    for name, start in (("local", ""), ("remote", f"{bucket.address}/drive/")):
        lines = [f"{n},{start}rgb/{n}.png,{start}gt/{n}.png\n" for n in NAMES]
        (root / f"{name}.csv").write_text("name,image,gt\n" + "".join(lines))
    bucket.put("drive/list.csv", (root / "local.csv").read_bytes())
    return root


def swept(root: Path, source: Path, output: Path) -> tuple[bytes, list[str]]:
    listener = RecordingListener()
    request = SweepRequest(
        source=source, output=output, refine=refinement(root),
        studies=studies_of([read_axis("iterations=0,2")], one_by_one=True),
        sampling=read_sampling("40"), plots="none",
    )  # fmt: skip
    run_sweep(request, listener)
    return (output / "sweep_frames.csv").read_bytes(), listener.names


def test_a_sweep_of_frames_in_a_store_equals_that_of_frames_on_disk(
    root: Path, bucket: Bucket, tmp_path: Path
) -> None:
    here, _ = swept(root, root / "local.csv", tmp_path / "here")
    assert swept(root, root / "remote.csv", tmp_path / "named")[0] == here
    listed = path_of(f"{bucket.address}/drive/list.csv")
    assert swept(root, listed, tmp_path / "listed")[0] == here
    assert swept(root, listed, tmp_path / "listed") == (here, [])


def test_a_sweep_does_not_write_to_a_store(root: Path, bucket: Bucket) -> None:
    with pytest.raises(UsageError, match="sweep writes to a local folder"):
        swept(root, root / "local.csv", path_of(f"{bucket.address}/out"))


def test_an_evaluation_refuses_files_in_a_store(root: Path, bucket: Bucket) -> None:
    predictions = root / "gt"
    for truth in (root / "remote.csv", path_of(f"{bucket.address}/drive/list.csv")):
        with pytest.raises(UsageError, match=r"^s3://.*: eval reads local files; copy the frames"):
            evaluate(EvalRequest(prediction=predictions, ground_truth=truth))
