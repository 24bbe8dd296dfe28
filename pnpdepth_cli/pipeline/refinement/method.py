"""Which method a request asks for: the choice by held-out points, or a method that is fixed.

Decided here and nowhere else:

1. `--auto` chooses by held-out points; options of the method then describe the candidates.
2. A preset is fixed. Options of the method that are given with it win over its own.
3. Any option of the method, or `--tile`, fixes the method.
4. Otherwise the method is chosen by held-out points.

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
    "fast": {"propagate": "gp"},
}
"""Options of the method by the name of their preset.

`paper` is Wang et al., ICRA 2019, equations 2 and 3, with α, K, U and L of section IV; the network
is cut where its definition says.
"""


@dataclass(frozen=True, kw_only=True)
class Method:
    """The method of a request."""

    chosen: bool
    """Whether held-out points choose among candidates. False: `options` are the method."""
    why: str
    """What decided this, for the record."""
    options: MethodOptions
    """The request's, and those of its preset that the request leaves open."""
    own_layer: bool = False
    """Whether the network is cut where its definition says, whatever the spacing of the points."""


def resolve_method(request: RefineRequest) -> Method:
    """Returns the method that the request asks for.

    Raises:
        UsageError: The request combines options that exclude each other.
    """
    options, hold_out = request.method, request.hold_out
    flags = tuple(_given(options))
    if options.preset is not None and hold_out.auto:
        raise UsageError("--preset fixes the method and --auto chooses one; give one of the two")
    if hold_out.auto:
        return Method(chosen=True, why="--auto", options=options)
    if options.preset is not None:
        why = " ".join((f"--preset {options.preset}", *flags))
        return Method(
            chosen=False,
            why=why,
            options=with_preset(options),
            own_layer=options.preset == PAPER,
        )
    if flags or request.network.tile is not None:
        return Method(chosen=False, why=" ".join(flags) or "--tile", options=options)
    return Method(chosen=True, why="default", options=options)


def needs_folds(request: RefineRequest) -> bool:
    """Returns whether points are held out in turns, to choose, to compare or to calibrate."""
    hold_out = request.hold_out
    return resolve_method(request).chosen or hold_out.baselines or hold_out.uncertainty


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
