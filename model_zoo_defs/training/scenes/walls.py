"""Walls of rooms: openings, decoration and the hallway behind open doors."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from model_zoo_defs.training.rendering.shapes import Group, Mesh, box, quads, rod, surface
from model_zoo_defs.training.scenes import clutter, furniture, seating
from model_zoo_defs.training.scenes.kit import Kit

Hole = tuple[float, float, float, float]


def wall(length: float, height: float, holes: Sequence[Hole], *, rise: float = 0.0) -> Mesh:
    """Returns an upright face from x = 0 to length at y = 0, with rectangular holes left out.

    rise lifts the upper edge at x = length against x = 0.
    """
    us = sorted({0.0, length, *(u for hole in holes for u in hole[::2])})
    vs = sorted({0.0, *(v for hole in holes for v in hole[1::2])})
    corners = []
    for u0, u1 in pairwise(us):
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


def opening(kit: Kit, side: Group, hole: Hole, paint: int) -> None:
    """Adds the reveal, the frame and what closes a window or door."""
    u0, v0, u1, v1 = hole
    # Reveals around the hole.
    deep = kit.uniform(0.08, 0.3)
    x = (u0 + u1) / 2
    width = u1 - u0
    height = v1 - v0
    for at, size in (
        ((u0, deep / 2, v0), (0.004, deep, height)), ((u1, deep / 2, v0), (0.004, deep, height)),
        ((x, deep / 2, v0), (width, deep, 0.004)), ((x, deep / 2, v1), (width, deep, 0.004)),
    ):  # fmt: skip
        side.add(box(*size), paint, at)
    # The frame.
    trim = kit.wood() if kit.chance(0.4) else kit.palette.new("plain", (0.9, 0.9, 0.88), gloss=0.3)
    thickness = kit.uniform(0.04, 0.09)
    for at, size in (
        ((u0 + thickness / 2, deep, v0), (thickness, 0.05, height)),
        ((u1 - thickness / 2, deep, v0), (thickness, 0.05, height)),
        ((x, deep, v1 - thickness), (width, 0.05, thickness)),
        ((x, deep, v0), (width, 0.05, thickness)),
    ):
        side.add(box(*size), trim, at)
    # A door: what is behind it, and a leaf, open or closed.
    if v0 < 0.05:
        _hallway(kit, side, (u0 + u1) / 2, deep, paint)
        if kit.chance(0.75):
            door = kit.wood() if kit.chance(0.5) else kit.surface("plain", vivid=0.2)
            angle = kit.uniform(-1.7, -0.2) if kit.chance(0.4) else 0.0
            leaf = Group()
            leaf.add(
                box(width - 2 * thickness, 0.04, height - thickness),
                door,
                (width / 2 - thickness, 0, 0),
            )
            for z in (0.15, height * 0.55):
                leaf.add(
                    box((width - 2 * thickness) * 0.7, 0.055, height * 0.35),
                    door,
                    (width / 2 - thickness, 0, z),
                )
            leaf.add(
                rod((width * 0.8, -0.06, 1.02), (width * 0.92, -0.06, 1.02), 0.01), kit.metal()
            )
            side.insert(leaf, (u0 + thickness, deep * 0.6, 0), yaw=angle)
        return
    # A window: bars and sill.
    for along in np.linspace(0, 1, int(kit.rng.integers(1, 4)) + 1)[1:-1]:
        side.add(box(0.05, 0.05, height), trim, (u0 + width * float(along), deep, v0))
    if kit.chance(0.4):
        side.add(box(width, 0.04, 0.04), trim, (x, deep, v0 + height * kit.uniform(0.4, 0.7)))
    side.add(box(width + 0.1, deep + 0.1, 0.03), trim, (x, deep / 2 - 0.1, v0 - 0.03))
    # Curtains, or a blind.
    if kit.chance(0.5):
        _curtain(kit, side, u0, u1, v1)
    elif kit.chance(0.4):
        slat = kit.surface("plain", vivid=0.15)
        for z in np.arange(v0 + height * kit.uniform(0, 0.6), v1, 0.06):
            side.add(box(width - 0.02, 0.04, 0.002), slat, (x, deep * 0.5, float(z)), pitch=0.6)
    # Things on the sill.
    scatter_z = v0
    if kit.chance(0.4):
        clutter.scatter(
            kit,
            side,
            area=clutter.Rectangle((u0 + 0.1, -0.02), (u1 - 0.1, 0.04), scatter_z),
            count=3,
            tallest=0.4,
        )


def _hallway(kit: Kit, side: Group, x: float, deep: float, paint: int) -> None:
    """Adds the walls and the floor that an open door shows."""
    left = x - kit.uniform(0.6, 2)
    right = x + kit.uniform(0.6, 2)
    far = deep + kit.uniform(0.9, 3)
    top = 2.6
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
        item = furniture.drawers(kit) if kit.chance(0.5) else seating.chair(kit)
        side.insert(item, (kit.uniform(left, right), far, 0))


def _curtain(kit: Kit, side: Group, u0: float, u1: float, top: float) -> None:
    """Adds a rod and two folded curtains beside a window from u0 to u1, up to `top`."""
    cloth = kit.surface("fabric", "plain", "stripes", tile_m=0.8, vivid=0.3)
    bottom = 0.03 if kit.chance(0.6) else top * 0.3
    side.add(rod((u0 - 0.3, -0.08, top + 0.1), (u1 + 0.3, -0.08, top + 0.1), 0.015), kit.metal())
    for start, end in (
        (u0 - 0.25, u0 + kit.uniform(0.1, 0.5)),
        (u1 - kit.uniform(0.1, 0.5), u1 + 0.25),
    ):
        s, z = np.meshgrid(np.linspace(0, 1, 60), np.linspace(bottom, top + 0.1, 6))
        folds = kit.uniform(4, 9)
        deep = kit.uniform(0.02, 0.05)
        y = -0.08 + deep * np.sin(2 * np.pi * folds * s + z * 0.4) * (1.2 - 0.2 * z)
        side.add(surface(np.stack([start + (end - start) * s, y, z], axis=2)), cloth)


def decorate(kit: Kit, side: Group, length: float, height: float, holes: Sequence[Hole]) -> None:
    """Adds posters, switches, radiators and shelves where the wall is free."""
    for _ in range(int(kit.rng.integers(0, 6))):
        u = kit.uniform(0.3, max(0.4, length - 0.3))
        if any(hole[0] - 0.5 < u < hole[2] + 0.5 for hole in holes):
            continue
        choice = kit.rng.random()
        z = kit.uniform(1.1, max(1.2, height - 0.7))
        width = kit.uniform(0.2, 1.0)
        h = kit.uniform(0.2, 0.8)
        # A picture, some with a frame.
        if choice < 0.6:
            thick = kit.uniform(0.002, 0.04)
            if thick > 0.01:
                edge = kit.wood() if kit.chance(0.5) else kit.dark()
                side.add(box(width + 0.06, thick, h + 0.06), edge, (u, -thick / 2, z - 0.03))
            poster = kit.palette.new("poster", tile_m=h, whole=True, mirror=kit.uniform(0, 0.05))
            side.add(box(width, 0.004, h, fit=h), poster, (u, -thick - 0.002, z))
        elif choice < 0.75:
            # A shelf with things.
            side.add(box(width + 0.3, 0.2, 0.025), kit.wood(), (u, -0.1, z))
            clutter.scatter(
                kit,
                side,
                area=clutter.Rectangle((u - width / 2, -0.15), (u + width / 2, -0.06), z + 0.025),
                count=4,
                tallest=0.3,
            )
        elif choice < 0.9:
            # A radiator.
            white = kit.surface("plain", vivid=0.05)
            for x in np.arange(-0.4, 0.41, 0.05):
                side.add(box(0.035, 0.08, 0.55), white, (u + float(x), -0.09, 0.12))
        else:
            # A switch.
            side.add(box(0.08, 0.012, 0.08), kit.palette.new("plain", (0.9,) * 3), (u, -0.006, 1.1))


def openings(kit: Kit, length: float, height: float) -> list[Hole]:
    """Returns random windows and doors of a wall of this length and height, metres."""
    holes: list[Hole] = []
    u = kit.uniform(0.2, 0.8)
    while u < length - 1.0:
        chance = kit.rng.random()
        width = kit.uniform(0.7, min(2.0, length - u - 0.2))
        if chance < 0.22:
            holes.append(
                (u, kit.uniform(0.5, 1.0), u + width, min(height - 0.15, kit.uniform(1.7, 2.4)))
            )
        elif chance < 0.4:
            width = min(width, kit.uniform(0.75, 1.0))
            holes.append((u, 0.0, u + width, min(height - 0.1, kit.uniform(1.95, 2.15))))
        u += width + kit.uniform(0.3, 1.5)
    return holes
