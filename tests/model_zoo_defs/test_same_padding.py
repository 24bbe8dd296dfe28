"""TensorFlow's SAME padding against a table of what TensorFlow does."""

from __future__ import annotations

import pytest

from model_zoo_defs._same_padding import same_padding

# (length, kernel, stride): padding at both ends
TENSORFLOWS = {
    (114, 3, 2): (0, 1), (113, 3, 2): (1, 1), (5, 3, 1): (1, 1), (228, 7, 2): (2, 3),
    (227, 7, 2): (3, 3), (10, 2, 2): (0, 0), (9, 2, 2): (0, 1), (8, 1, 2): (0, 0),
    (1, 3, 2): (1, 1), (6, 5, 3): (1, 1), (228, 11, 2): (4, 5), (227, 11, 2): (5, 5),
    (229, 5, 2): (2, 2), (1, 11, 2): (5, 5), (2, 11, 2): (4, 5), (353, 1, 2): (0, 0),
}  # fmt: skip


@pytest.mark.parametrize("case", TENSORFLOWS)
def test_same_padding_is_tensorflows(case: tuple[int, int, int]) -> None:
    assert same_padding(*case) == TENSORFLOWS[case]
