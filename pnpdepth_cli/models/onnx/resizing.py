"""Resize and Upsample in every mode of the standard, as a weighted sum of input elements.

Along one axis each output element is Σ_k weight[k]·x[index[k]]: one element for nearest, two for
linear, four for cubic, more where an antialiasing filter is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from pnpdepth_cli.models.onnx import (
    Inputs,
    Node,
    operator,
    optional,
    whole_numbers,
)
from pnpdepth_cli.models.steps import Unsupported


@operator("Upsample", "Resize", host=(1, 2, 3))
def resize(node: Node, inputs: Inputs) -> Tensor:
    x, scales, sizes = inputs[0], optional(inputs, 2), optional(inputs, 3)
    if node.op == "Upsample" or node.opset < 11:
        mode = {"bilinear": "linear"}.get(node.get("mode"), node.get("mode", "nearest"))
        more = {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "simple"}
        factors = node.get("scales") if len(inputs) < 2 else inputs[1].tolist()
        return _resize(x, replace(node, attributes={"mode": mode, **more}), factors, None)
    axes = [a % x.ndim for a in node.get("axes", range(x.ndim))]
    if sizes is not None and sizes.numel():
        wanted = dict(zip(axes, whole_numbers(sizes), strict=True))
        policy = node.get("keep_aspect_ratio_policy", "stretch")
        by_axis = {a: n / x.shape[a] for a, n in wanted.items()}
        if policy != "stretch":
            ratio = (min if policy == "not_larger" else max)(by_axis.values())
            wanted = {a: math.floor(ratio * x.shape[a] + 0.5) for a in axes}
            by_axis = dict.fromkeys(axes, ratio)
        out = [wanted.get(a, x.shape[a]) for a in range(x.ndim)]
        return _resize(x, node, [by_axis.get(a, 1.0) for a in range(x.ndim)], out)
    if scales is None:
        raise Unsupported("neither scales nor sizes")
    by_axis = dict(zip(axes, scales.tolist(), strict=True))
    return _resize(x, node, [by_axis.get(a, 1.0) for a in range(x.ndim)], None)


def _resize(x: Tensor, node: Node, factors: list[float], sizes: list[int] | None) -> Tensor:
    sizes = sizes or [math.floor(n * s) for n, s in zip(x.shape, factors, strict=True)]
    fast = _by_torch(x, node, factors, sizes)
    if fast is not None:
        return fast
    for axis, (size, factor) in enumerate(zip(sizes, factors, strict=True)):
        if factor != 1:
            x = _along(x, axis, *_taps(node, x.shape[axis], size, factor))
    return x


def _by_torch(x: Tensor, node: Node, factors: list[float], sizes: list[int]) -> Tensor | None:
    """The result of torch's own resize if it computes the same; else None."""
    exact = all(n * f == s for n, f, s in zip(x.shape, factors, sizes, strict=True))
    is_image = x.ndim == 4 and tuple(x.shape[:2]) == tuple(sizes[:2]) and exact
    if not is_image or node.get("antialias") or not x.is_floating_point():
        return None
    size, mode = (sizes[2], sizes[3]), node.get("mode", "nearest")
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    whole = all(f >= 1 and f == int(f) for f in factors)
    if mode == "nearest" and whole and node.get("nearest_mode") in ("simple", "floor"):
        return F.interpolate(x, size) if coordinates == "asymmetric" else None
    corners = coordinates == "align_corners"
    half = coordinates in ("half_pixel", "pytorch_half_pixel") and min(size) > 1
    if mode == "linear" and (half or corners):
        return F.interpolate(x, size, mode="bilinear", align_corners=corners)
    return None


def _along(x: Tensor, axis: int, index: Tensor, weight: Tensor) -> Tensor:
    """Σ_k weight (n, k) · x taken at index (n, k) along the axis."""
    index, shape = index.to(x.device), [1] * x.ndim
    shape[axis] = -1
    taken = [x.index_select(axis, index[:, k]) for k in range(index.shape[1])]
    if len(taken) == 1:
        return taken[0]
    weight = weight.to(x)
    parts = [t * weight[:, k].reshape(shape) for k, t in enumerate(taken)]
    return torch.stack(parts).sum(dim=0) if len(parts) > 2 else parts[0] + parts[1]


def _taps(node: Node, size: int, out: int, factor: float) -> tuple[Tensor, Tensor]:
    """Indices and weights (out, k) along one axis."""
    mode, antialias = node.get("mode", "nearest"), node.get("antialias", 0)
    coordinates = node.get("coordinate_transformation_mode", "half_pixel")
    position = _coordinates(coordinates, size, out, factor)
    if mode == "nearest":
        rounding = _ROUNDING[node.get("nearest_mode", "round_prefer_floor")]
        index = rounding(position, factor).long().clamp(0, size - 1)
        return index[:, None], torch.ones(out, 1)
    if mode not in ("linear", "cubic"):
        raise Unsupported(f"mode {mode}")
    linear = mode == "linear"
    shrink = min(1.0, factor) if antialias else 1.0
    reach = math.ceil((1 if linear else 2) / shrink)
    index = position.floor().long()[:, None] + torch.arange(1 - reach, reach + 1)
    distance = (index - position[:, None]) * shrink
    a = node.get("cubic_coeff_a", -0.75)
    weight = (1 - distance.abs()).clamp_min(0) if linear else _cubic(distance, a)
    if node.get("exclude_outside", 0):
        weight = weight.masked_fill((index < 0) | (index > size - 1), 0)
    if node.get("exclude_outside", 0) or antialias:
        weight = weight / weight.sum(dim=1, keepdim=True)
    return index.clamp(0, size - 1), weight


def _coordinates(mode: str, size: int, out: int, factor: float) -> Tensor:
    """The input coordinates of the output's elements; in float32 as runtimes compute them.

    A factor that stands for a ratio of sizes is taken as that, lest a half becomes less than one.
    """
    o = torch.arange(out, dtype=torch.float32)
    scale = torch.tensor(factor, dtype=torch.float32)
    if factor == out / size and mode == "asymmetric":
        return o * size / out
    if mode == "asymmetric":
        return o / scale
    if mode == "align_corners":
        return o * (size - 1) / (out - 1) if out > 1 else torch.zeros(out)
    if mode == "tf_half_pixel_for_nn":
        return (o + 0.5) / scale
    if mode == "pytorch_half_pixel" and out == 1:
        return torch.zeros(out)
    if mode == "half_pixel_symmetric":  # in onnxruntime's order, which decides how ties round
        return size / 2 * (1 - out / (scale * size)) + (o + 0.5) / scale - 0.5
    if mode in ("half_pixel", "pytorch_half_pixel"):
        return (o + 0.5) / scale - 0.5
    raise Unsupported(f"coordinate_transformation_mode {mode}")


_ROUNDING: dict[str, Callable[[Tensor, float], Tensor]] = {
    "round_prefer_floor": lambda p, _: (p - 0.5).ceil(),
    "round_prefer_ceil": lambda p, _: (p + 0.5).floor(),
    "floor": lambda p, _: p.floor(),
    "ceil": lambda p, _: p.ceil(),
    "simple": lambda p, factor: p.ceil() if factor < 1 else p.floor(),
}


def _cubic(distance: Tensor, a: float) -> Tensor:
    """The cubic convolution kernel (Keys 1981)."""
    t = distance.abs()
    near = ((a + 2) * t - (a + 3)) * t * t + 1
    far = ((a * t - 5 * a) * t + 8 * a) * t - 4 * a
    return torch.where(t <= 1, near, torch.where(t < 2, far, torch.zeros_like(t)))
