"""`pnpdepth models list`: the networks that can be named."""

from __future__ import annotations

from typing import Any

import torch

from pnpdepth_cli.core.user_code import wrap_user_errors
from pnpdepth_cli.models.definition import Fixed, ModelDefinition, Multiple, Near
from pnpdepth_cli.models.registry import families


def list_models() -> list[dict[str, Any]]:
    """Returns every network that can be named, in the order of `registry.names`.

    Of each, `ModelDefinition` has most values. family: the file or entry point that defines it.
    variant: True if the family's name stands for another network and no weights of this one ship.
    """
    listed: dict[str, dict[str, Any]] = {}
    for family, definitions in families().items():
        default = definitions.get(family)
        for definition in definitions.values():
            if definition.name not in listed:
                is_default = default is None or default.name == definition.name
                variant = not is_default and definition.checkpoint is None
                listed[definition.name] = _listed(definition, family, variant)
    return list(listed.values())


def _listed(definition: ModelDefinition, family: str, variant: bool) -> dict[str, Any]:
    # On the meta device counting needs no memory.
    with wrap_user_errors(f"build of network {definition.name!r}"), torch.device("meta"):
        module = definition.build()
    defaults = definition.defaults.complete()
    return {
        "name": definition.name,
        "family": family,
        "variant": variant,
        "summary": definition.summary,
        "paper": definition.paper,
        "licence": definition.licence,
        "input_kind": definition.input_kind,
        "size": _size(definition.size),
        "output_kind": definition.output_kind,
        "parameters": sum(parameter.numel() for parameter in module.parameters()),
        "checkpoint": str(definition.checkpoint) if definition.checkpoint else None,
        "layers": definition.layers,
        "layer": definition.default_layer,
        "iterations": defaults.iterations,
        "lr": defaults.lr,
        "loss": defaults.loss,
        "update": defaults.update,
    }


def _size(size: Fixed | Multiple | Near) -> str:
    if isinstance(size, Fixed):
        return f"{size.height}×{size.width} ({size.fit})"
    if isinstance(size, Near):
        return f"any, resized to {size.height}×{size.width}" if size.height else "any, resized"
    return "any" if size.longest is None else f"any, shrunk to {size.longest}"
