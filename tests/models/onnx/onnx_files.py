"""Small ONNX networks on disk, written without an exporter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save


def write_network(
    path: Path,
    *,
    shape: tuple[Any, ...] = (1, 3, 32, 48),
    opset: int = 13,
    nodes: tuple[Any, ...] = (),
    outputs: tuple[str, ...] = ("depth",),
    domain: str = "",
) -> Path:
    """An encoder, a bottleneck at stride 4, and an upsampled positive output near 2."""
    rng = np.random.default_rng(0)

    def weight(name: str, *size: int) -> Any:
        values = rng.normal(size=size) / np.sqrt(np.prod(size[1:]))
        return numpy_helper.from_array(values.astype(np.float32), name)

    channels_last = shape[3] == 3
    image = "nchw" if channels_last else "rgb"
    body = [
        helper.make_node("Conv", [image, "w1"], ["a"], "enc/conv.1", pads=[1] * 4, strides=[2, 2]),
        helper.make_node("Relu", ["a"], ["b"], "enc/relu.1"),
        helper.make_node("Conv", ["b", "w2"], ["c"], "enc/conv.2", pads=[1] * 4, strides=[2, 2]),
        helper.make_node("Relu", ["c"], ["d"]),
        helper.make_node("Conv", ["d", "w3"], ["e"], "dec/conv", pads=[1] * 4),
        helper.make_node("Resize", ["e", "", "by"], ["f"], "dec/up", mode="linear"),
        helper.make_node("Sigmoid", ["f"], ["g"], "dec/sigmoid"),
        helper.make_node("Mul", ["g", "two"], ["h"], "dec/scale"),
        helper.make_node("Add", ["h", "one"], ["depth"], "dec/shift", domain=domain),
    ]
    if channels_last:
        body.insert(0, helper.make_node("Transpose", ["rgb"], ["nchw"], perm=[0, 3, 1, 2]))
    constants = [
        weight("w1", 8, 3, 3, 3), weight("w2", 8, 8, 3, 3), weight("w3", 1, 8, 3, 3),
        numpy_helper.from_array(np.array([1, 1, 4, 4], np.float32), "by"),
        numpy_helper.from_array(np.float32(2), "two"),
        numpy_helper.from_array(np.float32(1), "one"),
    ]  # fmt: skip
    graph = helper.make_graph(
        [*body, *nodes],
        "net",
        [helper.make_tensor_value_info("rgb", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in outputs],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = 8
    save(model, str(path))
    return path
