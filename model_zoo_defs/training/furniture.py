"""Furniture; each piece stands on z = 0 with its back on y = 0, its front toward -y."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from model_zoo_defs.training.clutter import (
    Kit,
    books,
    bottle,
    bowl,
    carton,
    frame,
    gadget,
    lamp,
    laptop,
    monitor,
    mug,
    papers,
    plant,
    pot,
    scatter,
    vase,
)  # fmt: skip
from model_zoo_defs.training.shapes import (
    Group,
    box,
    cylinder,
    lathe,
    rod,
    superquadric,
    surface,
    torus,
    tube,
)  # fmt: skip

_SHELF_THINGS = (books, carton, vase, gadget, frame, mug, bottle, plant, bowl)
_KITCHEN_THINGS = (pot, pot, bottle, mug, bowl, carton, papers, books, vase)
_TABLE_THINGS = (mug, books, papers, laptop, bowl, bottle, plant, lamp, gadget, carton, vase)


def cushion(
    kit: Kit,
    group: Group,
    size: tuple[float, float, float],
    at: tuple[float, float, float],
    material: int,
    *,
    pitch: float = 0.0,
    yaw: float = 0.0,
) -> None:
    """Adds a padded block whose middle is at `at`."""
    body = superquadric(size, vertical=kit.size(0.25, 0.5), around=kit.size(0.2, 0.4))
    group.add(body, material, at, pitch=pitch, yaw=yaw)


def table(kit: Kit, *, width: float = 0.0) -> Group:
    """Returns a table with legs and things on it."""
    group, wood = Group(), kit.wood() if kit.chance(0.7) else kit.surface("plain", "marble")
    w, d, h = width or kit.size(0.7, 2.0), kit.size(0.5, 0.95), kit.size(0.4, 0.78)
    thick = kit.size(0.015, 0.05)
    legs = kit.metal() if kit.chance(0.3) else wood
    y = -d / 2
    if kit.chance(0.15):
        group.add(cylinder(d * 0.6, thick, sides=30), wood, (0, y, h - thick))
        group.add(cylinder(0.04, h - thick), legs, (0, y, 0))
        group.add(cylinder(d * 0.3, 0.03, top=d * 0.1), legs, (0, y, 0))
    else:
        group.add(box(w, d, thick), wood, (0, y, h - thick))
        t = kit.size(0.03, 0.09)
        for sx in (-1, 1):
            for sy in (-1, 1):
                at = (sx * (w / 2 - t), y + sy * (d / 2 - t), 0)
                leg = box(t, t, h - thick) if kit.chance(0.7) else cylinder(t / 2, h - thick)
                group.add(leg, legs, at)
        if kit.chance(0.5):
            group.add(box(w * 0.9, d * 0.85, 0.08), wood, (0, y, h - thick - 0.08))
    scatter(kit, group, low=(-w * 0.42, -d * 0.9), high=(w * 0.42, -d * 0.1), z=h,
            count=int(kit.rng.integers(0, 9)), tallest=0.45, things=_TABLE_THINGS)  # fmt: skip
    return group


def desk(kit: Kit) -> Group:
    """Returns a writing desk with a screen and clutter."""
    group = table(kit, width=kit.size(1.1, 1.8))
    top = 0.0
    if kit.chance(0.8):
        lower, upper = group.bounds()
        top = 0.74
        group = Group()
        wood = kit.wood()
        w = float(upper[0] - lower[0])
        group.add(box(w, 0.7, 0.03), wood, (0, -0.35, top - 0.03))
        for side in (-1, 1):
            group.add(box(0.03, 0.65, top - 0.03), wood, (side * (w / 2 - 0.02), -0.35, 0))
        group.place(monitor(kit), (kit.size(-0.2, 0.2), -0.2, top), yaw=kit.size(-0.3, 0.3))
        group.add(box(0.42, 0.14, 0.02), kit.dark(), (0, -0.5, top))
        scatter(
            kit,
            group,
            low=(-w * 0.45, -0.62),
            high=(w * 0.45, -0.15),
            z=top,
            count=int(kit.rng.integers(1, 7)),
            tallest=0.4,
        )
    return group


def chair(kit: Kit) -> Group:
    """Returns a chair with legs and an open back."""
    group, wood = Group(), kit.wood() if kit.chance(0.65) else kit.metal()
    seat = kit.surface("fabric", "plain", tile_m=0.3) if kit.chance(0.6) else wood
    w, d, h = kit.size(0.38, 0.5), kit.size(0.38, 0.5), kit.size(0.42, 0.48)
    back, t = kit.size(0.75, 1.1), kit.size(0.02, 0.045)
    y = -d / 2
    if kit.chance(0.5):
        group.add(box(w, d, 0.04), seat, (0, y, h - 0.04))
    else:
        cushion(kit, group, (w, d, 0.08), (0, y, h - 0.03), seat)
    for sx in (-1, 1):
        x = sx * (w / 2 - t / 2)
        group.add(box(t, t, h), wood, (x, -d + t / 2, 0))
        group.add(box(t, t, back), wood, (x, -t / 2, 0))
    style = int(kit.rng.integers(3))
    if style == 0:
        for z in np.linspace(h + 0.1, back - 0.06, int(kit.rng.integers(2, 5))):
            group.add(box(w - t, t * 0.6, 0.045), wood, (0, -t / 2, float(z)))
    elif style == 1:
        for x in np.linspace(-w / 2 + t, w / 2 - t, int(kit.rng.integers(4, 8))):
            group.add(cylinder(0.008, back - h), wood, (float(x), -t / 2, h))
        group.add(box(w, t, 0.06), wood, (0, -t / 2, back - 0.06))
    else:
        group.add(box(w, 0.03, (back - h) * 0.8), seat, (0, -t / 2, h + (back - h) * 0.2))
    return group


def office_chair(kit: Kit) -> Group:
    """Returns a swivel or cantilever chair of bent tube."""
    group, steel, cloth = Group(), kit.metal(), kit.surface("fabric", "plain", tile_m=0.3)
    cushion(kit, group, (0.48, 0.48, 0.1), (0, -0.3, 0.46), cloth)
    cushion(kit, group, (0.46, 0.09, 0.55), (0, -0.06, 0.85), cloth, pitch=-0.12)
    if kit.chance(0.5):
        group.add(cylinder(0.03, 0.42), steel, (0, -0.3, 0.05))
        for angle in np.arange(5) * 1.257:
            tip = (0.3 * np.cos(angle), -0.3 + 0.3 * np.sin(angle), 0.05)
            group.add(rod((0, -0.3, 0.1), tip, 0.018), kit.dark())
    else:
        for side in (-0.23, 0.23):
            s = np.linspace(0, 1, 16)
            path = np.stack(
                [np.full(16, side), -0.05 - 0.5 * np.sin(s * 2.4), 0.02 + 0.72 * s**1.5], axis=1
            )
            group.add(tube(path, 0.014), steel)
            group.add(rod((side, -0.05, 0.02), (side, -0.5, 0.02), 0.014), steel)
    return group


def sofa(kit: Kit) -> Group:
    """Returns a sofa or armchair with cushions."""
    group, cloth = Group(), kit.surface("fabric", "plain", "stripes", "mottled", tile_m=0.4)
    seats = int(kit.rng.integers(1, 4))
    each, d, h = kit.size(0.55, 0.75), kit.size(0.75, 0.95), kit.size(0.38, 0.46)
    w, arm = seats * each, kit.size(0.12, 0.25)
    group.add(box(w + 2 * arm, d, h * 0.6), cloth, (0, -d / 2, 0.06))
    cushion(kit, group, (w + 2 * arm, 0.25, kit.size(0.7, 0.95)), (0, -0.13, 0.45), cloth)
    for side in (-1, 1):
        cushion(kit, group, (arm, d, h * 1.4), (side * (w + arm) / 2, -d / 2, h * 0.75), cloth)
    for index in range(seats):
        x = (index - (seats - 1) / 2) * each
        cushion(kit, group, (each, d * 0.75, 0.18), (x, -d * 0.58, h), cloth)
        if kit.chance(0.6):
            pillow = kit.any_surface()
            s = kit.size(0.35, 0.5)
            cushion(
                kit,
                group,
                (s, 0.16, s),
                (x + kit.size(-0.1, 0.1), -0.36, h + s * 0.55),
                pillow,
                pitch=-0.35,
                yaw=kit.size(-0.3, 0.3),
            )
    return group


def bookshelf(kit: Kit) -> Group:
    """Returns open shelves full of books and things."""
    group, wood = Group(), kit.wood() if kit.chance(0.6) else kit.surface("plain")
    w, d, h = kit.size(0.6, 1.6), kit.size(0.24, 0.4), kit.size(0.8, 2.2)
    t = 0.025
    for side in (-1, 1):
        group.add(box(t, d, h), wood, (side * (w - t) / 2, -d / 2, 0))
    if kit.chance(0.75):
        group.add(box(w, 0.01, h), wood, (0, -0.005, 0))
    shelves = np.linspace(0.06, h - t, max(2, int(h / kit.size(0.28, 0.42))))
    gap = float(shelves[1] - shelves[0])
    covers = [kit.palette.new("poster", tile_m=0.3) for _ in range(3)]
    covers += [kit.palette.new("plain", tile_m=0.3, vivid=0.6) for _ in range(6)]
    for z in shelves:
        group.add(box(w, d, t), wood, (0, -d / 2, float(z)))
        if z < shelves[-1]:
            _fill_shelf(kit, group, w - 2 * t, d, float(z) + t, gap - t, covers)
    return group


def _fill_shelf(
    kit: Kit, group: Group, w: float, d: float, z: float, gap: float, covers: list[int]
) -> None:
    x = -w / 2
    while x < w / 2 - 0.06:
        if kit.chance(0.8):
            wide, tall, deep = (
                kit.size(0.012, 0.06),
                gap * kit.size(0.5, 0.97),
                d * kit.size(0.5, 0.9),
            )
            lean = kit.size(-0.25, 0.0) if kit.chance(0.06) else 0.0
            group.add(
                box(wide * 0.97, deep, tall),
                int(kit.rng.choice(covers)),
                (x + wide / 2, -d * kit.size(0.93, 1.0) + deep / 2, z),
                roll=lean,
            )
            x += wide
        else:
            wide = kit.size(0.08, 0.3)
            end = min(x + wide, w / 2)
            if kit.chance(0.7):
                scatter(
                    kit,
                    group,
                    low=((x + end) / 2, -d * 0.7),
                    high=((x + end) / 2 + 0.01, -d * 0.4),
                    z=z,
                    count=1,
                    tallest=gap * 0.9,
                    things=_SHELF_THINGS,
                )
            x += wide


def cupboard(kit: Kit, *, hang: float = 0.0) -> Group:
    """Returns a closed cupboard with door panels, joints and handles."""
    group, front = (
        Group(),
        kit.wood()
        if kit.chance(0.5)
        else kit.palette.new("plain", tile_m=1.0, gloss=0.4, mirror=kit.size(0, 0.05), vivid=0.4),
    )
    w, d, h = kit.size(0.5, 1.8), kit.size(0.35, 0.65), kit.size(0.5, 2.2)
    if hang:
        d, h = 0.35, kit.size(0.5, 0.8)
    group.add(box(w, d, h), front, (0, -d / 2, hang))
    _doors(kit, group, w, d, h, hang, front)
    if h < 1.3 and not hang:
        scatter(
            kit,
            group,
            low=(-w * 0.42, -d * 0.85),
            high=(w * 0.42, -d * 0.2),
            z=h,
            count=int(kit.rng.integers(0, 7)),
            tallest=0.7,
        )
    return group


def _doors(kit: Kit, group: Group, w: float, d: float, h: float, z: float, front: int) -> None:
    steel = kit.metal()
    columns, rows = (
        max(1, round(w / kit.size(0.4, 0.6))),
        int(kit.rng.integers(1, 5)) if h > 0.6 else 1,
    )
    style, gap = int(kit.rng.integers(3)), 0.006
    for column in range(columns):
        for row in range(rows):
            wide, tall = w / columns, (h - 0.06) / rows
            x, low = -w / 2 + (column + 0.5) * wide, z + 0.05 + row * tall
            group.add(box(wide - 2 * gap, 0.018, tall - 2 * gap), front, (x, -d - 0.01, low + gap))
            if style == 0:
                group.add(
                    box(min(0.25, wide * 0.5), 0.012, 0.012),
                    steel,
                    (x, -d - 0.045, low + tall * 0.85),
                )
            elif style == 1:
                group.add(
                    rod(
                        (x + wide * 0.38, -d - 0.05, low + tall * 0.3),
                        (x + wide * 0.38, -d - 0.05, low + tall * 0.7),
                        0.007,
                    ),
                    steel,
                )
            else:
                group.add(
                    superquadric((0.03, 0.03, 0.03)),
                    steel,
                    (x + wide * 0.4, -d - 0.035, low + tall / 2),
                )


def kitchen(kit: Kit) -> Group:
    """Returns a kitchen counter with tap, tiled back wall, hung cupboards and clutter."""
    group = Group()
    w, d, h = kit.size(1.6, 3.6), kit.size(0.58, 0.68), kit.size(0.84, 0.94)
    front = kit.palette.new("plain", tile_m=1.0, gloss=0.5, mirror=kit.size(0.0, 0.06), vivid=0.6)
    top = kit.surface("marble", "speckle", "plain", "wood", tile_m=0.8)
    group.add(box(w, d - 0.05, h - 0.1), front, (0, -d / 2, 0.1))
    group.add(box(w, d - 0.12, 0.1), kit.dark(), (0, -d / 2 + 0.03, 0))
    _doors(kit, group, w, d - 0.03, h - 0.1, 0.08, front)
    group.add(box(w + 0.02, d + 0.03, 0.04), top, (0, -d / 2, h - 0.04))
    group.add(
        box(w, 0.012, 0.55), kit.surface("tiles", "brick", "plain", tile_m=0.5), (0, -0.006, h)
    )
    x, steel = kit.size(-0.3, 0.3) * w, kit.metal()
    group.add(box(0.5, 0.4, 0.006), steel, (x, -d / 2, h))
    group.add(box(0.42, 0.32, 0.002), kit.dark(), (x, -d / 2, h + 0.006))
    a = np.linspace(0, np.pi, 12)
    arc = np.stack(
        [np.zeros(12), -0.18 - 0.09 * (1 - np.cos(a)), h + 0.22 + 0.08 * np.sin(a)], axis=1
    )
    group.add(tube(np.concatenate([[[0, -0.18, h]], arc]) + [x, 0, 0], 0.012), steel)
    scatter(
        kit,
        group,
        low=(-w * 0.47, -d * 0.9),
        high=(w * 0.47, -0.1),
        z=h,
        count=int(kit.rng.integers(4, 18)),
        tallest=0.45,
        things=_KITCHEN_THINGS,
    )
    if kit.chance(0.6):
        for side in (-0.25, 0.25):
            group.place(cupboard(kit, hang=h + kit.size(0.5, 0.65)), (side * w, 0, 0))
    return group


def bed(kit: Kit) -> Group:
    """Returns a bed with blanket and pillows."""
    group, wood = Group(), kit.wood()
    w, d = kit.size(0.9, 1.9), kit.size(1.9, 2.1)
    group.add(box(w, d, 0.3), wood, (0, -d / 2, 0))
    group.add(box(w, 0.06, kit.size(0.6, 1.1)), wood, (0, -0.03, 0))
    cushion(
        kit, group, (w, d, 0.3), (0, -d / 2, 0.38), kit.palette.new("fabric", (0.85, 0.85, 0.85))
    )
    x, y = np.meshgrid(np.linspace(-w * 0.55, w * 0.55, 30), np.linspace(-d * 1.01, -d * 0.35, 24))
    z = (
        0.55
        + 0.025 * np.sin(x * kit.size(4, 12) + 3 * np.sin(y * 4))
        + 0.015 * np.sin(y * 13 + x * 5)
    )
    z -= np.clip(np.abs(x) - w * 0.48, 0, None) * 4
    group.add(surface(np.stack([x, y, z], axis=2)), kit.any_surface())
    for side in (-0.25, 0.25) if w > 1.3 else (0.0,):
        cushion(kit, group, (0.6, 0.4, 0.18), (side * w, -0.35, 0.58), kit.any_surface(), pitch=0.2)
    return group


def floor_lamp(kit: Kit) -> Group:
    """Returns a tall thin lamp."""
    group, metal, h = Group(), kit.metal(), kit.size(1.3, 1.8)
    group.add(cylinder(0.14, 0.02), metal, (0, -0.2, 0))
    group.add(cylinder(0.011, h), metal, (0, -0.2, 0))
    r = kit.size(0.12, 0.22)
    shade = kit.palette.new("fabric", (0.85, 0.8, 0.7), glow=kit.size(0, 1.5))
    group.add(
        lathe([(r, h - 0.25), (r * 0.6, h), (r * 0.58, h), (r * 0.98, h - 0.25)]),
        shade,
        (0, -0.2, 0),
    )
    return group


def floor_plant(kit: Kit) -> Group:
    """Returns a large pot plant."""
    group = Group()
    group.place(plant(kit), (0, -0.3, 0), scale=kit.size(1.5, 3.5))
    return group


def drawers(kit: Kit) -> Group:
    """Returns a low chest with a television or things on top."""
    group = cupboard(kit)
    if kit.chance(0.4):
        upper = group.bounds()[1]
        group.place(monitor(kit), (0, -0.25, min(float(upper[2]), 0.9)), scale=kit.size(1.0, 1.8))
    return group


def person(kit: Kit) -> Group:
    """Returns a standing or sitting figure of rounded bodies, about the origin."""
    group, cloth, legs = Group(), kit.any_surface(), kit.surface("plain", "fabric", vivid=0.2)
    skin = kit.palette.new("plain", np.array([0.85, 0.65, 0.52]) * kit.size(0.45, 1.1), gloss=0.1)
    h = kit.size(1.5, 1.9)
    stride = kit.size(0, 0.3)
    for side in (-1, 1):
        x, foot = side * 0.09, side * stride
        group.add(
            tube(
                [(x, 0, h * 0.5), (x * 1.1, -0.03 + foot * 0.4, h * 0.27), (x * 1.1, foot, 0.05)],
                0.07,
            ),
            legs,
        )
        group.add(
            superquadric((0.1, 0.27, 0.1), vertical=0.7), kit.dark(), (x * 1.1, foot - 0.06, 0.05)
        )
        swing = -side * stride * 0.8
        group.add(
            tube(
                [
                    (side * 0.2, 0, h * 0.8),
                    (side * 0.26, swing * 0.4, h * 0.64),
                    (side * 0.24, swing - 0.08, h * 0.5),
                ],
                0.045,
            ),
            cloth,
        )
        group.add(superquadric((0.08, 0.08, 0.12)), skin, (side * 0.24, swing - 0.1, h * 0.47))
    group.add(
        superquadric((0.4, 0.25, h * 0.38), vertical=0.6, around=0.8), cloth, (0, 0, h * 0.66)
    )
    group.add(cylinder(0.05, 0.1), skin, (0, 0, h * 0.83))
    group.add(superquadric((0.17, 0.2, 0.25)), skin, (0, -0.01, h * 0.93))
    group.add(
        superquadric((0.19, 0.2, 0.18)),
        kit.palette.new("foliage", (0.2, 0.13, 0.08)),
        (0, 0.02, h * 0.955),
    )
    return group


def railing(kit: Kit) -> Group:
    """Returns a rail with thin bars."""
    group, steel = Group(), kit.metal() if kit.chance(0.6) else kit.wood()
    w, h = kit.size(0.8, 2.4), kit.size(0.7, 1.1)
    group.add(rod((-w / 2, -0.05, h), (w / 2, -0.05, h), 0.022), steel)
    group.add(rod((-w / 2, -0.05, 0.1), (w / 2, -0.05, 0.1), 0.012), steel)
    for x in np.arange(-w / 2, w / 2 + 0.01, kit.size(0.08, 0.16)):
        group.add(cylinder(0.007, h), steel, (float(x), -0.05, 0))
    return group


def bicycle(kit: Kit) -> Group:
    """Returns a bicycle along x."""
    group, paint, tyre = Group(), kit.palette.new("plain", vivid=0.9, gloss=0.6), kit.dark()
    for x in (-0.52, 0.52):
        group.add(torus(0.33, 0.018), tyre, (x, -0.2, 0.35), pitch=np.pi / 2)
        for angle in np.arange(6) * np.pi / 6:
            c, s = 0.32 * np.cos(angle), 0.32 * np.sin(angle)
            group.add(rod((x - c, -0.2, 0.35 - s), (x + c, -0.2, 0.35 + s), 0.003, sides=4), tyre)
    joints = {
        "a": (-0.52, 0.35),
        "b": (-0.05, 0.3),
        "c": (-0.2, 0.82),
        "d": (0.36, 0.8),
        "e": (0.52, 0.35),
    }
    for ends in ("ab", "ac", "bc", "bd", "cd", "de"):
        (x0, z0), (x1, z1) = joints[ends[0]], joints[ends[1]]
        group.add(rod((x0, -0.2, z0), (x1, -0.2, z1), 0.017), paint)
    group.add(rod((0.34, -0.45, 1.0), (0.34, 0.05, 1.0), 0.013), tyre)
    group.add(rod((0.36, -0.2, 0.8), (0.34, -0.2, 1.0), 0.013), tyre)
    group.add(superquadric((0.26, 0.15, 0.07)), tyre, (-0.24, -0.2, 0.92))
    return group


AGAINST_WALL: tuple[Callable[[Kit], Group], ...] = (
    table, desk, sofa, sofa, bookshelf, bookshelf, cupboard, cupboard, kitchen, kitchen, bed,
    floor_lamp, floor_plant, drawers, drawers, chair, railing, bicycle,
)  # fmt: skip
