"""The folder that a batch writes to: a local one, or one in a store, staged in a local one."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint, fingerprint_of_object
from pnpdepth_cli.io.journal import Journal
from pnpdepth_cli.io.record import read_json, write_json
from pnpdepth_cli.io.remote.address import RemotePath
from pnpdepth_cli.io.remote.copies import copies, remove_copies, renamed
from pnpdepth_cli.io.remote.segments import SegmentedJournal, fetch_journals
from pnpdepth_cli.io.remote.store import remove, upload
from pnpdepth_cli.pipeline.refinement.output_files import Outputs


@dataclass(frozen=True, kw_only=True)
class OutputFolder:
    """Where a batch keeps its journals, locks and summaries."""

    output: Path
    """The output folder."""
    local: Path
    """The same, or a local folder that stands for it."""

    def journal(self, path: Path, key: str) -> Journal:
        """Returns this run's own journal."""
        if isinstance(self.output, RemotePath):
            return SegmentedJournal(path, key, self.output)
        return Journal(path, key)

    def publish(self, names: Sequence[str]) -> None:
        """Puts files of the local folder into the store, if the output is there."""
        if isinstance(self.output, RemotePath):
            for name in names:
                upload(self.local / name, self.output / name)


@contextmanager
def opened_output(output: Path, *, create: bool = True) -> Iterator[OutputFolder]:
    """Yields an output folder; copies of files in a store are removed at its end.

    Args:
        output: The folder.
        create: Whether a local folder is created.

    Raises:
        OutputError: It cannot be created, or the store cannot be reached.
    """
    try:
        if isinstance(output, RemotePath):
            with tempfile.TemporaryDirectory(dir=copies().folder) as folder:
                fetch_journals(output, Path(folder))
                yield OutputFolder(output=output, local=Path(folder))
        else:
            if create:
                make_folder(output)
            yield OutputFolder(output=output, local=output)
    finally:
        remove_copies()


@contextmanager
def staged(outputs: Outputs, output: Path) -> Iterator[Outputs]:
    """Yields where the results of a frame are written: their own paths, or local ones.

    Args:
        outputs: As planned.
        output: The output folder.
    """
    if not isinstance(output, RemotePath):
        yield outputs
        return
    folder = Path(tempfile.mkdtemp(dir=copies().folder))
    try:
        yield _moved(outputs, output, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def published(
    written: Outputs, planned: Outputs, stage: Outputs, output: Path
) -> tuple[Outputs, dict[Path, Fingerprint]]:
    """Returns a frame's results in the output folder with their fingerprints; the record is last.

    Args:
        written: The files that were written, of `stage`.
        planned: The files of the frame in the output folder.
        stage: What `staged` yielded.
        output: The output folder.

    Raises:
        StorageError: They cannot be put into the store.
    """
    if not isinstance(output, RemotePath):
        return written, {path: fingerprint(path) for path in written.paths()}
    targets = planned.by_kind()
    files = written.by_kind()
    names = {str(stage.by_kind()[kind]): str(path) for kind, path in targets.items()}
    if written.record is not None:
        write_json(written.record, renamed(read_json(written.record), names))
    for kind in targets.keys() - files.keys():  # of an earlier result
        remove(_stored(targets[kind]))
    known = {}
    for kind, file in files.items():
        status = upload(file, _stored(targets[kind]))
        known[targets[kind]] = fingerprint_of_object(file, status)
    kept: dict[str, Any] = {kind: targets.get(kind) if kind in files else None for kind in targets}
    return replace(planned, **kept), known


def _stored(path: Path) -> RemotePath:
    assert isinstance(path, RemotePath)
    return path


def _moved(outputs: Outputs, output: Path, folder: Path) -> Outputs:
    paths: dict[str, Any] = {
        kind: folder / path.relative_to(output) for kind, path in outputs.by_kind().items()
    }
    for path in paths.values():
        make_folder(path.parent)
    return replace(outputs, **paths)
