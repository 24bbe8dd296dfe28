"""What a sweep varies: named parameters, the values of each, and the cells of a table."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pnpdepth_cli.choices import PRESETS
from pnpdepth_cli.core.step_sizes import step_size
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.refinement.request import count_or_fraction
from pnpdepth_cli.pipeline.sweep.points import known_sensor
from pnpdepth_cli.settings import Settings, options_of

Cell = Mapping[str, str]
"""The varied parameters: name to value, as the user wrote it."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter that can be varied."""

    title: str
    value: Callable[[str], Any]
    """Parses a text; raises ValueError or UsageError."""
    of_percent: str = ""
    """Title where the values are in per cent."""
    log: bool = False
    of_points: bool = False
    """True if it concerns the points, not the update."""


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A parameter and its values."""

    name: str
    """Key of PARAMETERS."""
    values: tuple[str, ...]
    """As the user wrote them, in that order."""

    @property
    def parameter(self) -> Parameter:
        """What is varied."""
        return PARAMETERS[self.name]

    def numbers(self) -> list[float] | None:
        """Returns the values as numbers; None if they are no numbers of one unit."""
        percents = {value.endswith("%") for value in self.values}
        try:
            return [float(v.removesuffix("%")) for v in self.values] if len(percents) == 1 else None
        except ValueError:
            return None

    def title(self) -> str:
        """Returns the title of the plot's axis."""
        if self.numbers() is None:
            return self.parameter.title.partition(" (")[0]  # the unit in brackets is of numbers
        return self.parameter.of_percent if self.values[0].endswith("%") else self.parameter.title


@dataclass(frozen=True, kw_only=True)
class Study:
    """One table: every combination of the values of its axes."""

    axes: tuple[Axis, ...]
    """One or two."""

    @property
    def name(self) -> str:
        """The names of the axes, joined."""
        return "_".join(axis.name for axis in self.axes)

    def cells(self) -> Iterator[Cell]:
        """Yields the cells in the order of the table; the last axis changes fastest."""
        names = [axis.name for axis in self.axes]
        for values in itertools.product(*(axis.values for axis in self.axes)):
            yield dict(zip(names, values, strict=True))


def read_axis(text: str) -> Axis:
    """Returns the axis of a text such as `points=20,100,500`. Raises UsageError for any other."""
    name, equals, listed = text.partition("=")
    if name not in PARAMETERS:
        raise UsageError(f"no parameter {name!r} to vary; there are {', '.join(PARAMETERS)}")
    values = tuple(value.strip() for value in listed.split(","))
    if not equals or not all(values):
        raise UsageError(f"--vary {text}: give values after =, with commas between them")
    for value in values:
        read_value(name, value)
    if len(set(values)) < len(values):
        raise UsageError(f"--vary {text}: a value comes twice; leave one out")
    return Axis(name=name, values=values)


def read_value(name: str, text: str) -> Any:
    """Returns the parameter's value of a text. Raises UsageError for an invalid one."""
    try:
        return PARAMETERS[name].value(text)
    except (ValueError, UsageError) as error:
        raise UsageError(f"--vary {name}={text}: {error}") from None


def studies_of(axes: Sequence[Axis], *, one_by_one: bool) -> list[Study]:
    """Returns a study for each axis, or one of all of them.

    Args:
        axes: What is varied.
        one_by_one: True for a study of each axis.

    Raises:
        UsageError: Without an axis, with one twice, or for a grid of more than two.
    """
    if not axes:
        raise UsageError("nothing to vary; say what with --vary, such as --vary points=20,100,500")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise UsageError("a parameter comes in two --vary; give all its values in one")
    if one_by_one:
        return [Study(axes=(axis,)) for axis in axes]
    if len(axes) > 2:
        raise UsageError(
            f"a grid of {len(axes)} parameters cannot be plotted; --one-by-one varies"
            " each alone, and two --vary make a grid"
        )
    return [Study(axes=tuple(axes))]


def _whole(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        raise ValueError(f"{text!r} is no whole number") from None
    if number < 0:
        raise ValueError(f"{number} is negative")
    return number


def _within(high: float) -> Callable[[str], float]:
    def value(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            raise ValueError(f"{text!r} is not a number") from None
        if not (math.isfinite(number) and 0 <= number <= high):
            limit = "finite" if math.isinf(high) else f"{high:g} at most"
            raise ValueError(f"{text} is not 0 or more and {limit}")
        return number

    return value


def _one_of(names: Sequence[str]) -> Callable[[str], str]:
    def value(text: str) -> str:
        if text not in names:
            raise ValueError(f"{text!r} is not one of {', '.join(names)}")
        return text

    return value


def _points(text: str) -> str:
    count, fraction = count_or_fraction(text)
    if (count is not None and count < 1) or (fraction is not None and not 0 < fraction <= 1):
        raise ValueError("give at least one point, or a fraction above 0 and at most 100 %")
    return text


def _step(text: str) -> str:
    step_size(text, torch.zeros(1))
    return text


_ANY = _within(math.inf)
_VALUES: Mapping[str, Callable[[str], Any]] = {"int": _whole, "float": _ANY, "str": str}


def _method_parameters() -> Iterator[tuple[str, Parameter]]:
    """Yields the options of the method that have an axis."""
    for each in options_of(Settings):
        axis, names = each.option.axis, each.option.choices
        if axis is None:
            continue
        value = _VALUES[each.type] if names is None else _one_of(tuple(names))
        yield (
            each.name.replace("_", "-"),
            Parameter(
                title=axis.title,
                of_percent=axis.title_percent,
                value=_step if each.name == "lr" else value,
                log=axis.log,
            ),
        )


def _seed(text: str) -> int:
    number = _whole(text)
    if number >= 2**63:
        raise ValueError(f"{number} is no seed; give one below 2^63")
    return number


PARAMETERS: Mapping[str, Parameter] = {
    "points": Parameter(
        title="sparse points",
        of_percent="sparse points (% of those there are)",
        value=_points,
        log=True,
        of_points=True,
    ),
    "sensor": Parameter(title="sensor", value=known_sensor, of_points=True),
    "noise": Parameter(title="noise of the points (m)", value=_ANY, of_points=True),
    "relative-noise": Parameter(
        title="noise of the points (fraction of depth)", value=_ANY, of_points=True
    ),
    "outliers": Parameter(
        title="outliers among the points (fraction)", value=_within(1), of_points=True
    ),
    "jitter": Parameter(title="jitter of the points (px)", value=_ANY, of_points=True),
    "rotation-noise": Parameter(
        title="rotation noise of the scanner (°)", value=_within(360), of_points=True
    ),
    **dict(_method_parameters()),
    "preset": Parameter(title="preset", value=_one_of(tuple(PRESETS))),
    "model": Parameter(title="network", value=str),
    "seed": Parameter(title="seed of the points", value=_seed),
}
"""All parameters that can be varied, in the order of the help."""
