"""Cars, vans, lorries and cyclists; each along +y (front), standing on z = 0."""

from __future__ import annotations

import numpy as np

from model_zoo_defs.training.rendering.shapes import (
    Group,
    Mesh,
    box,
    cylinder,
    joined,
    quads,
    rod,
    superquadric,
    surface,
    torus,
)  # fmt: skip
from model_zoo_defs.training.scenes import figures
from model_zoo_defs.training.scenes.kit import Kit


def _loft(stations: list[tuple[float, float, float, float]], power: float) -> Mesh:
    """Returns a closed hull through stations of (y, half width, low z, high z)."""
    # A rounded rectangle: power 1 is an ellipse, 0 a rectangle.
    angle = np.linspace(0, 2 * np.pi, 25)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    x = np.sign(cosine) * np.abs(cosine) ** power
    z = np.sign(sine) * np.abs(sine) ** power
    # The ends are closed by stations of nearly no size.
    rows = [
        (
            stations[0][0],
            0.01,
            (stations[0][2] + stations[0][3]) / 2,
            (stations[0][2] + stations[0][3]) / 2 + 0.01,
        )
    ]
    rows += stations
    rows.append(
        (
            stations[-1][0],
            0.01,
            (stations[-1][2] + stations[-1][3]) / 2,
            (stations[-1][2] + stations[-1][3]) / 2 + 0.01,
        )
    )
    # A ring of points for each station, the last point the first.
    points = np.empty((len(rows), 25, 3))
    for index, (y, half, low, high) in enumerate(rows):
        points[index, :, 0] = half * x
        points[index, :, 1] = y
        points[index, :, 2] = (low + high) / 2 + (high - low) / 2 * z
    points[:, -1] = points[:, 0]
    return surface(points)


def _wheels(kit: Kit, group: Group, track: float, axles: tuple[float, ...], radius: float) -> None:
    """Adds a wheel on both sides of each axle, standing on z = 0.

    Args:
        kit: Random numbers and materials.
        group: Group that they are added to.
        track: Distance of the wheels' middle planes from x = 0 in metres.
        axles: Each axle's y in metres.
        radius: Radius of the wheels in metres.
    """
    tyre = kit.dark()
    hub = kit.metal()
    for y in axles:
        for side in (-1, 1):
            at = (side * track - 0.1, y, radius)
            group.add(cylinder(radius, 0.2, sides=22), tyre, at, roll=np.pi / 2)
            out = side * track + (0.105 if side > 0 else -0.105)
            group.add(
                cylinder(radius * 0.62, 0.012, sides=14),
                hub,
                (out - 0.006, y, radius),
                roll=np.pi / 2,
            )


def car(kit: Kit) -> Group:
    """Returns a passenger car."""
    group = Group()
    # Materials.
    paint_colours = (
        (0.85,) * 3,
        (0.6,) * 3,
        (0.1,) * 3,
        (0.3,) * 3,
        (0.5, 0.08, 0.07),
        (0.1, 0.18, 0.4),
    )
    base = np.array(paint_colours[int(kit.rng.integers(6))]) * kit.uniform(0.8, 1.1)
    vivid = kit.chance(0.2)
    paint = kit.palette.new(
        "plain", None if vivid else base, gloss=0.7, mirror=kit.uniform(0.04, 0.12), vivid=1.0
    )
    glass = kit.palette.new("plain", (0.06, 0.07, 0.08), gloss=0.7, mirror=kit.uniform(0.1, 0.25))
    # Measures: half its width, and heights of its lines above the road.
    long = kit.uniform(3.7, 4.8)
    half = kit.uniform(0.82, 0.93)
    low = kit.uniform(0.18, 0.24)
    belt = kit.uniform(0.82, 0.98)
    roof = kit.uniform(1.4, 1.72)
    hood = belt - kit.uniform(0.02, 0.14)
    front = long / 2
    rear = -long / 2
    estate = kit.chance(0.55)
    # Body, cabin and roof.
    body = [
        (rear, half * 0.86, low + 0.12, belt * 0.85),
        (rear + 0.12, half * 0.95, low + 0.03, belt * 0.97),
        (rear + 0.8, half, low, belt),
        (0.2, half, low, belt),
        (front - 1.2, half * 0.99, low, hood),
        (front - 0.5, half * 0.96, low + 0.02, hood * 0.92),
        (front - 0.1, half * 0.9, low + 0.06, hood * 0.8),
        (front, half * 0.8, low + 0.12, hood * 0.62),
    ]
    group.add(_loft(body, 0.35), paint)
    tail = rear + (0.1 if estate else kit.uniform(0.45, 0.85))
    cabin = [
        (tail, half * 0.82, belt - 0.1, belt + 0.02),
        (tail + (0.3 if estate else 0.7), half * 0.76, belt - 0.1, roof - 0.04),
        (0.1, half * 0.77, belt - 0.1, roof),
        (front - 1.95, half * 0.76, belt - 0.1, roof - 0.05),
        (front - 1.1, half * 0.83, belt - 0.1, hood + 0.03),
    ]
    group.add(_loft(cabin, 0.4), glass)
    top = [(y, half_width * 0.93, z - 0.05, z + 0.012) for y, half_width, _, z in cabin[1:4]]
    group.add(_loft(top, 0.5), paint)
    # On both sides: pillars, mirror, lights and trim.
    for side in (-1, 1):
        for start, end in ((cabin[0], cabin[1]), (cabin[4], cabin[3])):
            group.add(
                rod(
                    (side * start[1] * 0.96, start[0], start[3] - 0.02),
                    (side * end[1] * 0.93, end[0], end[3]),
                    0.035,
                ),
                paint,
            )
        group.add(
            box(0.03, 0.07, roof - belt + 0.02),
            paint,
            (side * half * 0.8, -0.15, belt - 0.03),
            roll=-side * 0.1,
        )
        group.add(
            superquadric((0.16, 0.1, 0.12), vertical=0.5),
            paint,
            (side * (half + 0.07), front - 1.5, belt + 0.05),
        )
        light = kit.palette.new("plain", (0.9, 0.9, 0.85), gloss=0.8, mirror=0.2)
        group.add(
            superquadric((0.36, 0.16, 0.15), vertical=0.6),
            light,
            (side * half * 0.66, front - 0.1, hood * 0.72),
        )
        red = kit.palette.new("plain", (0.6, 0.04, 0.04), gloss=0.8, glow=kit.uniform(0, 1))
        group.add(
            superquadric((0.2, 0.1, 0.3), vertical=0.5),
            red,
            (side * half * 0.78, rear + 0.06, belt * 0.85),
        )
        group.add(box(0.005, long * 0.5, 0.02), kit.dark(), (side * half, -0.1, belt * 0.6))
    # Plates and bumper.
    plate = kit.palette.new("poster", (0.9, 0.9, 0.8), tile_m=0.5)
    group.add(box(0.5, 0.02, 0.11), plate, (0, front + 0.005, low + 0.22))
    group.add(box(0.5, 0.02, 0.11), plate, (0, rear - 0.005, belt * 0.6))
    group.add(box(half * 1.5, 0.06, 0.14), kit.dark(), (0, front - 0.03, low + 0.05))
    # Wheels.
    radius = kit.uniform(0.29, 0.36)
    # A dark box under the car and dark discs behind the wheels stand for the wheel arches.
    group.add(box(half * 1.8, long * 0.86, 0.3), kit.dark(), (0, 0, low - 0.02))
    arch = kit.dark()
    for y in (front - 0.82, rear + 0.78):
        group.add(
            cylinder(radius * 1.16, 2 * half + 0.012, sides=22),
            arch,
            (-half - 0.006, y, radius + 0.02),
            roll=np.pi / 2,
        )
    _wheels(kit, group, half - 0.08, (front - 0.82, rear + 0.78), radius)
    return group


def lorry(kit: Kit) -> Group:
    """Returns a van, bus or lorry."""
    group = Group()
    # Materials, length and the heights of its parts.
    paint = kit.palette.new("plain", gloss=0.5, mirror=0.05, vivid=0.5)
    glass = kit.palette.new("plain", (0.06, 0.07, 0.08), gloss=0.7, mirror=0.2)
    long = kit.uniform(4.8, 11)
    half = kit.uniform(0.95, 1.25)
    tall = kit.uniform(1.9, 3.4)
    front = long / 2
    rear = -long / 2
    # A closed body, or a cab before a load.
    body = [
        (rear, half, 0.4, tall),
        (front - 0.7, half, 0.4, tall),
        (front, half * 0.96, 0.4, tall * 0.55),
    ]
    if kit.chance(0.4):
        load = kit.surface("plain", "poster", "stripes", tile_m=2.5, vivid=0.4)
        group.add(box(2 * half, long * 0.72, tall - 0.6), load, (0, rear + long * 0.36, 0.7))
        body = [
            (front - 1.7, half * 0.95, 0.4, tall * 0.85),
            (front - 0.3, half * 0.95, 0.4, tall * 0.85),
            (front, half * 0.9, 0.4, tall * 0.6),
        ]
        group.add(box(half, long * 0.9, 0.3), kit.dark(), (0, 0, 0.5))
    group.add(_loft(body, 0.25), paint)
    # Windows at the sides, before and behind.
    for side in (-1, 1):
        y = front - 1.6
        while y > body[0][0] + 0.6:
            group.add(box(0.02, 0.9, 0.55), glass, (side * half * 0.995, y, tall * 0.55))
            y -= 1.1
    group.add(box(half * 1.7, 0.05, tall * 0.3), glass, (0, front - 0.25, tall * 0.55), pitch=0.45)
    group.add(box(half * 1.5, 0.02, tall * 0.25), glass, (0, rear - 0.005, tall * 0.55))
    # Wheels.
    _wheels(kit, group, half - 0.1, (front - 0.9, rear + 0.9), 0.42)
    return group


def cyclist(kit: Kit) -> Group:
    """Returns a bicycle with a rider."""
    group = Group()
    group.insert(figures.bicycle(kit), (0.2, 0, 0), yaw=np.pi / 2)
    cloth = kit.any_surface()
    skin = kit.palette.new("plain", (0.75, 0.55, 0.42))
    group.add(rod((0, -0.25, 1.0), (0, 0.1, 1.5), 0.15), cloth)
    group.add(superquadric((0.19, 0.22, 0.27)), skin, (0, 0.17, 1.68))
    group.add(superquadric((0.22, 0.26, 0.16)), kit.any_surface(), (0, 0.16, 1.78))
    for side in (-1, 1):
        group.add(rod((side * 0.17, 0.1, 1.42), (side * 0.22, 0.36, 1.02), 0.045), cloth)
        knee = (side * 0.12, 0.1, 0.78 + side * 0.1)
        group.add(rod((side * 0.1, -0.25, 0.95), knee, 0.07), kit.dark())
        group.add(rod(knee, (side * 0.1, -0.02, 0.3 + side * 0.1), 0.055), kit.dark())
    return group


def street_box(kit: Kit) -> Group:
    """Returns a wheeled bin, a hydrant or a box on the pavement."""
    group = Group()
    choice = kit.rng.random()
    if choice < 0.5:
        shell = kit.palette.new("plain", vivid=0.5)
        body = np.array(
            [[(-0.25, -0.25, 0.1), (0.25, -0.25, 0.1), (0.3, -0.3, 1.0), (-0.3, -0.3, 1.0)]]
        )
        # Two walls across and two along, each mirrored.
        group.add(joined([quads(body), quads(body * np.array([1, -1, 1]))]), shell)
        side = body[:, :, [1, 0, 2]]
        group.add(joined([quads(side), quads(side * np.array([-1, 1, 1]))]), shell)
        group.add(box(0.64, 0.66, 0.06), shell, (0, 0, 1.0))
        for x in (-0.22, 0.22):
            group.add(torus(0.08, 0.03), kit.dark(), (x, 0.25, 0.1), roll=np.pi / 2)
    elif choice < 0.75:
        group.add(cylinder(0.09, kit.uniform(0.6, 1.1)), kit.surface("plain", "stripes", vivid=0.5))
    else:
        group.add(
            box(kit.uniform(0.4, 1.4), kit.uniform(0.3, 0.6), kit.uniform(0.5, 1.6)),
            kit.any_surface(),
        )
    return group
