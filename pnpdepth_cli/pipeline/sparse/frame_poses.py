"""The camera's poses at the images of a bag, as a file beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from scipy.spatial.transform import Rotation

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.bags.bag import Bag
from pnpdepth_cli.io.bags.poses import camera_trajectory, poses_topics
from pnpdepth_cli.io.poses import Trajectory

POSES = "poses.txt"
"""Rows as of the TUM RGB-D benchmark, one for each frame in the order of their names."""

_LONGEST_GAP_S = 0.5
"""Between two poses that one is interpolated from."""


def write_poses(
    folder: Path,
    bag: Bag,
    wanted: str | None,
    camera: str,
    times: Sequence[float],
    say: Callable[[str], None],
) -> str | None:
    """Writes poses.txt if the bag has a pose for every frame; returns the topic, None without one.

    Args:
        folder: Of the frames.
        bag: An open bag.
        wanted: The topic of the poses. None: the only one.
        camera: Name of the camera's frame.
        times: Of the frames, seconds.
        say: Receives what is used, or why there are no poses.

    Raises:
        UsageError: The topic is not there.
    """
    topics = poses_topics(bag, wanted)
    if len(topics) != 1:
        if topics:
            say(f"poses: none, as several topics give some; --poses-topic {' | '.join(topics)}")
        return None
    (topic,) = topics
    trajectory = camera_trajectory(bag, topic, camera)
    if trajectory is None:
        say(f"warning: no transforms tie the camera's frame {camera} to the poses of {topic}")
        return None
    rows = [row for time_s in times if (row := _row(trajectory, time_s)) is not None]
    if len(rows) < len(times):
        say(
            f"warning: {len(times) - len(rows):,} of {len(times):,} images have no pose in {topic}"
            f" within {_LONGEST_GAP_S:g} s, so poses.txt is not written"
        )
        return None
    with atomic_path(folder / POSES) as temporary:
        temporary.write_text("".join(rows))
    say(f"poses: of {topic}")
    return topic


def _row(trajectory: Trajectory, time_s: float) -> str | None:
    pose = trajectory.at(time_s, _LONGEST_GAP_S)
    if pose is None:
        return None
    quaternion = Rotation.from_matrix(pose[:, :3]).as_quat()
    return " ".join(map(str, [f"{time_s:.6f}", *pose[:, 3], *quaternion])) + "\n"
