"""Random scenes and views of them; each depends only on a seed and a number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from model_zoo_defs.training.rendering.camera_effects import photographed
from model_zoo_defs.training.rendering.materials import Palette
from model_zoo_defs.training.rendering.shading import seen
from model_zoo_defs.training.rendering.shapes import FloatArray
from model_zoo_defs.training.scenes.desks import desk_scene
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.rooms import room
from model_zoo_defs.training.scenes.streets import street
from model_zoo_defs.training.scenes.world import Plan, View, World, looking

KINDS = ("room", "street", "desk")
"""Kinds of scene; a frame stores the index into this."""

KIND_WEIGHTS = {"room": 0.5, "street": 0.3, "desk": 0.2}
"""Relative frequency of each kind of scene."""

VIEWS_PER_SCENE = 4

_MAKERS = {"room": room, "street": street, "desk": desk_scene}


class Rig(NamedTuple):
    """Intrinsics and random pose of a camera."""

    fov_deg: float
    """Horizontal field of view."""
    shift: tuple[float, float]
    """The principal point from the image centre, (right, down), in widths and heights."""
    height: tuple[float, float]
    """Lowest and highest position above the floor or road, metres."""
    roll_deg: float
    """Standard deviation of roll and, in a street, of yaw."""
    pitch_deg: tuple[float, float] | None = None
    """Mean, upward, and standard deviation; None looks towards a target of the scene."""
    clearance: float | None = None
    """Least distance to visible surfaces, metres; None sets none."""


CAMERAS: dict[str, Rig | None] = {
    "any": None,
    # central 304 × 228 px of a Kinect image at half size, focal length 518.86 px; on a robot's
    # mast, looking down at the floor ahead of it
    "nyu": Rig(60.7, (0.0, 0.0), (1.35, 1.45), 0.5, (-17.0, 1.5), 0.8),
    # columns 154 to 1066, rows 136 to 364 of KITTI's left colour camera: 721.5 px, axis at row
    # 173, on a car's roof
    "kitti": Rig(64.6, (0.0, -0.338), (1.6, 1.7), 0.5),
}
"""Cameras of the benchmarks, whose metric depth a network can learn from the image alone."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One rendered frame: rgb (H, W, 3), depth in metres (H, W) with 0 = unknown."""

    rgb: npt.NDArray[np.uint8]
    depth: FloatArray
    kind: int
    intrinsics: FloatArray


def generator(seed: int, scene: int, part: int) -> np.random.Generator:
    """Returns the random number generator of one part of one scene."""
    return np.random.default_rng([seed, scene, part])


def build(kind: str, rng: np.random.Generator) -> tuple[World, Plan]:
    """Returns a random scene of the kind, ready for rays, and its plan."""
    palette = Palette(rng)
    plan = _MAKERS[kind](Kit(rng=rng, palette=palette))
    mesh, materials = plan.group.merged()
    world = World(
        mesh=mesh, face_material=materials, table=palette.frozen(), lights=plan.lights, sky=plan.sky
    )
    return world, plan


def pick_kind(rng: np.random.Generator, kinds: tuple[str, ...]) -> str:
    """Returns one of the kinds, drawn with KIND_WEIGHTS."""
    weights = np.array([KIND_WEIGHTS[kind] for kind in kinds])
    return kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]


def pick_view(
    world: World,
    plan: Plan,
    kind: str,
    rng: np.random.Generator,
    *,
    size: tuple[int, int],
    rig: Rig | None = None,
) -> View:
    """Returns a view (rows, columns) that shows much of the scene, the best of up to 24."""
    height, width = size
    best = None
    best_score = -1.0
    for _ in range(24):
        view = _street_view(plan, rng, height, width, rig) if kind == "street" else _indoor_view(
            plan, rng, height, width, rig, near=kind == "desk"
        )  # fmt: skip
        closest = 2.0 if kind == "street" else 0.15 if kind == "desk" else 0.3
        score = _score(world, view, (rig and rig.clearance) or closest)
        if best is None or score > best_score:
            best, best_score = view, score
        if score > rng.uniform(0.35, 0.75):
            break
    assert best is not None
    return best


def _street_view(
    plan: Plan, rng: np.random.Generator, height: int, width: int, rig: Rig | None
) -> View:
    """Returns a view mostly along the street; a rig sets its height, angles and intrinsics."""
    position = rng.uniform(plan.low, plan.high)
    yaw = rng.normal(0, 0.06) if rng.random() < 0.7 else rng.uniform(-1.2, 1.2)
    # A crop of a wide image may be off-centre to its principal point.
    shift = (float(rng.uniform(-0.8, 0.8)), 0.0) if rng.random() < 0.3 else (0.0, 0.0)
    pitch = rng.normal(-0.02, 0.03)
    fov = rng.uniform(30, 85)
    roll = rng.normal(0, 0.01)
    shift = (shift[0], float(rng.uniform(-0.15, 0.1)))
    if rig is not None:
        position[2] = rng.uniform(*rig.height)
        yaw, roll = np.radians(rng.normal(0, rig.roll_deg, 2))
        fov, shift = rig.fov_deg, rig.shift
    return looking(position, (yaw, pitch, roll), fov_deg=fov, shift=shift, size=(height, width))


def _indoor_view(
    plan: Plan, rng: np.random.Generator, height: int, width: int, rig: Rig | None, *, near: bool
) -> View:
    """Returns a view from the cameras' free box of a scene toward one of its targets.

    Args:
        plan: The scene.
        rng: Random numbers.
        height: Rows of the image.
        width: Columns of the image.
        rig: Height, tilt and lens of a given camera; None: random ones.
        near: Whether the camera may be moved close to its target.
    """
    position = rng.uniform(plan.low, plan.high)
    target = np.asarray(plan.targets[int(rng.integers(len(plan.targets)))])
    if near:
        position = target + (position - target) * rng.uniform(0.4, 1.2)
        position[2] = max(position[2], plan.low[2])
    if rig is not None:
        position[2] = rng.uniform(*rig.height)
    # Toward the target, but seldom exactly: less steeply, and a little aside.
    toward = target - position
    yaw = float(np.arctan2(-toward[0], toward[1]))
    pitch = float(np.arctan2(toward[2], np.hypot(toward[0], toward[1]) + 1e-6))
    pitch = np.clip(pitch, -1.1, 0.5) * rng.uniform(0.4, 1.0) + rng.normal(0, 0.05)
    yaw += rng.normal(0, 0.15)
    roll = rng.normal(0, 0.06 if rng.random() < 0.8 else 0.3)
    fov = rng.uniform(40, 95)
    if rig is not None:
        roll = np.radians(rng.normal(0, rig.roll_deg))
        fov = rig.fov_deg
        if rig.pitch_deg is not None:
            pitch = np.radians(rng.normal(*rig.pitch_deg))
    return looking(position, (yaw, pitch, roll), fov_deg=fov, size=(height, width))


def _score(world: World, view: View, closest: float) -> float:
    """Returns the variety of a view: 0 when one close surface fills it, near 1 for many edges."""
    v, u = np.mgrid[0 : view.height - 1 : 18j, 0 : view.width - 1 : 24j]
    hits = world.cast(*view.rays(u, v))
    t = np.where(hits.met, hits.t, 100.0).reshape(18, 24)
    if np.percentile(t, 2) < closest or np.mean(t < 1.5 * closest) > 0.3:
        return 0.0
    known = float(hits.met.mean())
    if known < 0.35:
        return 0.0
    jumps = np.abs(np.diff(np.log(t), axis=1)) > 0.08
    steps = np.abs(np.diff(np.log(t), axis=0)) > 0.08
    materials = len(np.unique(hits.material[hits.met]))
    rich = 1.6 * float(jumps.mean() + steps.mean()) + 0.02 * materials
    return float(min(1.0, rich) * min(1.0, known + 0.3))


def scene_frames(
    seed: int,
    scene: int,
    *,
    height: int,
    width: int,
    kinds: tuple[str, ...] = KINDS,
    rig: Rig | None = None,
) -> list[Frame]:
    """Returns the VIEWS_PER_SCENE frames of a scene; the same bytes on every run."""
    # One scene; each of its views has random numbers of its own.
    rng = generator(seed, scene, 0)
    kind = pick_kind(rng, kinds)
    world, plan = build(kind, rng)
    frames = []
    for number in range(VIEWS_PER_SCENE):
        own = generator(seed, scene, 1 + number)
        view = pick_view(world, plan, kind, own, rig=rig, size=(height, width))
        colour, depth = seen(world, view, own)
        frames.append(
            Frame(
                rgb=photographed(colour, own),
                depth=depth,
                kind=KINDS.index(kind),
                intrinsics=np.array([view.fx, view.fy, view.cx, view.cy], np.float32),
            )
        )
    return frames
