"""The precision a network computes in: fp32, or bf16 or fp16 with float32 inputs and outputs."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import nn

from pnpdepth_cli.choices import PRECISIONS
from pnpdepth_cli.core.user_code import describe, is_out_of_memory
from pnpdepth_cli.errors import DeviceError, ModelError, UsageError

_DTYPES = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}

_MAPS = (nn.Conv2d, nn.ConvTranspose2d)
_CAST_ONCE = (nn.Linear, nn.Conv1d, nn.Conv3d, nn.ConvTranspose1d, nn.ConvTranspose3d, *_MAPS)
"""Submodules whose weights autocast would cast in every pass: it caches trainable weights only."""


def dtype_of(precision: str, device: torch.device) -> torch.dtype | None:
    """Returns the type that convolutions and matrix products compute in; None leaves float32.

    Raises:
        UsageError: There is no such precision.
        DeviceError: fp16 on a CPU. Hardly any CPU computes in it, and those that do have bf16 too.
    """
    if precision not in PRECISIONS:
        raise UsageError(f"precision {precision!r} is not one of {' '.join(PRECISIONS)}")
    if precision == "fp16" and device.type == "cpu":
        raise DeviceError("precision fp16 is for GPUs; on a CPU take precision bf16 or fp32")
    return _DTYPES[precision]


def lower(module: nn.Module, dtype: torch.dtype, device: torch.device) -> None:
    """Makes the convolutions and matrix products of a module compute in a lower precision.

    The module is changed in place. torch's autocast decides which operations stay in float32.
    Weights are cast once, and laid out channels last, the fastest layout in low precision. Depth
    and gradients come out in float32.
    """
    for part in module.modules():
        if type(part) in _CAST_ONCE:
            part.to(dtype)
        if type(part) in _MAPS:
            part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    forward = module.forward

    @functools.wraps(forward)
    def forward_in_half(*args: Any, **kwargs: Any) -> Any:
        try:
            with torch.autocast(device.type, dtype=dtype):
                return forward(*args, **kwargs)
        except (RuntimeError, TypeError) as error:
            if is_out_of_memory(error):
                raise
            raise ModelError(
                f"the network's forward, with parts of it in {dtype}, raises {describe(error)}; try"
                " precision fp32"
            ) from error

    module.forward = forward_in_half
