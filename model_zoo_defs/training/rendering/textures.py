"""Square tiling textures of materials, drawn from noise and simple patterns."""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

FloatArray = npt.NDArray[np.float32]

SIDE = 256
"""Pixels along one edge of every texture."""


@lru_cache(maxsize=1)
def noise_tiles() -> FloatArray:
    """Returns 12 tiling noise images, (12, SIDE, SIDE), mean 0.5, ordered by smoothness."""
    rng = np.random.default_rng(20190513)
    fy = np.fft.fftfreq(SIDE)[:, None] * SIDE
    fx = np.fft.rfftfreq(SIDE)[None, :] * SIDE
    frequency = np.maximum(np.hypot(fx, fy), 1.0)
    tiles = []
    for slope in (0.0, 0.5, 0.9, 1.2, 1.5, 1.8):
        for _ in range(2):
            spectrum = np.fft.rfft2(rng.normal(size=(SIDE, SIDE))) / frequency**slope
            spectrum[0, 0] = 0.0
            tile = np.fft.irfft2(spectrum, s=(SIDE, SIDE))
            tiles.append(0.5 + 0.2 * tile / tile.std())
    return np.asarray(np.clip(np.stack(tiles), 0.0, 1.0), np.float32)


def noise(rng: np.random.Generator, *, smooth: float = 0.6) -> FloatArray:
    """Returns one noise image in [0, 1]; smooth from 0 (white) to 1 (clouds)."""
    tiles = noise_tiles()
    pick = min(int(smooth * 6), 5) * 2 + int(rng.integers(2))
    shift = rng.integers(SIDE, size=2)
    tile = np.roll(tiles[pick], tuple(int(s) for s in shift), axis=(0, 1))
    return np.ascontiguousarray(tile.T if rng.random() < 0.5 else tile)


_MUTED = (
    (0.85, 0.82, 0.76), (0.93, 0.93, 0.91), (0.60, 0.58, 0.55), (0.35, 0.34, 0.33),
    (0.55, 0.40, 0.26), (0.38, 0.25, 0.15), (0.72, 0.60, 0.45), (0.25, 0.30, 0.38),
    (0.45, 0.50, 0.42), (0.62, 0.66, 0.70), (0.15, 0.15, 0.16), (0.75, 0.72, 0.60),
)  # fmt: skip


def colour(rng: np.random.Generator, *, vivid: float = 0.3) -> FloatArray:
    """Returns a random display colour in [0, 1], saturated with probability `vivid`."""
    if rng.random() < vivid:
        value = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.25, 0.9), rng.uniform(0.25, 0.95))
        return np.array(value, np.float32)
    base = np.array(_MUTED[int(rng.integers(len(_MUTED)))])
    varied = base * rng.uniform(0.75, 1.15) + rng.normal(0, 0.03, 3)
    return np.clip(varied, 0.03, 0.97).astype(np.float32)


def near(rng: np.random.Generator, base: npt.ArrayLike, deviation: float = 0.08) -> FloatArray:
    """Returns a random colour close to `base`; `deviation` is relative."""
    moved = np.asarray(base) * rng.uniform(1 - 2 * deviation, 1 + 2 * deviation)
    return np.clip(moved + rng.normal(0, deviation / 2, 3), 0.02, 0.98).astype(np.float32)


def mixed(first: npt.ArrayLike, second: npt.ArrayLike, weight: FloatArray) -> FloatArray:
    """Returns the image (SIDE, SIDE, 3) of `first` at weight 0 and `second` at weight 1."""
    a = np.asarray(first, np.float32)
    b = np.asarray(second, np.float32)
    return a + (b - a) * np.clip(weight, 0, 1)[..., None]


_V, _U = np.meshgrid(
    (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE,
    (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE,
    indexing="ij",
)


def _cells(
    rng: np.random.Generator, columns: int, rows: int, *, stagger: float, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Returns two images (SIDE, SIDE): a random value 0…1 for each cell, and where joints are.

    Args:
        rng: Random numbers.
        columns: Cells from left to right.
        rows: Cells from top to bottom.
        stagger: Shift of every second row, as a fraction of a cell's width.
        gap: Width of the joints, as a fraction of a cell's shorter side.

    Returns:
        The values, and 1 in the joints between cells, 0 elsewhere.
    """
    row = np.floor(_V * rows)
    shifted = _U * columns + (row % 2) * stagger
    column = np.floor(shifted) % columns
    table = rng.random((rows, columns), dtype=np.float32)
    value = table[row.astype(int), column.astype(int)]
    du = shifted % 1.0
    dv = (_V * rows) % 1.0
    width = gap * columns / max(rows, columns)
    height = gap * rows / max(rows, columns)
    joint = (du < width) | (dv < height)
    return value, joint.astype(np.float32)


def _plain(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): one colour with a faint grain."""
    amount = rng.choice([0.0, 0.06, 0.15])
    grain = noise(rng, smooth=rng.random())[..., None] - 0.5
    return np.asarray(base * (1 + amount * grain))


def _plaster(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): two close colours in clouds."""
    weight = 0.7 * noise(rng, smooth=0.9) + 0.3 * noise(rng, smooth=0.3)
    return mixed(near(rng, base), near(rng, base), weight)


def _mottled(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): two colours in patches."""
    weight = noise(rng, smooth=rng.uniform(0.3, 0.95))
    weight = 0.5 + (weight - 0.5) * rng.uniform(1.0, 5.0)
    return mixed(base, near(rng, base, 0.25) if rng.random() < 0.6 else colour(rng), weight)


def _wood(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): grain of wood along the columns."""
    rows = noise(rng, smooth=rng.uniform(0.6, 0.9))
    wander = (noise(rng, smooth=0.99) - 0.5) * 40
    index = (np.arange(SIDE)[:, None] + wander).astype(int) % SIDE
    grain = rows[index, (np.arange(SIDE)[None, :] // 12) % SIDE // 4]
    fine = noise(rng, smooth=0.1)[index, np.arange(SIDE)[None, :] // 16]
    rings = 0.5 + 0.5 * np.sin(grain * rng.uniform(8, 40))
    return mixed(base, base * rng.uniform(0.55, 0.85), 0.55 * rings + 0.45 * fine)


def _planks(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): rows of planks with joints."""
    rows = int(rng.choice([4, 6, 8]))
    value, joint = _cells(rng, int(rng.integers(1, 3)), rows, stagger=0.43, gap=0.012)
    wood = _wood(rng, base) * (1 + rng.uniform(0.1, 0.5) * (value[..., None] - 0.5))
    return mixed_over(wood, base * 0.35, joint)


def mixed_over(image: FloatArray, ink: npt.ArrayLike, weight: FloatArray) -> FloatArray:
    """Returns the image with ink over it where `weight` (SIDE, SIDE) is 1."""
    return image + (np.asarray(ink, np.float32) - image) * weight[..., None]


def _brick(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): staggered bricks with mortar."""
    columns = int(rng.choice([3, 4, 6]))
    # Bricks are three times as wide as high.
    value, joint = _cells(rng, columns, columns * 3, stagger=0.5, gap=0.09)
    wall = mixed(base, near(rng, base, 0.3), value) * (0.8 + 0.4 * noise(rng)[..., None])
    return mixed_over(wall, near(rng, (0.7, 0.68, 0.64), 0.15), joint)


def _tiles(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): square tiles with joints."""
    count = int(rng.choice([2, 4, 8, 12]))
    value, joint = _cells(rng, count, count, stagger=0.0, gap=rng.uniform(0.03, 0.08))
    contrast = rng.choice([0.03, 0.1, 0.4])
    tile = base * (1 + contrast * (value - 0.5) + 0.1 * (noise(rng) - 0.5))[..., None]
    return mixed_over(tile, colour(rng, vivid=0.0), joint)


def _paving(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): paving stones with joints."""
    columns = int(rng.integers(3, 7))
    value, joint = _cells(rng, columns, columns, stagger=rng.choice([0.0, 0.5]), gap=0.05)
    stone = base * (0.85 + 0.25 * value + 0.3 * (noise(rng, smooth=0.4) - 0.5))[..., None]
    return mixed_over(stone, base * 0.5, joint)


def _checks(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): a chessboard of two colours."""
    count = 2 * int(rng.integers(1, 6))
    odd = (np.floor(_U * count) + np.floor(_V * count)) % 2
    return mixed(base, colour(rng, vivid=0.5), odd) * (0.9 + 0.2 * noise(rng)[..., None])


def _stripes(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): stripes along the columns."""
    count = int(rng.integers(3, 40))
    levels = rng.random(count, dtype=np.float32)
    band = levels[np.floor(_V * count).astype(int)]
    if rng.random() < 0.5:
        band = np.round(band)
    other = near(rng, base, 0.3) if rng.random() < 0.6 else colour(rng)
    return mixed(base, other, band) * (0.9 + 0.2 * noise(rng, smooth=0.2)[..., None])


def _carpet(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): lines with a fine weave."""
    weave = noise(rng, smooth=0.05)
    lines = noise(rng, smooth=0.3)[:, :1]
    weight = rng.uniform(0.2, 0.9) * lines + rng.uniform(0.2, 0.7) * weave
    return mixed(base * 0.5, np.clip(base * 1.35, 0, 1), weight)


def _fabric(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): woven cloth, some of it printed."""
    count = int(rng.choice([32, 48, 64]))
    weave = np.sin(_U * count * 2 * np.pi) * np.sin(_V * count * 2 * np.pi)
    shade = 1 + 0.12 * weave + 0.3 * (noise(rng, smooth=0.2) - 0.5)
    cloth = base * shade[..., None]
    if rng.random() < 0.3:
        cloth = mixed_over(cloth, colour(rng), (noise(rng, smooth=0.8) > 0.62).astype(np.float32))
    return cloth


def _spots(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): round spots in staggered rows."""
    count = int(rng.integers(3, 16))
    du = (_U * count) % 1 - 0.5
    dv = (_V * count + 0.5 * (np.floor(_U * count) % 2)) % 1 - 0.5
    spot = (np.hypot(du, dv) < rng.uniform(0.15, 0.4)).astype(np.float32)
    return mixed(base, colour(rng, vivid=0.5), spot)


def _marble(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): veins between two close colours."""
    vein: FloatArray = np.abs(np.sin((_U + _V) * 2 * np.pi + 9 * noise(rng, smooth=0.95)))
    return mixed(near(rng, base, 0.3), base, vein ** rng.uniform(0.2, 0.8))


def _speckle(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): grains in two more colours."""
    image = base * (0.85 + 0.3 * noise(rng, smooth=0.2)[..., None])
    for _ in range(2):
        grains = (noise(rng, smooth=rng.uniform(0, 0.35)) > rng.uniform(0.65, 0.8)).astype(
            np.float32
        )
        image = mixed_over(image, near(rng, base, 0.4), grains)
    return image


def _foliage(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): leaves, dark to bright."""
    weight = 0.5 + 1.5 * (noise(rng, smooth=0.35) - 0.5)
    return mixed(base * 0.4, np.clip(base * 1.4, 0, 1), weight)


def _brushed(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns an image (SIDE, SIDE, 3): fine lines of brushed metal."""
    lines = noise(rng, smooth=0.0)[:, :1] * np.ones((1, SIDE), np.float32)
    return base * (0.9 + 0.2 * lines[..., None])


def _poster(rng: np.random.Generator, base: FloatArray) -> FloatArray:
    """Returns printed matter: flat shapes, blurred blobs, lines of text."""
    paper = Image.new("RGB", (SIDE, SIDE), _ink(base))
    draw = ImageDraw.Draw(paper)
    # A photo.
    if rng.random() < 0.5:
        photo = mixed(colour(rng, vivid=0.6), colour(rng, vivid=0.6), _contrasted(rng))
        photo = mixed_over(photo, colour(rng), _contrasted(rng))
        x, y = (int(v) for v in rng.integers(0, 80, 2))
        w, h = (int(v) for v in rng.integers(100, SIDE, 2))
        paper.paste(
            Image.fromarray((np.clip(photo, 0, 1) * 255).astype(np.uint8)).resize((w, h)), (x, y)
        )
    # Flat shapes.
    for _ in range(int(rng.integers(0, 9))):
        x, y = (int(v) for v in rng.integers(-40, SIDE, 2))
        w, h = (int(v) for v in rng.integers(8, 150, 2))
        ink = _ink(colour(rng, vivid=0.6))
        shape = int(rng.integers(4))
        if shape == 0:
            draw.rectangle((x, y, x + w, y + h), fill=ink)
        elif shape == 1:
            draw.ellipse((x, y, x + w, y + h), fill=ink)
        elif shape == 2:
            points = [(x + int(dx), y + int(dy)) for dx, dy in rng.integers(0, 120, (4, 2))]
            draw.polygon(points, fill=ink)
        else:
            draw.line((x, y, x + w, y + h), fill=ink, width=int(rng.integers(1, 12)))
    # Large words.
    for _ in range(int(rng.integers(0, 5))):
        letters = rng.integers(65, 91, int(rng.integers(3, 12)))
        text = "".join(chr(int(c)) for c in letters)
        x, y = (int(v) for v in rng.integers(5, 190, 2))
        draw.text(
            (x, y), text, fill=_ink(colour(rng, vivid=0.5)), font_size=int(rng.integers(10, 60))
        )
    # Lines that look like text.
    if rng.random() < 0.5:
        x, y = (int(v) for v in rng.integers(10, 120, 2))
        for line in range(int(rng.integers(4, 18))):
            end = x + int(rng.integers(50, 110))
            draw.line((x, y + 7 * line, end, y + 7 * line), fill=_ink(base * 0.35), width=2)
    return np.asarray(paper, np.float32)[::-1] / 255.0


def _contrasted(rng: np.random.Generator) -> FloatArray:
    """Returns weights (SIDE, SIDE) 0..1 of smooth patches with clear borders."""
    return np.asarray(np.clip(0.5 + 3 * (noise(rng, smooth=0.95) - 0.5), 0, 1), np.float32)


Ink = tuple[int, int, int]
"""Red, green and blue, 0 to 255, as Pillow draws."""


def _ink(value: FloatArray) -> Ink:
    """Returns a colour 0..1 as Pillow draws it."""
    red, green, blue = (int(255 * channel) for channel in np.clip(value, 0, 1))
    return red, green, blue


_PAINTERS: dict[str, Callable[[np.random.Generator, FloatArray], FloatArray]] = {
    "plain": _plain, "plaster": _plaster, "mottled": _mottled, "wood": _wood, "planks": _planks,
    "brick": _brick, "tiles": _tiles, "paving": _paving, "checks": _checks, "stripes": _stripes,
    "carpet": _carpet, "fabric": _fabric, "spots": _spots, "marble": _marble,
    "speckle": _speckle, "foliage": _foliage, "brushed": _brushed, "poster": _poster,
}  # fmt: skip

KINDS = tuple(_PAINTERS)


def painted(kind: str, rng: np.random.Generator, base: FloatArray) -> npt.NDArray[np.uint8]:
    """Returns a tiling texture (SIDE, SIDE, 3) of the material around its base colour."""
    image = _PAINTERS[kind](rng, np.asarray(base, np.float32))
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
