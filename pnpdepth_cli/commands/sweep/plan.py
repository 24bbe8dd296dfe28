"""Plans the runs of a sweep: each is computed once, however many cells use it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.commands.batch.frames import Task
from pnpdepth_cli.commands.batch.settings import model_identity, settings_of
from pnpdepth_cli.commands.refinement.request import RefineRequest
from pnpdepth_cli.commands.sweep.axes import Cell, values_of
from pnpdepth_cli.commands.sweep.points import OWN, Sampling
from pnpdepth_cli.frames.resolve import resolve_layer, resolve_settings
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.io.remote import RemotePath, status_of
from pnpdepth_cli.models.definition import ModelDefinition
from pnpdepth_cli.settings import Settings


@dataclass(frozen=True, kw_only=True)
class Method:
    """A refinement and the propagation of its residuals."""

    layer: str
    settings: Settings
    """`iterations` is 0 unless the schedule of the step depends on it."""
    propagate: str = "none"

    def record(self) -> dict[str, Any]:
        """Returns all that decides the depth after a number of updates."""
        return asdict(self.settings) | {"layer": self.layer, "propagate": self.propagate}


@dataclass(frozen=True, kw_only=True)
class Run:
    """One computation for one frame, scored after some numbers of updates."""

    task: Task
    frame: Frame
    seed: int
    sampling: Sampling
    method: Method | None
    """None interpolates the points linearly."""
    iterations: tuple[int, ...]
    key: str
    """Digest of all that decides the result."""


Runs = dict[tuple[str, int, Sampling, Method | None], Run]
"""By the frame's name, the seed, the points and the method."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How the cells of one network are computed."""

    definition: ModelDefinition
    base: RefineRequest
    """How a frame is refined where nothing is varied."""
    sampling: Sampling
    """The points where nothing is varied."""
    seeds: int
    """Number of draws of the points."""

    def method(self, cell: Cell) -> tuple[Method, int]:
        """Returns the method of a cell and the number of updates.

        Raises:
            UsageError: If parameters contradict each other.
        """
        varied = values_of(cell, of_points=False)
        varied = {name: value for name, value in varied.items() if name not in ("model", "seed")}
        options = replace(self.base.method, **varied).with_preset()
        settings = resolve_settings(self.definition, options).opened("layer", "propagate", "preset")
        settings = replace(settings, lr=_one_spelling(settings.lr))
        iterations = settings.iterations
        if settings.schedule == "constant":  # more updates then begin as fewer do
            settings = replace(settings, iterations=0)
        layer, kind = resolve_layer(self.definition, options.layer), options.propagate or "none"
        return Method(layer=layer, settings=settings, propagate=kind), iterations

    def draws(self, cell: Cell) -> tuple[Sampling, Sequence[int]]:
        """Returns where a cell's points come from, and the seeds of their draws."""
        sampling = self.sampling.with_values(values_of(cell, of_points=True))
        if "seed" in cell:
            return sampling, (int(cell["seed"]),)
        own = self.base.method.seed
        return sampling, range(own, own + (self.seeds if sampling.is_random else 1))

    def runs(self, cells: Sequence[Cell], tasks: Sequence[tuple[Task, Frame]]) -> Runs:
        """Returns the runs of the cells by frame; those with the same points follow each other."""
        model, runs, states = model_identity(self.base), Runs(), dict[Path, Any]()
        wanted: dict[tuple[Sampling, int], dict[Method | None, set[int]]] = {}
        for cell in cells:
            (sampling, seeds), (method, iterations) = self.draws(cell), self.method(cell)
            for seed in seeds:
                methods = wanted.setdefault((sampling, seed), {None: set()})
                methods.setdefault(method, set()).add(iterations)
        for task, frame in tasks:
            read = settings_of(task.request, model, "files", "network") | {"frame": frame.name}
            del read["sample"]  # `sampling` says it
            for (sampling, seed), methods in wanted.items():
                paths = dict(_files(task, frame, sampling))
                states |= {path: _state(path) for path in paths.values() if path not in states}
                files = {name: states[path] for name, path in paths.items()}
                drawn = {"seed": seed, "sampling": sampling.record(), "files": files}
                for each, numbers in methods.items():
                    runs[frame.name, seed, sampling, each] = Run(
                        task=task, frame=frame, seed=seed, sampling=sampling, method=each,
                        iterations=tuple(sorted(numbers)),
                        key=_digest({**read, **drawn, "method": each and each.record()}),
                    )  # fmt: skip
        return runs


def _digest(identity: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(plain(identity), sort_keys=True).encode()).hexdigest()


def _files(task: Task, frame: Frame, sampling: Sampling) -> Iterator[tuple[str, Path]]:
    """The files that decide the result with these points."""
    own = sampling.sensor == OWN
    yield from ((n, path) for n, path in task.inputs.items() if own or n in ("image", "gt"))
    if sampling.lidar is not None and frame.calib is not None:
        yield "calib", frame.calib


def _state(path: Path) -> tuple[int, int | str] | None:
    """What changes with a file's content: size and time, or the version that a store states."""
    if isinstance(path, RemotePath):
        stored = status_of(path)
        return None if stored is None else (stored.size, stored.version)
    try:
        status = path.stat()
    except OSError:  # the run will say so
        return None
    return status.st_size, status.st_mtime_ns


def _one_spelling(lr: float | str) -> float | str:
    """The step in one spelling, 0.01 for `1e-2`, so that equal steps compare equal."""
    number = float(str(lr).strip().removesuffix("%"))
    return f"{number!r}%" if str(lr).strip().endswith("%") else number
