"""Small odds and ends, and how they lie about; each stands on z = 0 at the origin."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    box,
    prism,
    rod,
    superquadric,
    surface,
    torus,
    tube,
)
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


def gadget(kit: Kit) -> Group:
    """Returns a toy-like pile of rounded bodies on z = 0."""
    group = Group()
    z = 0.0
    for _ in range(int(kit.rng.integers(1, 4))):
        size = kit.rng.uniform(0.03, 0.16, 3)
        body = superquadric(size, vertical=kit.uniform(0.15, 1.8), around=kit.uniform(0.15, 1.8))
        shift = size * kit.rng.uniform(-0.3, 0.3, 3)
        group.add(
            body, kit.any_surface(), (shift[0], shift[1], z + size[2] / 2), yaw=kit.uniform(0, 6.3)
        )
        z += size[2] * kit.uniform(0.6, 0.98)
    return group


def ring(kit: Kit) -> Group:
    """Returns a ring on z = 0, flat or leaning."""
    group = Group()
    radius = kit.uniform(0.03, 0.1)
    thick = radius * kit.uniform(0.1, 0.5)
    pitch = kit.uniform(0, 1.4)
    # So high that the lowest point of the leaning ring touches the ground.
    group.add(
        torus(radius, thick),
        kit.any_surface(),
        (0, 0, thick + radius * np.sin(pitch)),
        pitch=pitch,
        yaw=kit.uniform(0, 6.3),
    )
    return group


def tool(kit: Kit) -> Group:
    """Returns something long: pen, spoon, screwdriver, ruler, scissors."""
    group = Group()
    long = kit.uniform(0.1, 0.35)
    thick = kit.uniform(0.003, 0.014)
    yaw = kit.uniform(0, 6.3)
    along_x = np.cos(yaw) * long / 2
    along_y = np.sin(yaw) * long / 2
    group.add(rod((-along_x, -along_y, thick), (along_x, along_y, thick), thick), kit.any_surface())
    if kit.chance(0.6):
        group.add(
            rod(
                (along_x * 0.2, along_y * 0.2, thick * 2),
                (along_x * 1.3, along_y * 1.3, thick * 2),
                thick * 1.9,
            ),
            kit.any_surface(),
        )
    if kit.chance(0.3):
        group.add(
            superquadric((0.06, 0.04, 0.016), vertical=0.7),
            kit.metal(),
            (-along_x, -along_y, 0.01),
            yaw=yaw,
        )
    return group


def cable(kit: Kit) -> Group:
    """Returns a thin cable lying in loops."""
    group = Group()
    s = np.linspace(0, 1, 40)
    path = np.zeros((40, 3))
    for axis in (0, 1):
        for k in (1, 2, 3):
            path[:, axis] += (
                kit.uniform(-0.2, 0.2)
                / k
                * np.sin(2 * np.pi * k * s * kit.uniform(0.4, 1) + kit.uniform(0, 6))
            )
    thick = kit.uniform(0.002, 0.006)
    path[:, 2] = thick + 0.008 * np.abs(np.sin(9 * s))
    group.add(tube(path, thick, sides=6), kit.dark() if kit.chance(0.6) else kit.any_surface())
    return group


def cloth(kit: Kit) -> Group:
    """Returns a crumpled piece of cloth or paper: a rough height field, low at its rim."""
    group = Group()
    # Creases of four frequencies, each in a direction of its own, on a square of 2 · size.
    size = kit.uniform(0.1, 0.4)
    x, y = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24))
    z = sum(
        kit.uniform(0.2, 1)
        / k
        * np.abs(np.sin(k * (x * kit.uniform(-2, 2) + y * kit.uniform(-2, 2)) + kit.uniform(0, 6)))
        for k in (1, 2, 3, 5)
    )
    # Toward the corners the height falls to 3 mm, and the outline is not quite straight.
    rim = np.clip(1.1 - x**2 - y**2, 0, 1)
    points = np.stack([x * size, y * size, 0.003 + size * kit.uniform(0.1, 0.4) * z * rim], axis=2)
    points[..., :2] += kit.rng.normal(0, size * 0.01, points[..., :2].shape)
    group.add(surface(points), kit.any_surface())
    return group


def letters(kit: Kit) -> Group:
    """Returns standing block letters built of bars."""
    group = Group()
    material = kit.any_surface()
    height = kit.uniform(0.06, 0.2)
    depth = kit.uniform(0.015, 0.05)
    thickness = height * kit.uniform(0.14, 0.24)
    strokes = {
        "L": "lb",
        "T": "tm",
        "H": "lrc",
        "E": "ltcb",
        "U": "lrb",
        "O": "lrtb",
        "F": "ltc",
        "A": "lrtc",
    }
    spots = {
        "l": (thickness, height, -0.3, 0),
        "r": (thickness, height, 0.3, 0),
        "m": (thickness, height, 0, 0),
        "t": (height * 0.6 + thickness, thickness, 0, height - thickness),
        "b": (height * 0.6 + thickness, thickness, 0, 0),
        "c": (height * 0.6, thickness, 0, height / 2 - thickness / 2),
    }
    for index, name in enumerate(kit.rng.choice(list(strokes), int(kit.rng.integers(1, 5)))):
        for stroke in strokes[str(name)]:
            width, tall, x, z = spots[stroke]
            group.add(box(width, depth, tall), material, (index * height + x * height, 0, z))
    return group


def frame(kit: Kit) -> Group:
    """Returns a small framed photo leaning back."""
    group = Group()
    tall = kit.uniform(0.1, 0.3)
    wide = tall * kit.uniform(0.6, 1.4)
    group.add(
        box(wide, 0.015, tall), kit.wood() if kit.chance(0.6) else kit.any_surface(), pitch=-0.2
    )
    photo = kit.palette.new("poster", tile_m=tall, whole=True, mirror=0.03)
    group.add(
        box(wide * 0.82, 0.002, tall * 0.82, fit=tall), photo, (0, -0.009, tall * 0.09), pitch=-0.2
    )
    return group


def wedge(kit: Kit) -> Group:
    """Returns a many-cornered block, such as a house-shaped toy or a piece of cheese."""
    count = int(kit.rng.integers(3, 9))
    radius = kit.uniform(0.03, 0.12)
    angle = np.sort(kit.rng.uniform(0, 2 * np.pi, count)) + np.linspace(0, 1, count)
    far = radius * kit.rng.uniform(0.6, 1.0, count)
    outline = np.stack([far * np.cos(angle), far * np.sin(angle)], axis=1)
    outline[:, 1] -= outline[:, 1].min()
    group = Group()
    group.add(prism(outline, kit.uniform(0.02, 0.15)), kit.any_surface(), yaw=kit.uniform(0, 6.3))
    return group


THINGS: tuple[Callable[[Kit], Group], ...] = (
    mug, bottle, vase, bowl, carton, books, papers, gadget, plant, lamp, tool, cable, cloth,
    letters, frame, laptop, monitor, pot, ring, wedge,
)  # fmt: skip


class Rectangle(NamedTuple):
    """A horizontal rectangle that things stand on, in metres."""

    low: tuple[float, float]
    """Least x and y."""
    high: tuple[float, float]
    """Greatest x and y."""
    z: float
    """Height."""


def scatter(
    kit: Kit,
    group: Group,
    *,
    area: Rectangle,
    count: int,
    tallest: float = 0.6,
    things: tuple[Callable[[Kit], Group], ...] = THINGS,
) -> None:
    """Adds about `count` objects onto the rectangle; some overlap."""
    low, high = area.low, area.high
    for _ in range(count):
        item = things[int(kit.rng.integers(len(things)))](kit)
        lower, upper = item.bounds()
        scale = min(
            1.0, tallest / float(upper[2]), (high[1] - low[1]) * 1.2 / float(upper[1] - lower[1])
        )
        at = (kit.uniform(low[0], high[0]), kit.uniform(low[1], high[1]), area.z)
        group.insert(
            item,
            at,
            yaw=kit.uniform(-0.6, 0.6) if kit.chance(0.6) else kit.uniform(0, 6.3),
            scale=scale,
        )
