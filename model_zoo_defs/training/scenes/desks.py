"""Close-ups: a table or floor full of small bodies before some background."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    lathe,
    quads,
    superquadric,
    surface,
    tube,
)
from model_zoo_defs.training.scenes import clutter, furniture
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.world import Light, Plan, Sky


def _wild(kit: Kit) -> Group:
    """Returns a body that no household has: bent, lumpy or turned."""
    group = Group()
    choice = kit.rng.random()
    size = kit.uniform(0.04, 0.3)
    if choice < 0.35:
        # A rounded body, dented by waves.
        body = superquadric(
            kit.rng.uniform(0.3, 1.0, 3) * size,
            vertical=kit.uniform(0.1, 2),
            around=kit.uniform(0.1, 2),
            rows=24,
            columns=36,
        )
        points = body.vertices.astype(np.float64)
        for _ in range(3):
            wave = kit.rng.normal(0, 4 / size, 3)
            points = points * (1 + 0.12 * np.sin(points @ wave))[:, None]
        group.add(
            surface(points.reshape(24, 37, 3)),
            kit.any_surface(),
            (0, 0, size * 0.4),
            pitch=kit.uniform(-1, 1),
            roll=kit.uniform(-1, 1),
        )
    elif choice < 0.65:
        # A turned body of random radii.
        z = np.linspace(0, size * 1.5, 20)
        radius = size * 0.4 * np.clip(0.6 + np.cumsum(kit.rng.normal(0, 0.14, 20)), 0.1, 1.4)
        group.add(lathe(np.stack([radius, z], axis=1), sides=24), kit.any_surface())
    else:
        # A bent wire or tube.
        s = np.linspace(0, 1, 40)[:, None]
        waves = [np.sin(s * kit.rng.uniform(1, 7, 3) + kit.rng.uniform(0, 6, 3)) for _ in range(2)]
        path = size * (waves[0] + waves[1])
        path[:, 2] += size * 1.3
        group.add(tube(path, size * kit.uniform(0.02, 0.15), sides=10), kit.any_surface())
    return group


def desk_scene(kit: Kit) -> Plan:
    """Returns a table top seen from near by, full of things."""
    group = Group()
    # The table.
    width = kit.uniform(0.8, 2.2)
    depth = kit.uniform(0.6, 1.4)
    top = kit.surface(
        "wood",
        "planks",
        "plain",
        "fabric",
        "poster",
        "tiles",
        "marble",
        "checks",
        "speckle",
        "carpet",
        tile_m=kit.uniform(0.2, 1.0),
    )
    z = 0.75
    group.add(box(width, depth, 0.04), top, (0, 0, z - 0.04))
    for x in (-width * 0.45, width * 0.45):
        group.add(box(0.05, 0.05, z - 0.04), kit.wood(), (x, 0, 0))
    # Floor, walls near and far, ceiling.
    floor = kit.surface("planks", "carpet", "tiles", "plain", tile_m=1)
    group.add(quads([[(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)]]), floor)
    paper = kit.surface(
        "plaster",
        "plain",
        "stripes",
        "brick",
        "tiles",
        "poster",
        "mottled",
        tile_m=kit.uniform(0.5, 2),
    )
    far = depth / 2 + (kit.uniform(0.0, 0.3) if kit.chance(0.5) else kit.uniform(0.3, 3))
    for yaw in np.arange(4) * np.pi / 2 + kit.uniform(-0.2, 0.2):
        side = Group()
        side.add(quads([[(-5, 0, 0), (5, 0, 0), (5, 0, 2.8), (-5, 0, 2.8)]]), paper)
        group.insert(
            side,
            (-np.sin(yaw) * far, np.cos(yaw) * far if yaw < 0.7 else np.cos(yaw) * 3.5, 0),
            yaw=float(yaw),
        )
        far = max(far, 2.5)
    group.add(
        quads([[(-5, -5, 2.8), (5, -5, 2.8), (5, 5, 2.8), (-5, 5, 2.8)]]),
        kit.surface("plain", vivid=0),
    )
    # Heaps of things, which the cameras look at.
    half = (width / 2 - 0.05, depth / 2 - 0.05)
    heaps = int(kit.rng.integers(2, 7))
    targets = []
    for _ in range(heaps):
        x = kit.uniform(-half[0], half[0])
        y = kit.uniform(-half[1], half[1])
        radius = kit.uniform(0.05, 0.4)
        targets.append((x, y, z + kit.uniform(0, 0.15)))
        low = (max(-half[0], x - radius), max(-half[1], y - radius))
        high = (min(half[0], x + radius), min(half[1], y + radius))
        clutter.scatter(
            kit, group, area=clutter.Rectangle(low, high, z), count=int(kit.rng.integers(4, 14))
        )
        # Odd bodies among them.
        for _ in range(int(kit.rng.integers(0, 4))):
            group.insert(
                _wild(kit),
                (kit.uniform(low[0], high[0]), kit.uniform(low[1], high[1]), z),
                yaw=kit.uniform(0, 6.3),
            )
    # Furniture behind the table.
    for _ in range(int(kit.rng.integers(0, 4))):
        maker = furniture.AGAINST_WALL[int(kit.rng.integers(len(furniture.AGAINST_WALL)))]
        group.insert(
            maker(kit),
            (kit.uniform(-2, 2), far - kit.uniform(0, 0.5), 0),
            yaw=kit.uniform(-0.5, 0.5),
        )
    # Lights, and the light from all sides.
    lights = []
    for _ in range(int(kit.rng.integers(1, 5))):
        power = kit.uniform(0.3, 1.5)
        position = (kit.uniform(-2, 2), kit.uniform(-2, min(1.5, far - 0.2)), kit.uniform(1.3, 2.7))
        tone = (power, power * kit.uniform(0.75, 1.0), power * kit.uniform(0.5, 1.05))
        lights.append(Light(position=position, colour=tone, radius=kit.uniform(0.03, 0.4)))
    level = kit.uniform(0.1, 0.4)
    sky = Sky(
        zenith=(1, 1, 1), horizon=(1, 1, 1), clouds=0.0, ambient_up=(level, level, level),
        ambient_down=(level * 0.6, level * 0.58, level * 0.55), haze_m=0.0,
        occlusion_m=kit.uniform(0.15, 0.6),
    )  # fmt: skip
    return Plan(
        group=group, lights=tuple(lights), sky=sky, low=(-width * 0.7, -depth * 0.5 - 0.9, z + 0.1),
        high=(width * 0.7, depth * 0.2, z + 0.9), targets=tuple(targets),
    )  # fmt: skip
