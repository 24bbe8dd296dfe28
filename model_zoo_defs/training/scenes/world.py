"""A scene for ray casting, and its cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from model_zoo_defs.training.rendering.materials import MaterialTable
from model_zoo_defs.training.rendering.shapes import FloatArray, Group, IntArray, Mesh, rotation


@dataclass(frozen=True, kw_only=True)
class Light:
    """A light at a position, or a sun in a direction."""

    position: tuple[float, float, float]
    """Metres; of a sun, the direction towards it."""
    colour: tuple[float, float, float]
    """Linear red, green and blue, of any brightness."""
    radius: float
    """Twice the standard deviation of the points that it shines from, which blurs its shadows."""
    sun: bool = False


@dataclass(frozen=True, kw_only=True)
class Sky:
    """Colour of rays that leave the scene, and ambient light."""

    zenith: tuple[float, float, float]
    """Linear colour straight up."""
    horizon: tuple[float, float, float]
    """Linear colour at the horizon, and of haze."""
    clouds: float
    """How white clouds are, 0..1."""
    ambient_up: tuple[float, float, float]
    """Ambient light on surfaces that face up."""
    ambient_down: tuple[float, float, float]
    """Ambient light on surfaces that face down."""
    haze_m: float
    """Distance in which haze hides all but 1/e; 0 for none."""
    occlusion_m: float
    """Distance up to which surfaces keep ambient light away."""


@dataclass(frozen=True, kw_only=True)
class View:
    """A pinhole camera: the ray of pixel (u, v) is R [(u - cx) / fx, (v - cy) / fy, 1].

    Pixel centres are at integers. The columns of R are the camera's right, down and
    forward axes in the world, whose z points up.
    """

    position: FloatArray
    axes: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int

    def rays(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Returns origins and directions (n, 3); a direction's length along the axis is 1."""
        x = (np.asarray(u, np.float32).ravel() - np.float32(self.cx)) / np.float32(self.fx)
        y = (np.asarray(v, np.float32).ravel() - np.float32(self.cy)) / np.float32(self.fy)
        axes = self.axes
        directions = x[:, None] * axes[:, 0] + y[:, None] * axes[:, 1] + axes[:, 2]
        return np.tile(self.position, (len(directions), 1)), directions

    def grid(self) -> tuple[FloatArray, FloatArray]:
        """Returns the rays through all pixel centres, row by row."""
        v, u = np.mgrid[: self.height, : self.width]
        return self.rays(u, v)


def looking(
    position: npt.ArrayLike,
    angles: tuple[float, float, float],
    *,
    fov_deg: float,
    size: tuple[int, int],
    shift: tuple[float, float] = (0.0, 0.0),
) -> View:
    """Returns a view along +y turned by yaw (left), pitch (up) and roll, all in radians.

    Args:
        position: (3,) of the camera, metres.
        angles: Yaw, pitch and roll.
        fov_deg: Horizontal field of view.
        size: Rows and columns of the image.
        shift: Of the principal point, as fractions of width and height.
    """
    height, width = size
    right_forward_up = rotation(*angles)
    axes = np.stack(
        [right_forward_up[:, 0], -right_forward_up[:, 2], right_forward_up[:, 1]], axis=1
    )
    focal_px = width / 2 / np.tan(np.radians(fov_deg) / 2)
    return View(
        position=np.asarray(position, np.float32),
        axes=np.ascontiguousarray(axes),
        fx=float(focal_px),
        fy=float(focal_px),
        cx=(width - 1) / 2 + shift[0] * width,
        cy=(height - 1) / 2 + shift[1] * height,
        height=height,
        width=width,
    )


@dataclass(frozen=True, kw_only=True)
class Hits:
    """First hits of n rays; of a ray that meets nothing, all but `met` is without meaning."""

    met: npt.NDArray[np.bool_]
    """(n,), whether the ray meets a surface."""
    t: FloatArray
    """(n,) in lengths of the ray's direction."""
    face: IntArray
    """Numbers of the triangles (n,)."""
    points: FloatArray
    """(n, 3)."""
    flat: FloatArray
    """Unit normals of the triangles (n, 3), towards the ray's origin."""
    normals: FloatArray
    """Unit normals (n, 3), smooth over the vertices."""
    uv: FloatArray
    """Texture coordinates (n, 2), metres."""
    material: IntArray
    """Numbers of the materials (n,)."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A scene before ray casting, with camera targets and the free box for cameras."""

    group: Group
    lights: tuple[Light, ...]
    sky: Sky
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    targets: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class World:
    """Triangles, materials and lights of a scene."""

    mesh: Mesh
    face_material: IntArray
    table: MaterialTable
    lights: tuple[Light, ...]
    sky: Sky
    far_m: float = 120.0

    @cached_property
    def _embree(self) -> EmbreeScene:
        """The triangles as Embree takes them, for casting rays."""
        scene = EmbreeScene()
        TriangleMesh(scene, self.mesh.vertices, self.mesh.faces)
        return scene

    @cached_property
    def _attributes(self) -> FloatArray:
        """Normal and texture coordinate of each vertex, (vertices, 5)."""
        return np.concatenate([self.mesh.normals, self.mesh.uv], axis=1)

    def depths(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Returns t of the first hit of every ray, 0 where it leaves the scene."""
        hit = self._embree.run(origins, directions, output=1)
        return np.where(hit["primID"] >= 0, hit["tfar"], 0).astype(np.float32)

    def cast(self, origins: FloatArray, directions: FloatArray) -> Hits:
        """Returns the first hits of the rays; both normals face the ray's origin."""
        hit = self._embree.run(origins, directions, output=1)
        met = hit["primID"] >= 0
        face = np.where(met, hit["primID"], 0).astype(np.int32)
        t = np.where(met, hit["tfar"], 0).astype(np.float32)
        corner = self.mesh.faces[face]
        # Normal and texture coordinate between those of the triangle's corners.
        u = hit["u"][:, None]
        v = hit["v"][:, None]
        mixed = self._attributes[corner[:, 0]] * (1 - u - v)
        mixed += self._attributes[corner[:, 1]] * u
        mixed += self._attributes[corner[:, 2]] * v
        flat = _facing(_unit(hit["Ng"]), directions)
        normals = _unit(mixed[:, :3])
        # A smooth normal takes the side of the flat one, then may not turn from the viewer.
        normals = np.where((normals * flat).sum(1, keepdims=True) < 0, -normals, normals)
        return Hits(
            met=met,
            t=t,
            face=face,
            points=origins + directions * t[:, None],
            flat=flat,
            normals=normals,
            uv=mixed[:, 3:],
            material=self.face_material[face],
        )

    def unoccluded(
        self, origins: FloatArray, directions: FloatArray, reach: npt.NDArray[np.float32]
    ) -> FloatArray:
        """Returns 1 for every ray without a hit within `reach` lengths of its direction, else 0."""
        hit = self._embree.run(origins, directions, dists=reach, query="OCCLUDED")
        return np.asarray(hit != 0, np.float32)


def _unit(vectors: FloatArray) -> FloatArray:
    """Returns vectors (n, 3) of length 1 in the same directions."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return np.asarray(vectors / (length[:, None] + 1e-12), np.float32)


def _facing(normals: FloatArray, directions: FloatArray) -> FloatArray:
    """Returns normals (n, 3), turned where they look along the rays, so that all face these."""
    away = np.einsum("ij,ij->i", normals, directions) > 0
    return np.where(away[:, None], -normals, normals)
