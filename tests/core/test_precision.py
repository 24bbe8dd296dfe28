"""A network in low precision: z, loss, updates and depth stay in float32."""

from __future__ import annotations

import pytest
import torch

from pnpdepth_cli.core.refine import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings
from tests.core.networks import Net, conv, image

POINTS = SparsePoints(
    xy=torch.tensor([[1.0, 1.0], [5.0, 6.0], [2.0, 6.0], [6.0, 2.0]]),
    depth=torch.tensor([2.0, 3.0, 2.5, 1.5]),
    size=(8, 8),
)


def in_half(dtype: torch.dtype) -> Net:
    """Two convolutions with a tanh between, in `dtype` from end to end."""
    torch.manual_seed(0)
    return Net(
        lambda net, x: 2 + net.decode(torch.tanh(net.encode(x.to(dtype)))),
        encode=conv(3, 4),
        decode=conv(4, 1),
    ).to(dtype)


def refined(network: Net, *, per_unit: float = 1.0, **settings: float) -> Refinement:
    with Split(network, "encode") as split:
        return refine(
            split,
            (image(8, 8),),
            POINTS,
            ClosedSettings(**settings),
            depth_of=lambda output: per_unit * output.float(),
        )


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_z_is_handed_out_in_float32_and_the_rear_of_it_is_the_network_bit_for_bit(
    dtype: torch.dtype,
) -> None:
    network = in_half(dtype)
    with torch.no_grad(), Split(network, "encode") as split:
        z = split.front(image(8, 8))
        output = split.rear(z)
        assert (z.dtype, output.dtype) == (torch.float32, dtype)
        assert torch.equal(output, network(image(8, 8)))


def test_steps_far_below_the_precision_of_z_add_up() -> None:
    """A step of 2^-12 is nothing to a bfloat16 near 1; many of them together are not."""
    many = refined(in_half(torch.bfloat16), iterations=200, lr=2.0**-10)
    assert many.losses[-1] < 0.9 * many.losses[0]


def test_gradients_too_small_for_float16_still_move_z() -> None:
    """A tenth of a micrometre per unit of output, so ∂L/∂output is below the smallest float16."""
    tiny = refined(in_half(torch.float16), per_unit=1e-7, iterations=1, lr=1.0)
    assert not torch.equal(tiny.before, tiny.after)
