"""People and bicycles, standing on z = 0."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import Group, cylinder, rod, superquadric, torus, tube
from model_zoo_defs.training.scenes.kit import Kit


def person(kit: Kit) -> Group:
    """Returns a standing or sitting figure of rounded bodies, about the origin."""
    group = Group()
    # Clothes, skin and size.
    cloth = kit.any_surface()
    legs = kit.surface("plain", "fabric", vivid=0.2)
    skin = kit.palette.new(
        "plain", np.array([0.85, 0.65, 0.52]) * kit.uniform(0.45, 1.1), gloss=0.1
    )
    height = kit.uniform(1.5, 1.9)
    stride = kit.uniform(0, 0.3)
    # Legs, feet, arms and hands; the arms swing against the legs.
    for side in (-1, 1):
        x = side * 0.09
        foot = side * stride
        group.add(
            tube(
                [
                    (x, 0, height * 0.5),
                    (x * 1.1, -0.03 + foot * 0.4, height * 0.27),
                    (x * 1.1, foot, 0.05),
                ],
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
                    (side * 0.2, 0, height * 0.8),
                    (side * 0.26, swing * 0.4, height * 0.64),
                    (side * 0.24, swing - 0.08, height * 0.5),
                ],
                0.045,
            ),
            cloth,
        )
        group.add(superquadric((0.08, 0.08, 0.12)), skin, (side * 0.24, swing - 0.1, height * 0.47))
    # Trunk, neck, head and hair.
    group.add(
        superquadric((0.4, 0.25, height * 0.38), vertical=0.6, around=0.8),
        cloth,
        (0, 0, height * 0.66),
    )
    group.add(cylinder(0.05, 0.1), skin, (0, 0, height * 0.83))
    group.add(superquadric((0.17, 0.2, 0.25)), skin, (0, -0.01, height * 0.93))
    group.add(
        superquadric((0.19, 0.2, 0.18)),
        kit.palette.new("foliage", (0.2, 0.13, 0.08)),
        (0, 0.02, height * 0.955),
    )
    return group


def bicycle(kit: Kit) -> Group:
    """Returns a bicycle along x."""
    group = Group()
    paint = kit.palette.new("plain", vivid=0.9, gloss=0.6)
    tyre = kit.dark()
    for x in (-0.52, 0.52):
        group.add(torus(0.33, 0.018), tyre, (x, -0.2, 0.35), pitch=np.pi / 2)
        for angle in np.arange(6) * np.pi / 6:
            along_x = 0.32 * np.cos(angle)
            along_z = 0.32 * np.sin(angle)
            group.add(
                rod(
                    (x - along_x, -0.2, 0.35 - along_z),
                    (x + along_x, -0.2, 0.35 + along_z),
                    0.003,
                    sides=4,
                ),
                tyre,
            )
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
