from __future__ import annotations

import json
import threading
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pnpdepth_cli.errors import InputError, StorageError
from pnpdepth_cli.io.journal import Journal
from tests.io.test_atomic import no_room_on_disk


def test_the_newest_line_of_each_key_counts(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.jsonl", "frame")
    journal.append({"frame": "a", "n": 1})
    journal.append({"frame": "b", "n": 2})
    journal.append({"frame": "a", "n": float("nan")})
    journal.append({"n": 4})
    for seen in (journal, Journal(tmp_path / "j.jsonl", "frame")):
        assert seen.keys() == ["a", "b"]
        assert seen.newest("a") == {"frame": "a", "n": None}
        assert seen.newest("b") == {"frame": "b", "n": 2}
        assert seen.newest("c") is None
        assert seen.lost == 0
    assert len((tmp_path / "j.jsonl").read_text().splitlines()) == 4


def test_lines_appended_together_count_as_lines_appended_one_by_one(tmp_path: Path) -> None:
    lines = [{"frame": 'a"\\', "n": 1}, {"n": 2, "frame": "b"}, {"frame": 3}, {"frame": "é"}]
    together, alone = (Journal(tmp_path / name, "frame") for name in ("t.jsonl", "a.jsonl"))
    together.append(*lines)
    for line in lines:
        alone.append(line)
    assert (tmp_path / "t.jsonl").read_bytes() == (tmp_path / "a.jsonl").read_bytes()
    for seen in (together, Journal(tmp_path / "t.jsonl", "frame")):
        assert seen.keys() == ['a"\\', "b", "é"]
        assert seen.newest("b") == {"n": 2, "frame": "b"}
        assert seen.lost == 0


def test_a_file_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert Journal(tmp_path / "j.jsonl", "frame").keys() == []
    assert not (tmp_path / "j.jsonl").exists()


@given(cut=st.integers(min_value=0, max_value=200))
def test_cut_anywhere_it_keeps_the_whole_lines_and_goes_on(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    journal = Journal(path, "frame")
    for number in range(5):
        journal.append({"frame": f"f{number}", "text": "x" * number})
    data = path.read_bytes()[:cut]
    path.write_bytes(data)
    torn = Journal(path, "frame")
    assert torn.keys() == [f"f{n}" for n in range(data.count(b"\n"))]
    torn.append({"frame": "new"})
    assert Journal(path, "frame").keys() == [*torn.keys()]
    assert all(json.loads(line) for line in path.read_text().splitlines())


@given(noise=st.binary(max_size=60))
def test_lines_without_meaning_are_counted_and_passed_over(
    tmp_path_factory: pytest.TempPathFactory, noise: bytes
) -> None:
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    written = Journal(path, "frame")
    written.append({"frame": "a"})
    with path.open("ab") as file:
        file.write(noise.replace(b"\n", b"") + b"|\n")
    Journal(path, "frame").append({"frame": "b"})
    journal = Journal(path, "frame")
    assert journal.keys() == ["a", "b"]
    assert journal.lost == 1
    assert journal.newest("b") == {"frame": "b"}


@given(data=st.data())
def test_a_line_with_a_changed_byte_is_passed_over(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("journal") / "j.jsonl"
    journal = Journal(path, "frame")
    for name in "ab":
        journal.append({"frame": name, "scores": {"rmse": 0.25}})
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, content.index(b"\n") - 1))
    content[at] = data.draw(st.sampled_from(sorted({*range(32, 127)} - {content[at]})))
    path.write_bytes(content)
    damaged = Journal(path, "frame")
    assert damaged.keys() == ["b"]
    assert damaged.lost == 1


def test_a_line_is_json_and_begins_with_the_checksum_of_its_rest(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    Journal(path, "frame").append({"frame": "a", "n": 1})
    line = path.read_text()
    assert line == '{"crc32": "78f709b6", "frame": "a", "n": 1}\n'
    assert int(json.loads(line)["crc32"], 16) == zlib.crc32(b'"frame": "a", "n": 1}')


def test_names_that_are_no_utf_8_come_back(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.jsonl", "frame")
    journal.append({"frame": "caf\udce9\n"})
    assert Journal(tmp_path / "j.jsonl", "frame").keys() == ["caf\udce9\n"]


def test_a_full_disk_is_said_and_what_was_there_stays(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    journal = Journal(path, "frame")
    journal.append({"frame": "a"})
    with no_room_on_disk(), pytest.raises(StorageError, match="cannot be written"):
        journal.append({"frame": "b", "text": "x" * 100})
    assert Journal(path, "frame").keys() == ["a"]
    journal.append({"frame": "c"})
    assert Journal(path, "frame").keys() == ["a", "c"]
    assert [json.loads(line)["frame"] for line in path.read_text().splitlines()] == ["a", "c"]


def test_threads_may_append_at_once(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.jsonl", "frame")

    def work(name: str) -> None:
        for number in range(50):
            journal.append({"frame": f"{name}{number}", "text": name * number})

    threads = [threading.Thread(target=work, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    again = Journal(tmp_path / "j.jsonl", "frame")
    assert len(again.keys()) == 200
    assert again.lost == 0
    assert all(again.newest(key) == journal.newest(key) for key in again.keys())  # noqa: SIM118


def test_a_folder_in_its_place_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        Journal(tmp_path, "frame")


def test_a_line_is_read_up_to_a_field(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.jsonl", "frame")
    name = 'a", "row": {'
    journal.append({"frame": name, "state": "done", "row": {"row": 1}}, {"frame": "b", "n": 1})
    assert journal.newest(name, before="row") == {"frame": name, "state": "done"}
    assert journal.newest("b", before="row") == {"frame": "b", "n": 1}
