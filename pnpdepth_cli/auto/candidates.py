"""Candidates that compete at held-out points.

A candidate is one method that predicts dense depth from a frame and its points. It starts from a
baseline, from a network's depth after a number of updates of z, or from the geometric mean of
several networks' depths, and may propagate the residual at the points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.models.definition import ModelDefinition

ITERATIONS = (5, 10)
"""Numbers of updates of z that compete, besides a configuration's own."""
WEIGHT_WITH_POINTS = 3.0
"""Weight in the fusion of a network that takes the points, against 1 of one that does not.

A network given another's depth as a prior counts as one more. On even frames of ICL-NUIM, 7-Scenes
and KITTI 1 : 3 was better than 1 : 1, and 1 : 3 : 2.7 the best of seven weightings with a prior.
"""
HIDDEN_POINT_STEPS = 40
"""Steps by hidden points that the chosen networks make if there is time; of dense points fewer."""
FUSED_ITERATIONS = 5
"""Updates of z before propagation. More fit what propagation fits anyway."""


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """A network, where it is cut, and how z is updated."""

    network: str = "network"
    """Name of the network among those that compete."""
    layer: str
    """Layer to cut at."""
    settings: RefineSettings
    """How z is updated, `settings.iterations` times at most."""
    weight: float = 1.0
    """Weight of the network in the fusion of all."""

    def __str__(self) -> str:
        s = self.settings
        aligned = "" if s.align == "none" else f", aligned ({s.align})"
        return f"{self.network} cut at {self.layer}, {s.update}, step {s.lr}{aligned}"

    @property
    def competing_iterations(self) -> tuple[int, ...]:
        """Numbers of updates of z above 0 that compete, ascending."""
        most = self.settings.iterations
        return tuple(sorted({*(k for k in ITERATIONS if k < most), most} - {0}))

    def within(self, seconds: float) -> RefinementConfig:
        """Returns the refinement with a cap on the time of its updates, where these are costly."""
        if not self.settings.moves_weights:
            return self
        return replace(self, settings=replace(self.settings, time_budget_s=seconds))


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One method that predicts dense depth from a frame and its points."""

    baseline: str | None = None
    """Name of the baseline that it starts from."""
    within_hull: bool = False
    """Whether the baseline is used inside the hull of the points only, and the default candidate
    outside."""
    config: RefinementConfig | None = None
    """Refinement that it starts from."""
    iterations: int = 0
    """Number of updates of z; 0 is the network's own depth."""
    prior: Candidate | None = None
    """Candidate whose depth the network is given as a prior."""
    fused: tuple[Candidate, ...] = ()
    """Candidates whose weighted geometric mean it starts from."""
    weights: tuple[float, ...] = ()
    """Their weights, with a sum of 1."""
    propagate: str = "none"
    """How the residual is propagated: "none" or a name in `choices.PROPAGATIONS`."""

    def __str__(self) -> str:
        return self._start() if self.propagate == "none" else f"{self._start()} + {self.propagate}"

    def _start(self) -> str:
        if self.fused:
            parts = zip(self.weights, self.fused, strict=True)
            return f"fusion of {' and '.join(f'{weight:.0%} {each}' for weight, each in parts)}"
        if self.baseline is not None:
            return f"{self.baseline} inside the hull" if self.within_hull else self.baseline
        if self.config is None:
            return "network"
        if self.iterations:
            return f"{self.iterations} updates of z ({self.config})"
        network, align = self.config.network, self.config.settings.align
        aligned = "" if align == "none" else f" aligned ({align})"
        prior = "" if self.prior is None else f" with {self.prior} as prior"
        return f"{network}{aligned}{prior}"

    @property
    def start(self) -> Candidate:
        """The same candidate without propagation."""
        return replace(self, propagate="none")

    @property
    def configs(self) -> tuple[RefinementConfig, ...]:
        """The refinements that it needs."""
        own = () if self.config is None else (self.config,)
        inner = self.fused if self.prior is None else (self.prior, *self.fused)
        return (*own, *(config for each in inner for config in each.configs))


def fusion(
    members: Sequence[Candidate], weights: Sequence[float], propagate: str = "none"
) -> Candidate:
    """Returns the candidate that starts from the weighted geometric mean of these depths.

    Members that weigh nothing are left out; a single one is no fusion.
    """
    parts = [(each, w) for each, w in zip(members, weights, strict=True) if w > 0]
    if len(parts) == 1:
        return replace(parts[0][0], propagate=propagate)
    total = sum(weight for _, weight in parts)
    return Candidate(
        fused=tuple(each for each, _ in parts),
        weights=tuple(weight / total for _, weight in parts),
        propagate=propagate,
    )


def default_config(
    definition: ModelDefinition, layer: str, settings: RefineSettings, *, network: str = "network"
) -> RefinementConfig:
    """Returns the refinement of a network that competes.

    A network whose output is metric is aligned too, where the points say that it should be.

    Args:
        definition: Of the network.
        layer: The layer to cut at.
        settings: The network's own, or the user's.
        network: Its name among those that compete.
    """
    align = settings.align
    if align == "none" and definition.input_kind == "rgb":
        align = "auto"
    weight = 1.0 if definition.input_kind == "rgb" else WEIGHT_WITH_POINTS
    settings = replace(settings, align=align)
    return RefinementConfig(network=network, layer=layer, settings=settings, weight=weight)


def cascades(
    configs: Sequence[RefinementConfig], definitions: Mapping[str, ModelDefinition]
) -> tuple[Candidate, ...]:
    """Returns each network that takes a prior, given each other network's aligned depth.

    Args:
        configs: One refinement of each network.
        definitions: Of the networks, by name.
    """
    return tuple(
        Candidate(config=config, prior=Candidate(config=prior))
        for config in configs
        if definitions[config.network].takes_prior
        for prior in configs
        if prior != config
    )
