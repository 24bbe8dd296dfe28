"""`pnpdepth models list`: the networks that can be named."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Near
from pnpdepth_cli.models.registry import families


@dataclass(frozen=True, kw_only=True)
class ListedModel:
    """One network that can be named; see `ModelDefinition` and `RefineDefaults` for the values.

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
    listed: dict[str, ListedModel] = {}
    for family, definitions in families().items():
        default = definitions.get(family)
        for definition in definitions.values():
            if definition.name not in listed:
                is_default = default is None or default.name == definition.name
                variant = not is_default and definition.checkpoint is None
                listed[definition.name] = _listed(definition, family, variant)
    return list(listed.values())


def _listed(definition: ModelDefinition, family: str, variant: bool) -> ListedModel:
    # On the meta device counting needs no memory.
    with wrap_user_errors(f"build of network {definition.name!r}"), torch.device("meta"):
        module = definition.build()
    defaults = definition.defaults
    return ListedModel(
        name=definition.name,
        family=family,
        variant=variant,
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


def _size(size: Fixed | Multiple | Near) -> str:
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        return f"any, resized to {size.height}×{size.width}" if size.height else "any, resized"
    return "any" if size.longest is None else f"any, shrunk to {size.longest}"
