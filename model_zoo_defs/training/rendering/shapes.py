"""Triangle meshes of simple bodies, every one in metres with z up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
Point = Sequence[float] | npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Holds n vertices with normal and texture coordinate (metres), and m triangles."""

    vertices: FloatArray
    normals: FloatArray
    uv: FloatArray
    faces: IntArray


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> FloatArray:
    """Returns the 3x3 matrix that turns about y (roll), then x (pitch), then z (yaw); radians."""
    cy = np.cos(yaw)
    sy = np.sin(yaw)
    cp = np.cos(pitch)
    sp = np.sin(pitch)
    cr = np.cos(roll)
    sr = np.sin(roll)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return np.asarray(about_z @ about_x @ about_y, np.float32)


class Group:
    """Collects meshes, each face with its material, in one frame of reference."""

    def __init__(self) -> None:
        self._parts: list[tuple[Mesh, IntArray]] = []

    def add(
        self,
        mesh: Mesh,
        material: int,
        at: Point = (0.0, 0.0, 0.0),
        *,
        yaw: float = 0.0,
        pitch: float = 0.0,
        roll: float = 0.0,
    ) -> None:
        """Adds a rotated and translated copy of the mesh."""
        materials = np.full(len(mesh.faces), material, np.int32)
        self._parts.append((_moved(mesh, at, yaw, pitch, roll, 1.0), materials))

    def insert(
        self,
        other: Group,
        at: Point = (0.0, 0.0, 0.0),
        *,
        yaw: float = 0.0,
        pitch: float = 0.0,
        roll: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        """Adds a scaled, rotated and translated copy of another group."""
        if other._parts:
            mesh, materials = other.merged()
            self._parts.append((_moved(mesh, at, yaw, pitch, roll, scale), materials))

    def merged(self) -> tuple[Mesh, IntArray]:
        """Returns everything as one mesh and the material of each of its faces."""
        if len(self._parts) > 1:
            meshes = [mesh for mesh, _ in self._parts]
            materials = np.concatenate([material for _, material in self._parts])
            self._parts = [(joined(meshes), materials)]
        return self._parts[0]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Returns the lower and the upper corner of the box around everything."""
        vertices = self.merged()[0].vertices
        return vertices.min(axis=0), vertices.max(axis=0)


def _moved(mesh: Mesh, at: Point, yaw: float, pitch: float, roll: float, scale: float) -> Mesh:
    """Returns a copy of the mesh that is scaled, turned as by `rotation`, and moved to `at`."""
    offset = np.asarray(at, np.float32)
    if yaw == 0.0 and pitch == 0.0 and roll == 0.0:
        vertices = mesh.vertices * np.float32(scale) + offset
        normals = mesh.normals
    else:
        turn = rotation(yaw, pitch, roll).T
        vertices = mesh.vertices @ (turn * np.float32(scale)) + offset
        normals = mesh.normals @ turn
    return Mesh(vertices=vertices, normals=normals, uv=mesh.uv, faces=mesh.faces)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Returns one mesh with the faces of all."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        faces=np.concatenate(
            [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]
        ),
    )


def quads(corners: npt.ArrayLike, uv: npt.ArrayLike | None = None) -> Mesh:
    """Returns flat four-cornered faces; corners (k, 4, 3) go round each, uv (k, 4, 2)."""
    points = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    along = points[:, 1] - points[:, 0]
    up = points[:, 3] - points[:, 0]
    normal = np.cross(along, up)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    if uv is None:
        texture = np.zeros((len(points), 4, 2), np.float32)
        texture[:, 1:3, 0] = np.linalg.norm(along, axis=1)[:, None]
        texture[:, 2:4, 1] = np.linalg.norm(up, axis=1)[:, None]
    else:
        texture = np.asarray(uv, np.float32)
    first = np.arange(0, 4 * len(points), 4, dtype=np.int32)[:, None]
    faces = np.concatenate([first + np.array(corners) for corners in ((0, 1, 2), (0, 2, 3))])
    return Mesh(
        vertices=points.reshape(-1, 3),
        normals=np.repeat(normal, 4, axis=0).astype(np.float32),
        uv=texture.reshape(-1, 2),
        faces=faces.astype(np.int32),
    )


_SIGNS = np.array(
    [
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]],
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, 1, -1], [-1, -1, -1], [-1, -1, 1], [-1, 1, 1]],
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
        [[-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, -1]],
    ],
    np.float32,
)
_UNIT_UV = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32), (6, 1, 1))


def box(width: float, depth: float, height: float, *, fit: float = 0.0) -> Mesh:
    """Returns a box standing on z = 0 about the origin; fit: each face shows one whole tile."""
    corners = _SIGNS * np.array([width / 2, depth / 2, height / 2], np.float32)
    corners[..., 2] += np.float32(height / 2)
    return quads(corners, _UNIT_UV * np.float32(fit) if fit else None)


def surface(points: npt.ArrayLike) -> Mesh:
    """Returns a smooth surface through a grid of points (rows, columns, 3)."""
    grid = np.asarray(points, np.float32)
    rows, columns = grid.shape[:2]
    down = np.gradient(grid, axis=0)
    across = np.gradient(grid, axis=1)
    if np.allclose(grid[:, 0], grid[:, -1], atol=1e-6):
        across[:, 0] = across[:, -1] = (grid[:, 1] - grid[:, -2]) / 2
    if np.allclose(grid[0], grid[-1], atol=1e-6):
        down[0] = down[-1] = (grid[1] - grid[-2]) / 2
    normals = np.cross(across, down)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True) + 1e-12
    uv = np.zeros((rows, columns, 2), np.float32)
    steps = np.linalg.norm(np.diff(grid, axis=1), axis=2).max(axis=0)
    uv[..., 0] = np.concatenate([[0], np.cumsum(steps)])
    steps = np.linalg.norm(np.diff(grid, axis=0), axis=2).mean(axis=1)
    uv[..., 1] = np.concatenate([[0], np.cumsum(steps)])[:, None]
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    triangles = ((0, 1, columns + 1), (0, columns + 1, columns))
    faces = np.concatenate([first + np.array(corners) for corners in triangles])
    return Mesh(
        vertices=grid.reshape(-1, 3),
        normals=normals.reshape(-1, 3).astype(np.float32),
        uv=uv.reshape(-1, 2),
        faces=faces.astype(np.int32),
    )


def lathe(profile: npt.ArrayLike, *, sides: int = 20) -> Mesh:
    """Returns the body that a profile of (radius, z) makes when turned about z."""
    outline = np.maximum(np.asarray(profile, np.float32), [1e-4, -1e9])
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle[-1] = circle[0]
    points = np.empty((len(outline), sides + 1, 3), np.float32)
    points[..., :2] = outline[:, None, :1] * circle
    points[..., 2] = outline[:, 1:]
    return surface(points)


def cylinder(radius: float, height: float, *, sides: int = 18, top: float | None = None) -> Mesh:
    """Returns a closed cylinder (or cone frustum) standing on z = 0, with sharp rims."""
    upper = radius if top is None else top
    e = 1e-4 * height
    profile = [(0, 0), (radius, 0), (radius, e), (upper, height - e), (upper, height), (0, height)]
    return joined(
        [lathe(profile[:2], sides=sides), lathe(profile[2:4], sides=sides),
         lathe(profile[4:], sides=sides)]
    )  # fmt: skip


def superquadric(
    size: Point, *, vertical: float = 1.0, around: float = 1.0, rows: int = 14, columns: int = 24
) -> Mesh:
    """Returns a body about the origin between ellipsoid (exponents 1) and box (near 0).

    Args:
        size: Full width, depth and height in metres.
        vertical: Exponent of the outline from pole to pole.
        around: Exponent of the horizontal sections.
        rows: Points from pole to pole.
        columns: Points around.
    """
    # Not up to the poles, where all points of a row would be one.
    lat = np.linspace(-np.pi / 2 + 0.01, np.pi / 2 - 0.01, rows)[:, None]
    lon = np.linspace(-np.pi, np.pi, columns + 1)[None, :]
    ring = _power(np.cos(lat), vertical)
    points = np.stack(
        [
            ring * _power(np.cos(lon), around),
            ring * _power(np.sin(lon), around),
            _power(np.sin(lat), vertical) * np.ones_like(lon),
        ],
        axis=2,
    )
    # The last column is the first one, exactly, so that the surface is closed.
    points[:, -1] = points[:, 0]
    return surface(points * (np.asarray(size, np.float64) / 2))


def _power(base: npt.NDArray[np.floating], exponent: float) -> npt.NDArray[np.floating]:
    """Returns |base| to the power, with the sign of the base."""
    return np.asarray(np.sign(base) * np.abs(base) ** exponent)


def tube(path: npt.ArrayLike, radius: float, *, sides: int = 8) -> Mesh:
    """Returns a round bar along a path of points (k, 3)."""
    line = np.asarray(path, np.float64)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
    # A helper axis far from the mean direction keeps the ring frame from flipping.
    helper = np.eye(3)[np.argmin(np.abs(along).mean(axis=0))]
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-12
    up = np.cross(along, side)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    angle[-1] = 0.0
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    return surface(line[:, None] + radius * ring)


def rod(start: Point, end: Point, radius: float, *, sides: int = 8) -> Mesh:
    """Returns a straight round bar between two points."""
    return tube(np.stack([np.asarray(start), np.asarray(end)]), radius, sides=sides)


def torus(ring: float, radius: float, *, turn: float = 2 * np.pi) -> Mesh:
    """Returns a ring (or a part of one) about the origin, lying in the plane z = 0.

    Args:
        ring: Radius of the ring's middle line in metres.
        radius: Radius of its round section in metres.
        turn: Angle of the part in radians; 2 π is the whole ring.
    """
    angle = np.linspace(0, turn, 25)
    path = np.stack([ring * np.cos(angle), ring * np.sin(angle), np.zeros(25)], axis=1)
    around = np.linspace(0, 2 * np.pi, 9)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], axis=1)
    points = (
        path[:, None]
        + radius * np.cos(around)[None, :, None] * out[:, None]
        + radius * np.sin(around)[None, :, None] * np.array([0, 0, 1.0])
    )
    points[:, -1] = points[:, 0]
    return surface(points)


def prism(outline: npt.ArrayLike, depth: float) -> Mesh:
    """Returns a star-shaped (x, z) outline drawn out along y, about y = 0."""
    ring = np.asarray(outline, np.float64)
    following = np.roll(ring, -1, axis=0)
    centre = np.broadcast_to(ring.mean(axis=0), ring.shape)

    def at(points: npt.NDArray[np.floating], y: float) -> npt.NDArray[np.floating]:
        """Returns points (k, 2) of x and z as (k, 3) at this y."""
        return np.stack([points[:, 0], np.full(len(points), y), points[:, 1]], axis=1)

    half = depth / 2
    sides = np.stack(
        [at(ring, -half), at(following, -half), at(following, half), at(ring, half)], 1
    )
    caps = []
    for y in (-half, half):
        # Each cap is a fan about the centre; the fourth corner halves the fan's triangle.
        middle = (ring + following) / 2
        caps.append(np.stack([at(centre, y), at(ring, y), at(middle, y), at(following, y)], 1))
    corners = np.concatenate([sides, *caps])
    uv = corners[..., [0, 2]].copy()
    uv[: len(ring), :, 0] = corners[: len(ring), :, 1]
    return quads(corners, uv)
