"""What a sweep varies: named parameters, the values of each, and the cells of a table."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pnpdepth_cli.commands.refinement.request import count_or_fraction
from pnpdepth_cli.commands.sweep.points import Sampling, read_sampling
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.sensors import SamplePattern
from pnpdepth_cli.settings import LARGEST_SEED, OptionField, Settings, options_of
from pnpdepth_cli.settings import Axis as Shown

Cell = Mapping[str, str]
"""Parameters: name to value, as the user wrote it."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter that can be varied."""

    shown: Shown
    value: Callable[[str], Any]
    """Parses a text; raises UsageError."""
    of_points: bool = False


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A parameter and its values, as the user wrote them."""

    name: str
    values: tuple[str, ...]

    def numbers(self) -> list[float] | None:
        """Returns the values as numbers; None if they are not numbers of one unit."""
        percents = {value.endswith("%") for value in self.values}
        try:
            return [float(v.removesuffix("%")) for v in self.values] if len(percents) == 1 else None
        except ValueError:
            return None

    def title(self) -> str:
        """Returns the title of the plot's axis; its unit is in brackets."""
        shown = PARAMETERS[self.name].shown
        if self.numbers() is None:
            return shown.title.partition(" (")[0]
        return shown.title_percent if self.values[0].endswith("%") else shown.title


@dataclass(frozen=True, kw_only=True)
class Study:
    """One table: every combination of the values of one axis or two."""

    axes: tuple[Axis, ...]

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
    name, _, listed = text.partition("=")
    values = tuple(value.strip() for value in listed.split(","))
    if name in PARAMETERS and not all(values):
        raise UsageError(f"--vary {text}: give values after =, with commas between them")
    for value in values:
        read_value(name, value)
    if len(set(values)) < len(values):
        raise UsageError(f"--vary {text}: a value comes twice; leave one out")
    return Axis(name=name, values=values)


def read_value(name: str, text: str) -> Any:
    """Returns the value of a parameter. Raises UsageError for an invalid name or value."""
    if name not in PARAMETERS:
        raise UsageError(f"no parameter {name!r} to vary; there are {', '.join(PARAMETERS)}")
    try:
        return PARAMETERS[name].value(text)
    except UsageError as error:
        raise UsageError(f"{name}={text}: {error}") from None


def values_of(cell: Cell, *, of_points: bool) -> dict[str, Any]:
    """Returns the values of a cell by the names of fields: of the points, or all others."""
    return {
        name.replace("-", "_"): read_value(name, text)
        for name, text in cell.items()
        if name not in PARAMETERS or PARAMETERS[name].of_points == of_points
    }


def studies_of(axes: Sequence[Axis], *, one_by_one: bool) -> list[Study]:
    """Returns a study for each axis, or one of all of them.

    Raises:
        UsageError: With an axis twice, or for a grid of more than two.
    """
    if len({axis.name for axis in axes}) < len(axes):
        raise UsageError("a parameter comes in two --vary; give all its values in one")
    if one_by_one:
        return [Study(axes=(axis,)) for axis in axes]
    if len(axes) > 2:
        raise UsageError(
            f"a grid of {len(axes)} parameters cannot be plotted; --one-by-one varies"
            " each alone, and two --vary make a grid"
        )
    return [Study(axes=tuple(axes))]


def _valid(owner: Callable[..., Any], field: str, kind: type) -> Callable[[str], Any]:
    """Returns a parser of texts that a field of the owner takes."""

    def value(text: str) -> Any:
        if kind is bool and text not in ("on", "off"):
            raise UsageError(f"{text!r} is neither on nor off")
        try:
            parsed = text == "on" if kind is bool else kind(text)
        except ValueError:
            whole = "whole " if kind is int else ""
            raise UsageError(f"{text!r} is not a {whole}number") from None
        return getattr(owner(**{field: parsed}), field)

    return value


def _points(text: str) -> str:
    count, fraction = count_or_fraction(text)
    SamplePattern(count=count, fraction=fraction)
    return text


def _seed(text: str) -> int:
    seed = int(_valid(Settings, "seed", int)(text))
    if seed > LARGEST_SEED:
        raise UsageError(f"the largest seed is {LARGEST_SEED}")
    return seed


def _of_method(field: OptionField) -> Parameter:
    """The parameter of an option of the method."""
    kind = {"int": int, "float": float, "bool": bool, "str": str}[field.type]
    if field.name == "lr":
        kind = str
    return Parameter(
        shown=field.option.axis or Shown(title=field.name.replace("_", " ")),
        value=_valid(Settings, field.name, kind),
    )


def _of_points(title: str, value: Callable[[str], Any], **shown: Any) -> Parameter:
    return Parameter(shown=Shown(title=title, **shown), value=value, of_points=True)


_OWN = ("tile", "time_budget_s", "seed")
"""Settings that a sweep does not vary, or varies itself."""
_OF_THOSE = "sparse points (% of those there are)"
PARAMETERS: Mapping[str, Parameter] = {
    "points": _of_points("sparse points", _points, title_percent=_OF_THOSE, log=True),
    "sensor": _of_points("sensor", read_sampling),
    **{
        name: _of_points(title, _valid(Sampling, name.replace("-", "_"), float))
        for name, title in {
            "noise": "noise of the points (m)",
            "relative-noise": "noise of the points (fraction of depth)",
            "outliers": "outliers among the points (fraction)",
            "jitter": "jitter of the points (px)",
            "rotation-noise": "rotation noise of the scanner (°)",
        }.items()
    },
    **{
        each.name_within: _of_method(each) for each in options_of(Settings) if each.name not in _OWN
    },
    "model": Parameter(shown=Shown(title="network"), value=str),
    "seed": Parameter(shown=Shown(title="seed of the points"), value=_seed),
}
