"""Buildings along a street, with recessed windows, balconies, awnings and roofs."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import Group, box, cylinder, prism, quads, rod
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.walls import Hole, wall

_ROW_END_M = 95.0
"""Distance along the street at which a row of houses ends."""
_OWN_HOUSES_END_M = 40.0
"""Distance along the street beyond which every house is one of the three that repeat."""


def building(kit: Kit, width: float) -> Group:
    """Returns a house whose front lies along x at y = 0 and looks toward -y."""
    group = Group()
    # Size and materials.
    floors = int(kit.rng.integers(1, 6))
    storey = kit.uniform(2.6, 3.4)
    height = floors * storey + kit.uniform(0.2, 1)
    deep = kit.uniform(7, 12)
    skin = kit.surface(
        "plaster",
        "plaster",
        "brick",
        "brick",
        "plain",
        "speckle",
        "tiles",
        tile_m=kit.uniform(1.2, 2.5),
        vivid=0.15,
    )
    glass = kit.palette.new("plain", (0.08, 0.09, 0.1), gloss=0.6, mirror=kit.uniform(0.1, 0.3))
    trim = (
        kit.palette.new("plain", (0.85, 0.84, 0.8))
        if kit.chance(0.6)
        else kit.surface("plain", vivid=0.3)
    )
    # Front and sides.
    holes = _windows(kit, width, floors, storey)
    group.add(wall(width, height, holes), skin, (-width / 2, 0, 0))
    side = [(0, 0, 0), (0, deep, 0), (0, deep, height), (0, 0, height)]
    for x in (-width / 2, width / 2):
        group.add(quads([side]), skin, (x, 0, 0))
    # Windows and doors: pane or curtain, reveals, sills and bars, balconies.
    recess = kit.uniform(0.06, 0.3)
    balcony = kit.chance(0.3)
    for u0, v0, u1, v1 in holes:
        x = (u0 + u1) / 2 - width / 2
        hole_width = u1 - u0
        hole_height = v1 - v0
        curtain = glass if kit.chance(0.6) else kit.surface("plain", "stripes", vivid=0.1)
        group.add(box(hole_width, 0.02, hole_height), curtain, (x, recess, v0))
        reveal, sill = (0.01, recess, hole_height), (hole_width + 0.15, recess + 0.1, 0.05)
        for at, size in (
            ((x - hole_width / 2, recess / 2, v0), reveal),
            ((x + hole_width / 2, recess / 2, v0), reveal),
            ((x, recess / 2, v1), (hole_width, recess, 0.01)),
            ((x, recess / 2 - 0.05, v0 - 0.05), sill),
            ((x, recess - 0.03, v0), (0.06, 0.05, hole_height)),
            ((x, recess - 0.03, v0 + hole_height * 0.6), (hole_width, 0.05, 0.06)),
        ):
            group.add(box(*size), trim, at)
        if balcony and v0 > 2 and kit.chance(0.6):
            _balcony(kit, group, x, v0 - 0.4, hole_width)
    # Roof, awning and shop sign.
    _top(kit, group, width, height, deep, skin)
    if kit.chance(0.3):
        awning = [
            (-width * 0.4, -1.2, 2.4),
            (width * 0.4, -1.2, 2.4),
            (width * 0.4, 0, 2.9),
            (-width * 0.4, 0, 2.9),
        ]
        group.add(quads([awning]), kit.surface("stripes", "plain", vivid=0.7, tile_m=2))
    if kit.chance(0.3):
        shop = kit.palette.new("poster", tile_m=2.0, glow=kit.uniform(0, 0.5))
        group.add(box(width * kit.uniform(0.3, 0.9), 0.12, 0.6), shop, (0, -0.06, storey - 0.3))
    return group


def _windows(kit: Kit, width: float, floors: int, storey: float) -> list[Hole]:
    """Returns the holes (left, low, right, high) of windows and one door in a front, in metres."""
    holes: list[Hole] = []
    count = max(1, int(width / kit.uniform(1.8, 3.2)))
    window_width = kit.uniform(0.8, 1.5)
    height = kit.uniform(1.1, 1.8)
    sill = kit.uniform(0.7, 1.0)
    door = int(kit.rng.integers(count))
    for floor in range(floors):
        for column in range(count):
            middle = (column + 0.5) * width / count
            if floor == 0 and column == door:
                holes.append((middle - 0.5, 0.02, middle + 0.5, 2.15))
            elif window_width < width / count - 0.1:
                low = floor * storey + sill
                holes.append(
                    (
                        middle - window_width / 2,
                        low,
                        middle + window_width / 2,
                        min(low + height, (floor + 1) * storey),
                    )
                )
    return holes


def _balcony(kit: Kit, group: Group, x: float, z: float, width: float) -> None:
    """Adds a balcony of a door of this width, in the middle of its floor's edge at (x, z)."""
    wide = width + 0.8
    group.add(box(wide, 1.0, 0.12), kit.palette.new("plain", (0.6, 0.6, 0.58)), (x, -0.5, z))
    steel = kit.metal()
    group.add(rod((x - wide / 2, -0.97, z + 1), (x + wide / 2, -0.97, z + 1), 0.025), steel)
    for bar in np.linspace(-wide / 2, wide / 2, int(wide / 0.14)):
        group.add(box(0.016, 0.016, 0.9), steel, (x + float(bar), -0.97, z + 0.1))


def _top(kit: Kit, group: Group, width: float, height: float, deep: float, skin: int) -> None:
    """Adds a roof, pitched or flat, and a downpipe; `skin` is the walls' material."""
    tiles = kit.palette.new(
        "tiles", np.array([0.5, 0.25, 0.18]) * kit.uniform(0.4, 1.2), tile_m=1.2
    )
    if kit.chance(0.65):
        # Two slopes from eaves to ridge, gables, chimney and gutter.
        rise = kit.uniform(1.5, 4.5)
        eave = kit.uniform(0.2, 0.6)
        half_width = width / 2 + 0.1
        ridge = height + rise
        low = height - eave * rise / (deep / 2)
        front = [
            (-half_width, -eave, low),
            (half_width, -eave, low),
            (half_width, deep / 2, ridge),
            (-half_width, deep / 2, ridge),
        ]
        back = [
            (-half_width, deep + eave, low),
            (half_width, deep + eave, low),
            (half_width, deep / 2, ridge),
            (-half_width, deep / 2, ridge),
        ]
        group.add(quads([front, back]), tiles)
        gable = [(0, height), (deep, height), (deep / 2, ridge - 0.05)]
        group.add(prism(gable, 2 * half_width - 0.25), skin, (0, 0, 0), yaw=np.pi / 2)
        group.add(
            box(0.6, 0.5, 1.6), skin, (kit.uniform(-0.3, 0.3) * width, deep * 0.4, ridge - 0.9)
        )
        group.add(rod((-half_width, -eave, low), (half_width, -eave, low), 0.06), kit.metal())
    else:
        # A flat roof.
        group.add(
            box(width + 0.2, deep + 0.2, 0.3),
            kit.surface("plain", vivid=0.0),
            (0, deep / 2, height),
        )
    # A downpipe.
    group.add(cylinder(0.045, height), kit.metal(), (width / 2 - 0.15, -0.06, 0))


def row(kit: Kit, group: Group, side: float, x: float) -> None:
    """Adds a row of houses, garden walls and gaps along one side of the road.

    Args:
        kit: Random numbers and materials.
        group: Group that they are added to.
        side: 1 for the right side of the road, which runs along +y; -1 for the left one.
        x: Distance of the row from the middle of the road in metres.
    """
    # A closed row has few gaps, an open one many. Most houses are copies of three.
    is_closed = kit.rng.random() < 0.6
    y = kit.uniform(-12, 5)
    gap_chance = 0.1 if is_closed else 0.6
    kinds = [building(kit, kit.uniform(6, 16)) for _ in range(3)]
    while y < _ROW_END_M:
        # A gap, mostly behind a garden wall.
        if kit.chance(gap_chance):
            length = kit.uniform(3, 15)
            if kit.chance(0.6):
                material = kit.surface("brick", "plaster", "paving", tile_m=1.5, vivid=0.1)
                group.add(
                    box(0.25, length, kit.uniform(0.6, 2.4)),
                    material,
                    (side * x, y + length / 2, 0),
                )
            y += length
            continue
        # A house; its front, which looks toward -y, is turned to the road.
        house = (
            building(kit, kit.uniform(6, 16))
            if kit.chance(0.3) and y < _OWN_HOUSES_END_M
            else kinds[int(kit.rng.integers(3))]
        )
        lower, upper = house.bounds()
        width = float(upper[0] - lower[0])
        at = (side * (x + kit.uniform(0, 1.2)), y + width / 2, 0)
        group.insert(house, at, yaw=-side * np.pi / 2)
        y += width + (0.0 if kit.chance(0.6) else kit.uniform(0.5, 4))
