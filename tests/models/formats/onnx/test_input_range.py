"""The rgb range that an ONNX graph expects, from the arithmetic at its start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the extra [onnx]")

from onnx import TensorProto, helper, numpy_helper

from pnpdepth_cli.models.definition import IMAGENET_MEAN, IMAGENET_STD, Normalisation
from pnpdepth_cli.models.formats.onnx.input_range import stated_input_range

BYTES = Normalisation(std=(1 / 255, 1 / 255, 1 / 255))
MEAN, STD = (np.array(each).reshape(1, 3, 1, 1) for each in (IMAGENET_MEAN, IMAGENET_STD))


def graph(*steps: tuple[str, Any], side_branch: bool = False) -> Any:
    """A model of these operations (name, constant or None) on its input, and a convolution."""
    nodes, constants, value = [], [], "rgb"
    for number, (operation, constant) in enumerate(steps):
        inputs = [value]
        if constant is not None:
            array = np.asarray(constant, np.float32)
            constants.append(numpy_helper.from_array(array, f"c{number}"))
            inputs.append(f"c{number}")
        value = f"x{number}"
        nodes.append(helper.make_node(operation, inputs, [value]))
    if side_branch:
        nodes.append(helper.make_node("Sigmoid", ["rgb"], ["side"]))
    constants.append(numpy_helper.from_array(np.ones((1, 3, 1, 1), np.float32), "kernel"))
    nodes.append(helper.make_node("Conv", [value, "kernel"], ["depth"]))
    rgb = helper.make_tensor_value_info("rgb", TensorProto.FLOAT, [1, 3, 8, 8])
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, 8, 8])
    return helper.make_model(helper.make_graph(nodes, "g", [rgb], [depth], constants))


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([("Sub", MEAN), ("Div", STD)], Normalisation()),
        ([("Sub", 255 * MEAN), ("Div", 255 * STD)], BYTES),
        ([("Div", 255.0)], BYTES),
        ([("Mul", 1 / 255), ("Sub", MEAN), ("Mul", 1 / STD)], BYTES),
        ([("Transpose", None), ("Mul", 2.0), ("Add", -1.0)], Normalisation()),
        ([("Sub", MEAN)], Normalisation()),
        ([("Sub", MEAN * 255)], BYTES),
        ([("Mul", 255.0), ("Sub", MEAN * 255)], Normalisation()),
        ([], None),
        ([("Relu", None), ("Div", 255.0)], None),
        ([("Div", 1e6)], None),
        ([("Div", 0.0)], None),
    ],
)
def test_the_range_is_the_one_whose_normalised_images_lie_around_zero(
    steps: list[tuple[str, Any]], expected: Normalisation | None
) -> None:
    input_range = stated_input_range(graph(*steps))
    assert (None if input_range is None else input_range[0]) == expected


def test_a_graph_whose_input_goes_two_ways_states_nothing() -> None:
    assert stated_input_range(graph(("Div", 255.0), side_branch=True)) is None


def test_fastdepth_states_nothing(shared_data: Path) -> None:
    import onnx

    (file,) = (shared_data / "weights").glob("**/*ast*epth*.onnx")
    assert stated_input_range(onnx.load(str(file))) is None
