"""The contract of a model definition."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import (
    Fixed,
    Multiple,
    Normalisation,
    graph_definition,
)
from tests.models.definitions import definition


def test_arguments_come_in_the_order_of_the_input_kind() -> None:
    rgb = torch.ones(1)
    sparse = torch.zeros(1)
    assert definition().call_arguments(rgb, sparse) == (rgb,)
    assert definition(input_kind="sparse").call_arguments(None, sparse) == (sparse,)
    assert definition(input_kind="rgb+sparse").call_arguments(rgb, sparse) == (rgb, sparse)
    swapped = definition(arguments=lambda rgb, sparse: (sparse, rgb))
    assert swapped.call_arguments(rgb, sparse) == (sparse, rgb)


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ((1, 32, 48, 3), Fixed(32, 48)),
        ((1, 3, 48, 3), Fixed(48, 3)),
        (("n", 3, "h", "w"), Multiple(8)),
    ],
)
def test_channels_are_first_or_last(shape: tuple[object, ...], size: Fixed | Multiple) -> None:
    known = {"size": Multiple(8), "build": nn.Identity}
    found = graph_definition([shape], Path("net.onnx"), {}, **known)
    assert found.size == size
    (argument,) = found.call_arguments(torch.zeros(1, 3, 32, 48), None)
    assert argument.shape == ((1, 32, 48, 3) if shape[1] == 32 else (1, 3, 32, 48))
    with pytest.raises(ModelError):
        graph_definition([(1, 2, 4, 2)], Path("net.onnx"), {}, **known)
    stated = {"input_kind": "sparse", "takes_intrinsics": True}
    sparse = graph_definition([[1, 8, 8, 1], [3, 3]], Path("x.pt2"), stated, build=nn.Identity)
    inputs = sparse.call_arguments(None, torch.zeros(1, 1, 8, 8), torch.eye(3)[None])
    assert [tuple(tensor.shape) for tensor in inputs] == [(1, 8, 8, 1), (3, 3)]


@pytest.mark.parametrize(
    ("make", "field", "value"),
    [
        *((Multiple, "of", value) for value in (0, 1.5, "8", True, None)),
        (partial(Fixed, width=8), "height", 0),
        (partial(Fixed, 8, 8), "fit", "zoom"),
        (Normalisation, "std", (0.5, 0.5, 0.0)),
        (definition, "name", 5),
        (definition, "input_kind", "depth"),
        (definition, "size", 32),
        (definition, "build", "net"),
        (definition, "layers", ("a", 3)),
        *((definition, hook, "x") for hook in ("read_checkpoint", "arguments", "output", "verify")),
    ],
)
def test_a_bad_field_of_a_definition_is_named(
    make: Callable[..., object], field: str, value: object
) -> None:
    with pytest.raises(ModelError, match=rf"\A.* {field}=.*\Z"):
        make(**{field: value})
