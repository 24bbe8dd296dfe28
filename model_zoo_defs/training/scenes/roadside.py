"""Trees, hedges, fences and poles, standing on z = 0."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    cylinder,
    quads,
    rod,
    superquadric,
    tube,
)
from model_zoo_defs.training.scenes.kit import Kit


def leaves(kit: Kit, centres: np.ndarray, size: float, material: int) -> Group:
    """Returns one small bent leaf-like quad at every centre (n, 3), turned at random."""
    count = len(centres)
    first = kit.rng.normal(size=(count, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(first, kit.rng.normal(size=(count, 3)))
    second /= np.linalg.norm(second, axis=1, keepdims=True) + 1e-9
    half = size * kit.rng.uniform(0.5, 1.2, (count, 1))
    a = first * half
    b = second * half * kit.uniform(0.4, 0.9)
    group = Group()
    corners = np.stack([centres - a, centres - b, centres + a, centres + b], axis=1)
    group.add(quads(corners), material)
    return group


Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""


def leaf_green(kit: Kit) -> Colour:
    """Returns a random colour of leaves."""
    if kit.chance(0.15):
        return kit.uniform(0.4, 0.7), kit.uniform(0.3, 0.45), kit.uniform(0.08, 0.2)
    return kit.uniform(0.16, 0.36), kit.uniform(0.26, 0.46), kit.uniform(0.06, 0.2)


def tree(kit: Kit, *, far: bool = False) -> Group:
    """Returns a tree of trunk, branches and clumps of leaves; far: with fewer leaves."""
    group = Group()
    # Trunk.
    h = kit.uniform(4, 13)
    r = kit.uniform(0.1, 0.3)
    stem = h * kit.uniform(0.2, 0.45)
    bark = kit.palette.new(
        "speckle", np.array([0.35, 0.28, 0.22]) * kit.uniform(0.5, 1.2), tile_m=0.6
    )
    lean = kit.rng.normal(0, 0.04 * h, 2)
    group.add(
        tube([(0, 0, 0), (lean[0] * 0.3, lean[1] * 0.2, stem), (lean[0], lean[1], h * 0.8)], r),
        bark,
    )
    # Clumps around the trunk: leaves, a dark body within, and a branch.
    conifer = kit.chance(0.2)
    clumps = int(kit.rng.integers(9, 22))
    green = kit.palette.new("foliage", leaf_green(kit), tile_m=0.8, gloss=0.0)
    shade = kit.palette.new("foliage", np.array(leaf_green(kit)) * 0.45, tile_m=0.8, gloss=0.0)
    wide = h * kit.uniform(0.16, 0.34)
    centres = []
    for index in range(clumps):
        angle = kit.uniform(0, 6.3)
        height = kit.uniform(0, 1) if not conifer else index / clumps
        out = (
            wide
            * kit.uniform(0.1, 0.9)
            * ((1 - height) if conifer else np.sqrt(max(0.05, 1 - height * height)))
        )
        z = stem + (h - stem) * height
        middle = np.array([lean[0] + out * np.cos(angle), lean[1] + out * np.sin(angle), z])
        radius = wide * kit.uniform(0.4, 0.75) * (1.2 - 0.6 * height)
        count = 40 if far else 200
        offsets = kit.rng.normal(size=(count, 3))
        offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
        centres.append(
            middle + offsets * radius * kit.rng.uniform(0.6, 1.1, (count, 1)) * [1, 1, 0.8]
        )
        if kit.chance(0.8):
            size = radius * kit.uniform(1.1, 1.7)
            group.add(superquadric((size, size, size * 0.8), rows=8, columns=10), shade, middle)
        group.add(
            rod(
                (lean[0] * 0.3, lean[1] * 0.2, stem * kit.uniform(0.7, 1.0)),
                middle,
                r * 0.35,
                sides=5,
            ),
            bark,
        )
    # All leaves together.
    size = kit.uniform(0.1, 0.24) * (2.0 if far else 1.0)
    group.insert(leaves(kit, np.concatenate(centres), size, green))
    return group


def hedge(kit: Kit, length: float) -> Group:
    """Returns a hedge or a row of bushes along y."""
    group = Group()
    tall = kit.uniform(0.5, 2.2)
    wide = kit.uniform(0.4, 1.0)
    green = kit.palette.new("foliage", leaf_green(kit), tile_m=0.8)
    dark = kit.palette.new("foliage", np.array(leaf_green(kit)) * 0.5, tile_m=0.8)
    group.add(box(wide * 0.9, length, tall * 0.95), dark)
    count = min(4000, int(260 * length * (tall + wide)))
    points = kit.rng.uniform(-0.5, 0.5, (count, 3)) * [wide, length, tall]
    out = kit.rng.integers(0, 3, count)
    points[out == 0, 0] = np.sign(points[out == 0, 0]) * wide / 2
    points[out == 2, 2] = tall / 2
    points += kit.rng.normal(0, 0.05, points.shape)
    group.insert(leaves(kit, points + np.array([0, 0, tall / 2]), 0.07, green))
    return group


def fence(kit: Kit, length: float) -> Group:
    """Returns a fence of thin slats, bars or wires along y."""
    group = Group()
    material = kit.wood() if kit.chance(0.5) else kit.metal()
    tall = kit.uniform(0.8, 1.8)
    step = kit.uniform(0.1, 0.3)
    wide = step * kit.uniform(0.15, 0.8)
    for y in np.arange(-length / 2, length / 2, step):
        group.add(box(0.02, wide, tall * kit.uniform(0.97, 1.0)), material, (0, float(y), 0.03))
    for z in (0.25, 0.8):
        group.add(box(0.03, length, 0.06), material, (0.02, 0, tall * z))
    return group


def pole(kit: Kit) -> Group:
    """Returns a lamp post, traffic light, road sign or bare pole."""
    group = Group()
    grey = kit.palette.new("plain", (kit.uniform(0.2, 0.6),) * 3, gloss=0.3)
    choice = kit.rng.random()
    radius = kit.uniform(0.03, 0.09)
    if choice < 0.4:
        # A lamp post.
        height = kit.uniform(4.5, 9)
        reach = kit.uniform(0.5, 2.2)
        group.add(
            tube(
                [
                    (0, 0, 0),
                    (0, 0, height * 0.6),
                    (0, 0, height * 0.93),
                    (reach * 0.3, 0, height),
                    (reach, 0, height),
                ],
                radius,
            ),
            grey,
        )
        group.add(superquadric((0.7, 0.25, 0.15), vertical=0.5), grey, (reach, 0, height))
    elif choice < 0.8:
        # A road sign, round or square.
        height = kit.uniform(2.0, 3.0)
        group.add(cylinder(0.032, height + 0.4), grey)
        sign = kit.palette.new("poster", tile_m=0.7, whole=True, gloss=0.2)
        width = kit.uniform(0.45, 0.9)
        if kit.chance(0.5):
            group.add(
                cylinder(width / 2, 0.02, sides=26),
                kit.surface("plain", "checks", "poster", vivid=0.9),
                (0, -0.04, height),
                pitch=np.pi / 2,
            )
        else:
            group.add(
                box(width, 0.02, kit.uniform(0.4, 0.9), fit=0.7), sign, (0, -0.04, height - 0.4)
            )
    else:
        # A traffic light.
        height = kit.uniform(2.6, 6)
        group.add(cylinder(radius, height), grey)
        case = kit.dark()
        group.add(box(0.28, 0.25, 0.85), case, (0.0, -0.12, min(height, 3.4) - 0.9))
        for index, lamp in enumerate(((0.6, 0.05, 0.03), (0.6, 0.4, 0.03), (0.05, 0.5, 0.1))):
            at = (0, -0.25, min(height, 3.4) - 0.2 - 0.28 * index)
            group.add(
                superquadric((0.19, 0.05, 0.19)),
                kit.palette.new("plain", lamp, glow=kit.uniform(0, 2)),
                at,
            )
    return group
