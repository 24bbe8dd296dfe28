"""sparse2dense: every variant of the authors' files, against a network written from their keys."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model_zoo_defs.sparse2dense import DECODERS, SparseToDense, definitions
from pnpdepth_cli.errors import CheckpointError
from pnpdepth_cli.models.network import load_network
from tests.model_zoo_defs.cuts import assert_the_cut_changes_nothing_and_a_step_does, built

BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3)}
Shapes = dict[str, tuple[int, ...]]


def norm(name: str, channels: int) -> Shapes:
    vectors = ("weight", "bias", "running_mean", "running_var")
    return {f"{name}.{v}": (channels,) for v in vectors} | {f"{name}.num_batches_tracked": ()}


def stage(name: str, depth: int, position: int, channels: int, width: int) -> tuple[Shapes, int]:
    """Tensor shapes of stage `position` (0…3) of torchvision's ResNet, and its output channels."""
    inner, shapes = width << position, Shapes()
    out = inner * (4 if depth >= 50 else 1)
    for number in range(BLOCKS[depth][position]):
        block = f"{name}.{number}"
        convs = [(inner, channels, 3), (inner, inner, 3)]
        if depth >= 50:
            convs = [(inner, channels, 1), (inner, inner, 3), (out, inner, 1)]
        for i, (to, of, k) in enumerate(convs, start=1):
            shapes |= {f"{block}.conv{i}.weight": (to, of, k, k), **norm(f"{block}.bn{i}", to)}
        if number == 0 and (position or channels != out):
            shapes[f"{block}.downsample.0.weight"] = (out, channels, 1, 1)
            shapes |= norm(f"{block}.downsample.1", out)
        channels = out
    return shapes, channels


def published(depth: int, decoder: str, channels: int = 4, width: int = 64) -> Shapes:
    """Every key and shape of the state dict of a checkpoint of the authors'."""
    shapes = {"conv1.weight": (width, channels, 7, 7), **norm("bn1", width)}
    count = width
    for index in range(4):
        more, count = stage(f"layer{index + 1}", depth, index, count, width)
        shapes |= more
    half = count // 2
    shapes |= {"conv2.weight": (half, count, 1, 1), **norm("bn2", half)}
    for number in range(1, 5):
        name, of, to = f"decoder.layer{number}", half, half // 2
        if decoder == "upproj":
            upper, bottom = f"{name}.upper_branch", f"{name}.bottom_branch"
            shapes |= {f"{upper}.conv1.weight": (to, of, 5, 5), **norm(f"{upper}.batchnorm1", to)}
            shapes |= {f"{upper}.conv2.weight": (to, to, 3, 3), **norm(f"{upper}.batchnorm2", to)}
            shapes |= {f"{bottom}.conv.weight": (to, of, 5, 5), **norm(f"{bottom}.batchnorm", to)}
        elif decoder == "upconv":
            shapes |= {f"{name}.conv.weight": (to, of, 5, 5), **norm(f"{name}.batchnorm", to)}
        else:
            k = int(decoder[-1])
            shapes |= {f"{name}.{decoder}.weight": (of, to, k, k), **norm(f"{name}.batchnorm", to)}
        half = to
    return {**shapes, "conv3.weight": (1, half, 3, 3)}


def filled(shapes: Shapes) -> dict[str, Tensor]:
    """Random weights that whose activations neither vanish nor grow."""
    generator, state = torch.Generator().manual_seed(2), {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            state[name] = torch.tensor(7)
        elif name.endswith(("running_var", ".weight")) and len(shape) == 1:
            state[name] = 0.5 + torch.rand(shape, generator=generator)
        else:
            scale = (2 / (shape[1] * shape[2] * shape[3])) ** 0.5 if len(shape) == 4 else 0.1
            state[name] = scale * torch.randn(shape, generator=generator)
    return state


class Reference:
    """The authors' network straight from the named tensors; notes which of them it used."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state, self.used = state, set[str]()

    def __getitem__(self, name: str) -> Tensor:
        self.used.add(name)
        return self.state[name]

    def conv(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        weight = self[f"{name}.weight"]
        return F.conv2d(x, weight, stride=stride, padding=weight.shape[-1] // 2)

    def norm(self, x: Tensor, name: str) -> Tensor:
        mean, variance = self[f"{name}.running_mean"], self[f"{name}.running_var"]
        return F.batch_norm(x, mean, variance, self[f"{name}.weight"], self[f"{name}.bias"])

    def stage(self, x: Tensor, name: str, scene: int, count: int) -> Tensor:
        for number in range(count):
            block = f"{name}.{number}"
            stride = 2 if scene and not number else 1
            bottleneck = f"{block}.conv3.weight" in self.state
            y = F.relu(self.norm(self.conv(x, f"{block}.conv1", 1 if bottleneck else stride),
                                 f"{block}.bn1"))  # fmt: skip
            y = self.norm(self.conv(y, f"{block}.conv2", stride if bottleneck else 1),
                          f"{block}.bn2")  # fmt: skip
            if bottleneck:
                y = self.norm(self.conv(F.relu(y), f"{block}.conv3"), f"{block}.bn3")
            if f"{block}.downsample.0.weight" in self.state:
                x = self.norm(
                    self.conv(x, f"{block}.downsample.0", stride), f"{block}.downsample.1"
                )
            x = F.relu(x + y)
        return x

    def decoder(self, x: Tensor, kind: str, name: str) -> Tensor:
        if kind.startswith("deconv"):
            more = int(kind[-1]) - 2
            weight = self[f"{name}.{kind}.weight"]
            y = F.conv_transpose2d(x, weight, stride=2, padding=more, output_padding=more)
            return F.relu(self.norm(y, f"{name}.batchnorm"))
        x = unpooled(x)
        if kind == "upconv":
            return F.relu(self.norm(self.conv(x, f"{name}.conv"), f"{name}.batchnorm"))
        upper, bottom = f"{name}.upper_branch", f"{name}.bottom_branch"
        y = F.relu(self.norm(self.conv(x, f"{upper}.conv1"), f"{upper}.batchnorm1"))
        y = self.norm(self.conv(y, f"{upper}.conv2"), f"{upper}.batchnorm2")
        return F.relu(y + self.norm(self.conv(x, f"{bottom}.conv"), f"{bottom}.batchnorm"))

    def depth(self, x: Tensor, depth: int, decoder: str) -> Tensor:
        size = x.shape[-2:]
        x = F.max_pool2d(F.relu(self.norm(self.conv(x, "conv1", 2), "bn1")), 3, 2, 1)
        for scene, count in enumerate(BLOCKS[depth]):
            x = self.stage(x, f"layer{scene + 1}", scene, count)
        x = self.norm(self.conv(x, "conv2"), "bn2")
        for number in range(1, 5):
            x = self.decoder(x, decoder, f"decoder.layer{number}")
        return F.interpolate(self.conv(x, "conv3"), size, mode="bilinear", align_corners=True)


def unpooled(x: Tensor) -> Tensor:
    """Zeros between the pixels, by hand."""
    large = x.new_zeros(*x.shape[:2], 2 * x.shape[2], 2 * x.shape[3])
    large[..., ::2, ::2] = x
    return large


def frame(height: int = 228, width: int = 304) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    rgb = torch.rand(1, 3, height, width, generator=generator)
    depth = 1 + 4 * torch.rand(1, 1, height, width, generator=generator)
    return rgb, depth * (torch.rand(depth.shape, generator=generator) < 0.01)


# ------------------------------------------------------------------ the architecture


@pytest.mark.parametrize("depth", [18, 50])
@pytest.mark.parametrize("decoder", DECODERS)
def test_every_variant_has_the_published_keys_and_shapes(depth: int, decoder: str) -> None:
    for modality, channels in (("", 4), ("-rgb", 3), ("-d", 1)):
        with torch.device("meta"):
            network = definitions[f"sparse2dense-r{depth}-{decoder}{modality}"].build()
        shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
        assert shapes == published(depth, decoder, channels)


@pytest.mark.parametrize("depth", [18, 50])
@pytest.mark.parametrize("decoder", DECODERS)
def test_every_variant_computes_what_the_published_tensors_say(depth: int, decoder: str) -> None:
    state = filled(published(depth, decoder, width=16))
    network = SparseToDense(depth, decoder, width=16).eval()  # type: ignore[arg-type]
    network.load_state_dict(state)
    reference = Reference(state)
    with torch.no_grad():
        output = network(*frame(100, 130))
        expected = reference.depth(torch.cat(frame(100, 130), dim=1), depth, decoder)
    assert output.shape == (1, 1, 100, 130)
    torch.testing.assert_close(output, expected, rtol=1e-3, atol=1e-4 * float(expected.std()))
    counters = {name for name in state if name.endswith("num_batches_tracked")}
    assert reference.used == set(state) - counters


def test_images_are_from_0_to_1_and_short_names_are_those_of_the_papers_networks() -> None:
    for name, definition in definitions.items():
        assert definition.normalisation is not None
        deviation = (1 / 255 if name == "sparse2dense-selfsup" else 1.0,) * 3
        assert definition.normalisation.std == pytest.approx(deviation)
    assert definitions["sparse2dense"].name == "sparse2dense-r50-upproj"
    assert definitions["sparse2dense-kitti"].name == "sparse2dense-r18-upproj-kitti"


def test_the_sizes_of_z_are_those_of_the_paper() -> None:
    with torch.device("meta"):
        for depth, scene, channels, columns in ((50, "", 1024, 10), (18, "-kitti", 256, 29)):
            network = definitions[f"sparse2dense-r{depth}-deconv2{scene}"].build().eval()
            seen: list[Tensor] = []
            network.bn2.register_forward_hook(lambda *call, seen=seen: seen.append(call[2]))
            rgb, sparse = (torch.empty(1, n, 228, 912 if scene else 304) for n in (3, 1))
            assert network(rgb, sparse).shape == sparse.shape
            assert seen[0].shape == (1, channels, 8, columns)


# ------------------------------------------------------------------ published files


@pytest.mark.parametrize("counters", [True, False], ids=["now", "before PyTorch 0.4.1"])
def test_a_published_file_loads_whole(counters: bool, tmp_path: Path) -> None:
    state = filled(published(18, "upproj"))
    kept = {n: t for n, t in state.items() if counters or not n.endswith("num_batches_tracked")}
    args = argparse.Namespace(data="nyudepthv2", arch="resnet18", modality="rgbd")
    path = tmp_path / "model_best.pth.tar"
    torch.save(
        {"args": args, "epoch": 9, "model": kept}, path, _use_new_zipfile_serialization=counters
    )
    network = load_network("sparse2dense-r18-upproj", path)
    own = network.module.state_dict()
    assert own.keys() == state.keys()
    assert all(torch.equal(own[name], tensor) for name, tensor in kept.items())
    assert any("data nyudepthv2" in note for note in network.notes)  # its weights fit -kitti too


def test_misfits_are_named_and_weights_of_another_variant_name_the_right_one(
    tmp_path: Path,
) -> None:
    def write(shapes: Shapes) -> Path:
        torch.save({n: torch.zeros(()).expand(s) for n, s in shapes.items()}, tmp_path / "w.pth")
        return tmp_path / "w.pth"

    shapes = {**published(18, "deconv2"), "fc.weight": (3,)}
    del shapes["conv3.weight"]
    message = r"1 missing \(conv3\.weight\); 1 unexpected \(fc\.weight\)$"
    with pytest.raises(CheckpointError, match=message):
        load_network("sparse2dense-r18-deconv2", write(shapes))
    right = "sparse2dense-r18-upconv-d"
    with pytest.raises(CheckpointError, match=rf"this is {right} or .*; use --model {right}$"):
        load_network("sparse2dense-r18-upconv", write(published(18, "upconv", channels=1)))


# ------------------------------------------------------------------ the self-supervised network


def selfsup_shapes() -> Shapes:
    shapes: Shapes = {}
    for name, to, of in (("conv1_d", 16, 1), ("conv1_img", 48, 3), ("conv6", 512, 512)):
        shapes |= {f"{name}.0.weight": (to, of, 3, 3), **norm(f"{name}.1", to)}
    channels = 64
    for index in range(4):
        more, channels = stage(f"conv{index + 2}", 34, index, channels, 64)
        shapes |= more
    ups = {"convt5": (512, 256), "convt4": (768, 128), "convt3": (384, 64), "convt2": (192, 64)}
    for name, (of, to) in {**ups, "convt1": (128, 64)}.items():
        shapes |= {f"{name}.0.weight": (of, to, 3, 3), **norm(f"{name}.1", to)}
    return {**shapes, "convtf.0.weight": (1, 128, 1, 1), "convtf.0.bias": (1,)}


def test_the_self_supervised_file_loads_and_gives_what_its_tensors_say(tmp_path: Path) -> None:
    state = filled(selfsup_shapes())
    content = {"epoch": 11, "model": state, "args": argparse.Namespace(input="rgbd", layers=34)}
    torch.save(content, tmp_path / "model_best.pth.tar")
    network = load_network("sparse2dense-selfsup", tmp_path / "model_best.pth.tar")
    w, (rgb, sparse) = Reference(state), frame(48, 64)

    def first(x: Tensor, name: str, stride: int = 1) -> Tensor:
        return F.leaky_relu(w.norm(w.conv(x, f"{name}.0", stride), f"{name}.1"), 0.2)

    maps = {1: torch.cat([first(sparse, "conv1_d"), first(255 * rgb, "conv1_img")], 1)}
    for index, count in enumerate(BLOCKS[34]):
        maps[index + 2] = w.stage(maps[index + 1], f"conv{index + 2}", index, count)
    x = first(maps[5], "conv6", 2)
    for number in (5, 4, 3, 2, 1):
        weight, more = w[f"convt{number}.0.weight"], int(number > 1)
        x = F.conv_transpose2d(x, weight, stride=1 + more, padding=1, output_padding=more)
        x = torch.cat([F.leaky_relu(w.norm(x, f"convt{number}.1"), 0.2), maps[number]], 1)
    expected = 100 * (w.conv(x, "convtf.0") + w["convtf.0.bias"].reshape(1, 1, 1, 1))
    with torch.no_grad():
        depth = network.module(255 * rgb, sparse)
    assert depth.shape == (1, 1, 48, 64)
    assert bool((depth == 0.9).any())
    expected = expected.clamp_min(0.9)
    torch.testing.assert_close(depth, expected, rtol=1e-3, atol=1e-4 * float(expected.std()))


def test_the_self_supervised_network_is_cut_at_its_bottleneck() -> None:
    network = built(definitions["sparse2dense-selfsup"])
    network.module.convtf[0].bias.data.fill_(100.0)  # off the floor of 0.9 m, where nothing moves
    assert network.definition.default_layer == "conv6"
    assert_the_cut_changes_nothing_and_a_step_does(network, "conv6")
