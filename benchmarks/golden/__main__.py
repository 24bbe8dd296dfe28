"""Golden output: what the commands of `pnpdepth` print and write, kept and compared.

    python -m benchmarks.golden write GOLDEN.json --shared ../shared/data
    python -m benchmarks.golden check GOLDEN.json --shared ../shared/data

`write` runs nearly three hundred small commands, each in a fork that starts with the heavy
libraries imported, and keeps their exit codes, messages and files. `check` runs them again, prints
a line for each difference and ends with 1 if there is one. Only the command line and files are
used, so that the code behind them may be moved about. Times, sizes of memory, versions and absolute
paths are left out. All runs on one thread: sums over several depend on how many there are. Golden
output holds for one kind of processor and one set of libraries; make it where you compare.

    --only 'batch*'      commands whose name fits (with `write`, the others in the file stay)
    --portable          write what another processor gives as well, for tests/test_golden.py
    --messages off       compare exit codes, data, files and depth, but no messages
    --jobs 2             commands at once
    --keep FOLDER        keep everything that the commands wrote
"""

from __future__ import annotations

import argparse
import fnmatch
import gc
import importlib
import json
import multiprocessing
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.golden.differences import compared, portable
from benchmarks.golden.inputs import ROOT, make_inputs
from benchmarks.golden.running import Observer, Runner, files_in
from benchmarks.golden.steps import Group, groups

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "COLUMNS": "120",
    "TERM": "dumb",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "HF_HUB_OFFLINE": "1",
    "MPLBACKEND": "Agg",
    "PYTHONHASHSEED": "0",
}
"""Of all commands; the first ones are read when the libraries are imported."""
PROCESSOR = " processor"
"""The entry of portable output that says with what it was made."""
LIBRARIES = (
    *("numpy", "scipy.spatial", "scipy.ndimage", "scipy.sparse.linalg", "scipy.io", "cv2", "PIL"),
    *("OpenEXR", "h5py", "torch", "torch.export", "safetensors.torch", "click", "rich.console"),
    *("rich.table", "tqdm", "onnx", "onnxruntime", "transformers", "matplotlib.pyplot"),
)
"""What commands import and start sooner with; those that are absent here are left out."""


def processor() -> str:
    """What decides how sums are rounded."""
    import torch

    return f"{torch.backends.cpu.get_cpu_capability()}, torch {torch.__version__}"


def _made_with() -> dict[str, str]:
    return {
        "processor": processor(),
        "python": platform.python_version(),
        **{
            name: importlib.import_module(name).__version__
            for name in ("numpy", "cv2", "scipy", "PIL")
        },
    }


def _import_libraries() -> None:
    for name in LIBRARIES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            print(f"note: {name} is absent ({error})", file=sys.stderr)
    gc.freeze()


def _selected(only: str | None, shared: Path | None) -> list[Group]:
    """The groups that have a wanted step; the steps before it in its group run as well."""
    fits = [
        group
        for group in groups()
        if only is None or any(fnmatch.fnmatch(step.name, only) for step in group.steps)
    ]
    return [group for group in fits if shared is not None or not group.shared]


def _steady_environment() -> None:
    """Starts this program again where the environment is not that of all commands."""
    wanted = ENVIRONMENT | {"PYTHONPATH": str(ROOT)}
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        kept = {name: value for name, value in os.environ.items() if "PNPDEPTH" not in name}
        command = [sys.executable, "-m", "benchmarks.golden", *sys.argv[1:]]
        os.execve(sys.executable, command, kept | wanted)


def _in_a_fork(work: Callable[[], None]) -> None:
    """Does what would leave threads behind, which must not be when commands are forked."""
    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join()
    if process.exitcode:
        sys.exit("the inputs of the commands cannot be made")


def _measure(options: argparse.Namespace, observe: Observer | None = None) -> Runner:
    shared = None if options.shared is None else Path(options.shared).resolve()
    if shared is not None and not shared.is_dir():
        sys.exit(f"{options.shared} is no folder")
    _import_libraries()
    wanted = _selected(options.only, shared)
    if options.keep is None:  # no TemporaryDirectory: forked commands would delete it as they end
        work = Path(tempfile.mkdtemp(prefix="golden-")).resolve()
    else:
        work = Path(options.keep).resolve()
        work.mkdir(parents=True)
    runner = Runner(work, shared, options.jobs, observe)
    try:
        _in_a_fork(lambda: make_inputs(work / "in", shared))
        before = files_in(work / "in")
        runner.run(wanted)
        for name, state in files_in(work / "in").items():
            if before.get(name) != state:
                print(f"note: an input was changed: {name}", file=sys.stderr)
    finally:
        if options.keep is None:
            shutil.rmtree(work)
    if options.slowest:
        print(f"{sum(runner.seconds.values()):6.1f} s of the processor", file=sys.stderr)
    for name in sorted(runner.seconds, key=lambda each: -runner.seconds[each])[: options.slowest]:
        print(f"{runner.seconds[name]:6.1f} s  {name}", file=sys.stderr)
    if options.only is not None:
        runner.results = {
            name: each
            for name, each in runner.results.items()
            if fnmatch.fnmatch(name, options.only)
        }
    return runner


def write(options: argparse.Namespace) -> int:
    """Runs the commands and keeps what they give."""
    path = Path(options.file)
    results = _measure(options).results
    if options.only is not None and path.exists():
        kept = json.loads(path.read_text("utf-8"))
        results = (kept if options.portable else kept["steps"]) | results
    if options.portable:
        results = {name: portable(each) for name, each in results.items()}
        lines = [
            f"{json.dumps(name)}: {_line(each)}"
            for name, each in sorted((results | {PROCESSOR: processor()}).items())
        ]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", "utf-8")
    else:
        golden = {"made_with": _made_with(), "steps": dict(sorted(results.items()))}
        path.write_text(json.dumps(golden, ensure_ascii=False, indent=0) + "\n", "utf-8")
    print(f"{len(results)} commands kept in {path}, {path.stat().st_size / 1e6:.1f} MB")
    return 0


def _line(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def check(options: argparse.Namespace) -> int:
    """Runs the commands and prints what is not as it was kept; 1 if something is not."""
    golden = json.loads(Path(options.file).read_text("utf-8"))
    made_with = _made_with()
    if made_with != golden["made_with"]:
        print(f"note: kept with {golden['made_with']}, now {made_with}", file=sys.stderr)
    kept, differing = golden["steps"], set[str]()

    def observe(name: str, now: Mapping[str, Any]) -> None:
        if options.only is not None and not fnmatch.fnmatch(name, options.only):
            return
        # what was kept went through JSON, so this does too
        again = json.loads(json.dumps(now))
        lines = (
            compared(kept[name], again, messages=options.messages == "on")
            if name in kept
            else ["is not in the file"]
        )
        for line in lines:
            print(f"{name}: {line}", flush=True)
            differing.add(name)

    results = _measure(options, observe).results
    absent = set(kept) - set(results)
    if options.only is None and absent:
        print(f"note: {len(absent)} commands in the file were not run", file=sys.stderr)
    print(f"{len(results)} commands, {len(differing)} differ")
    return 1 if differing else 0


def main() -> int:
    """Write or check; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(required=True)
    for verb, text in ((write, "keep what commands give"), (check, "compare with what was kept")):
        one = verbs.add_parser(verb.__name__, help=text)
        one.set_defaults(verb=verb)
        one.add_argument("file", metavar="GOLDEN.json")
        one.add_argument("--shared", metavar="FOLDER", help="the real frames and public weights")
        one.add_argument("--only", metavar="PATTERN", help="of names, such as 'batch/*'")
        one.add_argument("--jobs", type=int, default=1, help="commands at once")
        one.add_argument("--keep", metavar="FOLDER", help="for all that the commands write")
        one.add_argument("--slowest", type=int, default=0, metavar="N", help="print the N slowest")
        if verb is write:
            one.add_argument("--portable", action="store_true", help="for tests/test_golden.py")
        else:
            one.add_argument("--messages", choices=("on", "off"), default="on")
    options = parser.parse_args()
    _steady_environment()
    code: int = options.verb(options)
    return code


if __name__ == "__main__":
    sys.exit(main())
