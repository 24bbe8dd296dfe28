from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split import Split
from pnpdepth_cli.errors import DeviceError, ModelError, UsageError
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.precision import dtype_of, lower

CPU = torch.device("cpu")


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.encode = nn.Sequential(nn.Conv2d(3, 8, 3, 2, 1), nn.BatchNorm2d(8), nn.ReLU(True))
        self.decode = nn.ConvTranspose2d(8, 1, 4, 2, 1)
        self.mix = nn.Conv1d(1, 1, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        depth = self.decode(self.encode(x))
        return 2 + self.mix(depth.flatten(2)).reshape(depth.shape)  # type: ignore[no-any-return]


def test_fp32_is_the_network_as_it_stands_and_others_are_refused_with_a_remedy() -> None:
    assert dtype_of("fp32", CPU) is None
    with pytest.raises(DeviceError, match="bf16"):
        load_network("compact", None, "cpu", precision="fp16")
    with pytest.raises(UsageError):
        dtype_of("int8", CPU)


def test_weights_are_cast_once_and_the_rest_stays_in_float32() -> None:
    network = Net()
    lower(network, torch.bfloat16, CPU)
    dtypes = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    assert dtypes["encode.0.weight"] == dtypes["decode.bias"] == torch.bfloat16
    assert dtypes["mix.weight"] == torch.bfloat16
    assert dtypes["encode.1.weight"] == dtypes["encode.1.running_mean"] == torch.float32
    assert network.encode[0].weight.is_contiguous(memory_format=torch.channels_last)


def test_casting_once_gives_what_autocast_gives_bit_for_bit() -> None:
    # in the memory layout of the lowered network: on some CPUs the layout decides the kernel
    plain, lowered = Net().eval().to(memory_format=torch.channels_last), Net().eval()
    lower(lowered, torch.bfloat16, CPU)
    image = torch.rand(1, 3, 16, 16)
    with torch.no_grad():
        with torch.autocast("cpu", torch.bfloat16):
            expected = plain(image)
        output = lowered(image)
        assert output.dtype == torch.bfloat16
        assert torch.equal(output, expected)
        with Split(lowered, "encode.0") as split:  # which is as well cut
            assert torch.equal(split.rear(split.front(image)), output)
            assert torch.equal(split.rear(split.front(image)), output)


class Strict(nn.Module):
    """Wants its tensors in one type."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv(x)
        return y.index_add(0, torch.zeros(1, dtype=torch.long), x.new_ones(1, 1, *y.shape[2:]))


def test_a_network_without_bf16_is_refused_with_a_remedy() -> None:
    network = Strict()
    lower(network, torch.bfloat16, CPU)
    with pytest.raises(ModelError), torch.no_grad():
        network(torch.rand(1, 3, 4, 4))
