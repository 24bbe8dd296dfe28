"""TensorFlow's SAME padding, for networks that were published in it."""

from __future__ import annotations

import math


def same_padding(length: int, kernel: int, stride: int) -> tuple[int, int]:
    """Returns the pixels that SAME adds before and after a side; the odd one is added after.

    So many that the kernel has ⌈length / stride⌉ positions. Source: the guide of tf.nn, "Notes on
    padding".

    Args:
        length: Pixels of the side.
        kernel: Pixels of the kernel along it.
        stride: Stride along it.
    """
    last_position = (math.ceil(length / stride) - 1) * stride
    missing = max(last_position + kernel - length, 0)
    before = missing // 2
    return before, missing - before
