"""Small things that stand on tables, shelves and floors; each stands on z = 0 at the origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model_zoo_defs.training.materials import Palette
from model_zoo_defs.training.shapes import (
    Group,
    box,
    cylinder,
    lathe,
    prism,
    quads,
    rod,
    superquadric,
    surface,
    torus,
    tube,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Kit:
    """Is what every maker of things draws from: random numbers and the scene's materials."""

    rng: np.random.Generator
    palette: Palette

    def size(self, low: float, high: float) -> float:
        """Returns a length between the two, in metres."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """Returns True that often."""
        return bool(self.rng.random() < probability)

    def surface(self, *kinds: str, tile_m: float = 0.6, vivid: float = 0.35) -> int:
        """Returns a new material of one of the kinds."""
        kind = str(self.rng.choice(kinds))
        return self.palette.new(kind, tile_m=tile_m, vivid=vivid)

    def any_surface(self) -> int:
        """Returns a new material as everyday objects have it."""
        kinds = ("plain", "plain", "plain", "mottled", "spots", "stripes", "checks", "fabric",
                 "poster", "wood", "speckle", "marble")  # fmt: skip
        return self.surface(*kinds, tile_m=self.size(0.1, 0.5), vivid=0.55)

    def wood(self) -> int:
        """Returns a wooden material."""
        tones = ((0.62, 0.45, 0.28), (0.40, 0.26, 0.16), (0.78, 0.62, 0.42), (0.28, 0.19, 0.14))
        tone = np.array(tones[int(self.rng.integers(4))]) * self.rng.uniform(0.85, 1.15)
        return self.palette.new("wood", tone, tile_m=self.size(0.5, 1.2), mirror=self.size(0, 0.03))

    def metal(self) -> int:
        """Returns a metallic material."""
        grey = self.size(0.3, 0.8)
        mirror = self.size(0.05, 0.4)
        return self.palette.new("brushed", (grey,) * 3, tile_m=0.5, gloss=0.8, mirror=mirror)

    def dark(self) -> int:
        """Returns a black or nearly black material."""
        return self.palette.new("plain", (self.size(0.04, 0.16),) * 3, tile_m=0.5)


def mug(kit: Kit) -> Group:
    """Returns a hollow cup with a handle."""
    group, material = Group(), kit.any_surface()
    r, h = kit.size(0.03, 0.05), kit.size(0.07, 0.12)
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
    r, h, neck = kit.size(0.025, 0.05), kit.size(0.15, 0.33), kit.size(0.25, 0.5)
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
            angle, far = kit.size(0, 6.3), r * kit.size(0, 0.5)
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
    group, steel = Group(), kit.metal()
    r, h = kit.size(0.08, 0.16), kit.size(0.04, 0.2)
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
    w, d, h = kit.size(0.05, 0.3), kit.size(0.04, 0.2), kit.size(0.05, 0.3)
    printed = kit.chance(0.5)
    material = (
        kit.palette.new("poster", tile_m=max(w, h), whole=True) if printed else kit.any_surface()
    )
    group.add(box(w, d, h, fit=max(w, h) if printed else 0.0), material)
    return group


def books(kit: Kit) -> Group:
    """Returns a small pile of books, turned against each other."""
    group, z = Group(), 0.0
    for _ in range(int(kit.rng.integers(1, 6))):
        w, d, h = kit.size(0.13, 0.24), kit.size(0.18, 0.3), kit.size(0.008, 0.045)
        cover = kit.palette.new("poster", tile_m=d, whole=True)
        paper = kit.palette.new("stripes", (0.9, 0.88, 0.8), tile_m=0.05)
        yaw, at = kit.size(-0.4, 0.4), (kit.size(-0.02, 0.02), kit.size(-0.02, 0.02), z)
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
    group, case = Group(), kit.metal() if kit.chance(0.5) else kit.dark()
    w, d, tilt = kit.size(0.28, 0.38), kit.size(0.2, 0.26), kit.size(-0.6, 0.1)
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
    group.place(lid, (0, d / 2, 0.014), pitch=tilt)
    return group


def monitor(kit: Kit) -> Group:
    """Returns a flat screen on a foot, facing -y."""
    group, case = Group(), kit.dark()
    w = kit.size(0.4, 0.75)
    h, z = w * kit.size(0.55, 0.65), kit.size(0.08, 0.16)
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
    group, metal = Group(), kit.metal()
    h, r = kit.size(0.25, 0.55), kit.size(0.08, 0.17)
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
    r, h = kit.size(0.05, 0.15), kit.size(0.08, 0.25)
    group.add(cylinder(r * 0.8, h, top=r), kit.any_surface())
    group.add(
        cylinder(r * 0.9, 0.01),
        kit.palette.new("speckle", (0.2, 0.14, 0.1), tile_m=0.1),
        (0, 0, h * 0.95),
    )
    green = kit.palette.new(
        "foliage",
        (kit.size(0.15, 0.4), kit.size(0.35, 0.6), kit.size(0.1, 0.3)),
        tile_m=0.2,
        gloss=0.2,
    )
    count, reach, wide = int(kit.rng.integers(12, 60)), kit.size(0.15, 0.6), kit.size(0.008, 0.05)
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


def gadget(kit: Kit) -> Group:
    """Returns a toy-like pile of rounded bodies."""
    group, z = Group(), 0.0
    for _ in range(int(kit.rng.integers(1, 4))):
        size = kit.rng.uniform(0.03, 0.16, 3)
        body = superquadric(size, vertical=kit.size(0.15, 1.8), around=kit.size(0.15, 1.8))
        shift = size * kit.rng.uniform(-0.3, 0.3, 3)
        group.add(
            body, kit.any_surface(), (shift[0], shift[1], z + size[2] / 2), yaw=kit.size(0, 6.3)
        )
        z += size[2] * kit.size(0.6, 0.98)
    return group


def ring(kit: Kit) -> Group:
    """Returns a ring, flat or leaning."""
    group, r = Group(), kit.size(0.03, 0.1)
    thick = r * kit.size(0.1, 0.5)
    pitch = kit.size(0, 1.4)
    group.add(
        torus(r, thick),
        kit.any_surface(),
        (0, 0, thick + r * np.sin(pitch)),
        pitch=pitch,
        yaw=kit.size(0, 6.3),
    )
    return group


def tool(kit: Kit) -> Group:
    """Returns something long: pen, spoon, screwdriver, ruler, scissors."""
    group = Group()
    long, thick, yaw = kit.size(0.1, 0.35), kit.size(0.003, 0.014), kit.size(0, 6.3)
    c, s = np.cos(yaw) * long / 2, np.sin(yaw) * long / 2
    group.add(rod((-c, -s, thick), (c, s, thick), thick), kit.any_surface())
    if kit.chance(0.6):
        group.add(
            rod((c * 0.2, s * 0.2, thick * 2), (c * 1.3, s * 1.3, thick * 2), thick * 1.9),
            kit.any_surface(),
        )
    if kit.chance(0.3):
        group.add(
            superquadric((0.06, 0.04, 0.016), vertical=0.7), kit.metal(), (-c, -s, 0.01), yaw=yaw
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
                kit.size(-0.2, 0.2)
                / k
                * np.sin(2 * np.pi * k * s * kit.size(0.4, 1) + kit.size(0, 6))
            )
    thick = kit.size(0.002, 0.006)
    path[:, 2] = thick + 0.008 * np.abs(np.sin(9 * s))
    group.add(tube(path, thick, sides=6), kit.dark() if kit.chance(0.6) else kit.any_surface())
    return group


def cloth(kit: Kit) -> Group:
    """Returns a crumpled piece of cloth or paper: a rough height field."""
    group, size = Group(), kit.size(0.1, 0.4)
    x, y = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24))
    z = sum(
        kit.size(0.2, 1)
        / k
        * np.abs(np.sin(k * (x * kit.size(-2, 2) + y * kit.size(-2, 2)) + kit.size(0, 6)))
        for k in (1, 2, 3, 5)
    )
    rim = np.clip(1.1 - x**2 - y**2, 0, 1)
    points = np.stack([x * size, y * size, 0.003 + size * kit.size(0.1, 0.4) * z * rim], axis=2)
    points[..., :2] += kit.rng.normal(0, size * 0.01, points[..., :2].shape)
    group.add(surface(points), kit.any_surface())
    return group


def letters(kit: Kit) -> Group:
    """Returns standing block letters built of bars."""
    group, material = Group(), kit.any_surface()
    h, d = kit.size(0.06, 0.2), kit.size(0.015, 0.05)
    t = h * kit.size(0.14, 0.24)
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
    spots = {"l": (t, h, -0.3, 0), "r": (t, h, 0.3, 0), "m": (t, h, 0, 0),
             "t": (h * 0.6 + t, t, 0, h - t), "b": (h * 0.6 + t, t, 0, 0), "c": (h * 0.6, t, 0, h / 2 - t / 2)}  # fmt: skip
    for index, name in enumerate(kit.rng.choice(list(strokes), int(kit.rng.integers(1, 5)))):
        for stroke in strokes[str(name)]:
            w, tall, x, z = spots[stroke]
            group.add(box(w, d, tall), material, (index * h + x * h, 0, z))
    return group


def frame(kit: Kit) -> Group:
    """Returns a small picture leaning back in its frame."""
    group, tall = Group(), kit.size(0.1, 0.3)
    wide = tall * kit.size(0.6, 1.4)
    group.add(
        box(wide, 0.015, tall), kit.wood() if kit.chance(0.6) else kit.any_surface(), pitch=-0.2
    )
    picture = kit.palette.new("poster", tile_m=tall, whole=True, mirror=0.03)
    group.add(
        box(wide * 0.82, 0.002, tall * 0.82, fit=tall),
        picture,
        (0, -0.009, tall * 0.09),
        pitch=-0.2,
    )
    return group


def wedge(kit: Kit) -> Group:
    """Returns a many-cornered block, such as a house-shaped toy or a piece of cheese."""
    count, r = int(kit.rng.integers(3, 9)), kit.size(0.03, 0.12)
    angle = np.sort(kit.rng.uniform(0, 2 * np.pi, count)) + np.linspace(0, 1, count)
    far = r * kit.rng.uniform(0.6, 1.0, count)
    outline = np.stack([far * np.cos(angle), far * np.sin(angle)], axis=1)
    outline[:, 1] -= outline[:, 1].min()
    group = Group()
    group.add(prism(outline, kit.size(0.02, 0.15)), kit.any_surface(), yaw=kit.size(0, 6.3))
    return group


THINGS: tuple[Callable[[Kit], Group], ...] = (
    mug, bottle, vase, bowl, carton, books, papers, gadget, plant, lamp, tool, cable, cloth,
    letters, frame, laptop, monitor, pot, ring, wedge,
)  # fmt: skip


def scatter(
    kit: Kit,
    group: Group,
    *,
    low: tuple[float, float],
    high: tuple[float, float],
    z: float,
    count: int,
    tallest: float = 0.6,
    things: tuple[Callable[[Kit], Group], ...] = THINGS,
) -> None:
    """Puts about `count` things onto the rectangle at height z, overlapping at times."""
    for _ in range(count):
        item = things[int(kit.rng.integers(len(things)))](kit)
        lower, upper = item.bounds()
        scale = min(
            1.0, tallest / float(upper[2]), (high[1] - low[1]) * 1.2 / float(upper[1] - lower[1])
        )
        at = (kit.size(low[0], high[0]), kit.size(low[1], high[1]), z)
        group.place(
            item, at, yaw=kit.size(-0.6, 0.6) if kit.chance(0.6) else kit.size(0, 6.3), scale=scale
        )
