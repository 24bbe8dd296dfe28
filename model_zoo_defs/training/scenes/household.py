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
    r = kit.size(0.03, 0.05)
    h = kit.size(0.07, 0.12)
    taper = kit.size(0.75, 1.1)
    group.add(
        lathe([(0, 0), (r * taper, 0), (r, h), (r * 0.9, h), (r * taper * 0.9, 0.01), (0, 0.01)]),
        material,
    )
    if kit.chance(0.7):
        group.add(
            torus(h * 0.3, 0.006, turn=np.pi),
            material,
            (r * 0.97, 0, h / 2),
            roll=0,
            pitch=np.pi / 2,
            yaw=-np.pi / 2 * 0,
        )
    return group


def bottle(kit: Kit) -> Group:
    """Returns a bottle with a cap."""
    group = Group()
    r = kit.size(0.025, 0.05)
    h = kit.size(0.15, 0.33)
    neck = kit.size(0.25, 0.5)
    body = [(0, 0), (r, 0), (r, h * 0.6), (r * 0.95, h * 0.65), (r * neck, h * 0.85), (r * neck, h)]
    group.add(lathe(body), kit.palette.new("plain", gloss=0.7, mirror=0.05, vivid=0.6))
    label = kit.palette.new("poster", tile_m=h * 0.4)
    group.add(lathe([(r * 1.01, h * 0.15), (r * 1.01, h * 0.5)]), label)
    group.add(cylinder(r * neck * 1.15, h * 0.09), kit.any_surface(), (0, 0, h * 0.96))
    return group


def vase(kit: Kit) -> Group:
    """Returns a turned body with a random wavy profile."""
    group = Group()
    z = np.linspace(0, kit.size(0.08, 0.4), 14)
    waves = sum(
        kit.size(-0.5, 0.5) * np.sin(k * z / z[-1] * 3.3 + kit.size(0, 6)) / k for k in (1, 2, 3)
    )
    radius = z[-1] * kit.size(0.15, 0.4) * np.clip(1 + waves, 0.25, None)
    group.add(lathe(np.stack([radius, z], axis=1), sides=24), kit.any_surface())
    return group


def bowl(kit: Kit) -> Group:
    """Returns a bowl, at times with fruit in it."""
    group = Group()
    r = kit.size(0.06, 0.16)
    a = np.linspace(0.2, 1.0, 6)
    h = r * kit.size(0.2, 0.8)
    outer = np.stack([r * a, h * a**2], axis=1)
    group.add(
        lathe(np.concatenate([[(0, 0)], outer, outer[::-1] * [0.94, 1], [(0, 0.01)]])),
        kit.any_surface(),
    )
    if kit.chance(0.5):
        for _ in range(int(kit.rng.integers(2, 6))):
            angle = kit.size(0, 6.3)
            far = r * kit.size(0, 0.5)
            d = r * kit.size(0.45, 0.7)
            material = kit.palette.new("speckle", tile_m=0.1, vivid=1.0)
            group.add(
                superquadric((d, d, d * kit.size(0.85, 1.3))),
                material,
                (far * np.cos(angle), far * np.sin(angle), h * 0.6 + d * 0.25),
            )
    return group


def pot(kit: Kit) -> Group:
    """Returns a cooking pot or pan with its handles."""
    group = Group()
    steel = kit.metal()
    r = kit.size(0.08, 0.16)
    h = kit.size(0.04, 0.2)
    group.add(
        lathe([(0, 0), (r, 0), (r, h), (r * 0.96, h), (r * 0.96, 0.01), (0, 0.01)], sides=26), steel
    )
    if kit.chance(0.5):
        group.add(rod((r, 0, h * 0.85), (r + kit.size(0.12, 0.22), 0, h), 0.011), kit.dark())
    else:
        for side in (-1, 1):
            group.add(
                torus(0.03, 0.006, turn=np.pi), steel, (side * r, 0, h * 0.8), yaw=-side * np.pi / 2
            )
        if kit.chance(0.6):
            group.add(lathe([(r * 1.02, h), (r * 0.5, h + 0.02), (0, h + 0.025)]), steel)
            group.add(superquadric((0.03, 0.03, 0.03)), kit.dark(), (0, 0, h + 0.035))
    return group


def carton(kit: Kit) -> Group:
    """Returns a box, plain or printed."""
    group = Group()
    w = kit.size(0.05, 0.3)
    d = kit.size(0.04, 0.2)
    h = kit.size(0.05, 0.3)
    printed = kit.chance(0.5)
    material = (
        kit.palette.new("poster", tile_m=max(w, h), whole=True) if printed else kit.any_surface()
    )
    group.add(box(w, d, h, fit=max(w, h) if printed else 0.0), material)
    return group


def books(kit: Kit) -> Group:
    """Returns a small pile of books, turned against each other."""
    group = Group()
    z = 0.0
    for _ in range(int(kit.rng.integers(1, 6))):
        w = kit.size(0.13, 0.24)
        d = kit.size(0.18, 0.3)
        h = kit.size(0.008, 0.045)
        cover = kit.palette.new("poster", tile_m=d, whole=True)
        paper = kit.palette.new("stripes", (0.9, 0.88, 0.8), tile_m=0.05)
        yaw = kit.size(-0.4, 0.4)
        at = (kit.size(-0.02, 0.02), kit.size(-0.02, 0.02), z)
        group.add(box(w, d, h * 0.999, fit=d), cover, at, yaw=yaw)
        group.add(box(w * 0.99, d * 1.004, h * 0.8), paper, (at[0], at[1], z + h * 0.1), yaw=yaw)
        z += h
    return group


def papers(kit: Kit) -> Group:
    """Returns a few flat printed sheets: colour edges without depth edges."""
    group = Group()
    for index in range(int(kit.rng.integers(1, 5))):
        sheet = kit.palette.new("poster", (0.93, 0.93, 0.9), tile_m=0.3, whole=True)
        at = (kit.size(-0.1, 0.1), kit.size(-0.1, 0.1), 0.0007 * index)
        group.add(box(0.21, 0.297, 0.0006, fit=0.3), sheet, at, yaw=kit.size(0, 6.3))
    return group


def laptop(kit: Kit) -> Group:
    """Returns an open portable computer."""
    group = Group()
    case = kit.metal() if kit.chance(0.5) else kit.dark()
    w = kit.size(0.28, 0.38)
    d = kit.size(0.2, 0.26)
    tilt = kit.size(-0.6, 0.1)
    group.add(box(w, d, 0.016), case)
    group.add(
        box(w * 0.9, d * 0.5, 0.002),
        kit.palette.new("tiles", (0.1, 0.1, 0.1), tile_m=0.2),
        (0, d * 0.15, 0.016),
    )
    lid = Group()
    lid.add(box(w, 0.008, d), case)
    lid.add(
        box(w * 0.94, 0.002, d * 0.9, fit=d),
        kit.palette.new("poster", tile_m=d, whole=True, glow=0.8, mirror=0.05),
        (0, -0.005, d * 0.05),
    )
    group.insert(lid, (0, d / 2, 0.014), pitch=tilt)
    return group


def monitor(kit: Kit) -> Group:
    """Returns a flat screen on a foot, facing -y."""
    group = Group()
    case = kit.dark()
    w = kit.size(0.4, 0.75)
    h = w * kit.size(0.55, 0.65)
    z = kit.size(0.08, 0.16)
    group.add(box(w, 0.03, h), case, (0, 0, z))
    on = kit.chance(0.5)
    screen = (
        kit.palette.new("poster", tile_m=h, whole=True, glow=1.2 if on else 0.0, mirror=0.06)
        if on
        else kit.palette.new("plain", (0.05, 0.05, 0.06), mirror=0.1)
    )
    group.add(box(w * 0.95, 0.004, h * 0.92, fit=h), screen, (0, -0.0155, z + h * 0.04))
    group.add(box(0.06, 0.03, z + 0.1), case, (0, 0.03, 0))
    group.add(box(0.26, 0.18, 0.012), case)
    return group


def lamp(kit: Kit) -> Group:
    """Returns a table lamp: foot, stem and shade."""
    group = Group()
    metal = kit.metal()
    h = kit.size(0.25, 0.55)
    r = kit.size(0.08, 0.17)
    group.add(cylinder(r * 0.6, 0.02), metal)
    group.add(cylinder(0.008, h), metal)
    shade = kit.palette.new("fabric", tile_m=0.3, glow=kit.size(0, 1.5), vivid=0.3)
    top = r * kit.size(0.5, 1.0)
    group.add(
        lathe([(r, h - r), (top, h + r * 0.4), (top * 0.97, h + r * 0.4), (r * 0.97, h - r)]), shade
    )
    return group


def plant(kit: Kit) -> Group:
    """Returns a pot with many thin bent leaves."""
    group = Group()
    # Pot and earth.
    r = kit.size(0.05, 0.15)
    h = kit.size(0.08, 0.25)
    group.add(cylinder(r * 0.8, h, top=r), kit.any_surface())
    group.add(
        cylinder(r * 0.9, 0.01),
        kit.palette.new("speckle", (0.2, 0.14, 0.1), tile_m=0.1),
        (0, 0, h * 0.95),
    )
    # Leaves: strips that rise and bend down along s, 0 at the stem and 1 at the tip.
    green = kit.palette.new(
        "foliage",
        (kit.size(0.15, 0.4), kit.size(0.35, 0.6), kit.size(0.1, 0.3)),
        tile_m=0.2,
        gloss=0.2,
    )
    count = int(kit.rng.integers(12, 60))
    reach = kit.size(0.15, 0.6)
    wide = kit.size(0.008, 0.05)
    angle = kit.rng.uniform(0, 2 * np.pi, count)
    lift = kit.rng.uniform(0.2, 1.5, count)
    long = reach * kit.rng.uniform(0.5, 1.0, count)
    s = np.linspace(0, 1, 6)[None, :]
    along = long[:, None] * s * np.cos(lift)[:, None]
    up = h + long[:, None] * (s * np.sin(lift)[:, None] - kit.size(0, 0.6) * s**2)
    half = wide * np.sqrt(np.clip(s * (1.05 - s), 0, None)) * 2
    c, n = np.cos(angle)[:, None], np.sin(angle)[:, None]
    left = np.stack([along * c - half * n, along * n + half * c, up], axis=2)
    right = np.stack([along * c + half * n, along * n - half * c, up], axis=2)
    corners = np.stack([left[:, :-1], right[:, :-1], right[:, 1:], left[:, 1:]], axis=2)
    group.add(quads(corners.reshape(-1, 4, 3)), green)
    return group
