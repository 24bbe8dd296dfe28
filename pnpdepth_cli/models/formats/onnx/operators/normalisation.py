"""Normalisations, and the dequantisation of weights."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.formats.onnx.operators.table import (
    Inputs,
    Node,
    Unsupported,
    operator,
    optional,
    register,
)

register(
    {
        "InstanceNormalization": lambda node, i: F.instance_norm(
            i[0], weight=i[1], bias=i[2], eps=node.get("epsilon", 1e-5)
        ),
        "LRN": lambda node, i: F.local_response_norm(
            i[0],
            node.get("size"),
            node.get("alpha", 1e-4),
            node.get("beta", 0.75),
            node.get("bias", 1.0),
        ),
    }
)


@operator("BatchNormalization")
def batch_norm(node: Node, inputs: Inputs) -> Tensor:
    if node.get("training_mode", 0):
        raise Unsupported("training_mode; export the network in eval mode")
    x, weight, bias, mean, variance = inputs[:5]
    return F.batch_norm(x, mean, variance, weight, bias, eps=node.get("epsilon", 1e-5))


@operator("LayerNormalization")
def layer_norm(node: Node, inputs: Inputs) -> Tensor:
    if node.outputs > 1:
        raise Unsupported("its second and third output")
    x, weight, bias = inputs[0], inputs[1], optional(inputs, 2)
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    bias = None if bias is None else bias.expand(shape)
    return F.layer_norm(x, shape, weight.expand(shape), bias, node.get("epsilon", 1e-5))


@operator("RMSNormalization")
def rms_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight = inputs
    shape = list(x.shape[node.get("axis", -1) % x.ndim :])
    return F.rms_norm(x, shape, weight.expand(shape), node.get("epsilon", 1e-5))


@operator("GroupNormalization")
def group_norm(node: Node, inputs: Inputs) -> Tensor:
    x, weight, bias = inputs
    groups = node.get("num_groups")
    if node.opset < 21:  # one weight per group
        weight, bias = (v.repeat_interleave(x.shape[1] // groups) for v in (weight, bias))
    return F.group_norm(x, groups, weight, bias, node.get("epsilon", 1e-5))


@operator("LpNormalization")
def lp_norm(node: Node, inputs: Inputs) -> Tensor:
    x, axis, p = inputs[0], node.get("axis", -1), node.get("p", 2)
    norm = x.norm(p, dim=axis, keepdim=True)
    return torch.where(norm == 0, torch.zeros_like(x), x / norm)


@operator("MeanVarianceNormalization")
def mean_variance_norm(node: Node, inputs: Inputs) -> Tensor:
    x, axes = inputs[0], list(node.get("axes", [0, 2, 3]))
    centred = x - x.mean(axes, keepdim=True)
    std: Tensor = centred.square().mean(axes, keepdim=True).sqrt()
    return centred / (std + 1e-9)


@operator("DequantizeLinear")
def dequantize(node: Node, inputs: Inputs) -> Tensor:
    x, scale, zero = inputs[0], inputs[1], optional(inputs, 2)
    if node.get("block_size", 0):
        raise Unsupported("blocks")
    if scale.numel() > 1:
        shape = [1] * x.ndim
        shape[node.get("axis", 1)] = -1
        scale = scale.reshape(shape)
        zero = None if zero is None else zero.reshape(shape)
    centred = x.to(scale.dtype) if zero is None else x.to(scale.dtype) - zero.to(scale.dtype)
    return centred * scale
