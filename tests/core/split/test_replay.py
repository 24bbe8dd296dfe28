"""A recording says which calls of submodules later passes make, and for which frames it holds."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from pnpdepth_cli.core.split.replay import RecordedCall, Recording, shapes_of

ONE, TWO = nn.Identity(), nn.ReLU()
X = torch.ones(1, 3, 4, 5)


def recording(**changes: object) -> Recording:
    calls = tuple(RecordedCall(module=module, cached=module is ONE) for module in (ONE, TWO, ONE))
    fields = {"shapes": shapes_of((X,)), "static_graph": True, "complete": True, **changes}
    return Recording(calls=calls, cut=1, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("arguments", [(X[..., :4],), (X.double(),), (X, X), (X, 1), ([X],)])
def test_arguments_of_other_shapes_types_or_structure_need_another_recording(
    arguments: tuple[object, ...],
) -> None:
    assert recording().holds_for((X * 2,))
    assert not recording().holds_for(arguments)


@pytest.mark.parametrize("field", ["static_graph", "complete"])
def test_an_unfinished_or_dynamic_recording_holds_for_one_frame_only(field: str) -> None:
    assert not recording(**{field: False}).holds_for((X,))


def test_of_an_unread_tensor_only_the_shape_is_saved() -> None:
    call = RecordedCall(module=ONE, cached=True, unread=frozenset({("0",)}))
    unread, read = call.save((X, X)).value
    assert unread.shape == X.shape
    assert unread.untyped_storage().nbytes() == 4
    assert read is X
