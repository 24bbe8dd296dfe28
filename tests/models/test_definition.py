"""The contract of a model definition."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import (
    Fixed,
    ModelDefinition,
    Multiple,
    Near,
    graph_definition,
)
from pnpdepth_cli.settings import Settings


def definition(**more: object) -> ModelDefinition:
    settings: dict[str, object] = {
        "name": "n", "input_kind": "rgb", "size": Multiple(1), "build": nn.Identity, **more,
    }  # fmt: skip
    return ModelDefinition(**settings)  # type: ignore[arg-type]


def test_the_default_layer_is_the_one_named_or_the_first() -> None:
    assert definition().default_layer is None
    assert definition(layers=("a", "b")).default_layer == "a"
    assert definition(layers=("a", "b"), defaults=Settings(layer="b")).default_layer == "b"


def test_arguments_come_in_the_order_of_the_input_kind() -> None:
    rgb, sparse = torch.ones(1), torch.zeros(1)
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
        ((3, 3, 3, 3), None),
        ((1, 2, 4, 2), None),
    ],
)
def test_an_image_of_a_graph_has_three_channels_first_or_last(
    shape: tuple[Any, ...], size: Fixed | Multiple | None
) -> None:
    known = {"size": Multiple(8), "build": nn.Identity}
    if size is None:
        with pytest.raises(ModelError):
            graph_definition([shape], Path("net.onnx"), {}, **known)
        return
    found = graph_definition([shape], Path("net.onnx"), {}, **known)
    assert found.size == size
    (argument,) = found.call_arguments(torch.zeros(1, 3, 32, 48), None)
    assert argument.shape == ((1, 32, 48, 3) if shape[1] == 32 else (1, 3, 32, 48))


def test_inputs_are_given_with_the_axes_of_the_graph() -> None:
    stated = {"input_kind": "sparse", "takes_intrinsics": True}
    sparse = graph_definition([[1, 8, 8, 1], [3, 3]], Path("x.pt2"), stated, build=nn.Identity)
    inputs = sparse.call_arguments(None, torch.zeros(1, 1, 8, 8), torch.eye(3)[None])
    assert [tuple(each.shape) for each in inputs] == [(1, 8, 8, 1), (3, 3)]


# ------------------------------------------------------------------ fields that make no sense

NO_SIZES = [0, -4, 1.5, "8", True, None]


def refused(make: Callable[..., Any], **fields: Any) -> str:
    (field,) = fields
    with pytest.raises(ModelError) as error:
        make(**fields)
    message = str(error.value)
    assert f" {field}=" in message
    assert "\n" not in message
    assert error.value.exit_code == 4
    return message


@pytest.mark.parametrize("value", NO_SIZES)
def test_a_side_or_a_multiple_that_is_no_whole_number_above_zero_is_refused(value: Any) -> None:
    refused(Multiple, of=value)
    refused(Near, of=value)
    refused(partial(Fixed, width=8), height=value)
    refused(partial(Fixed, 8), width=value)
    if value is not None:
        refused(partial(Multiple, 8), longest=value)
        refused(partial(Near, of=8), height=value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", 5),
        ("input_kind", "depth"),
        ("size", 32),
        ("build", "net"),
        ("normalisation", (0, 1)),
        ("output_kind", "metric"),
        ("output_kind", "disparity"),
        ("output_scale", "relative"),
        ("layers", "encoder"),
        ("layers", ("a", 3)),
        ("defaults", {"lr": 1}),
        ("checkpoint", "net.pt"),
        *((f, "x") for f in ("read_checkpoint", "arguments", "output")),
        ("verify", "x"),
    ],
)
def test_a_field_of_a_definition_that_makes_no_sense_is_refused_by_its_name(
    field: str, value: Any
) -> None:
    refused(definition, **{field: value})
