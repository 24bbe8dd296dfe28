"""Images of bags; damaged bags, and bombs: small files that claim or decompress to gigabytes."""

from __future__ import annotations

import bz2
import sqlite3
import tracemalloc
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pnpdepth_cli.budget import set_max_pixels
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.bags import bound_decompression, open_bag
from pnpdepth_cli.io.bags.messages import camera_info_topic, cloud_points, image_file
from tests.bags import write_bag

pytest.importorskip("rosbags")

BOMB = 64 << 20
PIXELS = {name: name.rstrip("8") for name in ("rgb8", "bgr8", "rgba8", "bgra8")}
PIXELS |= {"8UC3": "bgr", "mono8": "g", "8UC1": "g"}
PIXELS |= {f"bayer_{name}8": name for name in ("rggb", "bggr", "gbrg", "grbg")}


def image_message(**others: object) -> SimpleNamespace:
    """An image of 6×6 grey pixels."""
    sizes = {"height": 6, "width": 6, "step": 6}
    return SimpleNamespace(**{"encoding": "mono8", "data": bytes(36), **sizes, **others})


@pytest.mark.parametrize("encoding", PIXELS)
def test_an_image_of_every_encoding_has_its_colour(encoding: str) -> None:
    pixel = np.array([{"r": 200, "g": 100, "b": 50, "a": 9}[c] for c in PIXELS[encoding]], "u1")
    rows = np.tile(pixel.reshape(2, 2), (3, 3)) if "bayer" in encoding else np.tile(pixel, (6, 6))
    message = image_message(encoding=encoding, data=rows.tobytes(), step=rows.shape[1])
    suffix, content = image_file(message, "/image")
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert suffix == ".png"
    assert decoded.tolist() == [[[100] * 3 if len(pixel) == 1 else [50, 100, 200]] * 6] * 6


def test_an_image_of_other_size_than_its_bytes_or_of_another_kind_is_refused() -> None:
    sizes = ({"height": 0}, {"height": 7}, {"width": 7}, {"step": 5}, {"step": 7})
    for claim in (*sizes, {"encoding": "rgb8"}, {"encoding": "yuv422"}):
        with pytest.raises(InputError):
            image_file(image_message(**claim), "/image")


@pytest.mark.parametrize("order", ["<", ">"])
def test_an_organised_cloud_gives_its_points_row_by_row(order: str) -> None:
    points = np.arange(18, dtype=np.float32).reshape(2, 3, 3)
    rows = points.astype(f"{order}f4").view(np.uint8).reshape(2, -1)
    padded = np.pad(rows, ((0, 0), (0, 5)))
    fields = [SimpleNamespace(name=n, offset=4 * k, datatype=7) for k, n in enumerate("xyz")]
    cloud = {"fields": fields, "is_bigendian": order == ">", "data": padded.tobytes()}
    cloud |= {"height": 2, "width": 3, "point_step": 12, "row_step": 41}
    got = cloud_points(SimpleNamespace(**cloud), "/scan")
    assert got.tolist() == points.reshape(-1, 3).tolist()
    flat = cloud_points(SimpleNamespace(**(cloud | {"height": 1, "row_step": 0})), "/scan")
    assert flat.tolist() == got[:3].tolist()
    claims = ({"height": 3}, {"width": 4}, {"point_step": 11}, {"row_step": 35})
    for claim in (*claims, {"fields": fields[:2]}):
        with pytest.raises(InputError):
            cloud_points(SimpleNamespace(**(cloud | claim)), "/scan")


def read_all(path: Path) -> int:
    """The number of messages in the bag."""
    with open_bag(path) as bag:
        topics = [connection.topic for connection in bag.reader.connections]
        return sum(1 for _ in bag.messages(topics))


@pytest.mark.parametrize(
    ("store", "kind"), [("rosbag1", "bz2"), ("rosbag1", "lz4"), ("mcap", "lz4"), ("mcap", "zstd")]
)
def test_a_chunk_is_decompressed_up_to_the_limit_only(store: str, kind: str) -> None:
    import lz4.frame
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap

    bound_decompression()
    compress = {"bz2": bz2, "lz4": lz4.frame, "zstd": storage_mcap.zstd}[kind].compress
    table = reader.decompressors if store == "rosbag1" else storage_mcap.DECOMPRESSORS
    size = [] if store == "rosbag1" else [1 << 40]
    try:
        set_max_pixels(1000)  # so that a file has 2²⁰ bytes at most
        assert table[kind](compress(bytes(1 << 20)), *size) == bytes(1 << 20)  # type: ignore[operator]
        bomb = 2 * compress(bytes(BOMB // 2))
        tracemalloc.start()
        with pytest.raises(ValueError):
            table[kind](bomb, *size)  # type: ignore[operator]
        assert tracemalloc.get_traced_memory()[1] < BOMB / 4
    finally:
        tracemalloc.stop()
        set_max_pixels(None)


def test_a_compressed_bag_is_read(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer

    plain = read_all(write_bag(tmp_path / "plain.bag"))
    for kind in Writer.CompressionFormat:
        assert read_all(write_bag(tmp_path / f"{kind.name}.bag", compression=kind)) == plain


METADATA = [
    "rosbag2_bagfile_information: 3",
    "rosbag2_bagfile_information: {compression_mode: file}",
    "a: &a [x, x]\nb: &b [*a, *a]\n" + "rosbag2_bagfile_information: {version: [*b, *b]}",
]
COMPUTED = [
    "ALTER TABLE messages ADD COLUMN big BLOB AS (zeroblob(900000000))",
    "DROP TABLE schema; CREATE VIEW schema AS WITH RECURSIVE"
    " n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS schema_version FROM n",
    "CREATE VIRTUAL TABLE v USING fts5(x)",
]


@pytest.mark.parametrize("hostile", METADATA + COMPUTED)
def test_odd_metadata_and_databases_that_compute_are_refused(hostile: str, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "ros2")
    (file,) = bag.glob("*.db3")
    if hostile in METADATA:
        (bag / "metadata.yaml").write_text(hostile)
    else:
        with closing(sqlite3.connect(file)) as connection:
            connection.executescript(hostile)
        with pytest.raises(InputError):
            read_all(file)
    with pytest.raises(InputError):
        read_all(bag)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(InputError, match=f"{bag} has no metadata"):
        read_all(bag)


def test_an_image_has_the_camera_info_beside_it_or_the_only_one() -> None:
    cases = {("/left/info", "/right/camera_info"): "/right/camera_info", ("/info",): "/info"}
    for topics, expected in {**cases, ("/left/camera_info", "/info"): None, (): None}.items():
        bag: Any = SimpleNamespace(topics=lambda kinds, names=topics: dict.fromkeys(names, 1))
        for topic in ("/right/image_raw", "/right/image_raw/compressed"):
            assert camera_info_topic(bag, topic) == expected
