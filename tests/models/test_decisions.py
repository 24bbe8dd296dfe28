"""What is kept about networks between runs, and what happens to it."""

from __future__ import annotations

import errno
import json
import multiprocessing
import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import _disable_current_modes

from pnpdepth_cli.frames import resolve
from pnpdepth_cli.frames.resolve import default_layer
from pnpdepth_cli.models import decisions, network
from pnpdepth_cli.models.network import load_network

SIZE = (64, 96)


class Small(nn.Module):
    """A map at a quarter of the image's size, and one at half of it."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.Conv2d(3, 4, 4, stride=4)
        self.up = nn.ConvTranspose2d(4, 4, 2, stride=2)
        self.head = nn.ConvTranspose2d(4, 1, 2, stride=2)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.head(self.up(self.down(rgb)))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(decisions.FOLDER, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def file(tmp_path: Path, cache: Path) -> str:
    return str(write(tmp_path / "net.onnx", seed=0))


def write(path: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    image = torch.rand(1, 3, *SIZE)
    with (
        _disable_current_modes()
    ):  # such as of `pytest --rounding`, which the exporter cannot trace
        torch.onnx.export(Small().eval(), (image,), str(path), dynamo=False)
    return path


def decided(file: str) -> tuple[tuple[str, ...], str | None]:
    loaded = load_network(file, None)
    return loaded.definition.layers, default_layer(loaded, SIZE, 50)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which decisions were made, and not recalled."""
    made = list[str]()

    def counting(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def counted(*args: object) -> object:
            made.append(name)
            return original(*args)

        monkeypatch.setattr(owner, name, counted)

    counting(network, "suggest_layers")
    counting(resolve, "fields_of")
    return made


def test_what_was_decided_is_recalled(file: str, asked: list[str], cache: Path) -> None:
    first = decided(file)
    assert asked == ["suggest_layers", "fields_of"]
    assert decided(file) == first
    assert len(asked) == 2


def test_what_is_kept_of_a_network_is_one_small_file(file: str, cache: Path) -> None:
    decided(file)
    (kept,) = decisions.kept_files()
    assert kept.stat().st_size < 4096


def test_what_was_forgotten_is_decided_again_and_alike(
    file: str, asked: list[str], cache: Path
) -> None:
    first = decided(file)
    decisions.forget()
    assert decided(file) == first
    assert asked == ["suggest_layers", "fields_of", "suggest_layers", "fields_of"]


def test_the_notes_are_the_same_when_decisions_are_recalled(file: str) -> None:
    arguments = (torch.rand(1, 3, *SIZE),)
    first, second = (load_network(file, None) for _ in range(2))
    assert first.notes == second.notes
    assert first.verify(arguments) == second.verify(arguments)


def test_another_network_in_the_same_file_is_decided_anew(file: str, asked: list[str]) -> None:
    decided(file)
    write(Path(file), seed=1)
    decided(file)
    assert len(asked) == 4


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"\xff\xfe", b'{"versions": {}, "answers": {}}', b"[" * 100_000,
        b"0" * 2_000_000,
    ],
)  # fmt: skip
def test_a_damaged_file_is_ignored_and_replaced(
    content: bytes, file: str, asked: list[str]
) -> None:
    first = decided(file)
    (kept,) = decisions.kept_files()
    kept.write_bytes(content)
    assert decided(file) == first
    assert decided(file) == first
    assert len(asked) == 4


@pytest.mark.parametrize(
    ("key", "value"),
    [("pnpdepth", "0.1"), ("torch", "1.0")],
)
def test_decisions_of_another_version_are_not_taken(
    key: str, value: str, file: str, asked: list[str]
) -> None:
    decided(file)
    (kept,) = decisions.kept_files()
    content = json.loads(kept.read_text())
    content["versions"][key] = value
    kept.write_text(json.dumps(content))
    decided(file)
    assert len(asked) == 4


@pytest.mark.parametrize("answer", [["no layer"], [], "down", [1], None])
def test_an_answer_that_cannot_be_right_is_not_taken(
    answer: object, file: str, asked: list[str]
) -> None:
    first = decided(file)
    (kept,) = decisions.kept_files()
    content = json.loads(kept.read_text())
    content["answers"] = dict.fromkeys(content["answers"], answer)
    kept.write_text(json.dumps(content))
    assert decided(file) == first
    assert len(asked) == 4


def test_a_folder_that_cannot_be_written_changes_nothing(
    file: str, asked: list[str], cache: Path
) -> None:
    cache.parent.mkdir(exist_ok=True)
    cache.write_text("a file where the folder would be")
    assert decided(file) == decided(file)
    assert len(asked) == 4
    assert cache.read_text() == "a file where the folder would be"


def test_a_folder_that_can_only_be_read_still_recalls(
    file: str, asked: list[str], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object, **options: object) -> object:
        raise OSError(errno.EROFS, "Read-only file system")

    first = decided(file)
    monkeypatch.setattr(decisions.tempfile, "mkstemp", refuse)
    before = {path: path.read_bytes() for path in cache.iterdir()}
    assert decided(file) == first
    # What is new is decided each time.
    default_layer(load_network(file, None), SIZE, 500)
    default_layer(load_network(file, None), SIZE, 500)
    assert asked == ["suggest_layers", *["fields_of"] * 3]
    assert {path: path.read_bytes() for path in cache.iterdir()} == before


def _ask_often(loaded: Any, number: int) -> None:
    """Asks of a network what another process does not; exit code 1 for an answer of another's."""
    for count in range(30):
        text = f"{number}.{count}"
        answer = decisions.recall_or_decide(
            loaded.module, loaded.checkpoint, text, partial(list, [text])
        )
        if answer != [text]:
            raise SystemExit(1)


@pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="the system cannot fork"
)
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_processes_that_write_at_once_leave_a_whole_file(
    file: str, asked: list[str], cache: Path
) -> None:
    first = decided(file)
    loaded = load_network(file, None)
    context: Any = multiprocessing.get_context("fork")
    processes = [context.Process(target=_ask_often, args=(loaded, number)) for number in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    (kept,) = decisions.kept_files()
    assert [path for path in cache.iterdir() if path != kept] == []
    # An answer may be lost, but none is wrong.
    answers = json.loads(kept.read_text())["answers"]
    asked_by_processes = {text: answer for text, answer in answers.items() if text[1:2] == "."}
    assert asked_by_processes
    assert all(answer == [text] for text, answer in asked_by_processes.items())
    assert decided(file) == first


def test_the_file_of_a_network_in_use_is_read_once_for_all_questions(
    file: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = load_network(file, None)
    decisions.recall_or_decide(loaded.module, loaded.checkpoint, "one", lambda: ["a"])
    read = list[Path]()
    original = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or original(path))
    decisions.recall_or_decide(loaded.module, loaded.checkpoint, "two", lambda: ["b"])
    assert loaded.checkpoint not in read


def test_two_that_write_at_once_leave_a_whole_file(file: str) -> None:
    loaded = load_network(file, None)
    assert isinstance(loaded.checkpoint, Path)

    def ask(number: int) -> None:
        for question in range(20):
            text = f"{number}.{question}"
            decide = partial(list, [text])
            got = decisions.recall_or_decide(loaded.module, loaded.checkpoint, text, decide)
            assert got == [text]

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (kept,) = decisions.kept_files()
    assert json.loads(kept.read_text())["answers"]
    assert [path for path in kept.parent.iterdir() if path != kept] == []


def test_nothing_is_kept_of_code_that_is_not_known(tmp_path: Path, cache: Path) -> None:
    code = "import torch\nfrom torch import nn\n\ndef net():\n    return nn.Conv2d(3, 1, 3)\n"
    (tmp_path / "net.py").write_text(code)
    module = nn.Conv2d(3, 1, 3)
    assert decisions.recall_or_decide(module, tmp_path / "net.py", "layers", lambda: ["a"]) == ["a"]
    assert not cache.exists()
