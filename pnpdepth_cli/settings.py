"""The settings of refinement, declared once, and how a field becomes an option.

A network's definition, the command line, the Python API and the records have the same type,
`Settings`. Imports neither numpy nor torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any

from pnpdepth_cli import choices
from pnpdepth_cli.errors import UsageError

LARGEST_SEED = 2**32 - 1
_KEY = "option"


@dataclass(frozen=True, kw_only=True)
class Option:
    """A field that the user can set, and what the command line says of it."""

    help: str
    flag: str = ""
    """Spelling on the command line. By default the field's name with dashes, such as `--lr`."""
    choices: Collection[str] | None = None
    metavar: str | None = None
    least: int | None = None
    most: int | None = None
    parse: Callable[[str], Any] | None = None
    """Converts the text of the command line. None: by the field's type."""
    value_if_bare: str | None = None
    """Value of the option where none follows. None: one has to."""
    show_default: bool = False
    name: str = ""
    """Name of the field."""
    type: str = ""
    """Type of the value as it is written, without "| None"; of several, the last."""
    default: Any = None


def option(default: Any, help: str, **details: Any) -> Any:
    """Returns a dataclass field that the user can set.

    Args:
        default: Default of the field. `MISSING`: the user has to give it.
        help: Help text of the command line.
        **details: Other fields of `Option`.
    """
    return field(default=default, metadata={_KEY: Option(help=help, **details)})


def options_of(group: type) -> Iterator[Option]:
    """Yields the fields of a dataclass that were made by `option`, in their order."""
    for each in fields(group):
        if _KEY in each.metadata:
            declared = each.metadata[_KEY]
            yield replace(
                declared,
                flag=declared.flag or f"--{each.name.replace('_', '-')}",
                name=each.name,
                type=str(each.type).removesuffix(" | None").rpartition(" | ")[2],
                default=each.default,
            )


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Where a network is cut, what is updated and how, and what follows.

    A field at its default is open: the user's settings come first, then those of the network's
    definition, then the paper's.

    Raises:
        UsageError: A value is out of range.
    """

    method: str = option(
        "fused",
        "fused: NETWORK and the included network `compact` refined, fused and propagated; alone:"
        " the same without `compact`; paper: the paper's setting and nothing else.",
        choices=choices.METHODS,
        show_default=True,
    )
    layer: str | None = option(
        None,
        "Layer to cut at: the name of a submodule (NAME#2: its second call, NAME[KEY]: one of its"
        " outputs), or a fraction of the network, 0 the layer nearest to the image, 1 to the"
        " depth.",
        metavar="NAME|0..1",
    )
    iterations: int | None = option(None, "Number of updates; 0 is no refinement.", metavar="K")
    lr: float | str | None = option(
        None, "Step size: absolute, or % of the std of z.", metavar="NUMBER|P%"
    )
    loss: str | None = option(None, "Loss at the sparse points.", choices=choices.LOSSES)
    update: str | None = option(
        None, "Update rule; another than the network's resets lr.", choices=choices.UPDATES
    )
    schedule: str | None = None
    """Step size over the updates, "constant" or "linear" to 0. It has no option."""
    blur: float | None = None
    """Standard deviation of the blur of the gradient in spacings of the points; 0 is off. It has no
    option."""
    align: str | None = option(
        None,
        "Fit the network's output to the points by scale, or scale and shift."
        "  [default: the network's own]",
        choices=choices.ALIGNMENTS,
    )
    propagate: str | None = option(
        None,
        "Propagate the residuals at the points to all pixels: by a Gaussian process, or lines"
        " through the nearest points.  [default: none, with other options of the method]",
        choices=("none", *choices.PROPAGATIONS),
    )
    seed: int = option(
        0, "Random seed.", metavar="N", least=0, most=LARGEST_SEED, show_default=True
    )

    def __post_init__(self) -> None:
        for name, value in self.given().items():
            names = _NAMES.get(name)
            valid, wanted = _CHECKS.get(name, (lambda _: True, ""))
            if names is not None:
                wanted = f"one of {', '.join(names)}"
            if not valid(value) or (names and not (isinstance(value, str) and value in names)):
                raise UsageError(f"{name.replace('_', '-')} must be {wanted}, got {value!r}")
        if self.lr is not None and not str(self.lr).strip().endswith("%"):
            object.__setattr__(self, "lr", float(self.lr))  # one spelling of a step

    @property
    def fixed_by(self) -> str:
        """What fixes the method, as the user gives it; empty for the default one."""
        given = self.given()
        flags = {each.name: each.name for each in fields(self)}
        flags |= {each.name: each.flag for each in options_of(Settings)}
        flags["method"] = f"--method {self.method}"
        not_fixed = {"seed"} if self.is_paper else {"seed", "method"}
        return " ".join(flags[name] for name in given if name not in not_fixed)

    @property
    def is_paper(self) -> bool:
        """Whether the method is the paper's."""
        return self.method == "paper"

    def with_paper(self) -> Settings:
        """Returns these settings; with the paper's method, its settings where these are open."""
        return self.over(PAPER) if self.is_paper else self

    def given(self) -> dict[str, Any]:
        """Returns the fields that are not open."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if value != _OPEN[name]}

    def opened(self, *names: str) -> Settings:
        """Returns these settings with the fields of these names open."""
        return Settings(**{k: v for k, v in self.given().items() if k not in names})

    def over(self, others: Settings) -> Settings:
        """Returns these settings, and the others' where these are open."""
        return replace(others, **self.given())

    def closed(self) -> ClosedSettings:
        """Returns these settings, and the paper's where these are open."""
        names = {each.name for each in fields(ClosedSettings)}
        return ClosedSettings(**{k: v for k, v in self.given().items() if k in names})


@dataclass(frozen=True, kw_only=True)
class ClosedSettings:
    """How z is updated and what follows, with nothing open.

    The defaults are those of Wang et al., ICRA 2019, equations 2 and 3, with α, K, U and L of
    section IV.
    """

    iterations: int = 5
    lr: float | str = 0.01
    loss: str = "l1"
    update: str = "sign"
    schedule: str = "constant"
    blur: float = 0.0
    align: str = "none"
    propagate: str = "none"


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 0


def _is_step(value: object) -> bool:
    try:
        return 0 < float(str(value).strip().removesuffix("%")) < math.inf
    except ValueError:
        return False


_NAMES: Mapping[str, Collection[str]] = {"schedule": choices.SCHEDULES} | {
    each.name: each.choices for each in options_of(Settings) if each.choices is not None
}
_CHECKS: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "layer": (lambda value: isinstance(value, str), "the name of a layer, or a fraction as text"),
    "iterations": (_is_whole, "a whole number >= 0"),
    "lr": (_is_step, "a step size above 0, or a text such as '3%'"),
    "blur": (lambda value: _is_number(value) and value >= 0, ">= 0"),
    "seed": (_is_whole, "a whole number >= 0"),
}
"""Whether a value of the field is valid, and what it must be."""

_OPEN = {each.name: each.default for each in fields(Settings)}

PAPER = Settings(**asdict(ClosedSettings()))
"""The settings of the paper, none open but the layer."""
