from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError, OutputError
from pnpdepth_cli.io.atomic import atomic_folder, atomic_path, make_folder, remove_leftovers
from pnpdepth_cli.io.depth import write_depth


@contextmanager
def no_room_on_disk() -> Iterator[None]:
    """Files cannot grow beyond 64 bytes inside."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["depth.png", "n" * 251 + ".npy"])
def test_the_file_appears_whole_and_nothing_else_stays(name: str, tmp_path: Path) -> None:
    target = tmp_path / name
    with atomic_path(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, target.suffix)
        temporary.write_bytes(b"new")
        assert not target.exists()
    assert target.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [InputError("the frame was bad"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_no_other(error: BaseException, tmp_path: Path) -> None:
    target = tmp_path / "depth.png"
    target.write_bytes(b"old")

    def fail() -> None:
        with atomic_path(target) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_link_is_replaced_and_what_it_points_to_stays(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"precious")
    for name, target in (("link.json", "real"), ("broken.json", "missing")):
        (tmp_path / name).symlink_to(tmp_path / target)
        with atomic_path(tmp_path / name) as temporary:
            temporary.write_bytes(b"x")
        assert not (tmp_path / name).is_symlink()
        assert (tmp_path / name).read_bytes() == b"x"
    assert (tmp_path / "real").read_bytes() == b"precious"
    assert not (tmp_path / "missing").exists()


def test_a_folder_in_the_output_is_no_link_but_the_output_itself_may_be(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    make_folder(tmp_path / "out/a/b", below=tmp_path / "out")
    assert (tmp_path / "real/a/b").is_dir()
    (tmp_path / "real/planted").symlink_to(tmp_path)
    with pytest.raises(OutputError):
        make_folder(tmp_path / "out/planted/c", below=tmp_path / "out")
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    "name",
    [
        "missing/out.png",
        "file.txt/out.png",
        "folder",
        "/proc/out.png",
        "/dev/null",
    ],
)
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").write_text("x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError) as caught, atomic_path(tmp_path / name):
        pytest.fail("must not get here")
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".npy", ".pfm", ".tiff"])
def test_a_full_disk_is_an_output_error_that_names_the_file(tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"depth{suffix}"
    depth = np.random.default_rng(0).uniform(1, 9, (40, 50)).astype(np.float32)
    with no_room_on_disk(), pytest.raises(OutputError) as caught:
        write_depth(target, depth)
    assert str(caught.value).startswith(f"{target} cannot be written")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_appears_whole_and_other_files_in_it_stay(tmp_path: Path) -> None:
    folder = tmp_path / "report"
    (folder / "old").mkdir(parents=True)
    for name in ("page", "old/a", "mine"):
        (folder / name).write_text("before")
    with atomic_folder(folder) as temporary:
        (temporary / "old").mkdir()
        for name in ("page", "old/b"):
            (temporary / name).write_text("after")
        assert (folder / "page").read_text() == "before"
    files = [path for path in folder.rglob("*") if path.is_file()]
    contents = {path.relative_to(folder).as_posix(): path.read_text() for path in files}
    assert contents == {"page": "after", "old/a": "before", "old/b": "after", "mine": "before"}


@pytest.mark.parametrize("existed", [False, True])
def test_a_folder_that_fails_stays_as_it_was(tmp_path: Path, existed: bool) -> None:
    folder = tmp_path / "report"
    if existed:
        folder.mkdir()

    def fail() -> None:
        with atomic_folder(folder) as temporary:
            (temporary / "page").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.rglob("*")) == ([folder] if existed else [])


def test_a_folder_left_by_a_killed_writer_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".0123456789ab" / "deep").mkdir(parents=True)
    (tmp_path / ".mine").mkdir()
    assert remove_leftovers(tmp_path) == 1
    assert [path.name for path in tmp_path.iterdir()] == [".mine"]
