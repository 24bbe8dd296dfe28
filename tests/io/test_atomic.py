"""Outputs are whole or absent, and written in turn."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import (
    atomic_folder,
    atomic_path,
    in_turn,
    make_folder,
    remove_leftovers,
)
from pnpdepth_cli.io.depth import write_depth
from tests.io.full_disk import no_room_on_disk


@pytest.mark.parametrize("error", [None, InputError("the frame was bad"), KeyboardInterrupt()])
def test_a_file_is_replaced_whole_or_not_at_all(
    tmp_path: Path, error: BaseException | None
) -> None:
    target = tmp_path / f"{'n' * 251}.png"  # the longest name that a file can have
    target.write_bytes(b"old")
    with pytest.raises(type(error)) if error else nullcontext(), atomic_path(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, target.suffix)
        temporary.write_bytes(b"new")
        assert target.read_bytes() == b"old"
        if error is not None:
            raise error
    assert target.read_bytes() == (b"new" if error is None else b"old")
    assert list(tmp_path.iterdir()) == [target]


def test_links_are_not_followed_but_the_output_itself_may_be_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "precious").write_bytes(b"mine")
    (tmp_path / "out").symlink_to(tmp_path / "real")
    make_folder(tmp_path / "out/a/b", below=tmp_path / "out")
    assert (tmp_path / "real/a/b").is_dir()
    (tmp_path / "out/link.json").symlink_to(tmp_path / "precious")
    with atomic_path(tmp_path / "out/link.json") as temporary:
        temporary.write_bytes(b"x")
    assert (tmp_path / "precious").read_bytes() == b"mine"
    (tmp_path / "real/planted").symlink_to(tmp_path)
    with pytest.raises(OutputError):
        make_folder(tmp_path / "out/planted/c", below=tmp_path / "out")
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize("name", ["missing/out.png", "file.txt/out.png", "folder", "/dev/null"])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").write_text("x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=str(tmp_path / name)), atomic_path(tmp_path / name):
        pytest.fail("must not get here")


@pytest.mark.parametrize("suffix", [".png", ".exr", ".npy"])
def test_a_full_disk_is_an_output_error_that_names_the_file(tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"depth{suffix}"
    depth = np.random.default_rng(0).random((40, 50)) + 1
    with no_room_on_disk(), pytest.raises(OutputError, match=str(target)):
        write_depth(target, depth.astype(np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fails", [False, True])
def test_a_folder_is_replaced_whole_or_not_and_leftovers_go(tmp_path: Path, fails: bool) -> None:
    folder = tmp_path / "report"
    for name in ("before", "../.0123456789ab/deep", "../.mine"):
        (folder / name).mkdir(parents=True)
    with pytest.raises(ValueError) if fails else nullcontext(), atomic_folder(folder) as temporary:
        (temporary / "after").touch()
        if fails:
            raise ValueError
    assert [path.name for path in folder.iterdir()] == ["before" if fails else "after"]
    assert remove_leftovers(tmp_path) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [".mine", "report"]


def test_while_one_holds_a_folder_another_waits_for_its_turn(tmp_path: Path) -> None:
    def second() -> None:
        with in_turn(tmp_path):
            pass

    with ThreadPoolExecutor() as pool, in_turn(tmp_path):
        waiting = pool.submit(second)
        with pytest.raises(TimeoutError):
            waiting.result(timeout=0.05)
    assert waiting.done()
