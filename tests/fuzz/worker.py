"""Runs damaged inputs through the command line in this process, and reports each as JSON.

    python -m tests.fuzz.worker FOLDER SEED FIRST COUNT

FOLDER is made anew.
Input number I is the I-th seed, cyclically, damaged by the generator of (SEED, I). A line
{"start": I} goes out before an input and {"end": I, ...} after it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.mutations import mutated
from tests.fuzz.seeds import Seed, write_seeds

FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect")
"""Audit events that no input may cause."""
CHANGES = {
    "os.rename": 2,
    "os.link": 2,
    "os.symlink": 2,
    "os.remove": 1,
    "os.mkdir": 1,
    "os.rmdir": 1,
}
"""Audit events that change files, and how many paths each has; none may lead outside."""


def problem(event: str, arguments: tuple[Any, ...], folder: Path) -> str | None:
    """Returns what an input caused that none may: a process, a connection, a change outside."""
    if event in FORBIDDEN:
        return event
    writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    for path in arguments[: CHANGES.get(event, int(bool(writes)))]:
        if isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path) != os.devnull:
            real = Path(os.path.realpath(os.fsdecode(path)))
            if not real.is_relative_to(folder):
                return f"{event} {real}"
    return None


def peak_bytes() -> int:
    """Returns the highest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextlib.contextmanager
def libraries_to(text: io.StringIO) -> Iterator[None]:
    """Adds to the text what C libraries and older handles write to the standard error."""
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            text.write(file.read().decode(errors="replace"))


def run_input(seed: Seed, data: bytes) -> dict[str, Any]:
    """Returns the exit code, output and cost of the seed's command on these bytes."""
    from pnpdepth_cli.cli.main import main

    file = Path(seed.file)
    original = file.read_bytes()
    file.write_bytes(data)
    out, err = io.StringIO(), io.StringIO()
    start, before = time.process_time(), peak_bytes()
    code: object = None
    try:
        with libraries_to(err), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main(list(seed.command))
    except SystemExit as end:
        code = end.code
    except BaseException:
        err.write(traceback.format_exc())
    finally:
        file.write_bytes(original)
        for name in seed.scratch:
            path = Path(name)
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return {
        "code": code,
        "seconds": time.process_time() - start,
        "bytes": peak_bytes() - before,
        "stderr": err.getvalue()[-4000:],
    }


def main() -> None:
    """Runs the inputs that the arguments name."""
    folder, seed, first, count = Path(sys.argv[1]), *map(int, sys.argv[2:5])
    report = os.fdopen(os.dup(1), "w")
    warnings.simplefilter("ignore")
    shutil.rmtree(folder, ignore_errors=True)  # of a worker that died
    folder.mkdir(parents=True)
    os.chdir(folder)
    seeds = write_seeds(Path())
    for each in seeds:  # imports and caches are nobody's cost
        result = run_input(each, Path(each.file).read_bytes())
        if result["code"] not in (0, 7):
            raise SystemExit(f"the valid {each.file} fails: {result}")
    events: list[str] = []
    tempfile.tempdir, inside = str(Path("tmp").resolve()), Path().resolve()
    Path("tmp").mkdir()
    sys.dont_write_bytecode = True

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        found = problem(event, arguments, inside)
        if found is not None:
            events.append(found)

    sys.addaudithook(watch)
    for number in range(first, first + count):
        chosen = seeds[number % len(seeds)]
        data = mutated(Path(chosen.file).read_bytes(), np.random.default_rng((seed, number)))
        print(json.dumps({"start": number, "file": chosen.file}), file=report, flush=True)
        events.clear()
        result = run_input(chosen, data)
        line = {"end": number, "file": chosen.file, **result, "events": sorted(set(events))}
        print(json.dumps(line), file=report, flush=True)


if __name__ == "__main__":
    main()
