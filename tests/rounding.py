"""Other roundings of torch's products: `pytest --rounding`.

Another processor, another number of threads or another library computes the same convolution with
other roundings. A test that compares too tightly, or whose method is unstable, fails with this
option.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

RELATIVE_ERRORS = {torch.float32: 1e-6, torch.float64: 2e-15}
"""The largest ones: 8 roundings, as of a sum of some hundred products in another order."""

PRODUCTS = {
    "convolution",
    "convolution_backward",
    "mm",
    "addmm",
    "bmm",
    "baddbmm",
    "mv",
    "addmv",
    "dot",
    "_scaled_dot_product_flash_attention_for_cpu",
    "_scaled_dot_product_flash_attention_for_cpu_backward",
}
"""The operators whose results are changed."""

_INTEGERS = {torch.float32: torch.int32, torch.float64: torch.int64}


def changed(values: torch.Tensor) -> torch.Tensor:
    """The values times 1 + error * h, where h in -1..1 is a hash of the value's own bits.

    So equal values stay equal, and what is computed twice in the same way comes out equal.
    """
    bits = values.view(_INTEGERS[values.dtype]).to(torch.int64)
    # the finalizer of MurmurHash3, with the low 32 bits
    bits = (bits ^ (bits >> 16)) * 0x85EBCA6B & 0xFFFFFFFF
    bits = (bits ^ (bits >> 13)) * 0xC2B2AE35 & 0xFFFFFFFF
    h = (bits ^ (bits >> 16)).double() / 0x7FFFFFFF - 1
    return (values.double() * (1 + RELATIVE_ERRORS[values.dtype] * h)).to(values.dtype)


class OtherRoundings(TorchDispatchMode):
    """Changes the results of the products while it is entered, forward and backward."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """What func returns, changed in place if it is a product of real numbers."""
        result = func(*args, **(kwargs or {}))
        is_product = func.overloadpacket.__name__.removesuffix("_") in PRODUCTS
        if is_product and not torch.jit.is_tracing():
            for tensor in result if isinstance(result, tuple | list) else (result,):
                # neither what stands for a tensor in torch.export, nor half precision
                if type(tensor) is torch.Tensor and tensor.dtype in _INTEGERS:
                    tensor.copy_(changed(tensor))
        return result


def enter_in_every_thread() -> None:
    """Enters the mode in this thread, for good, and in those that start from now on."""
    run: Callable[[threading.Thread], None] = threading.Thread.run

    def run_with_other_roundings(thread: threading.Thread) -> None:
        with OtherRoundings():
            run(thread)

    threading.Thread.run = run_with_other_roundings  # type: ignore[method-assign]
    OtherRoundings().__enter__()
