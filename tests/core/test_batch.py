"""The parts of the frames in tensors that hold several."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli.core.batch import frame_parts
from pnpdepth_cli.errors import BatchError


def test_every_tensor_of_a_structure_is_split_along_its_first_axis() -> None:
    x = torch.arange(6.0).reshape(2, 3)
    parts = frame_parts({"a": x, "b": [x + 1, None]}, 2)
    assert [part["a"].tolist() for part in parts] == [[[0, 1, 2]], [[3, 4, 5]]]
    assert [part["b"][0].tolist() for part in parts] == [[[1, 2, 3]], [[4, 5, 6]]]
    assert [part["b"][1] for part in parts] == [None, None]


def test_for_one_frame_the_structure_is_its_own_part() -> None:
    structure = {"a": torch.ones(5)}
    assert frame_parts(structure, 1)[0] is structure


def test_a_tensor_without_one_element_per_frame_is_named() -> None:
    with pytest.raises(BatchError, match=r"deep\.0 of shape \(3, 1\)"):
        frame_parts({"a": torch.ones(2, 1), "deep": [torch.ones(3, 1)]}, 2)
