"""Furniture; each piece stands on z = 0 with its back on y = 0, its front toward -y."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    cylinder,
    lathe,
    rod,
    superquadric,
    tube,
)
from model_zoo_defs.training.scenes.clutter import Rectangle, frame, gadget, scatter
from model_zoo_defs.training.scenes.figures import bicycle
from model_zoo_defs.training.scenes.household import (
    books,
    bottle,
    bowl,
    carton,
    lamp,
    laptop,
    monitor,
    mug,
    papers,
    plant,
    pot,
    vase,
)
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.seating import bed, chair, sofa

_SHELF_THINGS = (books, carton, vase, gadget, frame, mug, bottle, plant, bowl)


_KITCHEN_THINGS = (pot, pot, bottle, mug, bowl, carton, papers, books, vase)


_TABLE_THINGS = (mug, books, papers, laptop, bowl, bottle, plant, lamp, gadget, carton, vase)


def table(kit: Kit, *, width: float = 0.0) -> Group:
    """Returns a table with legs and things on it."""
    group = Group()
    # Size and materials.
    wood = kit.wood() if kit.chance(0.7) else kit.surface("plain", "marble")
    table_width = width or kit.uniform(0.7, 2.0)
    depth = kit.uniform(0.5, 0.95)
    height = kit.uniform(0.4, 0.78)
    thick = kit.uniform(0.015, 0.05)
    legs = kit.metal() if kit.chance(0.3) else wood
    y = -depth / 2
    # A round table on one leg, or one on four.
    if kit.chance(0.15):
        group.add(cylinder(depth * 0.6, thick, sides=30), wood, (0, y, height - thick))
        group.add(cylinder(0.04, height - thick), legs, (0, y, 0))
        group.add(cylinder(depth * 0.3, 0.03, top=depth * 0.1), legs, (0, y, 0))
    else:
        group.add(box(table_width, depth, thick), wood, (0, y, height - thick))
        thickness = kit.uniform(0.03, 0.09)
        for sx in (-1, 1):
            for sy in (-1, 1):
                at = (sx * (table_width / 2 - thickness), y + sy * (depth / 2 - thickness), 0)
                leg = (
                    box(thickness, thickness, height - thick)
                    if kit.chance(0.7)
                    else cylinder(thickness / 2, height - thick)
                )
                group.add(leg, legs, at)
        if kit.chance(0.5):
            group.add(
                box(table_width * 0.9, depth * 0.85, 0.08), wood, (0, y, height - thick - 0.08)
            )
    # Things on it.
    scatter(
        kit,
        group,
        area=Rectangle(
            (-table_width * 0.42, -depth * 0.9), (table_width * 0.42, -depth * 0.1), height
        ),
        count=int(kit.rng.integers(0, 9)),
        tallest=0.45,
        things=_TABLE_THINGS,
    )
    return group


def desk(kit: Kit) -> Group:
    """Returns a writing desk with a screen and clutter; one in five is a mere table."""
    group = table(kit, width=kit.uniform(1.1, 1.8))
    if kit.chance(0.8):
        # As wide as the table, but a plain board on two sides, at a desk's height.
        lower, upper = group.bounds()
        top = 0.74
        group = Group()
        wood = kit.wood()
        width = float(upper[0] - lower[0])
        group.add(box(width, 0.7, 0.03), wood, (0, -0.35, top - 0.03))
        for side in (-1, 1):
            group.add(box(0.03, 0.65, top - 0.03), wood, (side * (width / 2 - 0.02), -0.35, 0))
        # Screen, keyboard and small things in front of it.
        group.insert(monitor(kit), (kit.uniform(-0.2, 0.2), -0.2, top), yaw=kit.uniform(-0.3, 0.3))
        group.add(box(0.42, 0.14, 0.02), kit.dark(), (0, -0.5, top))
        scatter(
            kit,
            group,
            area=Rectangle((-width * 0.45, -0.62), (width * 0.45, -0.15), top),
            count=int(kit.rng.integers(1, 7)),
            tallest=0.4,
        )
    return group


def bookshelf(kit: Kit) -> Group:
    """Returns open shelves full of books and things."""
    group = Group()
    wood = kit.wood() if kit.chance(0.6) else kit.surface("plain")
    width = kit.uniform(0.6, 1.6)
    depth = kit.uniform(0.24, 0.4)
    height = kit.uniform(0.8, 2.2)
    thickness = 0.025
    for side in (-1, 1):
        group.add(
            box(thickness, depth, height), wood, (side * (width - thickness) / 2, -depth / 2, 0)
        )
    if kit.chance(0.75):
        group.add(box(width, 0.01, height), wood, (0, -0.005, 0))
    shelves = np.linspace(0.06, height - thickness, max(2, int(height / kit.uniform(0.28, 0.42))))
    gap = float(shelves[1] - shelves[0])
    covers = [kit.palette.new("poster", tile_m=0.3) for _ in range(3)]
    covers += [kit.palette.new("plain", tile_m=0.3, vivid=0.6) for _ in range(6)]
    for z in shelves:
        group.add(box(width, depth, thickness), wood, (0, -depth / 2, float(z)))
        if z < shelves[-1]:
            _fill_shelf(
                kit,
                group,
                (width - 2 * thickness, depth, gap - thickness),
                float(z) + thickness,
                covers,
            )
    return group


def _fill_shelf(
    kit: Kit, group: Group, size: tuple[float, float, float], z: float, covers: list[int]
) -> None:
    """Adds books and things to a shelf of this width, depth and height, whose board is at z."""
    width, depth, gap = size
    x = -width / 2
    while x < width / 2 - 0.06:
        if kit.chance(0.8):
            # A book, some of them leaning.
            wide = kit.uniform(0.012, 0.06)
            tall = gap * kit.uniform(0.5, 0.97)
            deep = depth * kit.uniform(0.5, 0.9)
            lean = kit.uniform(-0.25, 0.0) if kit.chance(0.06) else 0.0
            group.add(
                box(wide * 0.97, deep, tall),
                int(kit.rng.choice(covers)),
                (x + wide / 2, -depth * kit.uniform(0.93, 1.0) + deep / 2, z),
                roll=lean,
            )
            x += wide
        else:
            # A thing, or a gap.
            wide = kit.uniform(0.08, 0.3)
            end = min(x + wide, width / 2)
            if kit.chance(0.7):
                scatter(
                    kit,
                    group,
                    area=Rectangle(
                        ((x + end) / 2, -depth * 0.7), ((x + end) / 2 + 0.01, -depth * 0.4), z
                    ),
                    count=1,
                    tallest=gap * 0.9,
                    things=_SHELF_THINGS,
                )
            x += wide


def cupboard(kit: Kit, *, hang: float = 0.0) -> Group:
    """Returns a closed cupboard with door panels, joints and handles.

    Args:
        kit: Random numbers and materials.
        hang: Height of its bottom on the wall in metres. 0: it stands on the floor, may be taller
            and deeper, and may have things on its top.
    """
    group = Group()
    # The body, lower and less deep if it hangs, and its doors.
    front = (
        kit.wood()
        if kit.chance(0.5)
        else kit.palette.new("plain", tile_m=1.0, gloss=0.4, mirror=kit.uniform(0, 0.05), vivid=0.4)
    )
    width = kit.uniform(0.5, 1.8)
    depth = kit.uniform(0.35, 0.65)
    height = kit.uniform(0.5, 2.2)
    if hang:
        depth = 0.35
        height = kit.uniform(0.5, 0.8)
    group.add(box(width, depth, height), front, (0, -depth / 2, hang))
    _doors(kit, group, (width, depth, height), hang, front)
    # Things on its top, where one is seen from above.
    if height < 1.3 and not hang:
        scatter(
            kit,
            group,
            area=Rectangle((-width * 0.42, -depth * 0.85), (width * 0.42, -depth * 0.2), height),
            count=int(kit.rng.integers(0, 7)),
            tallest=0.7,
        )
    return group


def _doors(kit: Kit, group: Group, size: tuple[float, float, float], z: float, front: int) -> None:
    """Adds doors or drawers with handles to the front of a body, whose back is on y = 0.

    Args:
        kit: Random numbers and materials.
        group: Group that they are added to.
        size: Width, depth and height of the body in metres.
        z: Height of its bottom in metres.
        front: Material of the doors.
    """
    width, depth, height = size
    steel = kit.metal()
    # Rows and columns of doors or drawers, with handles of one style.
    columns = max(1, round(width / kit.uniform(0.4, 0.6)))
    rows = int(kit.rng.integers(1, 5)) if height > 0.6 else 1
    style = int(kit.rng.integers(3))
    gap = 0.006  # metres, on each side of a door
    for column in range(columns):
        for row in range(rows):
            wide = width / columns
            tall = (height - 0.06) / rows
            x = -width / 2 + (column + 0.5) * wide
            low = z + 0.05 + row * tall
            # The door.
            group.add(
                box(wide - 2 * gap, 0.018, tall - 2 * gap), front, (x, -depth - 0.01, low + gap)
            )
            # Its handle: a bar across, a bar along, or a knob.
            if style == 0:
                group.add(
                    box(min(0.25, wide * 0.5), 0.012, 0.012),
                    steel,
                    (x, -depth - 0.045, low + tall * 0.85),
                )
            elif style == 1:
                group.add(
                    rod(
                        (x + wide * 0.38, -depth - 0.05, low + tall * 0.3),
                        (x + wide * 0.38, -depth - 0.05, low + tall * 0.7),
                        0.007,
                    ),
                    steel,
                )
            else:
                group.add(
                    superquadric((0.03, 0.03, 0.03)),
                    steel,
                    (x + wide * 0.4, -depth - 0.035, low + tall / 2),
                )


def kitchen(kit: Kit) -> Group:
    """Returns a kitchen counter with tap, tiled back wall, hung cupboards and clutter."""
    group = Group()
    # The body with its doors, the top and the back wall.
    width = kit.uniform(1.6, 3.6)
    depth = kit.uniform(0.58, 0.68)
    height = kit.uniform(0.84, 0.94)
    front = kit.palette.new(
        "plain", tile_m=1.0, gloss=0.5, mirror=kit.uniform(0.0, 0.06), vivid=0.6
    )
    top = kit.surface("marble", "speckle", "plain", "wood", tile_m=0.8)
    group.add(box(width, depth - 0.05, height - 0.1), front, (0, -depth / 2, 0.1))
    group.add(box(width, depth - 0.12, 0.1), kit.dark(), (0, -depth / 2 + 0.03, 0))
    _doors(kit, group, (width, depth - 0.03, height - 0.1), 0.08, front)
    group.add(box(width + 0.02, depth + 0.03, 0.04), top, (0, -depth / 2, height - 0.04))
    group.add(
        box(width, 0.012, 0.55),
        kit.surface("tiles", "brick", "plain", tile_m=0.5),
        (0, -0.006, height),
    )
    # Sink and tap.
    x = kit.uniform(-0.3, 0.3) * width
    steel = kit.metal()
    group.add(box(0.5, 0.4, 0.006), steel, (x, -depth / 2, height))
    group.add(box(0.42, 0.32, 0.002), kit.dark(), (x, -depth / 2, height + 0.006))
    angle = np.linspace(0, np.pi, 12)
    arc = np.stack(
        [np.zeros(12), -0.18 - 0.09 * (1 - np.cos(angle)), height + 0.22 + 0.08 * np.sin(angle)],
        axis=1,
    )
    group.add(tube(np.concatenate([[[0, -0.18, height]], arc]) + np.array([x, 0, 0]), 0.012), steel)
    # Things on the counter.
    scatter(
        kit,
        group,
        area=Rectangle((-width * 0.47, -depth * 0.9), (width * 0.47, -0.1), height),
        count=int(kit.rng.integers(4, 18)),
        tallest=0.45,
        things=_KITCHEN_THINGS,
    )
    # Hung cupboards.
    if kit.chance(0.6):
        for side in (-0.25, 0.25):
            group.insert(cupboard(kit, hang=height + kit.uniform(0.5, 0.65)), (side * width, 0, 0))
    return group


def floor_lamp(kit: Kit) -> Group:
    """Returns a tall thin lamp."""
    group = Group()
    metal = kit.metal()
    height = kit.uniform(1.3, 1.8)
    group.add(cylinder(0.14, 0.02), metal, (0, -0.2, 0))
    group.add(cylinder(0.011, height), metal, (0, -0.2, 0))
    radius = kit.uniform(0.12, 0.22)
    shade = kit.palette.new("fabric", (0.85, 0.8, 0.7), glow=kit.uniform(0, 1.5))
    group.add(
        lathe(
            [
                (radius, height - 0.25),
                (radius * 0.6, height),
                (radius * 0.58, height),
                (radius * 0.98, height - 0.25),
            ]
        ),
        shade,
        (0, -0.2, 0),
    )
    return group


def floor_plant(kit: Kit) -> Group:
    """Returns a large pot plant."""
    group = Group()
    group.insert(plant(kit), (0, -0.3, 0), scale=kit.uniform(1.5, 3.5))
    return group


def drawers(kit: Kit) -> Group:
    """Returns a low chest with a television or things on top."""
    group = cupboard(kit)
    if kit.chance(0.4):
        upper = group.bounds()[1]
        group.insert(
            monitor(kit), (0, -0.25, min(float(upper[2]), 0.9)), scale=kit.uniform(1.0, 1.8)
        )
    return group


def railing(kit: Kit) -> Group:
    """Returns a rail with thin bars."""
    group = Group()
    steel = kit.metal() if kit.chance(0.6) else kit.wood()
    width = kit.uniform(0.8, 2.4)
    height = kit.uniform(0.7, 1.1)
    group.add(rod((-width / 2, -0.05, height), (width / 2, -0.05, height), 0.022), steel)
    group.add(rod((-width / 2, -0.05, 0.1), (width / 2, -0.05, 0.1), 0.012), steel)
    for x in np.arange(-width / 2, width / 2 + 0.01, kit.uniform(0.08, 0.16)):
        group.add(cylinder(0.007, height), steel, (float(x), -0.05, 0))
    return group


AGAINST_WALL: tuple[Callable[[Kit], Group], ...] = (
    table, desk, sofa, sofa, bookshelf, bookshelf, cupboard, cupboard, kitchen, kitchen, bed,
    floor_lamp, floor_plant, drawers, drawers, chair, railing, bicycle,
)  # fmt: skip
