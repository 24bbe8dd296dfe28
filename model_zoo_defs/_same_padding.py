"""TensorFlow's SAME padding, for networks that were published in it."""

from __future__ import annotations


def same_padding(length: int, kernel: int, stride: int) -> tuple[int, int]:
    """Returns the pixels that SAME adds before and after a side; the odd one is added after.

    Source: the guide of tf.nn, "Notes on padding".

    Args:
        length: Pixels of the side.
        kernel: Pixels of the kernel along it.
        stride: Stride along it.
    """
    missing = max((-(-length // stride) - 1) * stride + kernel - length, 0)
    return missing // 2, missing - missing // 2
