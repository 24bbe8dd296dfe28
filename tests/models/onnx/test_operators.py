"""Every operator against onnxruntime, on random inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

onnx = pytest.importorskip("onnx", reason="needs the extra [onnx]")
ort = pytest.importorskip("onnxruntime", reason="needs the extra [onnx]")

from pathlib import Path  # noqa: E402

from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from pnpdepth_cli.errors import ModelError  # noqa: E402
from pnpdepth_cli.models.onnx.graph import OnnxGraph  # noqa: E402
from pnpdepth_cli.models.onnx.table import OPERATORS  # noqa: E402

F32, I64 = np.float32, np.int64
RIGHT_SINCE = {
    "test_reductions_of_old_and_new_opsets[ReduceLogSum]": (1, 24),
    "test_reductions_of_old_and_new_opsets[ReduceSumSquare]": (1, 24),
    "test_pools[{'strides': [2, 2], 'pads': [0, 0, 1, 1]}]": (1, 26),
    "test_pools[{'strides': [2, 2], 'auto_pad': 'SAME_UPPER'}]": (1, 26),
    "test_resize_to_sizes[nearest-size2-asymmetric]": (1, 29),
}
"""The versions from which onnxruntime computes these cases as the standard says."""


@pytest.fixture(autouse=True)
def _right_reference(request: pytest.FixtureRequest) -> None:
    version = tuple(map(int, ort.__version__.split(".")[:2]))
    if version < RIGHT_SINCE.get(request.node.name, version):
        pytest.skip("this onnxruntime is no reference")


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(F32)


def model_of(
    op: str, inputs: list[np.ndarray | None], opset: int, outputs: int, **attributes: Any
) -> onnx.ModelProto:
    """One node whose first input is the graph's and whose others are constants."""
    names = [f"in{n}" if value is not None else "" for n, value in enumerate(inputs)]
    node = helper.make_node(op, names, [f"out{n}" for n in range(outputs)], **attributes)
    kinds = {np.dtype(F32): TensorProto.FLOAT, np.dtype(I64): TensorProto.INT64,
             np.dtype(bool): TensorProto.BOOL}  # fmt: skip
    assert inputs[0] is not None
    graph = helper.make_graph(
        [node],
        "g",
        [helper.make_tensor_value_info("in0", kinds[inputs[0].dtype], inputs[0].shape)],
        [onnx.ValueInfoProto(name=f"out{n}") for n in range(outputs)],
        [numpy_helper.from_array(v, f"in{n}") for n, v in enumerate(inputs) if n and v is not None],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = 10
    return model


def both(
    op: str, inputs: list[np.ndarray | None], opset: int, outputs: int = 1, **attributes: Any
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    model = model_of(op, inputs, opset, outputs, **attributes)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    true = session.run(None, {"in0": inputs[0]})
    ours = OnnxGraph(model, Path("x.onnx"))(torch.from_numpy(inputs[0]))
    return [t.numpy() for t in (ours.values() if isinstance(ours, dict) else [ours])], true


def check(op: str, inputs: list[np.ndarray | None], opset: int = 17, **more: Any) -> None:
    ours, true = both(op, inputs, opset, **more)
    for one, other in zip(ours, true, strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-5)


X = normal(1, 4, 7, 6)
POSITIVE = np.abs(X) + 0.1

UNARY = [
    ("Relu", {}), ("LeakyRelu", {"alpha": 0.2}), ("Elu", {"alpha": 0.7}), ("Celu", {"alpha": 0.7}),
    ("Selu", {}), ("ThresholdedRelu", {"alpha": 0.3}), ("Sigmoid", {}), ("HardSigmoid", {}),
    ("HardSigmoid", {"alpha": 1 / 6, "beta": 0.5}), ("HardSwish", {}), ("Tanh", {}),
    ("Softplus", {}), ("Softsign", {}), ("Mish", {}), ("Erf", {}), ("Exp", {}), ("Abs", {}),
    ("Neg", {}), ("Floor", {}), ("Ceil", {}), ("Round", {}), ("Sign", {}), ("Sin", {}), ("Cos", {}),
    ("Tan", {}), ("Atan", {}), ("Sinh", {}), ("Cosh", {}), ("Identity", {}), ("IsNaN", {}),
    ("Softmax", {"axis": 1}), ("LogSoftmax", {}), ("Flatten", {"axis": 2}),
    ("Flatten", {"axis": -1}), ("Transpose", {"perm": [0, 2, 3, 1]}), ("Transpose", {}),
    ("GlobalAveragePool", {}), ("GlobalMaxPool", {}), ("LRN", {"size": 3, "alpha": 0.01}),
    ("Shape", {"start": 1}),
    ("Size", {}), ("Cast", {"to": TensorProto.INT64}), ("Cast", {"to": TensorProto.BOOL}),
    ("ArgMax", {"axis": 1}), ("ArgMin", {"axis": 2, "keepdims": 0}), ("Dropout", {}),
    ("DepthToSpace", {"blocksize": 2}), ("DepthToSpace", {"blocksize": 2, "mode": "CRD"}),
    ("Trilu", {"upper": 0}),
]  # fmt: skip


BINARY = ["Add", "Sub", "Mul", "Div", "Equal", "Greater", "Less", "GreaterOrEqual", "LessOrEqual",
          "Max", "Min", "Sum", "Mean"]  # fmt: skip
SLICES = [
    ([1], [5], [2], [2]), ([-1], [-100], [3], [-1]), ([4], [0], [2], [-2]),
    ([0], [2**62], [1], [1]), ([1, -3], [3, -1], [1, -1], [1, 1]), ([5], [2], [2], [1]),
    ([-100], [3], [3], [1]), ([-1], [-7], [2], [-1]), ([-1], [-8], [2], [-1]),
]  # fmt: skip
TRUTHS, OTHERS = np.array([True, False, True]), np.array([True, True, False])
STATISTICS = [normal(4), normal(4), np.abs(normal(4)) + 0.1]
GRID = np.clip(normal(1, 3, 3, 2), -1, 1)


def ints(*values: int) -> np.ndarray:
    return np.array(values, I64)


def case(op: str, *inputs: np.ndarray | None, **more: Any) -> tuple[Any, ...]:
    return op, list(inputs), more


CASES = [
    *(case(op, X, opset=18, **attributes) for op, attributes in UNARY),
    *(
        case(op, np.clip(POSITIVE, 0.1, 0.9))
        for op in ("Log", "Sqrt", "Reciprocal", "Asin", "Acos")
    ),
    *(case(op, X, normal(4, 1, 1)) for op in BINARY),
    case("Pow", POSITIVE, np.array([0.5], F32)),
    case("Pow", X, np.array(2, I64)),
    case("Div", ints(7, -7), ints(2, 2)),
    case("Mod", ints(7, -7), ints(3, 3)),
    case("Mod", X, np.array([0.7], F32), fmod=1),
    *(case(op, TRUTHS, OTHERS) for op in ("And", "Or", "Xor")),
    case("Not", TRUTHS),
    case("Where", TRUTHS, normal(3), normal(2, 3)),
    *(case("Gelu", X, opset=20, approximate=approximate) for approximate in ("none", "tanh")),
    case("Clip", X, opset=6, min=0.0, max=6.0),
    case("Clip", X, opset=6, max=0.5),
    case("Clip", X, np.array(0, F32), np.array(0.5, F32), opset=11),
    case("Clip", X, None, np.array(0.5, F32)),
    case("Clip", X, np.array(2, F32), np.array(1, F32)),
    case("PRelu", X, normal(4, 1, 1)),
    case("IsInf", np.array([np.inf, -np.inf, 1], F32), detect_negative=0),
    case("IsInf", np.array([np.inf, -np.inf, 1], F32), detect_positive=0),
    case("Softmax", X, opset=9),
    case("Softmax", X, opset=11, axis=2),
    case("Softmax", X, opset=13),
    case("MatMul", normal(2, 3, 5), normal(5, 4)),
    case("Gemm", normal(3, 5), normal(4, 5), normal(4), transB=1, alpha=0.5, beta=2.0),
    case("Gemm", normal(5, 3), normal(5, 4), transA=1),
    case("Gemm", normal(3, 5), normal(5, 4), normal(4)),
    case("Einsum", normal(2, 3, 5), normal(2, 5, 4), equation="bij,bjk->bik"),
    case("CumSum", X, np.array(2, I64)),
    case("CumSum", X, np.array(2, I64), reverse=1),
    case("CumSum", X, np.array(2, I64), exclusive=1),
    case("CumSum", X, np.array(2, I64), reverse=1, exclusive=1),
    case("Conv", normal(1, 4, 9), normal(5, 4, 3), pads=[1, 1]),
    case("Conv", normal(1, 2, 4, 5, 6), normal(3, 2, 3, 3, 3)),
    case("BatchNormalization", X, np.abs(normal(4)), *STATISTICS, opset=15, epsilon=1e-3),
    case("BatchNormalization", X, np.abs(normal(4)), *STATISTICS, opset=7),
    case("InstanceNormalization", X, normal(4), normal(4)),
    case("LayerNormalization", X, normal(6), normal(6)),
    case("LayerNormalization", X, normal(7, 6), axis=2, epsilon=1e-3),
    case("GroupNormalization", X, normal(4), normal(4), opset=21, num_groups=2),
    case("GroupNormalization", X, normal(2), normal(2), opset=18, num_groups=2),
    case("Reshape", X, ints(0, -1, 6)),
    case("Squeeze", normal(1, 3, 1), ints(0)),
    case("Squeeze", normal(1, 3, 1), opset=11, axes=[2]),
    case("Squeeze", normal(1, 3, 1), opset=11),
    case("Unsqueeze", normal(3, 2), ints(0, -1)),
    case("Unsqueeze", normal(3, 2), opset=11, axes=[1, 3]),
    case("Expand", normal(3, 1), ints(2, 1, 4)),
    case("Expand", normal(2, 3, 1), ints(3, 4)),
    case("Tile", normal(3, 2), ints(2, 3)),
    case("Concat", normal(3, 2), normal(4, 2), axis=0),
    case("SpaceToDepth", normal(1, 2, 6, 9), blocksize=3),
    case("DepthToSpace", normal(1, 18, 2, 3), blocksize=3),
    case("CastLike", X, ints(1)),
    case("ConstantOfShape", ints(2, 3), value=numpy_helper.from_array(ints(7))),
    case("ConstantOfShape", ints(2, 3)),
    case("Range", np.array(2, I64), np.array(9, I64), np.array(3, I64)),
    case("Split", normal(5, 2), opset=11, outputs=1, axis=0),
    case("Split", normal(6, 2), opset=11, outputs=3, axis=0),
    case("Split", normal(6, 2), opset=11, outputs=2, axis=0, split=[4, 2]),
    case("Split", normal(6, 2), ints(1, 5), opset=13, outputs=2),
    case("Split", normal(7, 2), opset=18, outputs=3, num_outputs=3),
    case("Gather", X, ints(0, -1, 2), axis=2),
    case("Gather", X, np.array(1, I64), axis=1),
    case("Gather", X, np.array([[0, 1], [3, -2]], I64), axis=3),
    case("Gather", ints(1, 3, 64, 96), np.array(2, I64), axis=0),  # x.shape[2]
    case("GatherElements", normal(3, 3), np.array([[0, -1, 2]], I64), axis=0),
    case("GatherND", normal(3, 3), np.array([[0, 1], [2, 2]], I64)),
    case("ScatterND", normal(4, 2), np.array([[1], [3]], I64), normal(2, 2)),
    case("ScatterElements", normal(4, 2), np.array([[1, -1]], I64), normal(1, 2), axis=0),
    case("TopK", normal(4, 6), ints(3), outputs=2),
    case("GridSample", X, GRID, opset=20, mode="linear", align_corners=0),
    case("GridSample", X, GRID, opset=20, mode="linear", align_corners=1),
    case("GridSample", X, GRID, opset=20, mode="nearest", align_corners=0),
    case("GridSample", X, GRID, opset=20),
    *(case("Slice", X, *(ints(*part) for part in parts)) for parts in SLICES),
    case("Slice", X, opset=9, starts=[1, 0], ends=[3, -1], axes=[2, 3]),
    case("Slice", X, opset=9, starts=[0, 1], ends=[1, 3]),
]


@pytest.mark.parametrize(("op", "inputs", "more"), CASES, ids=[op for op, *_ in CASES])
def test_an_operator_gives_what_onnxruntime_gives(
    op: str, inputs: list[np.ndarray | None], more: dict[str, Any]
) -> None:
    check(op, inputs, **more)


REDUCTIONS = sorted(name for name in OPERATORS if name.startswith("Reduce"))


@pytest.mark.parametrize("op", REDUCTIONS)
def test_reductions_of_old_and_new_opsets(op: str) -> None:
    check(op, [POSITIVE], opset=11, axes=[2, -1], keepdims=0)
    check(op, [POSITIVE], opset=11)
    check(op, [POSITIVE, np.array([1], I64)], opset=18)
    check(op, [POSITIVE, np.array([], I64)], opset=18, noop_with_empty_axes=1)


PADS = [
    {"pads": [1, 1, 1, 1]}, {"pads": [0, 1, 2, 1]}, {"pads": [0, 0, 1, 2]}, {},
    {"auto_pad": "SAME_UPPER"}, {"auto_pad": "SAME_LOWER"}, {"auto_pad": "VALID"},
]  # fmt: skip


@pytest.mark.parametrize("pads", PADS, ids=str)
@pytest.mark.parametrize("stride", [1, 2])
def test_convolutions_with_every_kind_of_padding(pads: dict[str, Any], stride: int) -> None:
    weight, bias = normal(6, 4, 3, 3), normal(6)
    check("Conv", [X, weight, bias], strides=[stride, stride], **pads)
    check("Conv", [X, normal(4, 1, 3, 3)], group=4, strides=[stride, stride], **pads)
    if "auto_pad" not in pads:
        check("Conv", [X, weight], dilations=[2, 2], strides=[stride, stride], **pads)


TRANSPOSED = [
    {}, {"strides": [2, 2]}, {"strides": [2, 2], "pads": [1, 1, 1, 1]},
    {"strides": [2, 2], "pads": [1, 1, 1, 1], "output_padding": [1, 1]},
    {"strides": [2, 2], "pads": [0, 0, 1, 1]}, {"strides": [2, 2], "output_shape": [14, 12]},
    {"strides": [2, 2], "auto_pad": "SAME_UPPER"}, {"strides": [2, 2], "auto_pad": "SAME_LOWER"},
    {"strides": [2, 2], "output_shape": [13, 12], "auto_pad": "SAME_UPPER"},
    {"strides": [2, 2], "output_shape": [14, 12], "output_padding": [1, 0]},
    {"strides": [2, 1], "dilations": [2, 1]}, {"strides": [3, 3], "pads": [1, 0, 0, 1]},
]  # fmt: skip


@pytest.mark.parametrize("attributes", TRANSPOSED, ids=str)
def test_transposed_convolutions(attributes: dict[str, Any]) -> None:
    check("ConvTranspose", [X, normal(4, 5, 3, 3), normal(5)], **attributes)
    check("ConvTranspose", [X, normal(4, 2, 4, 4)], group=2, **attributes)


POOLS = [
    {}, {"strides": [2, 2]}, {"strides": [2, 2], "pads": [1, 1, 1, 1]},
    {"strides": [2, 2], "pads": [0, 0, 1, 1]}, {"strides": [2, 2], "ceil_mode": 1},
    {"strides": [2, 2], "ceil_mode": 1, "pads": [1, 1, 1, 1]},
    {"strides": [2, 2], "auto_pad": "SAME_UPPER"}, {"strides": [2, 2], "auto_pad": "SAME_LOWER"},
]  # fmt: skip


@pytest.mark.parametrize("attributes", POOLS, ids=str)
def test_pools(attributes: dict[str, Any]) -> None:
    for kernel in (2, 3):
        if max(attributes.get("pads", [0])) >= kernel:
            continue
        check("MaxPool", [X], kernel_shape=[kernel, kernel], opset=12, **attributes)
        for counted in (0, 1):
            more = {"kernel_shape": [kernel, kernel], "count_include_pad": counted}
            check("AveragePool", [X], opset=19, **more, **attributes)


COORDINATES = ["half_pixel", "pytorch_half_pixel", "align_corners", "asymmetric"]
SIZES = [(14, 12), (10, 11), (4, 5), (7, 1)]


@pytest.mark.parametrize("coordinates", [*COORDINATES, "half_pixel_symmetric"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mode", ["nearest", "linear", "cubic"])
def test_resize_to_sizes(mode: str, size: tuple[int, int], coordinates: str) -> None:
    roundings = ["round_prefer_floor", "round_prefer_ceil", "floor", "ceil"]
    for rounding in roundings if mode == "nearest" else roundings[:1]:
        check(
            "Resize", [X, None, None, np.array([1, 4, *size], I64)], opset=19, mode=mode,
            coordinate_transformation_mode=coordinates, nearest_mode=rounding,
        )  # fmt: skip


@pytest.mark.parametrize("coordinates", [*COORDINATES, "half_pixel_symmetric"])
@pytest.mark.parametrize("scales", [(2, 2), (1.5, 1.7), (0.6, 0.5), (3, 1.1)])
@pytest.mark.parametrize("mode", ["nearest", "linear", "cubic"])
def test_resize_by_scales(mode: str, scales: tuple[float, float], coordinates: str) -> None:
    if mode == "nearest" and coordinates == "asymmetric":
        coordinates = "tf_half_pixel_for_nn"  # for nearest alone; asymmetric is in Upsample's test
    opset = 19 if coordinates == "half_pixel_symmetric" else 11
    check(
        "Resize", [X, np.array([], F32), np.array([1, 1, *scales], F32)], opset=opset, mode=mode,
        coordinate_transformation_mode=coordinates, nearest_mode="floor",
    )  # fmt: skip


@pytest.mark.parametrize("mode", ["linear", "cubic"])
@pytest.mark.parametrize("size", [(14, 12), (4, 3)])
def test_resize_with_antialias_and_without_what_is_outside(
    mode: str, size: tuple[int, int]
) -> None:
    sizes = np.array([1, 4, *size], I64)
    check("Resize", [X, None, None, sizes], opset=19, mode=mode, antialias=1)
    if mode == "cubic":
        more = {"exclude_outside": 1, "cubic_coeff_a": -0.5}
        check("Resize", [X, None, None, sizes], opset=13, mode=mode, **more)


@pytest.mark.parametrize("mode", ["nearest", "linear"])
@pytest.mark.parametrize("scales", [(2, 2), (1.5, 1.5), (0.5, 0.7)])
def test_upsample_and_the_first_resize(mode: str, scales: tuple[float, float]) -> None:
    factors = np.array([1, 1, *scales], F32)
    check("Resize", [X, factors], opset=10, mode=mode)
    if min(scales) >= 1:
        check("Upsample", [X, factors], opset=9, mode=mode)
        check("Upsample", [X], opset=7, mode=mode, scales=factors.tolist())


@pytest.mark.parametrize(
    ("size", "scales", "axis"), [((3, 4), (1, 4), 1), ((3, 4), (3, 1), 0), ((3,), (), 1)]
)
def test_dequantised_weights_are_folded_into_numbers(
    size: tuple[int, ...], scales: tuple[int, ...], axis: int
) -> None:
    x, quantised = normal(1, 3), np.random.default_rng(0).integers(-9, 9, size).astype(np.int8)
    scale = np.abs(normal(*scales)).astype(F32) + F32(0.01)
    zero = np.arange(scale.size, dtype=np.int8).reshape(scales)
    model = model_of("MatMul", [x, None], 13, 1)
    dequantise = helper.make_node("DequantizeLinear", ["q", "s", "z"], ["w"], axis=axis)
    model.graph.node[0].input[1] = "w"
    model.graph.node.insert(0, dequantise)
    flat = -1 if scales else ()
    for value, name in ((quantised, "q"), (scale.reshape(flat), "s"), (zero.reshape(flat), "z")):
        model.graph.initializer.append(numpy_helper.from_array(value, name))
    module = OnnxGraph(model, Path("x.onnx"))
    assert [name for name, _ in module.named_children()] == ["MatMul_out0"]
    expected = x @ ((quantised - zero).astype(F32) * scale)
    np.testing.assert_allclose(module(torch.from_numpy(x)).numpy(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", ["constant", "reflect", "edge", "wrap"])
def test_pads(mode: str) -> None:
    flat = [0, 0, 2, 1, 0, 0, 1, 3]
    check("Pad", [X, np.array(flat, I64)], opset=19, mode=mode)
    check("Pad", [X, np.array([1, 2], I64), None, np.array([-1], I64)], opset=19, mode=mode)
    if mode == "constant":
        check("Pad", [X, np.array(flat, I64), np.array(1.5, F32)], opset=13)
        check("Pad", [X, np.array([0, 0, -1, 0, 0, 0, 0, -2], I64)], opset=13)
    if mode != "wrap":
        check("Pad", [X], opset=10, mode=mode, pads=flat)


INDEX = np.array([[0, 1]], I64)


@pytest.mark.parametrize(
    ("op", "inputs", "outputs", "more"),
    [
        ("ArgMin", [X], 1, {"select_last_index": 1}),
        ("MaxPool", [X], 2, {"kernel_shape": [2, 2]}),
        ("AveragePool", [X[0]], 1, {"kernel_shape": [2]}),
        ("AveragePool", [X], 1, {"kernel_shape": [2, 2], "dilations": [2, 1]}),
        ("BatchNormalization", [X, *[normal(4)] * 4], 1, {"training_mode": 1}),
        ("LayerNormalization", [X, normal(6)], 2, {}),
        ("Resize", [X, None, None], 1, {}),
        ("Resize", [X, None, np.full(4, 2, F32)], 1, {"mode": "area"}),
        ("Pad", [X, np.ones(8, I64)], 1, {"mode": "mirror"}),
        ("Pad", [normal(2, 1), np.ones(4, I64)], 1, {"mode": "reflect"}),
        ("Cast", [X], 1, {"to": TensorProto.STRING}),
        ("GatherND", [X, INDEX], 1, {"batch_dims": 1}),
        ("ScatterND", [X, INDEX, normal(1, 7, 6)], 1, {"reduction": "mul"}),
        ("ScatterElements", [normal(4, 2), INDEX, X], 1, {"reduction": "add"}),
    ],
)
def test_what_an_operator_does_not_cover_is_refused_by_its_name(
    op: str, inputs: list[Any], outputs: int, more: dict[str, Any]
) -> None:
    model = model_of(op, inputs, 17, outputs, **more)
    with pytest.raises(ModelError) as caught:
        OnnxGraph(model, Path("x.onnx"))(torch.from_numpy(inputs[0]))
    assert op in str(caught.value)
