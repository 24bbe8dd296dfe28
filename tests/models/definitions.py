"""A definition of a user's network, and that network."""

from __future__ import annotations

from torch import nn

from pnpdepth_cli.models.definition import (
    ModelDefinition,
    Multiple,
)
from pnpdepth_cli.models.network import Network, load_network


def definition(**more: object) -> ModelDefinition:
    settings: dict[str, object] = {
        "name": "n", "input_kind": "rgb", "size": Multiple(1), "build": nn.Identity, **more,
    }  # fmt: skip
    return ModelDefinition(**settings)  # type: ignore[arg-type]


def network(**more: object) -> Network:
    return load_network(definition(layers=("",), **more), None)
