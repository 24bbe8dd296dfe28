"""Tensors in structures are found and replaced; a forward's changes of the network are undone."""

from __future__ import annotations

import types
from collections import OrderedDict, defaultdict
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pytest
import torch

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.tensors import is_transparent, map_tensors, tensors_in
from tests.core.networks import Encoded, Updating, image


class Two(NamedTuple):
    a: Any
    b: Any = 3


@dataclass(frozen=True)
class Frozen:
    a: Any
    created: Any = field(init=False, default=None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "created", torch.zeros(1))


@dataclass
class Slotted:
    __slots__ = ("a",)
    a: Any


class Stack(list):  # type: ignore[type-arg]
    def __init__(self, first: Any, second: Any):
        super().__init__((first, second))


t = torch.ones(1)
STRUCTURES: list[tuple[Any, list[tuple[str, ...]]]] = [
    (t, [()]),
    ([t, (t, 5)], [("0",), ("1", "0")]),
    ({"a": t, 3: [t]}, [("a",), ("3", "0")]),
    ({1: t, "1": t + 1}, [("1",), ("1",)]),
    (OrderedDict(b=t, a=None), [("b",)]),
    (defaultdict(list, a=[t]), [("a", "0")]),
    (Two(t), [("0",)]),
    (Frozen(t), [("a",), ("created",)]),
    (Slotted(t), [("a",)]),
    (Stack(t, t), [("0",), ("1",)]),
    (Encoded(last=t, hidden=(t,)), [("last",), ("hidden", "0")]),
    (torch.ones(2, 2).max(0), [("0",), ("1",)]),
    (torch.Size([2, 3]), []),
    ((), []),
    ({}, []),
    ("text", []),
    (None, []),
]


@pytest.mark.parametrize(("structure", "paths"), STRUCTURES)
def test_mapping_replaces_each_tensor_and_keeps_everything_else(
    structure: Any, paths: list[tuple[str, ...]]
) -> None:
    before = [(path, tensor) for path, tensor in tensors_in(structure)]
    mapped = map_tensors(structure, lambda path, tensor: tensor + 1)
    assert type(mapped) is type(structure)
    after = list(tensors_in(mapped))
    assert [path for path, _ in after] == paths
    assert all(torch.equal(a, b + 1) for (_, a), (_, b) in zip(after, before, strict=True))
    assert [id(tensor) for _, tensor in tensors_in(structure)] == [id(b) for _, b in before]


def test_containers_are_new_even_when_empty_so_that_what_the_network_does_to_one_is_not_kept() -> (
    None
):
    for container in ([], {}, [t], {"a": t}, Slotted(t)):
        assert map_tensors(container, lambda path, tensor: tensor) is not container


def test_what_could_hide_a_tensor_is_not_transparent() -> None:
    assert is_transparent({"a": [t, 1, 2.0, "x", None, True], "b": Two(t)})
    assert is_transparent(Frozen(t))
    for hidden in (object(), iter([t]), {"a": {1, 2}}, lambda: t, types.MappingProxyType({"a": t})):
        assert not is_transparent(hidden)
        assert map_tensors(hidden, lambda path, tensor: tensor) is not None


def test_a_parameter_that_the_forward_overwrites_is_put_back() -> None:
    class Clamping(Updating):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            with torch.no_grad():
                self.head.weight.clamp_(min=0)
            return super().forward(x)

    torch.manual_seed(0)
    network = Clamping()
    before = network.head.weight.detach().clone()
    with Split(network, "cut") as split, torch.no_grad():
        z = split.front(image())
        assert torch.equal(split.rear(z), split.rear(z))
        assert not torch.equal(network.head.weight, before)
    assert torch.equal(network.head.weight, before)
