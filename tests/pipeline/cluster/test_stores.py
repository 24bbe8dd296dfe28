"""Frames and results in a store, on workers of a local cluster."""

from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.io.remote.address import path_of
from pnpdepth_cli.pipeline.cluster.options import LOCAL, ClusterOptions
from tests.pipeline.batches import NAMES, RecordingListener, batch, pairs_on_disk, results
from tests.stores import Bucket, s3_server

pytest.importorskip("ray")
pytest.importorskip("s3fs")
pytest.importorskip("moto")

pytestmark = pytest.mark.slow


def test_workers_read_and_write_a_store_as_one_process_does(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path / "drive")
    lines = (f"{name},rgb/{name}.png,sparse/{name}.png\n" for name in NAMES)
    (root / "list.csv").write_text("name,image,sparse\n" + "".join(lines))
    contents = []
    with s3_server() as endpoint:
        for options in (ClusterOptions(), ClusterOptions(ray=LOCAL, ray_workers=1)):
            bucket, listener = Bucket(endpoint), RecordingListener()
            bucket.put_folder(root, "drive")
            source, output = (path_of(f"{bucket.address}/{n}") for n in ("drive/list.csv", "out"))
            batch(root, listener, source=source, output=output, cluster=options)
            assert [row["status"] for row in listener.rows] == ["done"] * len(NAMES)
            folder = tmp_path / str(len(contents))
            bucket.fetch("out", folder)
            contents.append({n: d for n, d in results(folder).items() if n.endswith(".png")})
    assert contents[0] == contents[1]
    assert len(contents[0]) == 3 * len(NAMES)
