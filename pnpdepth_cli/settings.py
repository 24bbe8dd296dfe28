"""The settings of refinement, declared once, and how a field becomes an option.

A network's definition, the command line, the Python API and the records have the same type,
`Settings`. Imports neither numpy nor torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field, asdict, dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any

from pnpdepth_cli import choices
from pnpdepth_cli.errors import UsageError

LARGEST_SEED = 2**32 - 1
"""numpy takes no larger one."""
OF_UPDATES = ("layer", "lr", "loss", "update", "schedule", "blur")
"""Names of the settings, besides `iterations`, that have no effect if z is not updated."""


def option(default: Any, help: str, **details: object) -> Any:
    """Returns a dataclass field that the user can set, with its help on the command line.

    Args:
        default: Value of the field where the user sets none.
        help: Text of the option in `--help`.
        details: Arguments of the option in click, such as its metavar; and `choices`, the names
            that it takes, `least` and `most` of a whole number, and `flag`, its spelling where that
            is not the field's name.
    """
    return field(default=default, metadata={"help": help, **details})


def options_of(group: type) -> list[Field[Any]]:
    """Returns the fields of a dataclass that were made by `option`, in their order."""
    return [declared for declared in fields(group) if declared.metadata]


def flag_of(declared: Field[Any]) -> str:
    """Returns how the command line spells a field that was made by `option`, such as `--lr`."""
    return str(declared.metadata.get("flag", f"--{declared.name.replace('_', '-')}"))


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
        "Which steps are made; every other option tunes one of them. fused: NETWORK and the"
        " included network `compact` are aligned, refined, fused and propagated; alone: the same"
        " without `compact`; paper: z is updated with the paper's setting, and nothing else.",
        choices=choices.METHODS,
    )
    layer: str | None = option(
        None,
        "Layer to cut at: the name of a submodule (NAME#2: its second call, NAME[KEY]: one of its"
        " outputs), or a fraction of the network, 0 the layer nearest to the image, 1 to the"
        " depth.",
        metavar="NAME|0..1",
    )
    iterations: int | None = option(
        None, "Number of updates of z; 0 leaves z as it is.", metavar="K"
    )
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
        "Fit the network's output to the points by scale, or scale and shift (affine); or read it"
        " as depth, disparity, ….  [default: the network's own, auto where that is none, none with"
        " the paper's method]",
        choices=choices.ALIGNMENTS,
    )
    propagate: str | None = option(
        None,
        "Propagate the residuals at the points to all pixels: by a Gaussian process, or lines"
        " through the nearest points.  [default: gp, local for scan lines, none with the paper's"
        " method]",
        choices=("none", *choices.PROPAGATIONS),
    )
    seed: int = option(
        0, "Random seed.", metavar="N", least=0, most=LARGEST_SEED, show_default=True
    )

    def __new__(cls, *_: object, **values: object) -> Settings:
        """Returns the object that `__init__` fills.

        Raises:
            UsageError: A name is that of no setting; the message has the likely one.
        """
        settings = [setting.name for setting in fields(cls)]
        for name in values.keys() - {*settings}:
            import difflib

            likely = difflib.get_close_matches(name, settings, n=1)
            if likely:
                raise UsageError(f"there is no setting {name!r}; did you mean {likely[0]!r}?")
            raise UsageError(f"there is no setting {name!r}; there are {', '.join(settings)}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Checks the values that are given, and makes a step in digits a number.

        Raises:
            UsageError: A value is out of range, or is no name of its list.
        """
        for name, value in self.given().items():
            if name in _NAMES:
                is_valid = isinstance(value, str) and value in _NAMES[name]
                wanted = f"one of {', '.join(_NAMES[name])}"
            else:
                check, wanted = _CHECKS[name]
                is_valid = check(value)
            if not is_valid:
                raise UsageError(f"{name} must be {wanted}, got {value!r}")
        if self.lr is not None and not str(self.lr).strip().endswith("%"):
            object.__setattr__(self, "lr", float(self.lr))  # the class is frozen

    @property
    def of_updates(self) -> list[str]:
        """The names of the settings that are given and have no effect if z is not updated."""
        return [name for name in self.given() if name in ("iterations", *OF_UPDATES)]

    @property
    def is_paper(self) -> bool:
        """Whether the method is the paper's."""
        return self.method == "paper"

    def given(self) -> dict[str, Any]:
        """Returns the values that are not at their defaults, by name."""
        values: dict[str, Any] = {}
        for setting in fields(self):
            value = getattr(self, setting.name)
            if value != setting.default:
                values[setting.name] = value
        return values

    def over(self, others: Settings) -> Settings:
        """Returns these settings, with the others' values where these are open.

        A setting is open if it is at its default.
        """
        return replace(others, **self.given())

    def closed(self) -> ClosedSettings:
        """Returns how z is updated and what follows, with the paper's values where these are open.

        Those of `method`, `layer` and `seed` are not among them.
        """
        names = {setting.name for setting in fields(ClosedSettings)}
        return ClosedSettings(
            **{name: value for name, value in self.given().items() if name in names}
        )


@dataclass(frozen=True, kw_only=True)
class ClosedSettings:
    """How z is updated and what follows, each setting with a value.

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
    """Whether a value is a finite number of at least 0, and no bool."""
    return isinstance(value, Real) and not isinstance(value, bool) and 0 <= float(value) < math.inf


def _is_whole(value: object) -> bool:
    """Whether a value is a whole number of at least 0, and no bool."""
    return isinstance(value, Integral) and _is_number(value)


def _is_step(value: object) -> bool:
    """Whether a value is a finite number above 0, or a text of one, also with % behind it."""
    try:
        return 0 < float(str(value).strip().removesuffix("%")) < math.inf
    except ValueError:  # of `float`: the text is no number
        return False


_NAMES: Mapping[str, Collection[str]] = {"schedule": choices.SCHEDULES} | {
    setting.name: setting.metadata["choices"]
    for setting in options_of(Settings)
    if "choices" in setting.metadata
}
"""The names that a setting takes, by setting; those without names are in `_CHECKS`."""
_CHECKS: Mapping[str, tuple[Callable[[object], bool], str]] = {
    "layer": (lambda value: isinstance(value, str), "the name of a layer, or a fraction as text"),
    "iterations": (_is_whole, "a whole number >= 0"),
    "lr": (_is_step, "a step size above 0, or a text such as '3%'"),
    "blur": (_is_number, ">= 0"),
    "seed": (_is_whole, "a whole number >= 0"),
}
"""Function that tells whether a value of a setting is valid, and what it must be, by setting."""

PAPER = Settings(**asdict(ClosedSettings()))
"""The settings of the paper, none open but the layer."""
