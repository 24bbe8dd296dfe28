"""Shading of the rays of a view: light, shadow, reflection, sky and antialiased edges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from model_zoo_defs.training.rendering import textures
from model_zoo_defs.training.rendering.shapes import FloatArray
from model_zoo_defs.training.scenes.world import Hits, View, World


def seen(
    world: World, view: View, rng: np.random.Generator, *, ambient_rays: int = 3
) -> tuple[FloatArray, FloatArray]:
    """Returns what a camera sees: linear colour (H, W, 3), exact depth along the axis (H, W).

    Depth is 0 where it is unknown: where no surface is met, or beyond the world's reach.

    Args:
        world: The scene.
        view: The camera.
        rng: Random numbers.
        ambient_rays: Rays a pixel for ambient occlusion; more give less noise.
    """
    shape = (view.height, view.width)
    origins, directions = view.grid()
    hits = world.cast(origins, directions)
    visible = _visibility(world, hits, rng, ambient_rays=ambient_rays)
    visible = _smoothed(visible, hits, shape)
    colour = _radiance(world, view, hits, directions, visible, reflect=True)
    colour = colour.reshape(*shape, 3)
    _smooth_edges(world, view, hits, colour, rng, max(1, ambient_rays // 3))
    depth = np.where(hits.met & (hits.t <= world.far_m), hits.t, 0).reshape(shape)
    return colour, depth.astype(np.float32)


def _visibility(
    world: World, hits: Hits, rng: np.random.Generator, *, ambient_rays: int
) -> FloatArray:
    """Returns (n, 1 + lights): unoccluded fraction of the surroundings, then of each light."""
    count = len(hits.t)
    start = hits.points + hits.flat * (1e-3 + 3e-4 * hits.t)[:, None]
    result = np.ones((count, 1 + len(world.lights)), np.float32)
    reach = np.full(count, world.sky.occlusion_m, np.float32)
    ambient = np.zeros(count, np.float32)
    for _ in range(ambient_rays):
        toward = rng.standard_normal((count, 3), dtype=np.float32)
        toward /= np.sqrt(np.einsum("ij,ij->i", toward, toward))[:, None] + 1e-6
        toward += hits.flat * np.float32(1.02)
        ambient += world.unoccluded(start, toward, reach)
    result[:, 0] = ambient / ambient_rays
    for index, light in enumerate(world.lights):
        jitter = rng.standard_normal((count, 3), dtype=np.float32) * np.float32(light.radius / 2)
        position = np.asarray(light.position, np.float32)
        toward = (position + jitter) if light.sun else (position + jitter - start)
        away = np.full(count, 500.0 if light.sun else 0.97, np.float32)
        result[:, 1 + index] = world.unoccluded(start, toward.astype(np.float32), away)
    return result


def _smoothed(visible: FloatArray, hits: Hits, shape: tuple[int, int]) -> FloatArray:
    """Returns the visibility averaged over neighbours of the same material and plane."""
    channels = visible.shape[1]
    image = visible.reshape(*shape, channels)
    normals = hits.flat.reshape(*shape, 3)
    offset = np.einsum("ij,ij->i", hits.points, hits.flat).reshape(shape)
    tolerance = (0.02 + 0.01 * hits.t).reshape(shape)
    material = hits.material.reshape(shape)
    for axis in (0, 1):
        total = image.copy()
        weight = np.ones(shape, np.float32)
        for step in (1, 2, 3):
            here = tuple(slice(step, None) if a == axis else slice(None) for a in (0, 1))
            there = tuple(slice(None, -step) if a == axis else slice(None) for a in (0, 1))
            like = np.abs(offset[here] - offset[there]) < tolerance[here]
            like &= np.einsum("ijk,ijk->ij", normals[here], normals[there]) > 0.9
            like &= material[here] == material[there]
            same_surface = like.astype(np.float32)
            total[here] += image[there] * same_surface[..., None]
            total[there] += image[here] * same_surface[..., None]
            weight[here] += same_surface
            weight[there] += same_surface
        image = total / weight[..., None]
    return image.reshape(-1, channels)


def _radiance(
    world: World,
    view: View,
    hits: Hits,
    directions: FloatArray,
    visible: FloatArray,
    *,
    reflect: bool,
) -> FloatArray:
    """Returns the linear colour (n, 3) that comes back along every ray."""
    # How large a pixel is on the surface chooses the level of the texture.
    length = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    back = -directions / length[:, None]
    facing = np.clip(np.einsum("ij,ij->i", hits.normals, back), 0.08, 1)
    footprint = hits.t / view.fx / np.sqrt(facing)
    albedo = world.table.albedo(hits.material, hits.uv, footprint.astype(np.float32))
    # Light that falls on it, light that it gives, highlights and reflections.
    colour = albedo * _lit(world, hits, back, visible)
    colour += albedo * world.table.glow[hits.material][:, None]
    colour += _highlights(world, hits, back, visible)
    if reflect:
        _reflect(world, view, hits, back, facing.astype(np.float32), colour)
    # Haze, and the sky where nothing was met.
    if world.sky.haze_m > 0:
        clear = np.exp(-hits.t / world.sky.haze_m)[:, None]
        haze = np.asarray(world.sky.horizon, np.float32)
        colour = colour * clear + haze * (1 - clear)
    missed = np.flatnonzero(~hits.met)
    colour[missed] = _sky(world, -back[missed])
    return np.asarray(colour, np.float32)


def _toward(
    position: tuple[float, float, float], sun: bool, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns unit directions to the light (n, 3) and its intensity at the points (n,)."""
    if sun:
        direction = np.asarray(position, np.float32)
        direction = direction / np.linalg.norm(direction)
        return np.broadcast_to(direction, points.shape), np.ones(len(points), np.float32)
    toward = np.asarray(position, np.float32) - points
    square = np.einsum("ij,ij->i", toward, toward)
    return toward / np.sqrt(square)[:, None], 1 / (square + 0.4)


def _lit(world: World, hits: Hits, back: FloatArray, visible: FloatArray) -> FloatArray:
    """Returns the light (n, 3) that falls on matt surfaces, by Lambert's law.

    Args:
        world: The scene.
        hits: Points on the surfaces.
        back: Unit directions to the camera (n, 3).
        visible: What reaches each point of the surroundings and of each light, of `_visibility`.
    """
    # Of the surroundings, between the colour below and that above.
    up = (0.5 + 0.5 * hits.normals[:, 2:]).astype(np.float32)
    above = np.asarray(world.sky.ambient_up, np.float32)
    below = np.asarray(world.sky.ambient_down, np.float32)
    light = (below + (above - below) * up) * (0.25 + 0.75 * visible[:, :1])
    for index, lamp in enumerate(world.lights):
        toward, strength = _toward(lamp.position, lamp.sun, hits.points)
        cosine = np.clip(np.einsum("ij,ij->i", hits.normals, toward), 0, 1)
        amount = cosine * strength * visible[:, 1 + index]
        light = light + amount[:, None] * np.asarray(lamp.colour, np.float32)
    return np.asarray(light, np.float32)


def _highlights(world: World, hits: Hits, back: FloatArray, visible: FloatArray) -> FloatArray:
    """Returns the light (n, 3) of highlights on glossy surfaces, by Blinn and Phong's model.

    The arguments are those of `_lit`.
    """
    gloss = world.table.gloss[hits.material]
    result = np.zeros((len(gloss), 3), np.float32)
    shiny = np.flatnonzero((gloss > 0) & hits.met)
    if not len(shiny):
        return result
    normals = hits.normals[shiny]
    points = hits.points[shiny]
    gloss = gloss[shiny]
    for index, lamp in enumerate(world.lights):
        toward, strength = _toward(lamp.position, lamp.sun, points)
        middle = toward + back[shiny]
        middle /= np.sqrt(np.einsum("ij,ij->i", middle, middle))[:, None] + 1e-6
        peak = np.clip(np.einsum("ij,ij->i", normals, middle), 0, 1) ** (12 + 100 * gloss)
        amount = gloss * peak * strength * visible[shiny, 1 + index]
        result[shiny] += amount[:, None] * np.asarray(lamp.colour, np.float32)
    return result


def _reflect(
    world: World, view: View, hits: Hits, back: FloatArray, facing: FloatArray, colour: FloatArray
) -> None:
    """Adds reflections of the scene on mirror-like surfaces to `colour`."""
    mirror = world.table.mirror[hits.material]
    pick = np.flatnonzero((mirror > 0) & hits.met)
    if not len(pick):
        return
    normals = hits.normals[pick]
    gaze = back[pick]
    away = 2 * np.einsum("ij,ij->i", normals, gaze)[:, None] * normals - gaze
    start = hits.points[pick] + hits.flat[pick] * (2e-3 + 3e-4 * hits.t[pick])[:, None]
    again = world.cast(start, np.ascontiguousarray(away, dtype=np.float32))
    open_everywhere = np.full((len(pick), 1 + len(world.lights)), 0.7, np.float32)
    other = _radiance(world, view, again, away, open_everywhere, reflect=False)
    reflected = mirror[pick] + (1 - mirror[pick]) * 0.8 * (1 - facing[pick]) ** 5
    colour[pick] = colour[pick] * (1 - reflected[:, None]) + other * reflected[:, None]


def _sky(world: World, gaze: FloatArray) -> FloatArray:
    """Returns the colour (n, 3) of the sky in unit directions (n, 3), with its clouds."""
    height = np.clip(gaze[:, 2:], 0, 1) ** 0.6
    zenith = np.asarray(world.sky.zenith, np.float32)
    horizon = np.asarray(world.sky.horizon, np.float32)
    colour = horizon + (zenith - horizon) * height
    if world.sky.clouds > 0:
        tile = textures.noise_tiles()[-1]
        flat = gaze[:, :2] / (np.abs(gaze[:, 2:]) + 0.15)
        index = (flat * 40).astype(np.int32) & (textures.SIDE - 1)
        cover = np.clip((tile[index[:, 1], index[:, 0]] - 0.45) * 4, 0, 1) * world.sky.clouds
        colour += (np.float32(1.0) * horizon.max() - colour) * cover[:, None]
    return np.asarray(colour, np.float32)


_EDGE_SAMPLES: npt.NDArray[np.float32] = np.array(
    [[-0.13, -0.38], [0.38, -0.13], [0.13, 0.38], [-0.38, 0.13]], np.float32
)
"""Where a pixel on an edge is sampled: columns and rows from its centre, a rotated grid."""


def _smooth_edges(
    world: World,
    view: View,
    hits: Hits,
    colour: FloatArray,
    rng: np.random.Generator,
    ambient_rays: int,
) -> None:
    """Replaces pixels of `colour` along object edges by the mean of four samples each."""
    shape = (view.height, view.width)
    material = np.where(hits.met, hits.material, -1).reshape(shape)
    t = hits.t.reshape(shape)
    normals = hits.flat.reshape(*shape, 3)
    # Pixels that differ from a neighbour in material, distance or direction.
    edge = np.zeros(shape, bool)
    for axis in (0, 1):
        here = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        there = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        jump = np.abs(t[here] - t[there]) > 0.03 * np.minimum(t[here], t[there])
        jump &= np.einsum("ijk,ijk->ij", normals[here], normals[there]) < 0.999
        differs = (material[here] != material[there]) | jump
        differs |= np.einsum("ijk,ijk->ij", normals[here], normals[there]) < 0.7
        edge[here] |= differs
        edge[there] |= differs
    v, u = np.nonzero(edge)
    if not len(v):
        return
    # Four samples of each of these pixels.
    du = _EDGE_SAMPLES[:, :1]
    dv = _EDGE_SAMPLES[:, 1:]
    origins, directions = view.rays(u + du, v + dv)
    samples = world.cast(origins, directions)
    visible = _visibility(world, samples, rng, ambient_rays=ambient_rays)
    sample = _radiance(world, view, samples, directions, visible, reflect=True)
    # A lamp in the mirror must not outshine the other samples of its pixel.
    four = np.minimum(sample, 6.0).reshape(len(_EDGE_SAMPLES), len(v), 3)
    colour[v, u] = four.mean(axis=0)
