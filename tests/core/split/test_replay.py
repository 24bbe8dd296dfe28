"""Calls of submodules go to a handler; a recording says which of them later passes make."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from pnpdepth_cli.core.split.replay import Interception, RecordedCall, Recording, shapes_of


def plain(module: nn.Module, arguments: Any, run: Callable[[], Any]) -> Any:
    return run()


def test_only_chosen_submodules_are_intercepted_and_only_in_the_block() -> None:
    seen: list[Any] = []

    def twice(module: nn.Module, arguments: Any, run: Callable[[], Any]) -> Any:
        seen.append((module, arguments))
        return run() * 2

    network, x = nn.Sequential(nn.Identity(), nn.Identity()), torch.ones(2)
    interception = Interception(dict.fromkeys(network.modules()))
    with interception.handled_by(twice, plain):
        assert network(x).tolist() == [1, 1]
        interception.only({network[0]})
        assert network(x).tolist() == [2, 2]
        assert seen == [(network[0], ((x,), {}))]
        interception.all()
        assert network(x).tolist() == [8, 8]
    assert network(x).tolist() == [1, 1]


def test_every_submodule_has_its_own_forward_back() -> None:
    network = nn.Sequential(nn.Identity(), nn.Identity())
    own = network[1].forward = lambda x: x + 1
    interception = Interception(dict.fromkeys(network.modules()))
    interception.all()
    interception.close()
    assert "forward" not in vars(network)
    assert "forward" not in vars(network[0])
    assert vars(network[1])["forward"] is own


ONE, TWO = nn.Identity(), nn.ReLU()
X = torch.ones(1, 3, 4, 5)


def recording(**changes: object) -> Recording:
    calls = tuple(RecordedCall(module=module, cached=module is ONE) for module in (ONE, TWO, ONE))
    fields = {"shapes": shapes_of((X,)), "static_graph": True, "complete": True, **changes}
    return Recording(calls=calls, cut=1, **fields)  # type: ignore[arg-type]


def test_a_call_is_looked_up_by_its_submodule_and_number() -> None:
    assert [recording().index(ONE, count) for count in range(3)] == [0, 2, None]
    assert recording().index(nn.Identity(), 0) is None


def test_cached_calls_and_the_cut_are_intercepted() -> None:
    assert recording().intercepted() == {ONE, TWO}


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
