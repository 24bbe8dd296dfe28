"""Things of a household; each stands on z = 0 at the origin, screens facing -y."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    cylinder,
    lathe,
    quads,
    rod,
    superquadric,
    torus,
)
from model_zoo_defs.training.scenes.kit import Kit


def mug(kit: Kit) -> Group:
    """Returns a hollow cup with a handle."""
    group = Group()
    material = kit.any_surface()
    radius = kit.uniform(0.03, 0.05)
    height = kit.uniform(0.07, 0.12)
    taper = kit.uniform(0.75, 1.1)
    group.add(
        lathe(
            [
                (0, 0),
                (radius * taper, 0),
                (radius, height),
                (radius * 0.9, height),
                (radius * taper * 0.9, 0.01),
                (0, 0.01),
            ]
        ),
        material,
    )
    if kit.chance(0.7):
        group.add(
            torus(height * 0.3, 0.006, turn=np.pi),
            material,
            (radius * 0.97, 0, height / 2),
            roll=0,
            pitch=np.pi / 2,
            yaw=-np.pi / 2 * 0,
        )
    return group


def bottle(kit: Kit) -> Group:
    """Returns a bottle with a cap."""
    group = Group()
    radius = kit.uniform(0.025, 0.05)
    height = kit.uniform(0.15, 0.33)
    neck = kit.uniform(0.25, 0.5)
    body = [
        (0, 0),
        (radius, 0),
        (radius, height * 0.6),
        (radius * 0.95, height * 0.65),
        (radius * neck, height * 0.85),
        (radius * neck, height),
    ]
    group.add(lathe(body), kit.palette.new("plain", gloss=0.7, mirror=0.05, vivid=0.6))
    label = kit.palette.new("poster", tile_m=height * 0.4)
    group.add(lathe([(radius * 1.01, height * 0.15), (radius * 1.01, height * 0.5)]), label)
    group.add(
        cylinder(radius * neck * 1.15, height * 0.09), kit.any_surface(), (0, 0, height * 0.96)
    )
    return group


def vase(kit: Kit) -> Group:
    """Returns a turned body with a random wavy profile."""
    group = Group()
    z = np.linspace(0, kit.uniform(0.08, 0.4), 14)
    waves = sum(
        kit.uniform(-0.5, 0.5) * np.sin(k * z / z[-1] * 3.3 + kit.uniform(0, 6)) / k
        for k in (1, 2, 3)
    )
    radius = z[-1] * kit.uniform(0.15, 0.4) * np.clip(1 + waves, 0.25, None)
    group.add(lathe(np.stack([radius, z], axis=1), sides=24), kit.any_surface())
    return group


def bowl(kit: Kit) -> Group:
    """Returns a bowl, at times with fruit in it."""
    group = Group()
    radius = kit.uniform(0.06, 0.16)
    a = np.linspace(0.2, 1.0, 6)
    height = radius * kit.uniform(0.2, 0.8)
    outer = np.stack([radius * a, height * a**2], axis=1)
    group.add(
        lathe(np.concatenate([[(0, 0)], outer, outer[::-1] * [0.94, 1], [(0, 0.01)]])),
        kit.any_surface(),
    )
    if kit.chance(0.5):
        for _ in range(int(kit.rng.integers(2, 6))):
            angle = kit.uniform(0, 6.3)
            far = radius * kit.uniform(0, 0.5)
            aside = radius * kit.uniform(0.45, 0.7)
            material = kit.palette.new("speckle", tile_m=0.1, vivid=1.0)
            group.add(
                superquadric((aside, aside, aside * kit.uniform(0.85, 1.3))),
                material,
                (far * np.cos(angle), far * np.sin(angle), height * 0.6 + aside * 0.25),
            )
    return group


def pot(kit: Kit) -> Group:
    """Returns a cooking pot or pan with its handles."""
    group = Group()
    steel = kit.metal()
    radius = kit.uniform(0.08, 0.16)
    height = kit.uniform(0.04, 0.2)
    group.add(
        lathe(
            [
                (0, 0),
                (radius, 0),
                (radius, height),
                (radius * 0.96, height),
                (radius * 0.96, 0.01),
                (0, 0.01),
            ],
            sides=26,
        ),
        steel,
    )
    if kit.chance(0.5):
        group.add(
            rod((radius, 0, height * 0.85), (radius + kit.uniform(0.12, 0.22), 0, height), 0.011),
            kit.dark(),
        )
    else:
        for side in (-1, 1):
            group.add(
                torus(0.03, 0.006, turn=np.pi),
                steel,
                (side * radius, 0, height * 0.8),
                yaw=-side * np.pi / 2,
            )
        if kit.chance(0.6):
            group.add(
                lathe(
                    [(radius * 1.02, height), (radius * 0.5, height + 0.02), (0, height + 0.025)]
                ),
                steel,
            )
            group.add(superquadric((0.03, 0.03, 0.03)), kit.dark(), (0, 0, height + 0.035))
    return group


def carton(kit: Kit) -> Group:
    """Returns a box, plain or printed."""
    group = Group()
    width = kit.uniform(0.05, 0.3)
    depth = kit.uniform(0.04, 0.2)
    height = kit.uniform(0.05, 0.3)
    printed = kit.chance(0.5)
    material = (
        kit.palette.new("poster", tile_m=max(width, height), whole=True)
        if printed
        else kit.any_surface()
    )
    group.add(box(width, depth, height, fit=max(width, height) if printed else 0.0), material)
    return group


def books(kit: Kit) -> Group:
    """Returns a small pile of books, turned against each other."""
    group = Group()
    z = 0.0
    for _ in range(int(kit.rng.integers(1, 6))):
        width = kit.uniform(0.13, 0.24)
        depth = kit.uniform(0.18, 0.3)
        height = kit.uniform(0.008, 0.045)
        cover = kit.palette.new("poster", tile_m=depth, whole=True)
        paper = kit.palette.new("stripes", (0.9, 0.88, 0.8), tile_m=0.05)
        yaw = kit.uniform(-0.4, 0.4)
        at = (kit.uniform(-0.02, 0.02), kit.uniform(-0.02, 0.02), z)
        group.add(box(width, depth, height * 0.999, fit=depth), cover, at, yaw=yaw)
        group.add(
            box(width * 0.99, depth * 1.004, height * 0.8),
            paper,
            (at[0], at[1], z + height * 0.1),
            yaw=yaw,
        )
        z += height
    return group


def papers(kit: Kit) -> Group:
    """Returns a few flat printed sheets: colour edges without depth edges."""
    group = Group()
    for index in range(int(kit.rng.integers(1, 5))):
        sheet = kit.palette.new("poster", (0.93, 0.93, 0.9), tile_m=0.3, whole=True)
        at = (kit.uniform(-0.1, 0.1), kit.uniform(-0.1, 0.1), 0.0007 * index)
        group.add(box(0.21, 0.297, 0.0006, fit=0.3), sheet, at, yaw=kit.uniform(0, 6.3))
    return group


def laptop(kit: Kit) -> Group:
    """Returns an open portable computer."""
    group = Group()
    case = kit.metal() if kit.chance(0.5) else kit.dark()
    width = kit.uniform(0.28, 0.38)
    depth = kit.uniform(0.2, 0.26)
    tilt = kit.uniform(-0.6, 0.1)
    group.add(box(width, depth, 0.016), case)
    group.add(
        box(width * 0.9, depth * 0.5, 0.002),
        kit.palette.new("tiles", (0.1, 0.1, 0.1), tile_m=0.2),
        (0, depth * 0.15, 0.016),
    )
    lid = Group()
    lid.add(box(width, 0.008, depth), case)
    lid.add(
        box(width * 0.94, 0.002, depth * 0.9, fit=depth),
        kit.palette.new("poster", tile_m=depth, whole=True, glow=0.8, mirror=0.05),
        (0, -0.005, depth * 0.05),
    )
    group.insert(lid, (0, depth / 2, 0.014), pitch=tilt)
    return group


def monitor(kit: Kit) -> Group:
    """Returns a flat screen on a foot, facing -y."""
    group = Group()
    case = kit.dark()
    width = kit.uniform(0.4, 0.75)
    height = width * kit.uniform(0.55, 0.65)
    z = kit.uniform(0.08, 0.16)
    group.add(box(width, 0.03, height), case, (0, 0, z))
    on = kit.chance(0.5)
    screen = (
        kit.palette.new("poster", tile_m=height, whole=True, glow=1.2 if on else 0.0, mirror=0.06)
        if on
        else kit.palette.new("plain", (0.05, 0.05, 0.06), mirror=0.1)
    )
    group.add(
        box(width * 0.95, 0.004, height * 0.92, fit=height), screen, (0, -0.0155, z + height * 0.04)
    )
    group.add(box(0.06, 0.03, z + 0.1), case, (0, 0.03, 0))
    group.add(box(0.26, 0.18, 0.012), case)
    return group


def lamp(kit: Kit) -> Group:
    """Returns a table lamp: foot, stem and shade."""
    group = Group()
    metal = kit.metal()
    height = kit.uniform(0.25, 0.55)
    radius = kit.uniform(0.08, 0.17)
    group.add(cylinder(radius * 0.6, 0.02), metal)
    group.add(cylinder(0.008, height), metal)
    shade = kit.palette.new("fabric", tile_m=0.3, glow=kit.uniform(0, 1.5), vivid=0.3)
    top = radius * kit.uniform(0.5, 1.0)
    group.add(
        lathe(
            [
                (radius, height - radius),
                (top, height + radius * 0.4),
                (top * 0.97, height + radius * 0.4),
                (radius * 0.97, height - radius),
            ]
        ),
        shade,
    )
    return group


def plant(kit: Kit) -> Group:
    """Returns a pot with many thin bent leaves."""
    group = Group()
    # Pot and earth.
    radius = kit.uniform(0.05, 0.15)
    height = kit.uniform(0.08, 0.25)
    group.add(cylinder(radius * 0.8, height, top=radius), kit.any_surface())
    group.add(
        cylinder(radius * 0.9, 0.01),
        kit.palette.new("speckle", (0.2, 0.14, 0.1), tile_m=0.1),
        (0, 0, height * 0.95),
    )
    # Leaves: strips that rise and bend down along s, 0 at the stem and 1 at the tip.
    green = kit.palette.new(
        "foliage",
        (kit.uniform(0.15, 0.4), kit.uniform(0.35, 0.6), kit.uniform(0.1, 0.3)),
        tile_m=0.2,
        gloss=0.2,
    )
    count = int(kit.rng.integers(12, 60))
    reach = kit.uniform(0.15, 0.6)
    wide = kit.uniform(0.008, 0.05)
    angle = kit.rng.uniform(0, 2 * np.pi, count)
    lift = kit.rng.uniform(0.2, 1.5, count)
    long = reach * kit.rng.uniform(0.5, 1.0, count)
    s = np.linspace(0, 1, 6)[None, :]
    along = long[:, None] * s * np.cos(lift)[:, None]
    up = height + long[:, None] * (s * np.sin(lift)[:, None] - kit.uniform(0, 0.6) * s**2)
    half = wide * np.sqrt(np.clip(s * (1.05 - s), 0, None)) * 2
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    left = np.stack([along * cosine - half * sine, along * sine + half * cosine, up], axis=2)
    right = np.stack([along * cosine + half * sine, along * sine - half * cosine, up], axis=2)
    corners = np.stack([left[:, :-1], right[:, :-1], right[:, 1:], left[:, 1:]], axis=2)
    group.add(quads(corners.reshape(-1, 4, 3)), green)
    return group
