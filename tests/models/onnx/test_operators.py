"""Every operator against the standard's own cases; old opsets and paddings against onnxruntime."""

from __future__ import annotations

import functools
import warnings
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
import torch

onnx = pytest.importorskip("onnx", reason="needs the extra [onnx]")
ort = pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")

from pathlib import Path  # noqa: E402

import onnx.backend.test.case.node as standard  # noqa: E402
from onnx import TensorProto, helper, numpy_helper  # noqa: E402
from torch.testing import assert_close as close  # noqa: E402

from pnpdepth_cli.errors import ModelError  # noqa: E402
from pnpdepth_cli.models.onnx import onnx_graph  # noqa: E402
from pnpdepth_cli.models.onnx.operators import OPERATORS  # noqa: E402

F32 = np.float32
KINDS = {np.dtype(kind) for kind in ("f4", "f8", "i1", "i4", "i8", "u1", "?")}
WITHOUT_CASES = {"Cast", "Constant", "LayerNormalization"}
PARTLY_COVERED = {"AveragePool", "Dropout", "GatherND", "IsInf", "MaxPool"}
PARTLY_COVERED |= {"Pad", "ReduceSum", "Resize", "ScatterND"}
"""Operators some of whose attributes are refused."""
OTHERWISE = {
    "test_convtranspose_output_shape",
    "test_maxpool_2d_uint8",
    "test_resize_downsample_scales_linear_align_corners",
    "test_resize_downsample_scales_cubic_align_corners",
    *(f"test_reduce_{kind}" for kind in ("max_empty_set", "max_empty_set_bool", "min_empty_set")),
}
"""Cases that onnxruntime computes otherwise, and of nothing."""


@functools.cache
def standard_cases() -> dict[str, list[Any]]:
    """The standard's cases for single nodes by operator; their inputs divide by 0 on purpose."""
    by_operator = defaultdict[str, list[Any]](list)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for case in standard.collect_testcases(None):
            node, *rest = case.model.graph.node
            if case.data_sets and not rest and not node.domain:
                by_operator[node.op_type].append(case)
    return by_operator


def outputs_of(model: onnx.ModelProto, x: Any) -> list[torch.Tensor]:
    """Each output of the graph, which a network has only one of."""
    outputs = [*model.graph.output]
    del model.graph.output[1:]
    results = []
    for output in outputs:
        model.graph.output[0].CopyFrom(output)
        results.append(onnx_graph(model, Path("x.onnx"))(torch.from_numpy(x.copy())))
    return results


@pytest.mark.parametrize("op", sorted(OPERATORS.keys() - WITHOUT_CASES))
def test_an_operator_computes_what_the_standard_says(op: str) -> None:
    agreed = 0
    refused = list[str]()
    for case in standard_cases()[op]:
        inputs, outputs = ([np.asarray(value) for value in values] for values in case.data_sets[0])
        kinds = {value.dtype for value in (*inputs, *outputs)}
        if case.name in OTHERWISE or "training" in case.name or not inputs or not kinds <= KINDS:
            continue
        model = onnx.ModelProto.FromString(case.model.SerializeToString())
        for declared, value in zip(list(model.graph.input)[1:], inputs[1:], strict=True):
            model.graph.initializer.append(numpy_helper.from_array(value, declared.name))
        del model.graph.input[1:]
        try:
            given = outputs_of(model, inputs[0])
        except ModelError:
            refused.append(case.name)
            continue
        right = [torch.from_numpy(output.copy()) for output in outputs]
        close(given, right, rtol=1e-3, atol=1e-4, equal_nan=True, msg=case.name)
        agreed += 1
    assert agreed > 0
    assert op in PARTLY_COVERED or not refused


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(F32)


def model_of(
    op: str, inputs: list[np.ndarray | None], opset: int, outputs: int = 1, **attributes: Any
) -> onnx.ModelProto:
    """One node whose first input is the graph's and whose others are constants."""
    constants = {f"in{n}": value for n, value in enumerate(inputs) if value is not None}
    names = [f"in{n}" if f"in{n}" in constants else "" for n in range(len(inputs))]
    node = helper.make_node(op, names, [f"out{n}" for n in range(outputs)], **attributes)
    x = constants.pop("in0")
    graph = helper.make_graph(
        [node],
        "g",
        [helper.make_tensor_value_info("in0", helper.np_dtype_to_tensor_dtype(x.dtype), x.shape)],
        [onnx.ValueInfoProto(name=name) for name in node.output],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", opset)])


X = normal(1, 4, 7, 6)
STATISTICS = [normal(4), normal(4), np.abs(normal(4)) + 0.1]
W = normal(6, 4, 3, 3)
V = normal(4, 5, 3, 3)
TWICE = {"strides": [2, 2]}
CASES: list[tuple[str, int, list[np.ndarray | None], dict[str, Any]]] = [
    ("Clip", 6, [X], {"min": 0.0, "max": 6.0}),
    ("Softmax", 11, [X], {"axis": 2}),
    ("BatchNormalization", 7, [X, np.abs(normal(4)), *STATISTICS], {}),
    ("LayerNormalization", 17, [X, normal(7, 6)], {"axis": 2, "epsilon": 1e-3}),
    ("Squeeze", 11, [normal(1, 3, 1)], {}),
    ("Unsqueeze", 11, [normal(3, 2)], {"axes": [1, 3]}),
    ("Split", 11, [normal(6, 2)], {"outputs": 2, "axis": 0, "split": [4, 2]}),
    ("Slice", 9, [X], {"starts": [1, 0], "ends": [3, -1], "axes": [2, 3]}),
    ("Cast", 17, [X], {"to": TensorProto.INT64}),
    ("Conv", 17, [normal(1, 2, 4, 5, 6), normal(3, 2, 3, 3, 3)], {}),
    ("Conv", 17, [X, W, normal(6)], {"pads": [0, 1, 2, 1], "dilations": [2, 2]}),
    ("Conv", 17, [X, normal(4, 1, 3, 3)], {"auto_pad": "SAME_LOWER", "group": 4} | TWICE),
    ("ConvTranspose", 17, [X, V], {"pads": [1, 1, 1, 1], "output_padding": [1, 1]} | TWICE),
    ("ConvTranspose", 17, [X, V], {"auto_pad": "SAME_LOWER"} | TWICE),
    ("ConvTranspose", 17, [X, V], {"auto_pad": "SAME_UPPER", "output_shape": [13, 12]} | TWICE),
    *(("Resize", 10, [X, np.array([1, 1, f, f], F32)], {"mode": "linear"}) for f in (2, 1.5)),
    ("Upsample", 9, [X, np.array([1, 1, 1.5, 2], F32)], {"mode": "nearest"}),
    ("Upsample", 7, [X], {"mode": "linear", "scales": [1.0, 1.0, 2.0, 2.0]}),
    ("Pad", 10, [X], {"mode": "reflect", "pads": [0, 0, 2, 1, 0, 0, 1, 3]}),
    *((op, 11, [np.abs(X) + 0.1], {}) for op in sorted(OPERATORS) if op.startswith("Reduce")),
    ("ReduceSum", 11, [X], {"axes": [2, -1], "keepdims": 0}),
]


@pytest.mark.parametrize(("op", "opset", "inputs", "more"), CASES, ids=[op for op, *_ in CASES])
def test_an_operator_gives_what_onnxruntime_gives(
    op: str, opset: int, inputs: list[np.ndarray | None], more: dict[str, Any]
) -> None:
    model = model_of(op, inputs, opset, **more)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    true = session.run(None, {"in0": inputs[0]})
    right = [torch.from_numpy(output) for output in true]
    close(outputs_of(model, inputs[0]), right, rtol=2e-5, atol=2e-5, equal_nan=True)


UNCOVERED: list[tuple[str, list[np.ndarray | None], dict[str, Any]]] = [
    ("MaxPool", [X], {"outputs": 2, "kernel_shape": [2, 2]}),
    ("MaxPool", [X], {"kernel_shape": [2, 2], "pads": [0, 1, 1, 0], "ceil_mode": 1}),
    ("AveragePool", [X[0]], {"kernel_shape": [2]}),
    ("Resize", [X, None, None], {}),
    ("Resize", [X, None, np.full(4, 2, F32)], {"mode": "linear", "antialias": 1}),
    ("Conv", [X.astype(np.float64), W.astype(np.float64)], {}),
    ("Cast", [X], {"to": TensorProto.STRING}),
]


@pytest.mark.parametrize(("op", "inputs", "more"), UNCOVERED)
def test_what_is_not_covered_is_refused(op: str, inputs: list[Any], more: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match=op):
        outputs_of(model_of(op, inputs, 17, **more), inputs[0])
