"""Which method a request asks for: the default one, or one that the request fixes.

Decided here and nowhere else:

1. A preset is fixed. Options of the method that are given with it win over its own.
2. Any option of the method, or `--tile`, fixes the method.
3. Otherwise it is the default method, `frames.default`.

Imports neither numpy nor torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.pipeline.options import options_of
from pnpdepth_cli.pipeline.refinement.request import MethodOptions, RefineRequest

PAPER = "paper"
PRESETS: Mapping[str, Mapping[str, Any]] = {
    PAPER: {
        "iterations": 5,
        "lr": "0.01",
        "loss": "l1",
        "update": "sign",
        "schedule": "constant",
        "blur": 0.0,
        "align": "none",
        "propagate": "none",
    },
}
"""Options of the method by the name of their preset.

`paper` is Wang et al., ICRA 2019, equations 2 and 3, with α, K, U and L of section IV; the network
is cut where its definition says.
"""


@dataclass(frozen=True, kw_only=True)
class Method:
    """The method of a request."""

    is_default: bool
    """Whether it is the default method. False: `options` are the method."""
    reason: str
    """What decided this, for the record."""
    options: MethodOptions
    """The request's, and those of its preset that the request leaves open."""
    own_layer: bool = False
    """Whether the network is cut where its definition says, whatever the spacing of the points."""


def resolve_method(request: RefineRequest) -> Method:
    """Returns the method that the request asks for.

    Raises:
        UsageError: There is no such preset.
    """
    options = request.method
    flags = tuple(_given(options))
    if options.preset is not None:
        return Method(
            is_default=False,
            reason=" ".join((f"--preset {options.preset}", *flags)),
            options=with_preset(options),
            own_layer=options.preset == PAPER,
        )
    if flags or request.network.tile is not None:
        return Method(is_default=False, reason=" ".join(flags) or "--tile", options=options)
    return Method(is_default=True, reason="default", options=options)


def needs_check(request: RefineRequest) -> bool:
    """Returns whether the method is run again without some points: a table or σ needs them."""
    return request.hold_out.baselines or request.hold_out.uncertainty


def _given(options: MethodOptions) -> list[str]:
    """The flags of the method's options that are given, without the preset."""
    return [
        each.flag
        for each in options_of(MethodOptions)
        if each.name != "preset" and getattr(options, each.name) != each.default
    ]


def with_preset(options: MethodOptions) -> MethodOptions:
    """Returns the options, and those of the preset that they leave open.

    Raises:
        UsageError: There is no such preset.
    """
    if options.preset is None:
        return options
    if options.preset not in PRESETS:
        raise UsageError(f"preset {options.preset!r} is none of {', '.join(PRESETS)}")
    values = PRESETS[options.preset].items()
    return replace(options, **{n: value for n, value in values if getattr(options, n) is None})
