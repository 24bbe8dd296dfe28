"""Materials of a scene's surfaces: textures with mipmaps, colour and gloss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from model_zoo_defs.training.rendering import textures
from model_zoo_defs.training.rendering.textures import SIDE, colour, near

FloatArray = npt.NDArray[np.float32]

_LEVELS = 9
_STARTS = np.cumsum([0] + [(SIDE >> level) ** 2 for level in range(_LEVELS)]).astype(np.int32)
_TEXELS = int(_STARTS[-1])


@dataclass(frozen=True, kw_only=True)
class Material:
    """Appearance of one surface; tile_m is the length that one texture tile covers."""

    texture: int
    tile_m: float
    tint: tuple[float, float, float]
    gloss: float
    mirror: float
    detail: float
    glow: float
    offset: tuple[float, float]


class Palette:
    """Materials of one scene; materials of one kind reuse a few textures."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._known: dict[str, list[int]] = {}
        self._textures: list[npt.NDArray[np.uint32]] = []
        self.materials: list[Material] = []
        # Half of the scenes have few colours, so that objects and background look alike.
        narrow = rng.random() < 0.5
        self._theme = [
            colour(rng, vivid=0.15) for _ in range(int(rng.integers(2, 5)) if narrow else 0)
        ]

    def new(
        self,
        kind: str,
        base: npt.ArrayLike | None = None,
        *,
        tile_m: float = 1.0,
        gloss: float | None = None,
        mirror: float = 0.0,
        glow: float = 0.0,
        vivid: float = 0.3,
        whole: bool = False,
    ) -> int:
        """Returns the number of a new material; whole: a tile starts at texture coordinate 0."""
        rng = self._rng
        if base is not None:
            chosen: FloatArray = np.asarray(base, np.float32)
        elif self._theme and rng.random() < 0.7:
            chosen = near(rng, self._theme[int(rng.integers(len(self._theme)))], 0.12)
        else:
            chosen = colour(rng, vivid=vivid)
        known = self._known.setdefault(kind, [])
        if kind == "poster":
            tint = near(rng, (0.92, 0.92, 0.92), 0.05)
            if len(known) < 10 and (len(known) < 3 or rng.random() < 0.6):
                known.append(self._store(textures.painted(kind, rng, chosen)))
        else:
            # Painted around a bright neutral, so that one texture serves every colour.
            tint = chosen / 0.75
            if len(known) < 4 and (not known or rng.random() < 0.4):
                image = textures.painted(kind, rng, np.full(3, 0.75, np.float32))
                known.append(self._store(image))
        shine = rng.choice([0.0, 0.0, 0.15, 0.5]) if gloss is None else gloss
        offset = (0.0, 0.0) if whole else (float(rng.random()), float(rng.random()))
        self.materials.append(
            Material(
                texture=known[int(rng.integers(len(known)))],
                tile_m=tile_m,
                tint=(float(tint[0]), float(tint[1]), float(tint[2])),
                gloss=float(shine),
                mirror=mirror,
                detail=float(rng.uniform(0.0, 0.12)),
                glow=glow,
                offset=offset,
            )
        )
        return len(self.materials) - 1

    def _store(self, image: npt.NDArray[np.uint8]) -> int:
        """Keeps a texture (SIDE, SIDE, 3) with its smaller levels; returns its number.

        A texel is four bytes: red, green, blue and 0.
        """
        level: npt.NDArray[np.floating] = image.astype(np.float32)
        packed = []
        for _ in range(_LEVELS):
            four = np.zeros((*level.shape[:2], 4), np.uint8)
            four[..., :3] = (level + 0.5).astype(np.uint8)
            packed.append(four.view(np.uint32).ravel())
            if len(level) > 1:
                level = (
                    level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2]
                ) / 4
        self._textures.append(np.concatenate(packed))
        return len(self._textures) - 1

    def frozen(self) -> MaterialTable:
        """Returns all materials created so far as arrays for lookup."""
        rows = self.materials
        return MaterialTable(
            texels=np.concatenate(self._textures),
            texture=np.array([m.texture for m in rows], np.int32),
            tiles_per_m=np.array([1 / m.tile_m for m in rows], np.float32),
            tint=np.array([m.tint for m in rows], np.float32),
            gloss=np.array([m.gloss for m in rows], np.float32),
            mirror=np.array([m.mirror for m in rows], np.float32),
            detail=np.array([m.detail for m in rows], np.float32),
            glow=np.array([m.glow for m in rows], np.float32),
            offset=np.array([m.offset for m in rows], np.float32),
        )


@dataclass(frozen=True, kw_only=True)
class MaterialTable:
    """One row per material, and the packed texels of all textures at all mipmap levels."""

    texels: npt.NDArray[np.uint32]
    texture: npt.NDArray[np.int32]
    tiles_per_m: FloatArray
    tint: FloatArray
    gloss: FloatArray
    mirror: FloatArray
    detail: FloatArray
    glow: FloatArray
    offset: FloatArray

    def albedo(
        self, material: npt.NDArray[np.int32], uv: FloatArray, footprint_m: FloatArray
    ) -> FloatArray:
        """Returns linear reflectance (n, 3) at texture coordinates (n, 2) in metres.

        Args:
            material: Numbers of the materials (n,).
            uv: Texture coordinates (n, 2) in metres.
            footprint_m: Width (n,) of the surface patch that a ray sees; it selects the mipmap
                level, which avoids aliasing on far surfaces.
        """
        per_m = self.tiles_per_m[material]
        coordinates = uv * per_m[:, None] + self.offset[material]
        wanted = np.log2(np.maximum(footprint_m * per_m * SIDE, 1.0))
        level = np.minimum((wanted + 0.35).astype(np.int32), _LEVELS - 1)
        base = self.texture[material] * np.int32(_TEXELS) + _STARTS[level]
        colours = self._bilinear(coordinates, level, base)
        value = colours * (1 / 255) * self.tint[material]
        # Fine grain on close surfaces, where the texture resolution is too low.
        fine = textures.noise_tiles()[3]
        index = (coordinates * (SIDE * 7 / 3)).astype(np.int32) & (SIDE - 1)
        grain = (fine[index[:, 1], index[:, 0]] - 0.5) * self.detail[material]
        value *= (1 + grain * np.clip(2 - wanted, 0, 1))[:, None]
        return np.asarray(np.clip(value, 0.0, 1.0) ** 2, np.float32)

    def _bilinear(
        self, coordinates: FloatArray, level: npt.NDArray[np.int32], base: npt.NDArray[np.int32]
    ) -> FloatArray:
        """Returns display colours (n, 3) 0..255, interpolated between four texels each.

        Args:
            coordinates: (n, 2) in tiles.
            level: Mipmap level (n,), 0 is the finest.
            base: Number (n,) of the first texel of that level of the texture.
        """
        # The texel below and to the left, and how far the point is from it.
        side = (np.int32(SIDE) >> level).astype(np.int32)
        spot = coordinates * side[:, None].astype(np.float32) - np.float32(0.5)
        corner = np.floor(spot)
        part = spot - corner
        low = corner.astype(np.int64)
        mask = (side - 1).astype(np.int64)
        u0 = low[:, 0] & mask
        v0 = low[:, 1] & mask
        u1 = (low[:, 0] + 1) & mask
        v1 = (low[:, 1] + 1) & mask
        fu = part[:, :1]
        fv = part[:, 1:]
        # Tiles repeat: sides are powers of two, so a mask gives the remainder.
        total = np.zeros((len(coordinates), 3), np.float32)
        for u, v, weight in (
            (u0, v0, (1 - fu) * (1 - fv)),
            (u1, v0, fu * (1 - fv)),
            (u0, v1, (1 - fu) * fv),
            (u1, v1, fu * fv),
        ):
            packed = self.texels[base + v * side + u]
            total += packed.view(np.uint8).reshape(-1, 4)[:, :3] * weight
        return total
