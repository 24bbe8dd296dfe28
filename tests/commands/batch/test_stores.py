"""Batches whose frames and results are in a store."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.cli.main import run
from pnpdepth_cli.commands.batch.batch import plan_batch
from pnpdepth_cli.commands.batch.request import LOCAL, BatchRequest, ClusterOptions
from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io import remote
from pnpdepth_cli.io.remote import path_of
from tests.commands.batches import (
    NAMES,
    RecordingListener,
    batch,
    done,
    pairs_on_disk,
    refinement,
    results,
)
from tests.stores import Bucket, s3_server

pytest.importorskip("s3fs")
pytest.importorskip("moto")

pytestmark = pytest.mark.slow
PARTS = {"image": "rgb", "sparse": "sparse", "gt": "gt"}


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with s3_server() as address:
        yield address


@pytest.fixture
def bucket(endpoint: str) -> Bucket:
    return Bucket(endpoint)


@pytest.fixture
def root(tmp_path: Path, bucket: Bucket) -> Path:
    """Frames on disk and in the bucket, with a list."""
    root = pairs_on_disk(tmp_path / "drive")
    bucket.put_folder(root, "drive")
    lines = [f"{n},rgb/{n}.png,sparse/{n}.png,gt/{n}.png\n" for n in NAMES]
    (root / "local.csv").write_text("name,image,sparse,gt\n" + "".join(lines))
    bucket.put("drive/list.csv", (root / "local.csv").read_bytes())
    return root


def in_store(
    root: Path, bucket: Bucket, listener: RecordingListener | None = None, **changes: Any
) -> list[str]:
    """The names of the frames that are done."""
    fields = {
        "source": path_of(f"{bucket.address}/drive/list.csv"),
        "output": path_of(f"{bucket.address}/out"),
    }
    return done(root, listener, **fields | changes)


def fetched(bucket: Bucket, folder: Path) -> Any:
    bucket.fetch("out", folder)
    return {name: content for name, content in results(folder).items() if name[0] != "."}


def without_names(content: Any) -> Any:
    """Results whose records name no files."""
    for record in (each for each in content.values() if isinstance(each, dict)):
        del record["outputs"]
        for part in record["inputs"].values():
            part.pop("path")
    return content


@pytest.mark.parametrize("cluster", [ClusterOptions(), ClusterOptions(ray=LOCAL, ray_workers=1)])
def test_frames_and_results_in_a_store_equal_those_on_disk_also_on_ray_workers(
    root: Path, bucket: Bucket, tmp_path: Path, cluster: ClusterOptions
) -> None:
    if cluster.ray:
        pytest.importorskip("ray")
    in_store(root, bucket, cluster=cluster)
    there = fetched(bucket, tmp_path / "there")
    assert there["a.json"]["outputs"]["depth"] == f"{bucket.address}/out/a_depth.png"
    assert there["a.json"]["inputs"]["image"]["path"] == f"{bucket.address}/drive/rgb/a.png"
    batch(root, source=root / "local.csv")
    assert without_names(there) == without_names(results(root / "out"))
    assert len(there) == 4 * len(NAMES)


def test_a_second_run_does_only_what_changed_in_the_store(root: Path, bucket: Bucket) -> None:
    in_store(root, bucket)
    assert in_store(root, bucket) == []
    bucket.put("drive/rgb/b.png", bucket.get("drive/rgb/c.png"))
    bucket.client.delete_object(Bucket=bucket.name, Key="out/d_depth.png")
    request = BatchRequest(
        source=path_of(f"{bucket.address}/drive/list.csv"),
        output=path_of(f"{bucket.address}/out"), refine=refinement(root),
    )  # fmt: skip
    planned = list(plan_batch(request, lambda text: None))
    assert planned == [("b", "input changed: image"), ("d", "result missing: d_depth.png")]
    assert in_store(root, bucket) == ["b", "d"]
    summary = json.loads(bucket.get("out/summary.json"))
    assert [row["name"] for row in summary["frames"]] == list(NAMES)


def test_a_stopped_run_is_resumed_from_the_store_alone(
    root: Path, bucket: Bucket, tmp_path: Path
) -> None:
    stops = iter([False, True])
    in_store(root, bucket, stopped=lambda: next(stops))
    bucket.put("out/b_depth.png", b"of a run that was killed before it wrote the record")
    bucket.client.delete_object(Bucket=bucket.name, Key="out/summary.json")
    assert in_store(root, bucket) == ["b", "c", "d"]
    resumed = fetched(bucket, tmp_path / "resumed")
    in_store(root, bucket, output=path_of(f"{bucket.address}/whole"))
    bucket.fetch("whole", tmp_path / "whole")
    whole = {n: f for n, f in results(tmp_path / "whole").items() if n[0] != "."}
    assert without_names(resumed) == without_names(whole)


def test_frames_that_cannot_be_read_fail_with_the_name_of_the_object(
    root: Path, bucket: Bucket
) -> None:
    bucket.put("drive/rgb/a.png", b"no image")
    bucket.put("drive/rgb/b.png", b"x" * 2_000_000)
    bucket.client.delete_object(Bucket=bucket.name, Key="drive/sparse/c.png")
    listener = RecordingListener()
    set_max_pixels(100_000)
    try:
        in_store(root, bucket, listener)
    finally:
        set_max_pixels(None)
    messages = {row["name"]: row["message"] for row in listener.rows}
    at = f"{bucket.address}/drive"
    assert messages["a"].startswith(f"{at}/rgb/a.png ")
    assert messages["b"].startswith(f"{at}/rgb/b.png has 2,000,000 bytes, more ")
    assert messages["c"] == f"{at}/sparse/c.png: no such object; check the address"
    assert messages["d"] is None


def test_results_that_no_batch_wrote_are_replaced_only_if_asked(root: Path, bucket: Bucket) -> None:
    bucket.put("out/b_depth.png", b"mine")
    with pytest.raises(OutputError, match=r"b_depth\.png exists, and no batch wrote it"):
        in_store(root, bucket)
    assert [key for key in bucket.listed() if key.startswith("out/")] == ["out/b_depth.png"]
    in_store(root, bucket, refine={"overwrite": True})
    assert bucket.get("out/b_depth.png") != b"mine"


def test_presigned_addresses_are_read_and_never_recorded(root: Path, bucket: Bucket) -> None:
    def signed(key: str) -> str:
        parameters = {"Bucket": bucket.name, "Key": key}
        return str(bucket.client.generate_presigned_url("get_object", Params=parameters))

    lines = [{part: signed(f"drive/{folder}/a.png") for part, folder in PARTS.items()}]
    lines.append({**lines[0], "image": signed("drive/rgb/none.png"), "name": "none"})
    (root / "signed.jsonl").write_text("\n".join(map(json.dumps, lines)))
    listener = RecordingListener()
    batch(root, listener, source=root / "signed.jsonl")
    assert [row["status"] for row in listener.rows] == ["done", "failed"]
    assert listener.rows[0]["name"] == "a"
    written = b"".join(p.read_bytes() for p in (root / "out").rglob("*") if p.is_file())
    assert b"/drive/rgb/a.png" in written
    for secret in ("X-Amz-Signature", "very-secret", "Signature="):
        assert secret.encode() not in written
        assert secret not in "\n".join([*listener.messages, *map(str, listener.rows)])


def test_the_command_names_what_is_wrong_with_an_address(
    root: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ended(source: str, output: str) -> tuple[int, str]:
        code = run(["batch", source, "-o", output])
        line = capsys.readouterr().err.strip().splitlines()[-1]
        return code, line.removeprefix("pnpdepth: ")

    def missing(*_: Any, **__: Any) -> None:
        raise ImportError("s3fs")

    good, out = f"{bucket.address}/drive/list.csv", str(root / "out")
    code, text = ended("s3://me:pass@b/list.csv", out)
    assert (code, "pass" in text, "leave it out" in text) == (2, False, True)
    assert "folders in a store are not searched" in ended(f"{bucket.address}/drive", out)[1]
    assert ended(f"{bucket.address}/no.csv", out) == (
        3, f"{bucket.address}/no.csv: no such object; check the address",
    )  # fmt: skip
    assert "no such bucket" in ended(good, "s3://no-such-bucket-here/out")[1]
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    remote._file_system.cache_clear()
    assert "cannot be reached (Could not connect" in ended(good, out)[1]
    monkeypatch.setattr("fsspec.filesystem", missing)
    remote._file_system.cache_clear()
    assert ended(good, out) == (
        2, "s3:// needs fsspec and s3fs: pip install 'pnpdepth[remote]'",
    )  # fmt: skip
    remote._file_system.cache_clear()
