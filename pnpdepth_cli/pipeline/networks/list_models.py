"""`pnpdepth models list`: the networks that can be named."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.models.definition import Fixed, Multiple, Near
from pnpdepth_cli.models.registry import (
    family_definitions,
    family_of,
    find_definition,
    names,
)


@dataclass(frozen=True, kw_only=True)
class ListedModel:
    """One network that can be named; see `ModelDefinition` and `Settings` for the values.

    family: the file or entry point that defines it. variant: True if the family's name stands for
    another network and no weights of this one ship. size: the image sizes it takes, in words.
    checkpoint: the weights that ship with it. The last five are the defaults of refinement.
    """

    name: str
    family: str
    variant: bool
    summary: str
    paper: str
    licence: str
    input_kind: str
    size: str
    output_kind: str
    parameters: int
    checkpoint: str | None
    layers: tuple[str, ...]
    layer: str | None
    iterations: int
    lr: float | str
    loss: str
    update: str


def list_models() -> list[ListedModel]:
    """Returns every network that can be named, in the order of `registry.names`."""
    return [_listed(name) for name in names()]


def _listed(name: str) -> ListedModel:
    definition = find_definition(name)
    # On the meta device counting needs no memory.
    with wrap_user_errors(f"build of network {name!r}"), torch.device("meta"):
        module = definition.build()
    defaults, family = definition.defaults.complete(), family_of(name)
    return ListedModel(
        name=definition.name,
        family=family,
        variant=definition.checkpoint is None and _other_default(family, name),
        summary=definition.summary,
        paper=definition.paper,
        licence=definition.licence,
        input_kind=definition.input_kind,
        size=_size(definition.size),
        output_kind=definition.output_kind,
        parameters=sum(parameter.numel() for parameter in module.parameters()),
        checkpoint=str(definition.checkpoint) if definition.checkpoint else None,
        layers=definition.layers,
        layer=definition.default_layer,
        iterations=defaults.iterations,
        lr=defaults.lr,
        loss=defaults.loss,
        update=defaults.update,
    )


def _other_default(family: str, name: str) -> bool:
    """True if the family's own name stands for another of its networks."""
    default = family_definitions(family).get(family)
    return default is not None and default.name != name


def _size(size: Fixed | Multiple | Near) -> str:
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        return f"any, resized to {size.height}×{size.width}" if size.height else "any, resized"
    return "any" if size.longest is None else f"any, shrunk to {size.longest}"
