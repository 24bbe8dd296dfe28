"""TensorFlow's SAME padding against a table of what TensorFlow does."""

from __future__ import annotations

import pytest

from model_zoo_defs._same_padding import same_padding


@pytest.mark.parametrize(
    ("length", "kernel", "stride", "padding"),
    [
        (114, 3, 2, (0, 1)),
        (152, 3, 2, (0, 1)),
        (113, 3, 2, (1, 1)),
        (5, 3, 1, (1, 1)),
        (228, 7, 2, (2, 3)),
        (227, 7, 2, (3, 3)),
        (10, 2, 2, (0, 0)),
        (9, 2, 2, (0, 1)),
        (8, 1, 2, (0, 0)),
        (1, 3, 2, (1, 1)),
        (6, 5, 3, (1, 1)),
        (228, 11, 2, (4, 5)),
        (227, 11, 2, (5, 5)),
        (228, 5, 2, (1, 2)),
        (229, 5, 2, (2, 2)),
        (228, 3, 2, (0, 1)),
        (229, 3, 2, (1, 1)),
        (1, 11, 2, (5, 5)),
        (2, 11, 2, (4, 5)),
        (2, 3, 2, (0, 1)),
        (352, 2, 2, (0, 0)),
        (353, 1, 2, (0, 0)),
    ],
)
def test_same_padding_is_tensorflows(
    length: int, kernel: int, stride: int, padding: tuple[int, int]
) -> None:
    assert same_padding(length, kernel, stride) == padding
