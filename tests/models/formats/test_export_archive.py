"""Nothing in a torch.export archive is run but operators on tensors; hostile files are refused."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.export import Dim

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import Multiple
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.models.registry import find_definition

MODEL = "models/model.json"
INPUTS = "data/sample_inputs/model.pt"
WEIGHTS = "data/weights/model_weights_config.json"
Change = Callable[[bytes], bytes]


class Net(nn.Module):
    """Sizes that are reckoned, an equation, attention, a constant, and a part without gradients."""

    def __init__(self) -> None:
        super().__init__()
        self.inward, self.out = nn.Conv2d(3, 8, 3, 2, 1), nn.Conv2d(8, 1, 1)
        self.levels = torch.arange(1, 9)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        height, width = rgb.shape[2:]
        z = torch.einsum("bchw,c->bchw", self.inward(rgb).relu(), self.levels.float())
        rows = z.flatten(2).transpose(1, 2)
        z = z + nn.functional.scaled_dot_product_attention(rows, rows, rows).mean()
        with torch.no_grad():
            mean = rgb.mean()
        y = nn.functional.interpolate(self.out(z), size=(height, width), mode="bilinear")
        return 1 + torch.sigmoid(y) + mean


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    sides = {2: 32 * Dim("rows", min=1, max=64), 3: 32 * Dim("columns", min=1, max=64)}
    net, image = Net().eval(), torch.rand(1, 3, 64, 96)
    program = torch.export.export(net, (image,), dynamic_shapes=(sides,))
    torch.export.save(program, tmp_path / "net.pt2")
    return tmp_path / "net.pt2"


def rewritten(file: Path, name: str, change: Change) -> Path:
    """The archive with one entry changed, or added where there is none of that name."""
    with zipfile.ZipFile(file) as source:
        entries = {info.filename: source.read(info) for info in source.infolist()}
    full = f"{next(iter(entries)).partition('/')[0]}/{name}"
    entries[full] = change(entries.get(full, b""))
    target = file.with_name(f"{file.stem}_changed.pt2")
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive_out:
        for entry, content in entries.items():
            archive_out.writestr(entry, content)
    return target


def texts(change: Callable[[str], str]) -> Change:
    return lambda content: change(content.decode()).encode()


def call(target: str) -> Change:
    """The first operator is another one."""

    def change(program: str) -> str:
        program_json = json.loads(program)
        program_json["graph_module"]["graph"]["nodes"][0]["target"] = target
        return json.dumps(program_json)

    return texts(change)


def size(text: str) -> Change:
    """The first size that is reckoned is reckoned otherwise."""

    def change(program: str) -> str:
        first = program.index('"expr_str": "') + len('"expr_str": "')
        return program[:first] + json.dumps(text)[1:-1] + program[program.index('"', first) :]

    return texts(change)


def name(text: str) -> Change:
    """The image input has another name."""
    return texts(lambda program: program.replace('"rgb"', json.dumps(text)))


def saved(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


class Touch:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_an_archive_of_a_real_network_gives_what_the_network_gives(archive: Path) -> None:
    network = load_network(str(archive), None)
    assert network.definition.size == Multiple(32)
    torch.manual_seed(0)
    net, rgb = Net().eval(), torch.rand(1, 3, 96, 32)
    with torch.no_grad():
        torch.testing.assert_close(network.raw_of(network.module(rgb)), net(rgb))


def test_an_archive_written_anew_without_a_change_is_read(archive: Path) -> None:
    same = rewritten(archive, MODEL, lambda content: content)
    assert find_definition(str(same)).size == Multiple(32)


PICKLED = texts(lambda config: config.replace('"use_pickle": false', '"use_pickle": true'))
ENUM = texts(lambda p: p.replace('"in_spec": "', '"in_spec": "[{\\"__enum__\\": true}] ', 1))
HOSTILE: dict[str, tuple[str, Change, str]] = {
    "a function of the system": (MODEL, call("torch.os.system"), "it calls 'torch.os.system'"),
    "a loader of libraries": (MODEL, call("torch.ops.load_library"), "it calls"),
    "an operator that opens files": (MODEL, call("torch.ops.aten.from_file.default"), "it calls"),
    "a caller of methods": (MODEL, call("_operator.methodcaller"), "it calls"),
    "a size that is a program": (MODEL, size("__import__('os').mkdir('x')"), "not arithmetic"),
    "a size with a program in a text": (MODEL, size("Mul('exit()', 2)"), "not arithmetic"),
    "a size of many digits": (MODEL, size("9**9**9**9"), "powers without end"),
    "a size of many digits by a call": (MODEL, size("Pow(9, Pow(9, 99))"), "powers without end"),
    "a size of many powers": (MODEL, size("((((9**8)**8)**8)**8)**8"), "powers without end"),
    "a size shifted far": (MODEL, size("LShift(1, 10000000000)"), "powers without end"),
    "a size shifted far by an operator": (MODEL, size("1 << 10000000000"), "powers without end"),
    "a size of 3,000 digits": (MODEL, size("9" * 3000), "not arithmetic"),
    "a size that reads an attribute": (MODEL, size("Symbol.__class__"), "not arithmetic"),
    "a name with a default": (MODEL, name("x=__import__('os').mkdir('x')"), "is not a name"),
    "pickled weights": (WEIGHTS, PICKLED, "is pickled"),
    "a pickled object": ("data/constants/custom_obj_0", lambda _: b"x", "it holds 'data/const"),
    "a compiled library": ("data/aotinductor/model/m.so", lambda _: b"x", "it holds 'data/aot"),
    "weights of an older layout": ("data/weights/model.pt", lambda _: b"x", "it holds"),
    "an enumeration of any module": (MODEL, ENUM, "its in_spec is not a nesting"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_could_do_more_than_compute_is_refused_in_one_line(archive: Path, kind: str) -> None:
    entry, change, message = HOSTILE[kind]
    with pytest.raises(ModelError, match=r"is not read: .*only plain tensors") as error:
        find_definition(str(rewritten(archive, entry, change)))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("entry", ["example inputs", "weights"])
def test_no_pickle_in_an_archive_is_run(archive: Path, tmp_path: Path, entry: str) -> None:
    trap = tmp_path / "trap"
    if entry == "weights":
        hostile = rewritten(archive, "data/weights/weight_0", lambda _: saved(Touch(trap)))
        hostile = rewritten(hostile, WEIGHTS, PICKLED)
    else:
        hostile = rewritten(archive, INPUTS, lambda _: saved((Touch(trap),)))
    with pytest.raises(ModelError, match="is not read"):
        find_definition(str(hostile))
    assert not trap.exists()
    with pytest.raises(Exception):  # noqa: B017
        torch.export.load(hostile)
    assert trap.exists()  # where torch itself reads the file, it is run


def test_example_inputs_that_ask_for_memory_are_refused(archive: Path) -> None:
    class Allocates:
        def __reduce__(self) -> tuple[Any, ...]:
            return bytearray, (10**12,)

    greedy = rewritten(archive, INPUTS, lambda _: saved((Allocates(),)))
    with pytest.raises(
        ModelError, match=r"example inputs are more than tensors \(builtins.bytearray"
    ):
        find_definition(str(greedy))


def test_a_compressed_archive_is_refused(archive: Path) -> None:
    target = archive.with_name("packed.pt2")
    with (
        zipfile.ZipFile(archive) as plain,
        zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    with pytest.raises(ModelError, match="compressed"):
        find_definition(str(target))


def test_an_archive_with_a_second_one_of_the_older_layout_in_it_is_refused(archive: Path) -> None:
    with zipfile.ZipFile(archive, "a") as both:
        both.writestr("version", b"8.0")
    with pytest.raises(ModelError):
        find_definition(str(archive))
