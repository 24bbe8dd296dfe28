"""Random numbers and materials for the builders of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model_zoo_defs.training.rendering.materials import Palette


@dataclass(frozen=True, kw_only=True)
class Kit:
    """Random numbers and the scene's materials, passed to every builder of objects."""

    rng: np.random.Generator
    palette: Palette

    def uniform(self, low: float, high: float) -> float:
        """Returns a random number between the two: a length in metres, an angle, a fraction."""
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        """Returns True with this probability."""
        return bool(self.rng.random() < probability)

    def surface(self, *kinds: str, tile_m: float = 0.6, vivid: float = 0.35) -> int:
        """Returns a new material of one of the kinds."""
        kind = str(self.rng.choice(kinds))
        return self.palette.new(kind, tile_m=tile_m, vivid=vivid)

    def any_surface(self) -> int:
        """Returns a new material as everyday objects have it."""
        kinds = ("plain", "plain", "plain", "mottled", "spots", "stripes", "checks", "fabric",
                 "poster", "wood", "speckle", "marble")  # fmt: skip
        return self.surface(*kinds, tile_m=self.uniform(0.1, 0.5), vivid=0.55)

    def wood(self) -> int:
        """Returns a wooden material."""
        tones = ((0.62, 0.45, 0.28), (0.40, 0.26, 0.16), (0.78, 0.62, 0.42), (0.28, 0.19, 0.14))
        tone = np.array(tones[int(self.rng.integers(4))]) * self.rng.uniform(0.85, 1.15)
        return self.palette.new(
            "wood", tone, tile_m=self.uniform(0.5, 1.2), mirror=self.uniform(0, 0.03)
        )

    def metal(self) -> int:
        """Returns a metallic material."""
        grey = self.uniform(0.3, 0.8)
        mirror = self.uniform(0.05, 0.4)
        return self.palette.new("brushed", (grey,) * 3, tile_m=0.5, gloss=0.8, mirror=mirror)

    def dark(self) -> int:
        """Returns a black or nearly black material."""
        return self.palette.new("plain", (self.uniform(0.04, 0.16),) * 3, tile_m=0.5)
