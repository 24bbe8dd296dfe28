from __future__ import annotations

from pathlib import Path

from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.dataset.frame_list import FrameList
from pnpdepth_cli.io.remote.address import path_of
from pnpdepth_cli.pipeline.batch.spread import largest_first


def test_the_largest_frames_go_first_and_others_keep_their_order(tmp_path: Path) -> None:
    sizes = {"a": 900, "b": 1000, "c": 5000, "d": 0, "e": 4900}
    for name, size in sizes.items():
        (tmp_path / name).write_bytes(b"x" * size)
    frames = FrameList(Frame(name=name, image=tmp_path / name) for name in [*sizes, "none"])
    assert list(largest_first(frames).names()) == ["c", "e", "a", "b", "d", "none"]


def test_frames_in_a_store_keep_their_order() -> None:
    frames = FrameList(Frame(name=name, image=path_of(f"s3://b/{name}.png")) for name in "ba")
    assert list(largest_first(frames).names()) == ["b", "a"]
