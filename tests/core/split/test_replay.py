"""Calls of submodules go to a handler, and the submodules are as before afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from pnpdepth_cli.core.split.interception import Interception


def twice(module: nn.Module, arguments: Any, run: Callable[[], Any]) -> Any:
    return run() * 2


def plain(module: nn.Module, arguments: Any, run: Callable[[], Any]) -> Any:
    return run()


def test_only_chosen_submodules_are_intercepted_and_only_in_the_block() -> None:
    network, x = nn.Sequential(nn.Identity(), nn.Identity()), torch.ones(2)
    interception = Interception(dict.fromkeys(network.modules()))
    with interception.handled_by(twice, plain):
        assert network(x).tolist() == [1, 1]
        interception.only({network[0]})
        assert network(x).tolist() == [2, 2]
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


def test_a_handler_receives_the_submodule_and_its_arguments() -> None:
    seen: list[Any] = []

    def note(module: nn.Module, arguments: Any, run: Callable[[], Any]) -> Any:
        seen.append((module, arguments))
        return run()

    layer = nn.Identity()
    interception = Interception([layer])
    interception.all()
    with interception.handled_by(note, plain):
        layer(3)
    assert seen == [(layer, ((3,), {}))]
