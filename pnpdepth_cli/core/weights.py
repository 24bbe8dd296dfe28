"""θ: weights of a network that move during a refinement, without a change to the network.

A stand-in W(θ) lies over every parameter W of the network, in the instance's own attributes, where
Python finds it first. The parameters themselves are never written, so that the network is as before
as soon as the stand-ins are gone, whatever happened in between. With "weights", W(θ) = θ and θ
starts as W. With "lora:R", W(θ) = W + B·A (Hu et al., "LoRA: Low-Rank Adaptation of Large Language
Models", ICLR 2022), where B (out, R) starts at 0 and A (R, in) at random; vectors do not move.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pnpdepth_cli.errors import UsageError


@dataclass(frozen=True, eq=False)
class _StandIn:
    """The parts of θ of one parameter."""

    parameter: nn.Parameter  # W
    users: tuple[tuple[nn.Module, str], ...]  # the submodules that use it, each with its name there
    leaves: tuple[int, ...]  # positions of its parts in θ: one of W's shape, or A and B

    def value(self, theta: Sequence[Tensor]) -> Tensor:
        """Returns W(θ)."""
        parts = [theta[index] for index in self.leaves]
        if len(parts) == 1:
            return parts[0].to(self.parameter.dtype)
        inner, outer = parts
        change = (outer @ inner).view(self.parameter.shape)
        return (self.parameter.detach().float() + change).to(self.parameter.dtype)


class MovingWeights:
    """The weights that move, and their values.

    Args:
        network: The network; its parameters do not change.
        parameters: "weights", or "lora:R" with the rank R.
        seed: Of the random start of A.

    Raises:
        UsageError: `parameters` is neither.

    Attributes:
        theta: The values, each float32; assign new ones to move the weights.
    """

    def __init__(self, network: nn.Module, parameters: str, seed: int = 0) -> None:
        rank = rank_of(parameters)
        generator = torch.Generator().manual_seed(seed)
        self.theta: list[Tensor] = []
        self._stand_ins: list[_StandIn] = []
        for parameter, users in _users_of(network).items():
            start = [parameter.detach().float()]
            if rank is not None:
                start = _low_rank(parameter, rank, generator)
            leaves = range(len(self.theta), len(self.theta) + len(start))
            self.theta += start
            if start:
                self._stand_ins.append(_StandIn(parameter, tuple(users), tuple(leaves)))

    def parameters(self) -> list[Tensor]:
        """Returns for every element of θ the parameter of the network that it belongs to."""
        return [one.parameter for one in self._stand_ins for _ in one.leaves]

    def values(self) -> dict[nn.Parameter, Tensor]:
        """Returns W(θ) of every parameter that moves."""
        return {one.parameter: one.value(self.theta) for one in self._stand_ins}

    @contextmanager
    def in_place(self, *, requires_grad: bool = False) -> Iterator[list[Tensor]]:
        """Inside, the network computes with W(θ). Gives θ, as leaves if gradients are wanted."""
        leaves = [value.detach().requires_grad_(requires_grad) for value in self.theta]
        try:
            for one in self._stand_ins:
                value = one.value(leaves)
                for module, name in one.users:
                    module.__dict__[name] = value
            yield leaves
        finally:
            for one in self._stand_ins:
                for module, name in one.users:
                    module.__dict__.pop(name, None)

    def keep(self, reached: Sequence[bool]) -> None:
        """Lets go of the parameters no part of which is reached by a gradient.

        Args:
            reached: Of every element of θ.
        """
        kept = [one for one in self._stand_ins if any(reached[index] for index in one.leaves)]
        theta, self.theta, self._stand_ins = self.theta, [], []
        for one in kept:
            start = len(self.theta)
            self.theta += [theta[index] for index in one.leaves]
            leaves = tuple(range(start, len(self.theta)))
            self._stand_ins.append(_StandIn(one.parameter, one.users, leaves))


def rank_of(parameters: str) -> int | None:
    """Returns R of "lora:R"; None of "weights". Raises UsageError for any other text."""
    if parameters == "weights":
        return None
    kind, _, rank = parameters.partition(":")
    if kind != "lora" or not rank.isdecimal() or int(rank) < 1:
        raise UsageError(
            f"parameters {parameters!r} is none of elements, channels, weights and lora:R with a"
            " rank R, such as lora:8"
        )
    return int(rank)


def _users_of(network: nn.Module) -> dict[nn.Parameter, list[tuple[nn.Module, str]]]:
    """The submodules that use each floating-point parameter under its own name."""
    users: dict[nn.Parameter, list[tuple[nn.Module, str]]] = {}
    for module in network.modules():
        for name, parameter in module.named_parameters(recurse=False, remove_duplicate=False):
            if (
                parameter.is_floating_point()
                and getattr(module, name, None) is parameter
                and not isinstance(module, torch.jit.ScriptModule)
            ):
                users.setdefault(parameter, []).append((module, name))
    return users


def _low_rank(parameter: nn.Parameter, rank: int, generator: torch.Generator) -> list[Tensor]:
    """A and B at their start; nothing for a vector."""
    if parameter.ndim < 2:
        return []
    out, into = parameter.shape[0], parameter[0].numel()
    rank = min(rank, out, into)
    inner = torch.randn(rank, into, generator=generator) / into**0.5
    device = parameter.device
    return [inner.to(device), torch.zeros(out, rank, device=device)]
