"""What a sweep varies: parameters by their name, the values of each, and the cells they make."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pnpdepth_cli.core.step_sizes import step_size
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import options_of
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, count_or_share
from pnpdepth_cli.pipeline.sweep.points import known_sensor

Cell = Mapping[str, str]
"""The values of the parameters that are varied, as the user wrote them, by the parameter's name."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """What can be varied.

    title: what stands at an axis; of_percent: the same where the values are given in per cent.
    value: what a text says; it raises ValueError or UsageError if that is nothing. log: whether
    equal ratios should look equal. of_points: it says something of the points, not of the update.
    """

    title: str
    value: Callable[[str], Any]
    of_percent: str = ""
    log: bool = False
    of_points: bool = False


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A parameter and the texts of the values it takes, in the order of the user."""

    name: str
    values: tuple[str, ...]

    @property
    def parameter(self) -> Parameter:
        """The parameter that is varied."""
        return PARAMETERS[self.name]

    def numbers(self) -> list[float] | None:
        """The values as places on an axis; None where they are no numbers of one kind."""
        shares = {value.endswith("%") for value in self.values}
        try:
            return [float(v.removesuffix("%")) for v in self.values] if len(shares) == 1 else None
        except ValueError:
            return None

    def title(self) -> str:
        """What stands at the axis."""
        if self.numbers() is None:
            return self.parameter.title.partition(" (")[0]  # what is in brackets is of numbers
        return self.parameter.of_percent if self.values[0].endswith("%") else self.parameter.title


@dataclass(frozen=True, kw_only=True)
class Study:
    """One table: every combination of the values of its axes."""

    axes: tuple[Axis, ...]

    @property
    def name(self) -> str:
        """The names of the axes, joined."""
        return "_".join(axis.name for axis in self.axes)

    def cells(self) -> Iterator[Cell]:
        """In the order of the table; the last axis changes fastest."""
        names = [axis.name for axis in self.axes]
        for values in itertools.product(*(axis.values for axis in self.axes)):
            yield dict(zip(names, values, strict=True))


def read_axis(text: str) -> Axis:
    """The axis that a text such as `points=20,100,500` says. UsageError if it says none."""
    name, equals, listed = text.partition("=")
    name = FORMER_NAMES.get(name, name)
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
    """What the text says for that parameter. UsageError if that is nothing."""
    try:
        return PARAMETERS[name].value(text)
    except (ValueError, UsageError) as error:
        raise UsageError(f"--vary {name}={text}: {error}") from None


def studies_of(axes: Sequence[Axis], *, one_by_one: bool) -> list[Study]:
    """A study for each axis, or one of all of them. UsageError where that makes no picture."""
    if not axes:
        raise UsageError("nothing to vary; say what with --vary, such as --vary points=20,100,500")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise UsageError("a parameter comes in two --vary; give all its values in one")
    if one_by_one:
        return [Study(axes=(axis,)) for axis in axes]
    if len(axes) > 2:
        raise UsageError(
            f"a grid of {len(axes)} parameters is more than a picture shows; --one-by-one varies"
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
            raise ValueError(f"{text!r} is no number") from None
        if not 0 <= number <= high or math.isinf(number):
            raise ValueError(f"{text} is not 0 or more" + (f" and {high:g} at most" * (high < 1e9)))
        return number

    return value


def _one_of(names: Sequence[str]) -> Callable[[str], str]:
    def value(text: str) -> str:
        if text not in names:
            raise ValueError(f"{text!r} is not one of {', '.join(names)}")
        return text

    return value


def _points(text: str) -> str:
    count, share = count_or_share(text)
    if (count is not None and count < 1) or (share is not None and not 0 < share <= 1):
        raise ValueError("give at least one point, or a share above 0 and at most 100 %")
    return text


def _step(text: str) -> str:
    step_size(text, torch.zeros(1))
    return text


_ANY = _within(math.inf)
_VALUES: Mapping[str, Callable[[str], Any]] = {"int": _whole, "float": _ANY, "str": str}


def _method_parameters() -> Iterator[tuple[str, Parameter]]:
    """Yields the options of the method that have an axis."""
    for each in options_of(MethodOptions):
        axis, names = each.option.axis, each.option.choices
        if axis is None:
            continue
        value = _VALUES[each.type] if names is None else _one_of(tuple(names))
        yield (
            each.name,
            Parameter(
                title=axis.title,
                of_percent=axis.title_percent,
                value=_step if each.name == "lr" else value,
                log=axis.log,
            ),
        )


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
        title="noise of the points (share of depth)", value=_ANY, of_points=True
    ),
    "outliers": Parameter(title="wrong points (share)", value=_within(1), of_points=True),
    "jitter": Parameter(title="jitter of the points (px)", value=_ANY, of_points=True),
    "rotation-noise": Parameter(
        title="rotation noise of the scanner (°)", value=_within(360), of_points=True
    ),
    **dict(_method_parameters()),
}
"""All that can be varied, in the order of the help."""

FORMER_NAMES = {
    each.option.alias.removeprefix("--"): each.name
    for each in options_of(MethodOptions)
    if each.option.alias is not None
}
"""Present names of parameters by their former ones, which are still accepted."""
