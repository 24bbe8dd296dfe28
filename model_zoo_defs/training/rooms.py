"""Rooms: shell with openings, furniture along the walls and in the middle, lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model_zoo_defs.training import clutter, furniture
from model_zoo_defs.training.clutter import Kit
from model_zoo_defs.training.shapes import Group, Mesh, box, cylinder, quads, rod, surface
from model_zoo_defs.training.world import Light, Sky

Hole = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Says where a scene's things are, for choosing cameras: targets and the free box."""

    group: Group
    lights: tuple[Light, ...]
    sky: Sky
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    targets: tuple[tuple[float, float, float], ...]


def wall(length: float, height: float, holes: Sequence[Hole], *, rise: float = 0.0) -> Mesh:
    """Returns an upright face from x = 0 to length at y = 0, with rectangular holes left out.

    rise lifts the upper edge at x = length against x = 0.
    """
    us = sorted({0.0, length, *(u for hole in holes for u in hole[::2])})
    vs = sorted({0.0, *(v for hole in holes for v in hole[1::2])})
    corners = []
    for u0, u1 in zip(us[:-1], us[1:], strict=True):
        tops = [height + rise * u / length for u in (u0, u1)]
        for index, v0 in enumerate(vs):
            last = index == len(vs) - 1
            v1 = vs[index + 1] if not last else 0.0
            middle = ((u0 + u1) / 2, v0 + 0.01)
            if any(h[0] < middle[0] < h[2] and h[1] < middle[1] < h[3] for h in holes):
                continue
            left, right = (tops[0], tops[1]) if last else (v1, v1)
            corners.append([(u0, 0, v0), (u1, 0, v0), (u1, 0, right), (u0, 0, left)])
    points = np.array(corners, np.float32)
    return quads(points, points[..., [0, 2]])


def _opening(kit: Kit, side: Group, hole: Hole, paint: int) -> None:
    """Adds the reveal, the frame and what closes a window or door."""
    u0, v0, u1, v1 = hole
    deep, x, w, h = kit.size(0.08, 0.3), (u0 + u1) / 2, u1 - u0, v1 - v0
    for at, size in (
        ((u0, deep / 2, v0), (0.004, deep, h)), ((u1, deep / 2, v0), (0.004, deep, h)),
        ((x, deep / 2, v0), (w, deep, 0.004)), ((x, deep / 2, v1), (w, deep, 0.004)),
    ):  # fmt: skip
        side.add(box(*size), paint, at)
    trim = kit.wood() if kit.chance(0.4) else kit.palette.new("plain", (0.9, 0.9, 0.88), gloss=0.3)
    t = kit.size(0.04, 0.09)
    for at, size in (
        ((u0 + t / 2, deep, v0), (t, 0.05, h)), ((u1 - t / 2, deep, v0), (t, 0.05, h)),
        ((x, deep, v1 - t), (w, 0.05, t)), ((x, deep, v0), (w, 0.05, t)),
    ):  # fmt: skip
        side.add(box(*size), trim, at)
    if v0 < 0.05:
        _hallway(kit, side, (u0 + u1) / 2, deep, paint)
        if kit.chance(0.75):
            door = kit.wood() if kit.chance(0.5) else kit.surface("plain", vivid=0.2)
            angle = kit.size(-1.7, -0.2) if kit.chance(0.4) else 0.0
            leaf = Group()
            leaf.add(box(w - 2 * t, 0.04, h - t), door, (w / 2 - t, 0, 0))
            for z in (0.15, h * 0.55):
                leaf.add(box((w - 2 * t) * 0.7, 0.055, h * 0.35), door, (w / 2 - t, 0, z))
            leaf.add(rod((w * 0.8, -0.06, 1.02), (w * 0.92, -0.06, 1.02), 0.01), kit.metal())
            side.place(leaf, (u0 + t, deep * 0.6, 0), yaw=angle)
        return
    for share in np.linspace(0, 1, int(kit.rng.integers(1, 4)) + 1)[1:-1]:
        side.add(box(0.05, 0.05, h), trim, (u0 + w * float(share), deep, v0))
    if kit.chance(0.4):
        side.add(box(w, 0.04, 0.04), trim, (x, deep, v0 + h * kit.size(0.4, 0.7)))
    side.add(box(w + 0.1, deep + 0.1, 0.03), trim, (x, deep / 2 - 0.1, v0 - 0.03))
    if kit.chance(0.5):
        _curtain(kit, side, u0, u1, v1)
    elif kit.chance(0.4):
        slat = kit.surface("plain", vivid=0.15)
        for z in np.arange(v0 + h * kit.size(0, 0.6), v1, 0.06):
            side.add(box(w - 0.02, 0.04, 0.002), slat, (x, deep * 0.5, float(z)), pitch=0.6)
    scatter_z = v0
    if kit.chance(0.4):
        clutter.scatter(
            kit,
            side,
            low=(u0 + 0.1, -0.02),
            high=(u1 - 0.1, 0.04),
            z=scatter_z,
            count=3,
            tallest=0.4,
        )


def _hallway(kit: Kit, side: Group, x: float, deep: float, paint: int) -> None:
    """Adds the walls and the floor that an open door shows."""
    left, right, far, top = x - kit.size(0.6, 2), x + kit.size(0.6, 2), deep + kit.size(0.9, 3), 2.6
    low = deep + 0.03
    faces = [
        [(left, far, 0), (right, far, 0), (right, far, top), (left, far, top)],
        [(left, low, 0), (left, far, 0), (left, far, top), (left, low, top)],
        [(right, low, 0), (right, far, 0), (right, far, top), (right, low, top)],
        [(left, low, top), (right, low, top), (right, far, top), (left, far, top)],
    ]
    side.add(quads(faces), paint if kit.chance(0.5) else kit.surface("plaster", "plain", "stripes"))
    ground = [(left, low, 0.001), (right, low, 0.001), (right, far, 0.001), (left, far, 0.001)]
    side.add(quads([ground]), kit.surface("planks", "carpet", "tiles", vivid=0.1))
    if kit.chance(0.5):
        item = furniture.drawers(kit) if kit.chance(0.5) else furniture.chair(kit)
        side.place(item, (kit.size(left, right), far, 0))


def _curtain(kit: Kit, side: Group, u0: float, u1: float, top: float) -> None:
    cloth = kit.surface("fabric", "plain", "stripes", tile_m=0.8, vivid=0.3)
    bottom = 0.03 if kit.chance(0.6) else top * 0.3
    side.add(rod((u0 - 0.3, -0.08, top + 0.1), (u1 + 0.3, -0.08, top + 0.1), 0.015), kit.metal())
    for start, end in ((u0 - 0.25, u0 + kit.size(0.1, 0.5)), (u1 - kit.size(0.1, 0.5), u1 + 0.25)):
        s, z = np.meshgrid(np.linspace(0, 1, 60), np.linspace(bottom, top + 0.1, 6))
        folds, deep = kit.size(4, 9), kit.size(0.02, 0.05)
        y = -0.08 + deep * np.sin(2 * np.pi * folds * s + z * 0.4) * (1.2 - 0.2 * z)
        side.add(surface(np.stack([start + (end - start) * s, y, z], axis=2)), cloth)


def _decorate(kit: Kit, side: Group, length: float, height: float, holes: Sequence[Hole]) -> None:
    """Adds pictures, switches, radiators and shelves where the wall is free."""
    for _ in range(int(kit.rng.integers(0, 6))):
        u = kit.size(0.3, max(0.4, length - 0.3))
        if any(hole[0] - 0.5 < u < hole[2] + 0.5 for hole in holes):
            continue
        choice = kit.rng.random()
        z = kit.size(1.1, max(1.2, height - 0.7))
        w, h = kit.size(0.2, 1.0), kit.size(0.2, 0.8)
        if choice < 0.6:
            thick = kit.size(0.002, 0.04)
            if thick > 0.01:
                edge = kit.wood() if kit.chance(0.5) else kit.dark()
                side.add(box(w + 0.06, thick, h + 0.06), edge, (u, -thick / 2, z - 0.03))
            picture = kit.palette.new("poster", tile_m=h, whole=True, mirror=kit.size(0, 0.05))
            side.add(box(w, 0.004, h, fit=h), picture, (u, -thick - 0.002, z))
        elif choice < 0.75:
            side.add(box(w + 0.3, 0.2, 0.025), kit.wood(), (u, -0.1, z))
            clutter.scatter(
                kit,
                side,
                low=(u - w / 2, -0.15),
                high=(u + w / 2, -0.06),
                z=z + 0.025,
                count=4,
                tallest=0.3,
            )
        elif choice < 0.9:
            white = kit.surface("plain", vivid=0.05)
            for x in np.arange(-0.4, 0.41, 0.05):
                side.add(box(0.035, 0.08, 0.55), white, (u + float(x), -0.09, 0.12))
        else:
            side.add(box(0.08, 0.012, 0.08), kit.palette.new("plain", (0.9,) * 3), (u, -0.006, 1.1))


def room(kit: Kit) -> Plan:
    """Returns a furnished room with its free box and things worth looking at."""
    rng = kit.rng
    corridor = kit.chance(0.12)
    w = kit.size(1.4, 2.2) if corridor else kit.size(2.2, 6.5)
    d = kit.size(4, 9) if corridor else kit.size(2.2, 7.5)
    h = kit.size(2.2, 3.1)
    rise = kit.size(-0.9, 1.5) if kit.chance(0.2) else 0.0
    group, targets = Group(), []
    paint = kit.surface(
        "plaster",
        "plaster",
        "plain",
        "plain",
        "stripes",
        "brick",
        "mottled",
        "spots",
        tile_m=kit.size(1, 3),
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
        tile_m=kit.size(0.6, 2),
        vivid=0.2,
    )
    m = kit.size(0, 0.12) if kit.chance(0.4) else 0.0
    if m:
        floor = kit.palette.new(
            "planks" if kit.chance(0.5) else "tiles", tile_m=kit.size(0.6, 2), mirror=m, vivid=0.1
        )
    ceiling = kit.surface("plain", "plaster", "tiles", vivid=0.05, tile_m=2)
    group.add(quads([[(0, 0, 0), (w, 0, 0), (w, d, 0), (0, d, 0)]]), floor)
    group.add(quads([[(0, 0, h), (w, 0, h + rise), (w, d, h + rise), (0, d, h)]]), ceiling)
    sides = (((0.0, d), 0.0, w, h, rise), ((w, d), -np.pi / 2, d, h + rise, 0.0),
             ((w, 0.0), np.pi, w, h + rise, -rise), ((0.0, 0.0), np.pi / 2, d, h, 0.0))  # fmt: skip
    for start, yaw, length, tall, lift in sides:
        own = paint if kit.chance(0.8) else kit.surface("plaster", "plain", "brick", tile_m=1.5)
        side = Group()
        holes = _holes(kit, length, min(tall, tall + lift))
        side.add(wall(length, tall, holes, rise=lift), own)
        for hole in holes:
            _opening(kit, side, hole, own)
        if kit.chance(0.7):
            skirting = (
                kit.palette.new("plain", (0.88, 0.87, 0.85)) if kit.chance(0.6) else kit.wood()
            )
            side.add(box(length, 0.03, kit.size(0.05, 0.14)), skirting, (length / 2, -0.015, 0))
        _decorate(kit, side, length, min(tall, tall + lift), holes)
        _line_up(kit, side, length, min(w, d), holes, corridor)
        group.place(side, (*start, 0), yaw=yaw)
    if not corridor:
        _middle(kit, group, w, d)
    if kit.chance(0.3):
        thing = (
            box(0.35, 0.35, h + max(rise, 0))
            if kit.chance(0.5)
            else cylinder(0.18, h + max(rise, 0))
        )
        group.add(thing, paint, (kit.size(0.3, 0.7) * w, kit.size(0.3, 0.7) * d, 0))
    clutter.scatter(
        kit, group, low=(0.4, 0.4), high=(w - 0.4, d - 0.4), z=0.0, count=int(rng.integers(0, 10))
    )
    _outside(kit, group, w, d)
    for _ in range(16):
        targets.append((kit.size(0.1, 0.9) * w, kit.size(0.1, 0.9) * d, kit.size(0.1, 1.4)))
    lights = _lights(kit, w, d, h, group)
    return Plan(
        group=group, lights=lights, sky=_indoor_sky(kit),
        low=(0.3, 0.3, 0.5), high=(w - 0.3, d - 0.3, min(1.9, h - 0.3)), targets=tuple(targets),
    )  # fmt: skip


def _holes(kit: Kit, length: float, height: float) -> list[Hole]:
    holes: list[Hole] = []
    u = kit.size(0.2, 0.8)
    while u < length - 1.0:
        chance = kit.rng.random()
        w = kit.size(0.7, min(2.0, length - u - 0.2))
        if chance < 0.22:
            holes.append((u, kit.size(0.5, 1.0), u + w, min(height - 0.15, kit.size(1.7, 2.4))))
        elif chance < 0.4:
            w = min(w, kit.size(0.75, 1.0))
            holes.append((u, 0.0, u + w, min(height - 0.1, kit.size(1.95, 2.15))))
        u += w + kit.size(0.3, 1.5)
    return holes


def _line_up(
    kit: Kit, side: Group, length: float, across: float, holes: Sequence[Hole], corridor: bool
) -> None:
    """Places furniture with its back to the wall, keeping doors free."""
    u = kit.size(0.0, 0.8)
    tries = 0
    while u < length - 0.4 and tries < 12:
        tries += 1
        if kit.chance(0.7 if corridor else 0.2):
            u += kit.size(0.3, 1.0)
            continue
        item = furniture.AGAINST_WALL[int(kit.rng.integers(len(furniture.AGAINST_WALL)))](kit)
        lower, upper = item.bounds()
        wide, deep = float(upper[0] - lower[0]), float(-lower[1])
        blocked = any(
            hole[1] == 0 and hole[0] - 0.1 < u + wide and u < hole[2] + 0.1 for hole in holes
        )
        if u + wide > length or deep > 0.45 * across or blocked:
            u += 0.15
            continue
        side.place(
            item, (u - float(lower[0]), -0.03 - kit.size(0, 0.05), 0), yaw=kit.size(-0.06, 0.06)
        )
        u += wide + (kit.size(0.0, 0.1) if kit.chance(0.5) else kit.size(0.2, 0.9))


def _middle(kit: Kit, group: Group, w: float, d: float) -> None:
    """Places a table with chairs, a rug, single chairs, people and hanging lamps."""
    x, y, yaw = kit.size(0.35, 0.65) * w, kit.size(0.35, 0.65) * d, kit.size(0, 6.3)
    if kit.chance(0.5):
        rug = box(kit.size(1, 2.4), kit.size(0.8, 1.8), 0.008, fit=0.0)
        group.add(
            rug,
            kit.surface("carpet", "fabric", "poster", "stripes", "checks", tile_m=1.5),
            (x, y, 0),
            yaw=yaw,
        )
    if min(w, d) > 2.8 and kit.chance(0.75):
        ensemble = Group()
        item = furniture.table(kit) if kit.chance(0.7) else furniture.desk(kit)
        lower, upper = item.bounds()
        ensemble.place(item, (0, -float(lower[1]) / 2, 0))
        seat = furniture.chair(kit) if kit.chance(0.75) else furniture.office_chair(kit)
        for side in (-1, 1):
            for share in np.linspace(-0.3, 0.3, int(kit.rng.integers(1, 4))):
                if kit.chance(0.75):
                    at = (
                        float(share * (upper[0] - lower[0])),
                        side * (-float(lower[1]) / 2 + kit.size(0.1, 0.5)),
                        0,
                    )
                    ensemble.place(seat, at, yaw=(0.0 if side > 0 else np.pi) + kit.size(-0.5, 0.5))
        group.place(ensemble, (x, y, 0), yaw=yaw)
    for _ in range(int(kit.rng.integers(0, 4))):
        makers = (
            furniture.chair,
            furniture.office_chair,
            furniture.floor_plant,
            furniture.sofa,
            furniture.floor_lamp,
            furniture.drawers,
            furniture.railing,
        )
        item = makers[int(kit.rng.integers(len(makers)))](kit)
        group.place(item, (kit.size(0.2, 0.8) * w, kit.size(0.2, 0.8) * d, 0), yaw=kit.size(0, 6.3))
    if kit.chance(0.3):
        group.place(
            furniture.person(kit),
            (kit.size(0.2, 0.8) * w, kit.size(0.2, 0.8) * d, 0),
            yaw=kit.size(0, 6.3),
        )
    if kit.chance(0.4):
        shade, z = kit.palette.new("plain", glow=kit.size(0, 2), vivid=0.4), kit.size(1.5, 2.0)
        group.add(rod((x, y, z), (x, y, 2.9), 0.004, sides=5), kit.dark())
        group.add(
            cylinder(kit.size(0.1, 0.25), kit.size(0.12, 0.3), top=kit.size(0.03, 0.2)),
            shade,
            (x, y, z),
        )


def _outside(kit: Kit, group: Group, w: float, d: float) -> None:
    """Adds what windows show: ground, and at times a wall, a hedge or boxes."""
    ground = kit.surface("paving", "foliage", "speckle", tile_m=3, vivid=0.2)
    group.add(box(80, 80, 0.1), ground, (w / 2, d / 2, -kit.size(0.3, 4)))
    for _ in range(int(kit.rng.integers(0, 6))):
        angle, far = kit.size(0, 6.3), kit.size(4, 25) + max(w, d)
        block = box(kit.size(1, 12), kit.size(1, 8), kit.size(1, 9))
        material = kit.surface("brick", "plaster", "foliage", tile_m=2, vivid=0.2)
        group.add(
            block,
            material,
            (w / 2 + far * np.cos(angle), d / 2 + far * np.sin(angle), -2),
            yaw=kit.size(0, 6.3),
        )


def _lights(kit: Kit, w: float, d: float, h: float, group: Group) -> tuple[Light, ...]:
    lights = []
    for _ in range(int(kit.rng.integers(1, 4))):
        warm = kit.size(0.65, 1.0)
        power = kit.size(0.5, 3.0)
        place = (kit.size(0.15, 0.85) * w, kit.size(0.15, 0.85) * d, kit.size(1.7, h - 0.1))
        colour = (power, power * (0.3 + 0.7 * warm), power * warm**2)
        lights.append(Light(place=place, colour=colour, radius=kit.size(0.05, 0.5)))
    if kit.chance(0.5):
        angle, power = kit.size(0, 6.3), kit.size(2, 9)
        place = (np.cos(angle), np.sin(angle), kit.size(0.3, 1.2))
        lights.append(
            Light(place=place, colour=(power, power * 0.93, power * 0.8), radius=0.03, sun=True)
        )
    return tuple(lights)


def _indoor_sky(kit: Kit) -> Sky:
    bright, level = kit.size(1, 5), kit.size(0.15, 0.6)
    up = tuple(float(v) for v in level * kit.rng.uniform(0.85, 1.1, 3))
    down = tuple(
        float(v) for v in level * kit.rng.uniform(0.35, 1.0) * kit.rng.uniform(0.85, 1.1, 3)
    )
    return Sky(
        zenith=(bright * 0.5, bright * 0.7, bright), horizon=(bright * 0.9, bright * 0.95, bright),
        clouds=kit.size(0, 1), ambient_up=(up[0], up[1], up[2]), ambient_down=(down[0], down[1], down[2]),
        haze_m=0.0, occlusion_m=kit.size(0.4, 1.5),
    )  # fmt: skip
