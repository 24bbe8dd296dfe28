"""Streets: road, what stands along it, what drives on it, and the far background."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import Group, box, rod, surface
from model_zoo_defs.training.scenes import buildings, clutter, figures, vehicles
from model_zoo_defs.training.scenes.kit import Kit
from model_zoo_defs.training.scenes.roadside import fence, hedge, leaf_green, pole, tree
from model_zoo_defs.training.scenes.world import Light, Plan, Sky

_FAR = 110.0
"""Metres along the street to the farthest trees."""


def _ground(kit: Kit, group: Group, half: float) -> None:
    """Adds road, markings, kerbs, pavements and the land beside them."""
    # Road and land.
    asphalt = kit.palette.new(
        "speckle", (kit.uniform(0.25, 0.5),) * 3, tile_m=kit.uniform(1, 3), gloss=0.0
    )
    if kit.chance(0.15):
        asphalt = kit.palette.new("paving", (kit.uniform(0.35, 0.55),) * 3, tile_m=1.2)
    land = (
        kit.surface("foliage", "foliage", "speckle", "paving", tile_m=3, vivid=0.0)
        if kit.chance(0.4)
        else kit.palette.new("foliage", leaf_green(kit), tile_m=3)
    )
    group.add(box(2 * half, 260, 0.2), asphalt, (0, 60, -0.2))
    group.add(box(400, 400, 0.1), land, (0, 60, -0.14))
    # Pavements and kerbs.
    walk = kit.surface("paving", "speckle", "tiles", tile_m=kit.uniform(1, 2), vivid=0.0)
    kerb = kit.palette.new("speckle", (0.6, 0.6, 0.58), tile_m=1)
    if kit.chance(0.85):
        for side in (-1, 1):
            wide = kit.uniform(1.2, 3.5)
            group.add(box(wide, 260, 0.14), walk, (side * (half + wide / 2 + 0.15), 60, -0.02))
            group.add(box(0.15, 260, 0.14), kerb, (side * (half + 0.075), 60, -0.015))
    # Lines between the lanes, at the sides, and a crossing.
    white = kit.palette.new("speckle", (0.85, 0.85, 0.82), tile_m=0.6)
    lines = [0.0] if half < 5 else [-half / 3, half / 3]
    for x in lines:
        dash = kit.uniform(1, 4)
        gap = kit.uniform(1, 6) if kit.chance(0.8) else 0.0
        for y in np.arange(-10, 90, dash + gap):
            group.add(box(0.13, dash, 0.008), white, (x, float(y), 0))
    if kit.chance(0.5):
        for side in (-1, 1):
            group.add(box(0.12, 160, 0.008), white, (side * (half - kit.uniform(0.2, 0.5)), 60, 0))
    if kit.chance(0.25):
        y = kit.uniform(5, 25)
        for x in np.arange(-half + 0.4, half - 0.3, 0.9):
            group.add(box(0.45, 3, 0.008), white, (float(x), y, 0))
    # Mended patches.
    for _ in range(int(kit.rng.integers(0, 6))):
        patch = kit.palette.new("speckle", (kit.uniform(0.2, 0.5),) * 3, tile_m=1)
        group.add(
            box(kit.uniform(0.5, 3), kit.uniform(1, 8), 0.004),
            patch,
            (kit.uniform(-half, half), kit.uniform(0, 40), 0),
        )


def _traffic(kit: Kit, group: Group, half: float) -> list[tuple[float, float, float]]:
    """Adds parked and moving vehicles; returns camera targets."""
    targets = []
    # Parked vehicles on both sides, most of them of a few kinds.
    fleet = [vehicles.car(kit) for _ in range(4)] + [vehicles.lorry(kit)]
    for side in (-1, 1):
        y = kit.uniform(-8, 12)
        if kit.chance(0.3):
            continue
        density = kit.uniform(0.1, 0.9)
        while y < 80:
            if kit.chance(density):
                vehicle = (
                    vehicles.car(kit)
                    if kit.chance(0.3) and y < 30
                    else fleet[int(kit.rng.integers(4))]
                )
                x = side * (half - kit.uniform(0.7, 1.1))
                group.insert(
                    vehicle, (x, y, 0), yaw=(0 if side > 0 else np.pi) + kit.uniform(-0.05, 0.05)
                )
                targets.append((x, y, 0.8))
            y += kit.uniform(5.2, 8)
    # Moving vehicles.
    for _ in range(int(kit.rng.integers(0, 4))):
        lane = kit.rng.choice([-1, 1]) * half * 0.4
        y = kit.uniform(7, 70)
        vehicle = fleet[int(kit.rng.integers(5))]
        group.insert(vehicle, (lane, y, 0), yaw=0 if lane > 0 else np.pi)
    # Cyclists.
    for _ in range(int(kit.rng.integers(0, 3))):
        group.insert(
            vehicles.cyclist(kit),
            (kit.uniform(-half, half), kit.uniform(5, 35), 0),
            yaw=kit.rng.choice([0, np.pi]),
        )
    return targets


def _verge(kit: Kit, group: Group, side: float, x: float) -> None:
    """Adds poles, trees, people, bins and hedges along one pavement."""
    # Trees in a row.
    trees = [tree(kit) for _ in range(2)]
    spacing = kit.uniform(5, 14)
    density = kit.uniform(0, 1)
    for y in np.arange(kit.uniform(0, 8), 75, spacing):
        if kit.chance(density):
            at = (side * (x + kit.uniform(0.5, 2.0)), float(y) + kit.uniform(-1, 1), 0.1)
            group.insert(
                trees[int(kit.rng.integers(2))],
                at,
                yaw=kit.uniform(0, 6.3),
                scale=kit.uniform(0.6, 1.1),
            )
    # Poles in a row.
    post = pole(kit)
    for y in np.arange(kit.uniform(2, 12), 90, kit.uniform(12, 30)):
        item = post if kit.chance(0.6) else pole(kit)
        group.insert(
            item, (side * (x + 0.4), float(y), 0.1), yaw=0 if side < 0 else np.pi * kit.chance(0.5)
        )
    # People, bins and bicycles.
    for _ in range(int(kit.rng.integers(0, 5))):
        at = (side * (x + kit.uniform(0.3, 2.5)), kit.uniform(3, 40), 0.12)
        group.insert(figures.person(kit), at, yaw=kit.uniform(0, 6.3))
    for _ in range(int(kit.rng.integers(0, 4))):
        item = vehicles.street_box(kit) if kit.chance(0.7) else figures.bicycle(kit)
        group.insert(
            item,
            (side * (x + kit.uniform(0.5, 2.5)), kit.uniform(3, 40), 0.12),
            yaw=kit.uniform(0, 6.3),
        )
    # A hedge or a fence.
    if kit.chance(0.5):
        length = kit.uniform(5, 18)
        maker = hedge if kit.chance(0.55) else fence
        group.insert(
            maker(kit, length), (side * (x + kit.uniform(2.2, 4)), kit.uniform(5, 25), 0.0)
        )


def _grove(kit: Kit, group: Group, side: float, x: float) -> None:
    """Adds trees, bushes and a guard rail along a side without houses."""
    kinds = [tree(kit) for _ in range(3)]
    for _ in range(int(kit.rng.integers(4, 26))):
        at = (side * (x + kit.uniform(0, 14)), kit.uniform(3, 80), -0.1)
        item = kinds[int(kit.rng.integers(3))]
        group.insert(item, at, yaw=kit.uniform(0, 6.3), scale=kit.uniform(0.6, 1.2))
    for _ in range(int(kit.rng.integers(0, 4))):
        group.insert(
            hedge(kit, kit.uniform(2, 12)),
            (side * (x + kit.uniform(0, 5)), kit.uniform(4, 50), -0.1),
        )
    if kit.chance(0.5):
        steel = kit.metal()
        for z in (0.5, 0.66):
            group.add(box(0.05, 90, 0.11), steel, (side * (x - 1.2), 40, z))
        for y in np.arange(-4, 85, 3.0):
            group.add(box(0.1, 0.07, 0.6), steel, (side * (x - 1.12), float(y), 0))


def _background(kit: Kit, group: Group) -> None:
    """Adds far trees beside and beyond the street, and often hills."""
    far_trees = [tree(kit, far=True) for _ in range(3)]
    for _ in range(int(kit.rng.integers(5, 40))):
        x = kit.uniform(-60, 60)
        y = kit.uniform(70, _FAR) if abs(x) < 14 else kit.uniform(25, _FAR)
        if abs(x) > 9:
            group.insert(
                far_trees[int(kit.rng.integers(3))], (x, y, -0.1), scale=kit.uniform(0.7, 1.6)
            )
    if kit.chance(0.5):
        right, ahead = np.meshgrid(np.linspace(-150, 150, 40), np.linspace(85, 180, 12))
        slope = (ahead - 85) * kit.uniform(0.05, 0.35)
        waves = 4 * np.sin(right / kit.uniform(10, 40)) * np.sin(ahead / 20 + right / 31)
        hills = surface(np.stack([right, ahead, -6 + slope + waves], axis=2))
        group.add(hills, kit.palette.new("foliage", leaf_green(kit), tile_m=15))


def street(kit: Kit) -> Plan:
    """Returns a street along +y with cameras' free box over its lanes."""
    group = Group()
    # Road, vehicles, and both sides of it.
    half = kit.uniform(2.8, 7.0)
    _ground(kit, group, half)
    targets = _traffic(kit, group, half)
    for side in (-1.0, 1.0):
        _verge(kit, group, side, half)
        if kit.chance(0.75):
            buildings.row(kit, group, side, half + kit.uniform(2.5, 7))
        else:
            _grove(kit, group, side, half + kit.uniform(3, 7))
    # What is far, and wires across the street.
    _background(kit, group)
    if kit.chance(0.4):
        for _ in range(int(kit.rng.integers(1, 5))):
            y = kit.uniform(5, 60)
            height = kit.uniform(5, 8)
            group.add(
                rod(
                    (-half - 4, y, height),
                    (half + 4, y + kit.uniform(-4, 4), height + kit.uniform(-1, 1)),
                    0.015,
                    sides=5,
                ),
                kit.dark(),
            )
    # Things on the road, places that the cameras look at, and light.
    clutter.scatter(
        kit,
        group,
        area=clutter.Rectangle((-half - 2, 4), (half + 2, 20), 0.0),
        count=int(kit.rng.integers(0, 4)),
    )
    targets += [(kit.uniform(-9, 9), kit.uniform(10, 60), kit.uniform(0.3, 4)) for _ in range(12)]
    light, sky = _daylight(kit)
    return Plan(
        group=group, lights=light, sky=sky,
        low=(-half * 0.7, -4.0, 1.2), high=(half * 0.7, 12.0, 2.0),
        targets=tuple(targets),
    )  # fmt: skip


def _daylight(kit: Kit) -> tuple[tuple[Light, ...], Sky]:
    """Returns the sun and the sky of a clear or an overcast day."""
    overcast = kit.chance(0.35)
    angle = kit.uniform(0, 6.3)
    power = kit.uniform(0.1, 0.4) if overcast else kit.uniform(1.2, 3.0)
    position = (np.cos(angle), np.sin(angle), kit.uniform(0.25, 1.8))
    sun = Light(
        position=position,
        colour=(power, power * kit.uniform(0.85, 1), power * kit.uniform(0.7, 0.95)),
        radius=0.02,
        sun=True,
    )
    level = kit.uniform(0.6, 1.0) if overcast else kit.uniform(0.25, 0.6)
    blue = 1.0 if overcast else kit.uniform(1.1, 1.5)
    zenith = (0.9, 0.95, 1.0) if overcast else (kit.uniform(0.2, 0.5), kit.uniform(0.45, 0.7), 1.1)
    horizon = kit.uniform(0.9, 1.6)
    return (sun,), Sky(
        zenith=zenith, horizon=(horizon, horizon, horizon * 1.03), clouds=kit.uniform(0, 1),
        ambient_up=(level, level * (1 + blue) / 2, level * blue),
        ambient_down=(level * 0.4, level * 0.38, level * 0.34),
        haze_m=kit.uniform(200, 900) if kit.chance(0.3) else 3000.0,
        occlusion_m=kit.uniform(1.0, 4.0),
    )  # fmt: skip
