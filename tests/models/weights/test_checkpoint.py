"""Weights from files: whole and fitting, or one line; nothing that is in a file is ever run."""

from __future__ import annotations

import argparse
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import Tensor, nn

from pnpdepth_cli.errors import CheckpointError, ModelError
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.registry import find_definition
from pnpdepth_cli.models.weights.checkpoint import load_checkpoint
from tests.models.weights.files import refused, write_npy


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv, self.norm = nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4)


def definition(**more: Any) -> ModelDefinition:
    return ModelDefinition(name="net", input_kind="rgb", size=Multiple(1), build=Net, **more)


def weights() -> dict[str, Tensor]:
    torch.manual_seed(3)
    return Net().state_dict()


def loaded(path: Path, **more: Any) -> tuple[dict[str, Tensor], list[str]]:
    network = Net()
    notes = load_checkpoint(network, definition(**more), path)
    return network.state_dict(), notes


def equal(one: Mapping[str, Tensor], other: Mapping[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


SAVES: dict[str, Callable[[Any, Path], None]] = {
    "zip": torch.save,
    "legacy": lambda content, path: torch.save(content, path, _use_new_zipfile_serialization=False),
}


# ------------------------------------------------------------------ good files


def test_a_safetensors_file_is_read(tmp_path: Path) -> None:
    save_file(weights(), tmp_path / "w.safetensors")
    state, notes = loaded(tmp_path / "w.safetensors")
    assert equal(state, weights())
    assert notes == []


@pytest.mark.parametrize("save", SAVES)
@pytest.mark.parametrize("suffix", [".pth", ".pt", ".pth.tar", ".ckpt", ""])
def test_a_torch_file_is_read_whatever_its_suffix(save: str, suffix: str, tmp_path: Path) -> None:
    SAVES[save](weights(), tmp_path / f"w{suffix}")
    assert equal(loaded(tmp_path / f"w{suffix}")[0], weights())


@pytest.mark.parametrize("key", ["state_dict", "model_state_dict", "model", "network", "net"])
def test_the_state_dict_may_lie_beside_other_things(key: str, tmp_path: Path) -> None:
    optimiser = torch.optim.Adam(Net().parameters()).state_dict()
    content = {"epoch": 3, "loss": 0.5, "optimizer": optimiser, key: OrderedDict(weights())}
    torch.save(content, tmp_path / "w.pth")
    assert equal(loaded(tmp_path / "w.pth")[0], weights())


@pytest.mark.parametrize("prefix", ["module.", "module.module."])
def test_a_prefix_of_every_key_is_stripped_and_reported(prefix: str, tmp_path: Path) -> None:
    torch.save({f"{prefix}{k}": v for k, v in weights().items()}, tmp_path / "w.pth")
    state, notes = loaded(tmp_path / "w.pth")
    assert equal(state, weights())
    assert notes == ["checkpoint w.pth: prefix 'module.' of every key stripped"]


def test_a_prefix_of_some_keys_is_not_stripped(tmp_path: Path) -> None:
    first, *others = weights().items()
    torch.save(dict([first, *((f"module.{k}", v) for k, v in others)]), tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"unexpected .*module\."):
        loaded(tmp_path / "w.pth")


def test_a_network_whose_own_names_start_so_keeps_them(tmp_path: Path) -> None:
    network = nn.DataParallel(Net())
    torch.save(network.state_dict(), tmp_path / "w.pth")
    fresh = nn.DataParallel(Net())
    assert load_checkpoint(fresh, definition(), tmp_path / "w.pth") == []
    assert equal(fresh.state_dict(), network.state_dict())


def test_files_from_before_torch_counted_batches_are_read(tmp_path: Path) -> None:
    old = {k: v for k, v in weights().items() if not k.endswith("num_batches_tracked")}
    assert len(old) == len(weights()) - 1
    torch.save(old, tmp_path / "w.pth")
    assert equal(loaded(tmp_path / "w.pth")[0], weights())


def test_numpy_files_are_read_and_the_outputs_of_operations_are_no_part_of_a_name(
    tmp_path: Path,
) -> None:
    for ending in ("", ":0"):  # TensorFlow's operations number their outputs
        arrays = {f"{name}{ending}": t.numpy() for name, t in weights().items()}
        np.savez(tmp_path / "w.npz", **arrays)
        assert equal(loaded(tmp_path / "w.npz")[0], weights())
    layers = {part: {n: t.numpy() for n, t in some.items()} for part, some in parts().items()}
    assert equal(loaded(write_npy(tmp_path / "w.npy", layers))[0], weights())


def parts() -> dict[str, dict[str, Tensor]]:
    parts: dict[str, dict[str, Tensor]] = {"conv": {}, "norm": {}}
    for name, tensor in weights().items():
        parts[name.partition(".")[0]][name.partition(".")[2]] = tensor
    return parts


def test_the_files_of_a_folder_are_parts_by_their_names(tmp_path: Path) -> None:
    module = {f"module.{name}": tensor for name, tensor in parts()["conv"].items()}
    torch.save({"state_dict": module}, tmp_path / "conv.pth.tar")
    save_file(parts()["norm"], tmp_path / "norm.safetensors")
    (tmp_path / "README.md").write_text("weights")
    state, notes = loaded(tmp_path)
    assert equal(state, weights())
    assert notes == [
        f"checkpoint {tmp_path.name}: conv.pth.tar, norm.safetensors",
        "checkpoint conv.pth.tar: prefix 'module.' of every key stripped",
    ]


def test_a_folder_with_one_file_of_weights_is_that_file(tmp_path: Path) -> None:
    torch.save(weights(), tmp_path / "epoch_7.pth")
    state, notes = loaded(tmp_path)
    assert equal(state, weights())
    assert notes == [f"checkpoint {tmp_path.name}: epoch_7.pth"]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(value: float, tmp_path: Path) -> None:
    state = weights()
    state["conv.weight"][0, 0, 0, 0] = value
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(
        CheckpointError, match=r"1 of its weights are NaN or infinite \(conv.weight"
    ):
        loaded(tmp_path / "w.pth")


def test_many_large_half_precision_weights_are_finite(tmp_path: Path) -> None:
    state = {name: tensor.half() for name, tensor in weights().items()}
    state["conv.weight"][:] = 60000.0
    torch.save(state, tmp_path / "w.pth")
    assert loaded(tmp_path / "w.pth")[0]["conv.weight"].max() == 60000.0


def test_a_definition_may_rename_what_a_published_file_holds(tmp_path: Path) -> None:
    torch.save({f"module.net.{k}": v for k, v in weights().items()}, tmp_path / "w.pth")
    rename = {"read_checkpoint": lambda s: {k.removeprefix("net."): v for k, v in s.items()}}
    assert equal(loaded(tmp_path / "w.pth", **rename)[0], weights())


def test_the_data_of_the_training_is_reported(tmp_path: Path) -> None:
    for data, shown in (("kitti", "kitti"), ("a" * 10**5, "a" * 60 + "…")):
        args = argparse.Namespace(data=data, lr=0.1, secret="x")
        torch.save({"args": args, "state_dict": weights()}, tmp_path / "w.pth")
        assert loaded(tmp_path / "w.pth")[1][-1] == f"checkpoint w.pth: trained with data {shown}"


# ------------------------------------------------------------------ files that do not fit


def test_every_kind_of_misfit_is_listed_and_nothing_is_loaded(tmp_path: Path) -> None:
    state = weights()
    del state["norm.weight"], state["norm.bias"]
    state["extra.weight"] = torch.ones(1)
    state["conv.bias"] = torch.ones(7)
    torch.save(state, tmp_path / "w.pth")
    network = Net()
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with pytest.raises(CheckpointError) as error:
        load_checkpoint(network, definition(), tmp_path / "w.pth")
    message = str(error.value)
    assert "does not fit network 'net': 2 missing (norm.weight, norm.bias)" in message
    assert "1 unexpected (extra.weight)" in message
    assert "1 of another shape (conv.bias (7,) for (4,))" in message
    assert "\n" not in message
    assert error.value.exit_code == 4
    assert equal(network.state_dict(), before)


def test_the_checkpoint_of_another_network_is_refused_in_few_words(tmp_path: Path) -> None:
    other = nn.Sequential(*(nn.Linear(2, 2) for _ in range(50)))
    torch.save(other.state_dict(), tmp_path / "w.pth")
    with pytest.raises(
        CheckpointError, match=r"100 unexpected \(0.weight, .* and 96 more\)"
    ) as error:
        loaded(tmp_path / "w.pth")
    assert len(str(error.value)) < 500


def test_a_definition_that_cannot_read_the_layout_is_named(tmp_path: Path) -> None:
    torch.save(weights(), tmp_path / "w.pth")
    for fault in (KeyError("x"), TypeError("x"), IndexError("x"), AttributeError("x")):

        def reader(state: Mapping[str, Tensor], fault: Exception = fault) -> Mapping[str, Tensor]:
            raise fault

        with pytest.raises(CheckpointError, match="not in a layout that 'net' reads"):
            loaded(tmp_path / "w.pth", read_checkpoint=reader)
    with pytest.raises(ModelError, match="gives no named tensors"):
        loaded(tmp_path / "w.pth", read_checkpoint=lambda state: None)


def test_a_network_that_refuses_its_state_is_one_line(tmp_path: Path) -> None:
    class Picky(Net):
        def get_extra_state(self) -> dict[str, int]:
            return {"version": 1}

        def set_extra_state(self, state: Any) -> None:
            raise AssertionError

    torch.save(weights(), tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"does not fit .*_extra_state") as error:
        load_checkpoint(Picky(), definition(), tmp_path / "w.pth")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "no state dict; it holds nothing"),
        ({"epoch": 1, "best": 0.3}, "no state dict; it holds epoch, best"),
        ({0: torch.ones(1)}, "no state dict; it holds 0"),
        ([torch.ones(1)], "holds a list"),
        (torch.ones(1), "holds a Tensor"),
        ({"state_dict": {"a": 1}}, "no state dict; it holds state_dict"),
    ],
)
def test_a_file_without_named_tensors_is_refused(
    content: Any, message: str, tmp_path: Path
) -> None:
    torch.save(content, tmp_path / "w.pth")
    assert message in refused(tmp_path / "w.pth")


def test_weights_of_another_known_network_name_it(tmp_path: Path) -> None:
    torch.save(find_definition("nconv").build().state_dict(), tmp_path / "w.pth")
    with pytest.raises(CheckpointError) as error:
        loaded(tmp_path / "w.pth")
    assert str(error.value).endswith("does not fit network 'net': this is nconv; use --model nconv")


def test_of_several_that_fit_the_one_with_the_requested_ending_comes_first(tmp_path: Path) -> None:
    state = find_definition("sparse2dense-r18-deconv3").build().state_dict()
    torch.save(state, tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"--model sparse2dense-r18-deconv3-kitti$"):
        load_checkpoint(
            Net(), replace(definition(), name="sparse2dense-r50-upproj-kitti"), tmp_path / "w.pth"
        )
    with pytest.raises(CheckpointError, match=r"--model sparse2dense-r18-deconv3$"):
        loaded(tmp_path / "w.pth")


# ------------------------------------------------------------------ broken files


def test_a_path_that_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "does not exist" in refused(tmp_path / "absent.pth")
    assert "is a folder without weights" in refused(tmp_path)


def test_a_pointer_to_a_file_that_was_not_fetched_is_named(tmp_path: Path) -> None:
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:b497\nsize 126396039\n"
    (tmp_path / "w.pth.tar").write_text(pointer)
    assert "is a Git LFS pointer" in refused(tmp_path / "w.pth.tar")


@pytest.mark.parametrize("suffix", [".pth", ".safetensors", ".npy", ".npz", ".index"])
@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 50, b"not a checkpoint\n", b"<html>", b"\x80\x02}q\0.", b"PK\x03\x04"],
)
def test_garbage_is_refused(content: bytes, suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"w{suffix}").write_bytes(content)
    refused(tmp_path / f"w{suffix}")


def test_a_truncated_safetensors_file_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    whole = tmp_path / "w.safetensors"
    save_file(weights(), whole)
    content = whole.read_bytes()
    for fraction in (0.001, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999):
        whole.write_bytes(content[: int(len(content) * fraction)])
        refused(whole)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(content=st.binary(max_size=200), suffix=st.sampled_from([".pth", ".safetensors"]))
def test_any_other_bytes_are_refused(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"fuzz{suffix}"
    path.write_bytes(content)
    refused(path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_zip_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "w.pth", "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "0 entries named data.pkl" in refused(tmp_path / "w.pth")
    torch.jit.save(torch.jit.script(nn.Conv2d(1, 1, 1)), tmp_path / "w.pt")
    assert "state_dict() of its module" in refused(tmp_path / "w.pt")


def test_a_sparse_tensor_is_refused_by_name(tmp_path: Path) -> None:
    torch.save({"a": torch.ones(1), "w": torch.eye(3).to_sparse()}, tmp_path / "w.pth")
    assert "w is not a plain tensor (sparse" in refused(tmp_path / "w.pth")


@pytest.mark.parametrize("save", SAVES)
def test_the_tensors_of_a_whole_module_are_extracted_and_reported(
    save: str, tmp_path: Path
) -> None:
    torch.manual_seed(3)
    SAVES[save](Net(), tmp_path / "w.pth")
    state, notes = loaded(tmp_path / "w.pth")
    assert equal(state, weights())
    assert len(notes) == 1
    assert notes[0].startswith("checkpoint w.pth: its pickle names tests.models.weights")
    assert notes[0].endswith("nothing of it was run")
