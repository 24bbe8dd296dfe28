"""Plans the runs of a sweep: each is computed once, however many cells use it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.io.dataset.frame import Frame
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.pipeline.batch.frames import Task
from pnpdepth_cli.pipeline.batch.settings import settings_of
from pnpdepth_cli.pipeline.refinement.method import with_preset
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.pipeline.refinement.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.pipeline.sweep.axes import Cell, values_of
from pnpdepth_cli.pipeline.sweep.points import OWN, Sampling


@dataclass(frozen=True, kw_only=True)
class Method:
    """A refinement and the propagation of its residuals."""

    layer: str
    settings: RefineSettings
    """`iterations` is 0 unless the schedule of the step depends on it."""
    propagate: str = "none"

    def record(self) -> dict[str, Any]:
        """Returns all that decides the depth after a number of updates."""
        return {"layer": self.layer, **asdict(self.settings), "propagate": self.propagate}


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What one cell is."""

    sampling: Sampling
    method: Method
    iterations: int
    seeds: tuple[int, ...]
    """Of the draws of the points."""


RunId = tuple[str, int, Sampling, "Method | None"]
"""(frame's name, seed, points, method); unique in a sweep."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One computation for one frame."""

    task: Task
    frame: Frame
    seed: int
    sampling: Sampling
    method: Method | None
    """None interpolates the points linearly."""
    iterations: tuple[int, ...]
    """Numbers of updates after which the depth is scored."""
    key: str
    """Digest of all that decides the result, but the content of files."""

    @property
    def id(self) -> RunId:
        """What distinguishes the run from the others of its network."""
        return self.frame.name, self.seed, self.sampling, self.method

    def files(self) -> dict[str, Path]:
        """Returns the files that decide the result."""
        own, calib = self.sampling.sensor == OWN, self.frame.calib
        read = {n: path for n, path in self.task.inputs.items() if own or n in ("image", "gt")}
        scanned = self.sampling.lidar is not None and calib is not None and calib.is_file()
        return read | ({"calib": calib} if scanned and calib is not None else {})


class Plan:
    """The runs that the cells of one network need, the same for every frame.

    Args:
        cells: The cells.
        definition: Of the network.
        base: How a frame is refined where nothing is varied.
        sampling: The points where nothing is varied.
        seeds: Number of draws of the points.
        model: The `model_identity` of the network.
    """

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
        self._seeds, self._model = range(base.hold_out.seed, base.hold_out.seed + seeds), model
        self._wanted: dict[tuple[Sampling, int], dict[Method | None, set[int]]] = {}
        for setup in map(self.setup, cells):
            for seed in setup.seeds:
                methods = self._wanted.setdefault((setup.sampling, seed), {None: set()})
                methods.setdefault(setup.method, set()).add(setup.iterations)

    @property
    def layers(self) -> list[str]:
        """The layers of all methods, each once."""
        methods = (method for methods in self._wanted.values() for method in methods if method)
        return list(dict.fromkeys(method.layer for method in methods))

    def setup(self, cell: Cell) -> Setup:
        """Returns what the cell is. Raises UsageError if its parameters contradict each other."""
        varied = values_of(cell, of_points=False)
        varied.pop("model", None)
        seed = varied.pop("seed", None)
        options = with_preset(replace(self._base.method, **varied))
        settings = resolve_settings(self._definition, options)
        settings = replace(settings, lr=_one_spelling(settings.lr))
        iterations = settings.iterations
        if settings.schedule == "constant":  # more updates then begin as fewer do
            settings = replace(settings, iterations=0)
        layer = resolve_layer(self._definition, options.layer)
        sampling = self._sampling.with_values(values_of(cell, of_points=True))
        seeds = tuple(self._seeds) if seed is None else (seed,)
        return Setup(
            sampling=sampling,
            seeds=seeds if sampling.is_random else seeds[:1],
            method=Method(layer=layer, settings=settings, propagate=options.propagate or "none"),
            iterations=iterations,
        )

    def base(self) -> dict[str, Any]:
        """Returns the settings that are not varied."""
        options = with_preset(self._base.method)
        layer = options.layer or self._definition.default_layer
        return {
            "layer": None if layer is None else resolve_layer(self._definition, layer),
            **asdict(resolve_settings(self._definition, options)),
            "propagate": options.propagate or "none",
        }

    def runs(self, task: Task, frame: Frame) -> Iterator[Run]:
        """Yields the runs of one frame; those with the same points follow each other."""
        read = settings_of(task.request, self._model, "files", "network")
        del read["sample"]  # `sampling` says it
        for (sampling, seed), methods in self._wanted.items():
            for method, wanted in methods.items():
                identity = {
                    "frame": frame.name,
                    "seed": seed,
                    "sampling": sampling.record(),
                    "method": None if method is None else method.record(),
                    "read": read,
                }
                text = json.dumps(plain(identity), sort_keys=True)
                yield Run(
                    task=task,
                    frame=frame,
                    seed=seed,
                    sampling=sampling,
                    method=method,
                    iterations=tuple(sorted(wanted)),
                    key=hashlib.sha256(text.encode()).hexdigest(),
                )


def _one_spelling(lr: float | str) -> float | str:
    """The step in one spelling, 0.01 for `1e-2`, so that equal steps compare equal."""
    number = float(str(lr).strip().removesuffix("%"))
    return f"{number!r}%" if str(lr).strip().endswith("%") else number
