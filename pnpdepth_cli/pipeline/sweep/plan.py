"""Which runs the cells of a sweep need: each once, however many cells look at it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import settings_of
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.pipeline.sweep.axes import PARAMETERS, Cell, Study, read_value
from pnpdepth_cli.pipeline.sweep.points import Sampling, read_sensor_text


@dataclass(frozen=True, kw_only=True)
class Method:
    """How points are made depth: by a refinement at this layer; its `iterations` do not count
    unless the step falls with them. propagate: how what is left at the points is spread then.
    """

    layer: str
    settings: RefineSettings
    propagate: str = "none"

    def record(self) -> dict[str, Any]:
        """All that decides the depth after so many updates."""
        return {"layer": self.layer, **asdict(self.settings), "propagate": self.propagate}


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a cell's figures come from: after so many updates of a method with such points."""

    sampling: Sampling
    method: Method
    iterations: int


RunPlace = tuple[str, int, Sampling, "Method | None"]
"""The frame's name, the seed, and what was done: what tells a sweep's runs apart."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One thing to compute for one frame; method None interpolates the points linearly.

    iterations: the numbers of updates after which it is scored. key: what it is known by.
    """

    task: Task
    frame: Frame
    seed: int
    sampling: Sampling
    method: Method | None
    iterations: tuple[int, ...]
    key: str

    @property
    def place(self) -> RunPlace:
        """What tells the run from all others of the sweep."""
        return self.frame.name, self.seed, self.sampling, self.method


class Plan:
    """What the cells of the studies need, of every frame alike."""

    def __init__(
        self,
        studies: Sequence[Study],
        definition: ModelDefinition,
        base: RefineRequest,
        sampling: Sampling,
        seeds: int,
        model: dict[str, Any],
    ) -> None:
        self._definition, self._base, self._sampling = definition, base, sampling
        self._seeds, self._model = range(base.hold_out.seed, base.hold_out.seed + seeds), model
        self._wanted: dict[Sampling, dict[Method, set[int]]] = {}
        for study in studies:
            for cell in study.cells():
                place = self.place(cell)
                methods = self._wanted.setdefault(place.sampling, {})
                methods.setdefault(place.method, set()).add(place.iterations)

    @property
    def layers(self) -> list[str]:
        """The layers that are cut at, each once."""
        methods = (method for methods in self._wanted.values() for method in methods)
        return list(dict.fromkeys(method.layer for method in methods))

    def seeds(self, sampling: Sampling) -> Sequence[int]:
        """Those that are drawn with: one where all would give the same."""
        return self._seeds if sampling.is_random else self._seeds[:1]

    def place(self, cell: Cell) -> Place:
        """Where the cell's figures come from. UsageError if it makes no sense."""
        of_update = {
            name: read_value(name, text)
            for name, text in cell.items()
            if not PARAMETERS[name].of_points
        }
        method = replace(self._base.method, **of_update)
        settings = resolve_settings(self._definition, method)
        settings = replace(settings, lr=_one_spelling(settings.lr))
        iterations = settings.iterations
        if settings.schedule == "constant":  # then more updates begin like fewer
            settings = replace(settings, iterations=0)
        return Place(
            sampling=sampling_of(cell, self._sampling),
            method=Method(
                layer=resolve_layer(self._definition, method.layer),
                settings=settings,
                propagate=method.propagate or "none",
            ),
            iterations=iterations,
        )

    def runs(self, task: Task, frame: Frame) -> Iterator[Run]:
        """Of one frame, those with the same points one after the other."""
        read = settings_of(task.request, self._model, "files", "network")
        del read["sample"]  # `sampling` says it
        for sampling, methods in self._wanted.items():
            for seed in self.seeds(sampling):
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
    """The step such that equal ones are equal: 0.01 for `1e-2`."""
    number = float(str(lr).strip().removesuffix("%"))
    return f"{number!r}%" if str(lr).strip().endswith("%") else number


def sampling_of(cell: Cell, base: Sampling) -> Sampling:
    """Where the cell's points come from. UsageError if it makes no sense."""
    given = {
        name.replace("-", "_"): read_value(name, text)
        for name, text in cell.items()
        if PARAMETERS[name].of_points
    }
    if "sensor" in given:
        sensor, points = read_sensor_text(given["sensor"])
        if points is not None and "points" in given:
            raise UsageError(
                f"sensor {given['sensor']!r} says how many points; leave that out or do not vary"
                " the points"
            )
        given["sensor"] = sensor
        if points is not None:
            given["points"] = points
    found = replace(base, **given)
    if not found.is_pattern and "points" not in given and found.sensor != base.sensor:
        found = replace(found, points=None)  # what --sample says is of its own pattern
    if found.is_pattern:
        found.pattern()
    return found


def run_key(
    name: str, seed: int, sampling: Sampling, method: Method | None, read: dict[str, Any]
) -> str:
    """What a run is known by: equal where the results would be."""
    said = {
        "frame": name,
        "seed": seed,
        "sampling": sampling.record(),
        "method": None if method is None else method.record(),
        "read": read,
    }
    return hashlib.sha256(json.dumps(plain(said), sort_keys=True).encode()).hexdigest()
