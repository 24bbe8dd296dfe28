"""How TensorFlow pads, for networks that were published in it."""

from __future__ import annotations


def same_padding(length: int, kernel: int, stride: int) -> tuple[int, int]:
    """What SAME puts before and after a side of so many pixels: the odd pixel goes behind.

    As in the guide of tf.nn, "Notes on padding".
    """
    missing = max((-(-length // stride) - 1) * stride + kernel - length, 0)
    return missing // 2, missing - missing // 2
