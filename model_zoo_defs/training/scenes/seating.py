"""Things to sit or lie on; each stands on z = 0, its back on y = 0, its front toward -y."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    cylinder,
    rod,
    superquadric,
    surface,
    tube,
)
from model_zoo_defs.training.scenes.kit import Kit


def cushion(
    kit: Kit,
    group: Group,
    size: tuple[float, float, float],
    at: tuple[float, float, float],
    material: int,
    **turn: float,
) -> None:
    """Adds a padded block whose middle is at `at`; turn: `pitch` and `yaw` in radians."""
    body = superquadric(size, vertical=kit.uniform(0.25, 0.5), around=kit.uniform(0.2, 0.4))
    group.add(body, material, at, **turn)


def chair(kit: Kit) -> Group:
    """Returns a chair with legs and an open back."""
    group = Group()
    # Size and materials.
    wood = kit.wood() if kit.chance(0.65) else kit.metal()
    seat = kit.surface("fabric", "plain", tile_m=0.3) if kit.chance(0.6) else wood
    width = kit.uniform(0.38, 0.5)
    depth = kit.uniform(0.38, 0.5)
    height = kit.uniform(0.42, 0.48)
    back = kit.uniform(0.75, 1.1)
    thickness = kit.uniform(0.02, 0.045)
    y = -depth / 2
    # Seat and legs.
    if kit.chance(0.5):
        group.add(box(width, depth, 0.04), seat, (0, y, height - 0.04))
    else:
        cushion(kit, group, (width, depth, 0.08), (0, y, height - 0.03), seat)
    for sx in (-1, 1):
        x = sx * (width / 2 - thickness / 2)
        group.add(box(thickness, thickness, height), wood, (x, -depth + thickness / 2, 0))
        group.add(box(thickness, thickness, back), wood, (x, -thickness / 2, 0))
    # Back: boards, bars or a panel.
    style = int(kit.rng.integers(3))
    if style == 0:
        for z in np.linspace(height + 0.1, back - 0.06, int(kit.rng.integers(2, 5))):
            group.add(
                box(width - thickness, thickness * 0.6, 0.045), wood, (0, -thickness / 2, float(z))
            )
    elif style == 1:
        for x in np.linspace(
            -width / 2 + thickness, width / 2 - thickness, int(kit.rng.integers(4, 8))
        ):
            group.add(cylinder(0.008, back - height), wood, (float(x), -thickness / 2, height))
        group.add(box(width, thickness, 0.06), wood, (0, -thickness / 2, back - 0.06))
    else:
        group.add(
            box(width, 0.03, (back - height) * 0.8),
            seat,
            (0, -thickness / 2, height + (back - height) * 0.2),
        )
    return group


def office_chair(kit: Kit) -> Group:
    """Returns a swivel or cantilever chair of bent tube."""
    group = Group()
    steel = kit.metal()
    cloth = kit.surface("fabric", "plain", tile_m=0.3)
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
    group = Group()
    cloth = kit.surface("fabric", "plain", "stripes", "mottled", tile_m=0.4)
    # Size.
    seats = int(kit.rng.integers(1, 4))
    each = kit.uniform(0.55, 0.75)
    depth = kit.uniform(0.75, 0.95)
    height = kit.uniform(0.38, 0.46)
    width = seats * each
    arm = kit.uniform(0.12, 0.25)
    # Body, back and arms.
    group.add(box(width + 2 * arm, depth, height * 0.6), cloth, (0, -depth / 2, 0.06))
    cushion(kit, group, (width + 2 * arm, 0.25, kit.uniform(0.7, 0.95)), (0, -0.13, 0.45), cloth)
    for side in (-1, 1):
        cushion(
            kit,
            group,
            (arm, depth, height * 1.4),
            (side * (width + arm) / 2, -depth / 2, height * 0.75),
            cloth,
        )
    # A cushion for each seat, and pillows.
    for index in range(seats):
        x = (index - (seats - 1) / 2) * each
        cushion(kit, group, (each, depth * 0.75, 0.18), (x, -depth * 0.58, height), cloth)
        if kit.chance(0.6):
            pillow = kit.any_surface()
            s = kit.uniform(0.35, 0.5)
            cushion(
                kit,
                group,
                (s, 0.16, s),
                (x + kit.uniform(-0.1, 0.1), -0.36, height + s * 0.55),
                pillow,
                pitch=-0.35,
                yaw=kit.uniform(-0.3, 0.3),
            )
    return group


def bed(kit: Kit) -> Group:
    """Returns a bed with blanket and pillows."""
    group = Group()
    wood = kit.wood()
    width = kit.uniform(0.9, 1.9)
    depth = kit.uniform(1.9, 2.1)
    group.add(box(width, depth, 0.3), wood, (0, -depth / 2, 0))
    group.add(box(width, 0.06, kit.uniform(0.6, 1.1)), wood, (0, -0.03, 0))
    cushion(
        kit,
        group,
        (width, depth, 0.3),
        (0, -depth / 2, 0.38),
        kit.palette.new("fabric", (0.85, 0.85, 0.85)),
    )
    x, y = np.meshgrid(
        np.linspace(-width * 0.55, width * 0.55, 30), np.linspace(-depth * 1.01, -depth * 0.35, 24)
    )
    z = (
        0.55
        + 0.025 * np.sin(x * kit.uniform(4, 12) + 3 * np.sin(y * 4))
        + 0.015 * np.sin(y * 13 + x * 5)
    )
    z -= np.clip(np.abs(x) - width * 0.48, 0, None) * 4
    group.add(surface(np.stack([x, y, z], axis=2)), kit.any_surface())
    for side in (-0.25, 0.25) if width > 1.3 else (0.0,):
        cushion(
            kit, group, (0.6, 0.4, 0.18), (side * width, -0.35, 0.58), kit.any_surface(), pitch=0.2
        )
    return group
