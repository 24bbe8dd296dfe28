"""The contract of a model definition."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple, RefineDefaults


def definition(**more: object) -> ModelDefinition:
    settings: dict[str, object] = {
        "name": "n", "input_kind": "rgb", "size": Multiple(1), "build": nn.Identity, **more,
    }  # fmt: skip
    return ModelDefinition(**settings)  # type: ignore[arg-type]


def test_the_default_layer_is_the_one_named_or_the_first() -> None:
    assert definition().default_layer is None
    assert definition(layers=("a", "b")).default_layer == "a"
    assert definition(layers=("a", "b"), defaults=RefineDefaults(layer="b")).default_layer == "b"


def test_arguments_come_in_the_order_of_the_input_kind() -> None:
    rgb, sparse = torch.ones(1), torch.zeros(1)
    assert definition().call_arguments(rgb, sparse) == (rgb,)
    assert definition(input_kind="sparse").call_arguments(None, sparse) == (sparse,)
    assert definition(input_kind="rgb+sparse").call_arguments(rgb, sparse) == (rgb, sparse)
    swapped = definition(arguments=lambda rgb, sparse: (sparse, rgb))
    assert swapped.call_arguments(rgb, sparse) == (sparse, rgb)


@pytest.mark.parametrize("kind", ["rgb", "rgb+sparse"])
def test_a_missing_input_is_not_passed_over(kind: str) -> None:
    with pytest.raises(ValueError, match="needs all of its inputs"):
        definition(input_kind=kind).call_arguments(None, torch.zeros(1))


def test_the_defaults_are_the_papers() -> None:
    paper = RefineDefaults(layer=None, iterations=5, lr=0.01, loss="l1", update="sign")
    assert RefineDefaults() == paper


def test_reading_a_definition_needs_no_torch() -> None:
    code = "import sys, pnpdepth_cli.models.definition; assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
