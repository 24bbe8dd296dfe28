"""Computes the runs of a sweep, and remembers their results in a journal."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

import torch

from pnpdepth_cli.commands.batch.frames import Task
from pnpdepth_cli.commands.batch.running import read_frame
from pnpdepth_cli.commands.refinement.inputs import Inputs
from pnpdepth_cli.commands.sweep.points import Sampling, frame_points
from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.core.metrics import MEASURES, score
from pnpdepth_cli.errors import DeviceError, OutputError, PnpDepthError, StorageError
from pnpdepth_cli.frames.opened import SplitCache
from pnpdepth_cli.frames.refine import refine_frame
from pnpdepth_cli.io.atomic import cannot_write
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.record import plain
from pnpdepth_cli.models.frame import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.settings import Settings

T = TypeVar("T")
Result = dict[str, Any]
"""What the journal has of a run: `points`, the `scores` by METHODS, `time_s`, why it `diverged`."""

METHODS = ("plain", "linear", "refined")
SWEPT = tuple(m for m in MEASURES if m.key in ("mae", "rmse", "mre", "delta1"))
RESULTS = ("sweep.csv", "sweep.json", "sweep.tex", "sweep_frames.csv")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One refinement of one frame with one draw of its points."""

    task: Task
    frame: Frame
    seed: int
    sampling: Sampling
    settings: Settings
    """With the layer; nothing is open."""
    key: str
    """Digest of all that decides the result."""


def results(runs: Sequence[Run], network: Network) -> Iterator[tuple[Run, Result | PnpDepthError]]:
    """Yields the runs of a network with their results; each frame is read once.

    The runs of a frame follow each other, and among these those with the same points.
    """
    with SplitCache(network) as cuts:
        for _, of_frame in groupby(runs, key=lambda run: run.frame.name):
            same_frame = list(of_frame)
            inputs = _tried(read_frame, same_frame[0].task)
            for _, of_points in groupby(same_frame, key=lambda run: (run.sampling, run.seed)):
                same_points = list(of_points)
                drawn = _tried(_drawn, same_points[0], inputs, network)
                for run in same_points:
                    yield run, _tried(_result_of, run, drawn, cuts)


def _tried(step: Callable[..., T], *arguments: Any) -> T | PnpDepthError:
    """The result, or the error of a frame that cannot be used: of this step, or of one before."""
    for argument in arguments:
        if isinstance(argument, PnpDepthError):
            return argument
    try:
        return step(*arguments)
    except (StorageError, DeviceError):
        raise
    except PnpDepthError as error:
        return error


def _drawn(run: Run, inputs: Inputs, network: Network) -> tuple[Inputs, dict[str, Any]]:
    """The frame with the run's points, and the scores of their linear interpolation."""
    points = frame_points(run.sampling, run.seed, inputs, run.task.request, run.frame)
    inputs = replace(inputs, points=points)
    return inputs, _score(linear(points), network, inputs)


def _result_of(run: Run, drawn: tuple[Inputs, dict[str, Any]], cuts: SplitCache) -> Result:
    """The result of a run; after a divergence it is that of the last finite depth."""
    (inputs, interpolated), network = drawn, cuts.network
    settings = replace(run.settings, seed=run.seed)
    torch.manual_seed(run.seed)
    began = time.perf_counter()
    try:
        split = cuts.at_points() if settings.masked else cuts.at(settings.layer or "")
        propagation = settings.propagate or "none"
        one = refine_frame(network, split, settings, inputs.registered(), propagation=propagation)
    except BaseException:
        cuts.close()
        raise
    plain_scores, refined = (
        _score(torch.from_numpy(depth), network, inputs) for depth in (one.before, one.after)
    )
    return {
        "points": len(inputs.points),
        "scores": {"plain": plain_scores, "linear": interpolated, "refined": refined},
        "time_s": time.perf_counter() - began,
        "diverged": str(one.diverged) if one.diverged else None,
    }


def _score(depth: torch.Tensor, network: Network, inputs: Inputs) -> dict[str, Any]:
    """The scores of (H, W) depth on the ground truth inside the network's crop."""
    assert inputs.gt is not None
    top, left, height, width = FrameMap.fit(network.definition.size, *inputs.size).crop
    ground_truth = torch.zeros(inputs.size)
    here = (slice(top, top + height), slice(left, left + width))
    ground_truth[here] = torch.from_numpy(inputs.gt)[here]
    return asdict(score(depth, ground_truth))


class Journal:
    """The results in `sweep.jsonl`, a line for each run; lines that are not whole are ignored.

    Attributes:
        results: By the key of the run.

    Raises:
        OutputError: If the folder has results that no sweep wrote.
    """

    def __init__(self, output: Path) -> None:
        self._path = output / "sweep.jsonl"
        self.results: dict[str, Result] = {}
        if self._path.exists():
            text = self._path.read_bytes().decode("ascii", "replace")
            for line in text.splitlines():
                with contextlib.suppress(
                    ValueError, TypeError, KeyError, IndexError, OverflowError
                ):
                    content = json.loads(line)
                    _check_result(content)
                    self.results[content["run"]] = content
            if not text.endswith("\n"):
                self._append("\n")
        elif unowned := [name for name in RESULTS if (output / name).exists()]:
            raise OutputError(
                f"{output / unowned[0]} exists, and no sweep wrote it; -o names another folder"
            )

    def add(self, run: Run, result: Result) -> None:
        """Records the result of a run."""
        line = {"run": run.key, "frame": run.frame.name, "seed": run.seed}
        content = json.dumps(plain(line | result), allow_nan=False)
        self._append(content + "\n")
        self.results[run.key] = json.loads(content)

    def _append(self, text: str) -> None:
        try:
            with self._path.open("a", encoding="ascii") as file:
                file.write(text)
        except OSError as error:
            raise cannot_write(self._path, error) from error


def _check_result(content: Any) -> None:
    """Raises an error of any kind if a line of the journal lacks what tables need of it."""
    values = [content["scores"][of][m.key] for of in METHODS for m in SWEPT]
    values += [content["time_s"], content["points"]]
    if not all(math.isfinite(value) for value in values if value is not None):
        raise ValueError
    if not isinstance(content["run"], str) or not isinstance(content["diverged"], str | None):
        raise TypeError
