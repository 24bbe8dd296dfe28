"""A file that defines a user's network."""

from __future__ import annotations

from torch import nn

from pnpdepth_cli.models.definition import (
    ModelDefinition,
    Multiple,
)


def definition(**more: object) -> ModelDefinition:
    settings: dict[str, object] = {
        "name": "n", "input_kind": "rgb", "size": Multiple(1), "build": nn.Identity, **more,
    }  # fmt: skip
    return ModelDefinition(**settings)  # type: ignore[arg-type]
