"""A network in low precision: z, loss, updates and depth stay in float32."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.core.refine import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings


class InHalf(nn.Module):
    """Two convolutions with a tanh between, in `dtype` from end to end."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.encode, self.decode = nn.Conv2d(1, 4, 3, padding=1), nn.Conv2d(4, 1, 3, padding=1)
        self.to(dtype)

    def forward(self, x: Tensor) -> Tensor:
        depth = self.decode(torch.tanh(self.encode(x.to(self.encode.weight.dtype))))
        return 2 + depth  # type: ignore[no-any-return]


def points() -> SparsePoints:
    xy = torch.tensor([[1.0, 1.0], [5.0, 6.0], [2.0, 6.0], [6.0, 2.0]])
    return SparsePoints(xy=xy, depth=torch.tensor([2.0, 3.0, 2.5, 1.5]), size=(8, 8))


def refined(network: nn.Module, *, per_unit: float = 1.0, **settings: object) -> Refinement:
    image = torch.rand(1, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    with Split(network, "encode") as split:
        return refine(
            split,
            (image,),
            points(),
            ClosedSettings(**settings),  # type: ignore[arg-type]
            depth_of=lambda output: per_unit * output.float(),
        )


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_z_is_handed_out_in_float32_and_the_rear_of_it_is_the_network_bit_for_bit(
    dtype: torch.dtype,
) -> None:
    network, image = InHalf(dtype), torch.rand(1, 1, 8, 8)
    with torch.no_grad(), Split(network, "encode") as split:
        z = split.front(image)
        output = split.rear(z)
        assert z.dtype == torch.float32
        assert output.dtype == dtype
        assert torch.equal(output, network(image))


def test_steps_far_below_the_precision_of_z_add_up() -> None:
    """A step of 2^-12 is nothing to a bfloat16 near 1; many of them together are not."""
    many = refined(InHalf(torch.bfloat16), iterations=200, lr=2.0**-10)
    assert many.losses[-1] < 0.9 * many.losses[0]


def test_gradients_too_small_for_float16_still_move_z() -> None:
    """A tenth of a micrometre per unit of output, so ∂L/∂output is below the smallest float16."""
    tiny = refined(InHalf(torch.float16), per_unit=1e-7, iterations=1, lr=1.0)
    assert not torch.equal(tiny.before, tiny.after)
