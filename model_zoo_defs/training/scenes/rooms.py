"""Rooms: shell with openings, furniture along the walls and in the middle, lights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model_zoo_defs.training.rendering.shapes import Group, box, cylinder, quads, rod
from model_zoo_defs.training.scenes import clutter, figures, furniture, seating
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.walls import Hole, decorate, opening, openings, wall
from model_zoo_defs.training.scenes.world import Light, Plan, Sky


def room(kit: Kit) -> Plan:
    """Returns a furnished room with its free box and camera targets."""
    rng = kit.rng
    # Size: some rooms are corridors, some ceilings slope.
    corridor = kit.chance(0.12)
    width = kit.uniform(1.4, 2.2) if corridor else kit.uniform(2.2, 6.5)
    depth = kit.uniform(4, 9) if corridor else kit.uniform(2.2, 7.5)
    height = kit.uniform(2.2, 3.1)
    rise = kit.uniform(-0.9, 1.5) if kit.chance(0.2) else 0.0
    # Floor, ceiling and walls.
    group = Group()
    paint = _add_floor_and_ceiling(kit, group, (width, depth, height), rise)
    sides = (
        ((0.0, depth), 0.0, width, height, rise),
        ((width, depth), -np.pi / 2, depth, height + rise, 0.0),
        ((width, 0.0), np.pi, width, height + rise, -rise),
        ((0.0, 0.0), np.pi / 2, depth, height, 0.0),
    )
    for start, yaw, length, tall, lift in sides:
        side = _side(kit, length, tall, lift, paint, across=min(width, depth), corridor=corridor)
        group.insert(side, (*start, 0), yaw=yaw)
    # What stands in the middle: furniture, a pillar, things on the floor.
    if not corridor:
        _middle(kit, group, width, depth)
    if kit.chance(0.3):
        thing = (
            box(0.35, 0.35, height + max(rise, 0))
            if kit.chance(0.5)
            else cylinder(0.18, height + max(rise, 0))
        )
        group.add(thing, paint, (kit.uniform(0.3, 0.7) * width, kit.uniform(0.3, 0.7) * depth, 0))
    clutter.scatter(
        kit,
        group,
        area=clutter.Rectangle((0.4, 0.4), (width - 0.4, depth - 0.4), 0.0),
        count=int(rng.integers(0, 10)),
    )
    # What the windows show.
    _outside(kit, group, width, depth)
    # Places that the cameras look at, and lights.
    targets = []
    for _ in range(16):
        targets.append(
            (kit.uniform(0.1, 0.9) * width, kit.uniform(0.1, 0.9) * depth, kit.uniform(0.1, 1.4))
        )
    lights = _lights(kit, width, depth, height, group)
    return Plan(
        group=group,
        lights=lights,
        sky=_indoor_sky(kit),
        low=(0.3, 0.3, 0.5),
        high=(width - 0.3, depth - 0.3, min(1.9, height - 0.3)),
        targets=tuple(targets),
    )


def _add_floor_and_ceiling(
    kit: Kit, group: Group, size: tuple[float, float, float], rise: float
) -> int:
    """Adds the floor, which may reflect, and the ceiling; returns the material of the walls.

    Args:
        kit: Random numbers and materials.
        group: Group of the room.
        size: Width, depth and height of the room in metres.
        rise: How much higher the ceiling is at the right wall than at the left.
    """
    width, depth, height = size
    paint = kit.surface(
        "plaster",
        "plaster",
        "plain",
        "plain",
        "stripes",
        "brick",
        "mottled",
        "spots",
        tile_m=kit.uniform(1, 3),
        vivid=0.15,
    )
    floor = kit.surface(
        "planks",
        "planks",
        "carpet",
        "tiles",
        "carpet",
        "checks",
        "plain",
        "marble",
        "speckle",
        tile_m=kit.uniform(0.6, 2),
        vivid=0.2,
    )
    mirror = kit.uniform(0, 0.12) if kit.chance(0.4) else 0.0
    if mirror:
        floor = kit.palette.new(
            "planks" if kit.chance(0.5) else "tiles",
            tile_m=kit.uniform(0.6, 2),
            mirror=mirror,
            vivid=0.1,
        )
    ceiling = kit.surface("plain", "plaster", "tiles", vivid=0.05, tile_m=2)
    group.add(quads([[(0, 0, 0), (width, 0, 0), (width, depth, 0), (0, depth, 0)]]), floor)
    group.add(
        quads(
            [
                [
                    (0, 0, height),
                    (width, 0, height + rise),
                    (width, depth, height + rise),
                    (0, depth, height),
                ]
            ]
        ),
        ceiling,
    )
    return paint


def _side(
    kit: Kit,
    length: float,
    height: float,
    rise: float,
    paint: int,
    *,
    across: float,
    corridor: bool,
) -> Group:
    """Returns a wall with windows, doors, and what hangs on it and stands along it.

    Args:
        kit: Random numbers and materials.
        length: Length of the wall, metres.
        height: Height at its left end.
        rise: How much higher it is at its right end.
        paint: Material of most walls of the room.
        across: The shorter side of the room.
        corridor: Whether the room is a corridor, with less furniture.
    """
    own = paint if kit.chance(0.8) else kit.surface("plaster", "plain", "brick", tile_m=1.5)
    side = Group()
    holes = openings(kit, length, min(height, height + rise))
    side.add(wall(length, height, holes, rise=rise), own)
    for hole in holes:
        opening(kit, side, hole, own)
    if kit.chance(0.7):
        skirting = kit.palette.new("plain", (0.88, 0.87, 0.85)) if kit.chance(0.6) else kit.wood()
        side.add(box(length, 0.03, kit.uniform(0.05, 0.14)), skirting, (length / 2, -0.015, 0))
    decorate(kit, side, length, min(height, height + rise), holes)
    _line_up(kit, side, length, across, holes, corridor)
    return side


def _line_up(
    kit: Kit, side: Group, length: float, across: float, holes: Sequence[Hole], corridor: bool
) -> None:
    """Adds furniture with its back to the wall, keeping doors free."""
    u = kit.uniform(0.0, 0.8)
    tries = 0
    while u < length - 0.4 and tries < 12:
        tries += 1
        if kit.chance(0.7 if corridor else 0.2):
            u += kit.uniform(0.3, 1.0)
            continue
        item = furniture.AGAINST_WALL[int(kit.rng.integers(len(furniture.AGAINST_WALL)))](kit)
        lower, upper = item.bounds()
        wide = float(upper[0] - lower[0])
        deep = float(-lower[1])
        blocked = any(
            hole[1] == 0 and hole[0] - 0.1 < u + wide and u < hole[2] + 0.1 for hole in holes
        )
        if u + wide > length or deep > 0.45 * across or blocked:
            u += 0.15
            continue
        side.insert(
            item,
            (u - float(lower[0]), -0.03 - kit.uniform(0, 0.05), 0),
            yaw=kit.uniform(-0.06, 0.06),
        )
        u += wide + (kit.uniform(0.0, 0.1) if kit.chance(0.5) else kit.uniform(0.2, 0.9))


def _middle(kit: Kit, group: Group, width: float, depth: float) -> None:
    """Adds a table with chairs, a rug, single chairs, people and hanging lamps."""
    x = kit.uniform(0.35, 0.65) * width
    y = kit.uniform(0.35, 0.65) * depth
    yaw = kit.uniform(0, 6.3)
    # A rug.
    if kit.chance(0.5):
        rug = box(kit.uniform(1, 2.4), kit.uniform(0.8, 1.8), 0.008, fit=0.0)
        group.add(
            rug,
            kit.surface("carpet", "fabric", "poster", "stripes", "checks", tile_m=1.5),
            (x, y, 0),
            yaw=yaw,
        )
    # A table with chairs on both sides.
    if min(width, depth) > 2.8 and kit.chance(0.75):
        ensemble = Group()
        item = furniture.table(kit) if kit.chance(0.7) else furniture.desk(kit)
        lower, upper = item.bounds()
        ensemble.insert(item, (0, -float(lower[1]) / 2, 0))
        seat = seating.chair(kit) if kit.chance(0.75) else seating.office_chair(kit)
        for side in (-1, 1):
            for along in np.linspace(-0.3, 0.3, int(kit.rng.integers(1, 4))):
                if kit.chance(0.75):
                    at = (
                        float(along * (upper[0] - lower[0])),
                        side * (-float(lower[1]) / 2 + kit.uniform(0.1, 0.5)),
                        0,
                    )
                    ensemble.insert(
                        seat, at, yaw=(0.0 if side > 0 else np.pi) + kit.uniform(-0.5, 0.5)
                    )
        group.insert(ensemble, (x, y, 0), yaw=yaw)
    # Single pieces of furniture.
    for _ in range(int(kit.rng.integers(0, 4))):
        makers = (
            seating.chair,
            seating.office_chair,
            furniture.floor_plant,
            seating.sofa,
            furniture.floor_lamp,
            furniture.drawers,
            furniture.railing,
        )
        item = makers[int(kit.rng.integers(len(makers)))](kit)
        group.insert(
            item,
            (kit.uniform(0.2, 0.8) * width, kit.uniform(0.2, 0.8) * depth, 0),
            yaw=kit.uniform(0, 6.3),
        )
    # A person.
    if kit.chance(0.3):
        group.insert(
            figures.person(kit),
            (kit.uniform(0.2, 0.8) * width, kit.uniform(0.2, 0.8) * depth, 0),
            yaw=kit.uniform(0, 6.3),
        )
    # A hanging lamp.
    if kit.chance(0.4):
        shade = kit.palette.new("plain", glow=kit.uniform(0, 2), vivid=0.4)
        z = kit.uniform(1.5, 2.0)
        group.add(rod((x, y, z), (x, y, 2.9), 0.004, sides=5), kit.dark())
        group.add(
            cylinder(kit.uniform(0.1, 0.25), kit.uniform(0.12, 0.3), top=kit.uniform(0.03, 0.2)),
            shade,
            (x, y, z),
        )


def _outside(kit: Kit, group: Group, width: float, depth: float) -> None:
    """Adds what is seen through windows: ground and, at random, a wall, a hedge or boxes."""
    ground = kit.surface("paving", "foliage", "speckle", tile_m=3, vivid=0.2)
    group.add(box(80, 80, 0.1), ground, (width / 2, depth / 2, -kit.uniform(0.3, 4)))
    for _ in range(int(kit.rng.integers(0, 6))):
        angle = kit.uniform(0, 6.3)
        far = kit.uniform(4, 25) + max(width, depth)
        block = box(kit.uniform(1, 12), kit.uniform(1, 8), kit.uniform(1, 9))
        material = kit.surface("brick", "plaster", "foliage", tile_m=2, vivid=0.2)
        group.add(
            block,
            material,
            (width / 2 + far * np.cos(angle), depth / 2 + far * np.sin(angle), -2),
            yaw=kit.uniform(0, 6.3),
        )


def _lights(kit: Kit, width: float, depth: float, height: float, group: Group) -> tuple[Light, ...]:
    """Returns lamps in a room of this width, depth and height, and often a sun."""
    # Lamps, white to orange.
    lights = []
    for _ in range(int(kit.rng.integers(1, 4))):
        warm = kit.uniform(0.65, 1.0)
        power = kit.uniform(0.5, 3.0)
        position = (
            kit.uniform(0.15, 0.85) * width,
            kit.uniform(0.15, 0.85) * depth,
            kit.uniform(1.7, height - 0.1),
        )
        colour = (power, power * (0.3 + 0.7 * warm), power * warm**2)
        lights.append(Light(position=position, colour=colour, radius=kit.uniform(0.05, 0.5)))
    # A sun in any direction; its position is the direction toward it.
    if kit.chance(0.5):
        angle = kit.uniform(0, 6.3)
        power = kit.uniform(2, 9)
        position = (np.cos(angle), np.sin(angle), kit.uniform(0.3, 1.2))
        lights.append(
            Light(
                position=position, colour=(power, power * 0.93, power * 0.8), radius=0.03, sun=True
            )
        )
    return tuple(lights)


def _indoor_sky(kit: Kit) -> Sky:
    """Returns the sky outside the windows, and the ambient light of a room."""
    bright = kit.uniform(1, 5)
    level = kit.uniform(0.15, 0.6)
    up = tuple(float(v) for v in level * kit.rng.uniform(0.85, 1.1, 3))
    down = tuple(
        float(v) for v in level * kit.rng.uniform(0.35, 1.0) * kit.rng.uniform(0.85, 1.1, 3)
    )
    return Sky(
        zenith=(bright * 0.5, bright * 0.7, bright), horizon=(bright * 0.9, bright * 0.95, bright),
        clouds=kit.uniform(0, 1), ambient_up=(up[0], up[1], up[2]),
        ambient_down=(down[0], down[1], down[2]),
        haze_m=0.0, occlusion_m=kit.uniform(0.4, 1.5),
    )  # fmt: skip
