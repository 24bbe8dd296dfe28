"""Activations, arithmetic, comparison, matrix products and reductions."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.onnx import (
    Inputs,
    Node,
    Operator,
    operator,
    optional,
    register,
    stated,
)

_SAME_NAME = (
    *("Relu", "Sigmoid", "Tanh", "Erf", "Exp", "Log", "Sqrt", "Reciprocal", "Abs", "Neg", "Floor"),
    *("Ceil", "Round", "Sign", "Sin", "Cos", "IsNaN", "IsInf", "Softplus", "HardSwish", "Mish"),
    *("Add", "Sub", "Mul", "Greater", "Less", "MatMul", "Where"),
)
"""Named as in torch, but for capitals."""


def _divide(a: Tensor, b: Tensor) -> Tensor:
    return a / b if a.is_floating_point() else torch.div(a, b, rounding_mode="trunc")


_PLAIN: dict[str, Callable[..., Tensor]] = {
    **{n: getattr(torch, n.lower(), None) or getattr(F, n.lower()) for n in _SAME_NAME},
    "Equal": torch.eq, "GreaterOrEqual": torch.ge, "LessOrEqual": torch.le, "Div": _divide,
    "And": torch.logical_and, "Or": torch.logical_or, "Not": torch.logical_not,
    "Identity": torch.clone, "Dropout": lambda x, *_: x.clone(),
    "Pow": lambda base, exponent: torch.pow(base, exponent).to(base.dtype),
    "Max": lambda *each: functools.reduce(torch.maximum, each),
    "Min": lambda *each: functools.reduce(torch.minimum, each),
    "Sum": lambda *each: functools.reduce(torch.add, each),
}  # fmt: skip
"""Functions of the inputs alone."""


def _plain(function: Callable[..., Tensor]) -> Operator:
    return lambda _, inputs: function(*inputs)


register({name: _plain(function) for name, function in _PLAIN.items()})
register(
    {
        "Mod": lambda node, i: (torch.fmod if node.get("fmod", 0) else torch.remainder)(i[0], i[1]),
        "LeakyRelu": lambda node, i: F.leaky_relu(i[0], node.get("alpha", 0.01)),
        "Elu": lambda node, i: F.elu(i[0], node.get("alpha", 1.0)),
        "Einsum": lambda node, i: torch.einsum(node.get("equation"), *i),
        "HardSigmoid": lambda node, i: torch.add(
            torch.mul(i[0], node.get("alpha", 0.2)), node.get("beta", 0.5)
        ).clamp(0, 1),
        "Gelu": lambda node, i: F.gelu(i[0], approximate=node.get("approximate", "none")),
    }
)


@operator("Clip")
def clip(node: Node, inputs: Inputs) -> Tensor:
    low = optional(inputs, 1) if node.opset >= 11 else node.get("min")
    high = optional(inputs, 2) if node.opset >= 11 else node.get("max")
    x: Tensor = inputs[0]
    # Two steps: if low > high, the standard's result is high; either may be left out.
    for bound, function in ((low, torch.maximum), (high, torch.minimum)):
        if bound is not None:
            x = function(x, torch.as_tensor(bound, dtype=x.dtype, device=x.device))
    return x


@operator("PRelu")
def prelu(node: Node, inputs: Inputs) -> Tensor:
    x, slope = inputs
    return torch.where(x < 0, x * slope, x)


@operator("Softmax", "LogSoftmax")
def softmax(node: Node, inputs: Inputs) -> Tensor:
    x = inputs[0]
    function = torch.softmax if node.op == "Softmax" else torch.log_softmax
    if node.opset >= 13:
        return function(x, node.get("axis", -1))
    axis = node.get("axis", 1) % x.ndim
    rows = math.prod(x.shape[:axis])
    return function(x.reshape(rows, -1), 1).reshape(x.shape)


@operator("Gemm")
def gemm(node: Node, inputs: Inputs) -> Tensor:
    a, b, c = inputs[0], inputs[1], optional(inputs, 2)
    a = a.T if node.get("transA", 0) else a
    b = b.T if node.get("transB", 0) else b
    product: Tensor = node.get("alpha", 1.0) * (a @ b)
    return product if c is None else product + node.get("beta", 1.0) * c


_REDUCTIONS: dict[str, Callable[[Tensor, list[int], bool], Tensor]] = {
    "ReduceMean": lambda x, axes, keep: x.mean(axes, keepdim=keep),
    "ReduceSum": lambda x, axes, keep: x.sum(axes, keepdim=keep, dtype=x.dtype),
    "ReduceMax": lambda x, axes, keep: x.amax(axes, keepdim=keep),
    "ReduceMin": lambda x, axes, keep: x.amin(axes, keepdim=keep),
    "ReduceL2": lambda x, axes, keep: x.square().sum(axes, keepdim=keep).sqrt(),
    "ReduceProd": lambda x, axes, keep: functools.reduce(
        lambda y, axis: y.prod(axis, keepdim=keep, dtype=x.dtype),
        sorted((a % x.ndim for a in axes), reverse=True),
        x,
    ),
}


@operator(*_REDUCTIONS, host=(1,))
def reduce(node: Node, inputs: Inputs) -> Tensor:
    axes = stated(node, "axes", inputs, 1)
    axes = axes or list(range(inputs[0].ndim))
    return _REDUCTIONS[node.op](inputs[0], axes, bool(node.get("keepdims", 1)))


@operator("ArgMax", "ArgMin")
def arg_extreme(node: Node, inputs: Inputs) -> Tensor:
    function = torch.argmax if node.op == "ArgMax" else torch.argmin
    return function(inputs[0], node.get("axis", 0), keepdim=bool(node.get("keepdims", 1)))
