"""Plans the runs of a sweep: each is computed once, however many cells use it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import settings_of
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.sweep.axes import PARAMETERS, Cell, read_value
from pnpdepth_cli.pipeline.sweep.points import Sampling, read_sensor_text
from pnpdepth_cli.settings import Settings

_NOT_OF_UPDATE = ("model", "seed")
"""Parameters that neither the update nor the points have."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """A refinement and the propagation of its residuals."""

    layer: str
    """Where the network is cut."""
    settings: Settings
    """Of the refinement; `iterations` is 0 unless the schedule of the step depends on it."""
    propagate: str = "none"
    """How the residuals at the points are propagated."""

    def record(self) -> dict[str, Any]:
        """Returns all that decides the depth after a number of updates."""
        return {"layer": self.layer, **asdict(self.settings), "propagate": self.propagate}


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What one cell is: the points, the method, and the number of updates."""

    sampling: Sampling
    """Where the points come from."""
    method: Method
    """How they refine the depth."""
    iterations: int
    """Number of updates."""
    seeds: tuple[int, ...]
    """Of the draws of the points."""


RunId = tuple[str, int, Sampling, "Method | None"]
"""(frame's name, seed, points, method); unique in a sweep."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One computation for one frame."""

    task: Task
    """The frame's files and settings."""
    frame: Frame
    """The frame."""
    seed: int
    """Of the drawing of points."""
    sampling: Sampling
    """Where the points come from."""
    method: Method | None
    """None interpolates the points linearly."""
    iterations: tuple[int, ...]
    """Numbers of updates after which the depth is scored."""
    key: str
    """Digest of all that decides the result."""

    @property
    def id(self) -> RunId:
        """What distinguishes the run from the others of its sweep."""
        return self.frame.name, self.seed, self.sampling, self.method


class Plan:
    """The runs that the cells of one network need, the same for every frame."""

    def __init__(
        self,
        cells: Sequence[Cell],
        definition: ModelDefinition,
        base: RefineRequest,
        sampling: Sampling,
        seeds: int,
        model: dict[str, Any],
    ) -> None:
        self._definition, self._base, self._sampling = definition, base, sampling
        self._seeds, self._model = range(base.method.seed, base.method.seed + seeds), model
        self._wanted: dict[tuple[Sampling, int], dict[Method, set[int]]] = {}
        for cell in cells:
            setup = self.setup(cell)
            for seed in setup.seeds:
                methods = self._wanted.setdefault((setup.sampling, seed), {})
                methods.setdefault(setup.method, set()).add(setup.iterations)

    @property
    def layers(self) -> list[str]:
        """The layers of all methods, each once."""
        methods = (method for methods in self._wanted.values() for method in methods)
        return list(dict.fromkeys(method.layer for method in methods))

    def setup(self, cell: Cell) -> Setup:
        """Returns what the cell is. Raises UsageError if its parameters contradict each other."""
        of_update = {
            name.replace("-", "_"): read_value(name, text)
            for name, text in cell.items()
            if not PARAMETERS[name].of_points and name not in _NOT_OF_UPDATE
        }
        method = replace(self._base.method, **of_update).with_preset()
        settings = resolve_settings(self._definition, method)
        settings = replace(settings, lr=_one_spelling(settings.lr))
        iterations = settings.iterations
        if settings.schedule == "constant":  # more updates then begin as fewer do
            settings = replace(settings, iterations=0)
        sampling = sampling_of(cell, self._sampling)
        seeds = tuple(self._seeds)
        if "seed" in cell:
            seeds = (read_value("seed", cell["seed"]),)
        return Setup(
            sampling=sampling,
            seeds=seeds if sampling.is_random else seeds[:1],
            method=Method(
                layer=resolve_layer(self._definition, method.layer),
                settings=settings,
                propagate=method.propagate or "none",
            ),
            iterations=iterations,
        )

    def runs(self, task: Task, frame: Frame) -> Iterator[Run]:
        """Yields the runs of one frame; those with the same points follow each other."""
        read = settings_of(task.request, self._model, "files", "network")
        del read["sample"]  # `sampling` says it
        for (sampling, seed), methods in self._wanted.items():
            none: set[int] = set()
            for method, wanted in ((None, none), *methods.items()):
                yield Run(
                    task=task,
                    frame=frame,
                    seed=seed,
                    sampling=sampling,
                    method=method,
                    iterations=tuple(sorted(wanted)),
                    key=run_key(frame.name, seed, sampling, method, read),
                )


def _one_spelling(lr: float | str) -> float | str:
    """The step in one spelling, 0.01 for `1e-2`, so that equal steps compare equal."""
    number = float(str(lr).strip().removesuffix("%"))
    return f"{number!r}%" if str(lr).strip().endswith("%") else number


def sampling_of(cell: Cell, base: Sampling) -> Sampling:
    """Returns where the cell's points come from. Raises UsageError for a contradiction."""
    varied = {
        name.replace("-", "_"): read_value(name, text)
        for name, text in cell.items()
        if PARAMETERS[name].of_points
    }
    if "sensor" in varied:
        sensor, points = read_sensor_text(varied["sensor"])
        if points is not None and "points" in varied:
            raise UsageError(
                f"sensor {varied['sensor']!r} says how many points; leave that out or do not vary"
                " the points"
            )
        varied["sensor"] = sensor
        if points is not None:
            varied["points"] = points
    sampling = replace(base, **varied)
    if not sampling.is_pattern and "points" not in varied and sampling.sensor != base.sensor:
        sampling = replace(sampling, points=None)  # the number in --sample is of its own pattern
    if sampling.is_pattern:
        sampling.pattern()
    return sampling


def run_key(
    name: str, seed: int, sampling: Sampling, method: Method | None, read: dict[str, Any]
) -> str:
    """Returns a digest, equal for runs whose results would be equal."""
    identity = {
        "frame": name,
        "seed": seed,
        "sampling": sampling.record(),
        "method": None if method is None else method.record(),
        "read": read,
    }
    return hashlib.sha256(json.dumps(plain(identity), sort_keys=True).encode()).hexdigest()
