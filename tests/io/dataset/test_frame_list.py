from __future__ import annotations

import pickle
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np

from pnpdepth_cli.io.calibration import Calibration
from pnpdepth_cli.io.dataset.frame import Frame, Hdf5Array
from pnpdepth_cli.io.dataset.frame_list import FrameList
from pnpdepth_cli.io.dataset.protocols import PROTOCOLS
from pnpdepth_cli.io.remote.address import path_of


def many(count: int) -> list[Frame]:
    return [
        Frame(
            name=f"d/f{number:07}",
            image=Path(f"/data/rgb/f{number:07}.png"),
            sparse=Path(f"/data/sparse/f{number:07}.png"),
            gt_scale=256.0,
        )
        for number in range(count)
    ]


def test_frames_come_back_as_they_were() -> None:
    array = Hdf5Array(path=Path("a.h5"), name="x", axes=(0, 1))
    frames = [
        *many(3),
        Frame(name="relative", image=Path("a.png"), calib=Path("/c.txt"), camera=2),
        Frame(name="array", image=array, gt=array),
        Frame(name="stored", image=path_of("s3://b/d/a.png"), masks=(Path("m.png"),)),
        Frame(name="cut", image=Path("a.png"), protocol=next(iter(PROTOCOLS.values()))),
        Frame(name="window", image=Path("a.png"), window=(many(1)[0],)),
    ]
    packed = FrameList(frames)
    assert list(packed) == frames
    assert [str(frame.image) for frame in packed] == [str(frame.image) for frame in frames]
    assert list(packed.names()) == [frame.name for frame in frames]
    assert packed.count_of("sparse") == 3
    assert packed.count_of("image") == len(frames)
    assert [f.protocol for f in packed[-2:].patterns()] == [f.protocol for f in frames[-2:]]
    assert list(packed[1::2]) == frames[1::2]
    assert list(packed.taken([4, 0])) == [frames[4], frames[0]]
    assert pickle.loads(pickle.dumps(packed[5])) == frames[5]


def test_frames_with_queries_or_arrays_are_kept_as_they_are() -> None:
    signed = path_of("https://h/a.png?sig=1")
    frames = FrameList([Frame(name="a", image=signed)])
    assert getattr(frames[0].image, "query", "") == "?sig=1"
    camera = np.eye(3)
    calibration = Calibration(
        intrinsics=camera, rotation=camera, translation=camera[0], distortion=camera[0],
        size=None, has_pose=False, source="test",
    )  # fmt: skip
    assert FrameList([Frame(name="a", calibration=calibration)])[0].calibration is calibration


def test_replacing_a_frame_leaves_other_lists_alone() -> None:
    packed = FrameList(many(4))
    half = packed[:2]
    packed.set(0, replace(packed[0], compared=True))
    assert packed[0].compared
    assert not half[0].compared


def test_a_frame_takes_a_few_hundred_bytes() -> None:
    FrameList(many(10))
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    packed = FrameList(frame for number in range(20) for frame in many(100))
    taken = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert taken / len(packed) < 500
