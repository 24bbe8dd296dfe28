"""What a watched pass learns: what depends on z, what may be handed back, what to protect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split import Split
from tests.core.networks import Counting, Net, branching, conv, image


def behind(operation: Callable[[Tensor, Tensor], Tensor]) -> nn.Module:
    """A network with a branch behind the cut whose input is `operation` of z and y."""

    def run(net: Any, x: Tensor) -> Tensor:
        y = net.enter(x)
        z = net.cut(y)
        return net.head(z + net.branch(operation(z, y)))

    parts = {"enter": conv(3, 4), "cut": conv(4, 4), "head": conv(4, 1)}
    return Net(run, branch=Counting(conv(4, 4)), **parts)


DEPENDENT: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "z itself": lambda z, y: z,
    "detach": lambda z, y: z.detach() * 2,
    "data": lambda z, y: z.data,
    "argmax": lambda z, y: y + z.argmax(1, keepdim=True),
    "a comparison": lambda z, y: torch.where(z > 0, y, -y),
    "a view": lambda z, y: z.detach()[:, [0]].expand(-1, 4, -1, -1),
    "written into a new tensor": lambda z, y: torch.zeros_like(y).copy_(z.detach()),
    "written by out=": lambda z, y: torch.add(z.detach(), 1, out=torch.empty_like(y)),
    "written into a part": lambda z, y: y.clone().add_(z[0, 0].detach()),
    "a value": lambda z, y: y * float(z.detach().mean()),
    "numpy": lambda z, y: torch.from_numpy(z.detach().numpy() * 2),
    "an array": lambda z, y: torch.from_numpy(np.asarray(z.detach()) * 2),
    "dlpack": lambda z, y: torch.from_numpy(np.from_dlpack(z.detach()) * 2),
    "a list": lambda z, y: torch.tensor(z.detach().tolist()),
    "a mask": lambda z, y: y + y[z > 0].sum(),
    "foreach": lambda z, y: torch._foreach_add([y], [z.detach()])[0],
}
INDEPENDENT: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "the features before z": lambda z, y: y,
    "the shape of z": lambda z, y: y * z.shape[1],
    "new zeros": lambda z, y: y + torch.zeros(z.shape),
}


@pytest.mark.parametrize("operation", [*DEPENDENT, *INDEPENDENT])
def test_a_branch_runs_again_where_it_depends_on_z_by_any_operation(operation: str) -> None:
    torch.manual_seed(0)
    network = behind((DEPENDENT | INDEPENDENT)[operation])
    x = image()
    with Split(network, "cut") as split, torch.no_grad():
        z = split.front(x)
        for changed in (z, z + 1):
            split.rear(changed)
        replayed = split.rear(-z)
    assert network.branch.calls == (3 if operation in DEPENDENT else 1)
    with Split(network, "cut") as split, torch.no_grad():
        split.front(x)
        assert torch.equal(split.rear(-z), replayed)


@pytest.mark.parametrize(
    "escape",
    [
        lambda y: bool(y.mean() > 0),
        lambda y: y.mean((0, 2, 3)).tolist()[0] > 0,
        lambda y: y.numpy().mean() > 0,
        lambda y: len(y[y > 0]) > 400,
    ],
)
def test_python_may_take_another_branch_at_another_z(escape: Callable[[Tensor], bool]) -> None:
    torch.manual_seed(0)
    network = branching(escape)
    x = image()
    for sign in (1, -1):
        with Split(network, "cut") as split, torch.no_grad():
            z = split.front(x)
            z = sign * z.abs()
            outputs = [split.rear(changed) for changed in (z, -z, z, -z)]
        for output, changed in zip(outputs, (z, -z), strict=False):
            with Split(network, "cut") as fresh, torch.no_grad():
                fresh.front(x)
                assert torch.equal(fresh.rear(changed), output)
        assert torch.equal(outputs[0], outputs[2])
        assert torch.equal(outputs[1], outputs[3])
        assert not torch.equal(outputs[0], outputs[1])
