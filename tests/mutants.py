"""Random mutants of the package, and whether the first tier of the tests notices them.

    python -m tests.mutants --count 40 --seed 0 --only pnpdepth_cli/core --jobs 2

One expression of a file is changed: a comparison, an arithmetic operator, a constant, `and`, a
returned value, min, any, floor, mean and the like. The tests that run this line, or a line that
names the changed constant, are tried in a temporary copy of the tree: first those that mirror the
file and one case of each other test, the fastest first. A test that fails with the mutant and
passes without it kills it; so does a run without end. Prints a table by package, and each survivor
with its place and change.

Which test runs which line is found by running the first tier once under coverage (three minutes on
two cores). `--lines FOLDER` keeps it for the next samples of the same tree.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import copy
import multiprocessing
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple, TypeGuard
from xml.etree import ElementTree

import pytest
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("pnpdepth_cli", "model_zoo_defs")
FIRST = 40
"""Number of tests that are tried in a process of their own before the others are collected."""
HANGS_S = 10
"""Seconds of processor time after a mutant's limit at which its tests are ended."""

_ORDER = "Lt LtE Gt,LtE Lt Gt,Gt GtE Lt,GtE Gt Lt,FloorDiv Mult,Mod Mult,Pow Mult"
_PAIRS = "Eq NotEq,In NotIn,Is IsNot,Add Sub,Mult Div,BitAnd BitOr,And Or"
_CALLS = "min max,any all,floor ceil,mean median,zeros ones,argmin argmax,amin amax,sin cos"


def _swaps(text: str, *, both: bool = True) -> dict[str, list[str]]:
    """From `a b,c d`: b for a and, both ways, a for b."""
    pairs = [words.split() for words in text.split(",")]
    back = {other: [first] for first, *others in pairs for other in others} if both else {}
    return {first: others for first, *others in pairs} | back


_OPERATORS, _NAMES = _swaps(_ORDER, both=False) | _swaps(_PAIRS), _swaps(_CALLS)


class Mutant(NamedTuple):
    """A file with bytes `start` to `end` changed, and the change in words.

    `constants` are the names that the statement assigns in the module.
    """

    file: Path
    start: int
    end: int
    text: bytes
    change: str
    lines: tuple[int, int] | None
    constants: tuple[str, ...]


def changed(node: ast.AST) -> Iterator[ast.AST]:
    """Yields the mutations of this node alone."""
    other = copy.copy(node)
    match other:
        case ast.Compare(ops=[op]) | ast.BinOp(op=op) | ast.BoolOp(op=op):
            for name in _OPERATORS.get(type(op).__name__, ()):
                kind = getattr(ast, name)()
                setattr(other, *("ops", [kind]) if isinstance(other, ast.Compare) else ("op", kind))
                yield other
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield other.operand
        case ast.Constant(value=bool()):
            yield ast.Constant(not other.value)
        case ast.Constant(value=int() | float()):
            yield ast.Constant(other.value + 1)
            yield ast.Constant(other.value - 1)
        case ast.Name(id=name) if name in _NAMES:
            yield ast.Name(*_NAMES[name])
        case ast.Attribute(attr=name) if name in _NAMES:
            (other.attr,) = _NAMES[name]
            yield other
        case ast.Return(value=ast.expr()) if ast.unparse(other) != "return None":
            yield ast.Return(ast.Constant(None))


def places(
    node: ast.AST, lines: tuple[int, int] | None = None
) -> Iterator[tuple[ast.AST, tuple[int, int] | None]]:
    """Yields the nodes that run (no annotations, texts or imports for types) with the lines that
    a test of them runs: those of the statement or lambda, of the function whose default it is, or
    None for all of the file.
    """
    yield node, lines
    inside = lines is not None or isinstance(node, ast.FunctionDef)
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
            if not isinstance(child, ast.AST) or typing:
                continue
            within = lines
            if isinstance(child, ast.Lambda):
                within = child.lineno, child.end_lineno or 0
            if isinstance(child, ast.stmt) and inside:
                last = child.body[0].lineno - 1 if hasattr(child, "body") else child.end_lineno
                within = child.lineno, max(child.lineno, last or 0)
            if isinstance(child, ast.arguments) and isinstance(node, ast.FunctionDef):
                within = node.lineno, node.end_lineno or 0
            yield from places(child, within)


def mutants(only: str) -> list[Mutant]:
    """Returns all mutants of the files whose path begins with `only`."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            file = path.relative_to(ROOT)
            if "training" in file.parts or not file.as_posix().startswith(only):
                continue
            content = path.read_bytes()
            starts = [0, *accumulate(len(line) for line in content.splitlines(keepends=True))]
            tree = ast.parse(content)
            constants = {
                line: tuple(name.id for name in ast.walk(each) if _is_assigned(name))
                for each in tree.body
                if isinstance(each, ast.Assign | ast.AnnAssign)
                for line in range(each.lineno, (each.end_lineno or 0) + 1)
            }
            for node, lines in places(tree):
                for other in changed(node):
                    assert isinstance(node, ast.expr | ast.stmt)
                    text = ast.unparse(other)
                    if isinstance(other, ast.BinOp | ast.BoolOp | ast.Compare):
                        text = f"({text})"
                    start = starts[node.lineno - 1] + node.col_offset
                    end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
                    before = " ".join(content[start:end].decode().split())
                    change = f"{file}:{node.lineno}: {before}  ->  {text}"
                    names = constants.get(node.lineno, ())
                    found.append(Mutant(file, start, end, text.encode(), change, lines, names))
    return found


def _is_assigned(node: ast.AST) -> TypeGuard[ast.Name]:
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


class RunLines:
    """The tests of the first tier that run a line, and their times in seconds."""

    def __init__(self, folder: Path, jobs: int) -> None:
        """Runs the first tier under coverage, unless `folder` holds its results already."""
        data, times = folder / "coverage", folder / "times.xml"
        if not times.exists():
            folder.mkdir(parents=True, exist_ok=True)
            settings = folder / "settings.ini"
            settings.write_text(f"[run]\nsource = {','.join(PACKAGES)}\ndata_file = {data}\n")
            command = [sys.executable, "-m", "pytest", "-n", str(jobs), "--dist", "loadfile"]
            command += ["--cov", f"--cov-config={settings}", "--cov-context=test"]
            command += ["--cov-report=", f"--junitxml={times}", "-o", "junit_family=xunit1"]
            subprocess.run(command, cwd=ROOT, check=True)
        self._data = CoverageData(str(data))
        self._data.read()
        self._times = {
            f"{case.get('file')}::{case.get('name')}": float(case.get("time", 0))
            for case in ElementTree.parse(times).iter("testcase")
        }

    def tests(self, mutant: Mutant, limit: float) -> list[str]:
        """Returns tests that together take `limit` seconds at most, in the order to try them."""
        first, last = mutant.lines or (0, sys.maxsize)
        names = self._running(ROOT / mutant.file, lambda line: first <= line <= last)
        near, cases = _mirroring(mutant.file), Counter[str]()
        if mutant.lines is None:  # a constant, perhaps without a function that uses it
            names |= {name for name in self._times if name.partition("::")[0] in near}
            names |= {test for name in mutant.constants for test in self._naming(name)}
        order = list[tuple[int, float, str]]()
        for time_s, name in sorted((self._times[name], name) for name in names & {*self._times}):
            test = name.partition("[")[0]
            mirrored = name.partition("::")[0] in near
            order.append((0 if mirrored else cases[test], time_s, name))
            cases[test] += 1
        order.sort()
        ends = accumulate(time_s for _, time_s, _ in order)
        chosen = [name for (_, _, name), end in zip(order, ends, strict=True) if end <= limit]
        return chosen or near

    def _running(self, file: Path, wanted: Callable[[int], bool]) -> set[str]:
        """The tests that run a wanted line of a file."""
        lines = self._data.contexts_by_lineno(str(file))
        return {
            test.rpartition("|")[0] for n, tests in lines.items() if wanted(n) for test in tests
        }

    def _naming(self, constant: str) -> set[str]:
        """The tests that run a line, of any file, that names the constant."""
        named, found = re.compile(rf"\b{constant}\b"), set[str]()
        for file in map(Path, self._data.measured_files()):
            lines = enumerate(file.read_text().splitlines(), start=1)
            if at := {number for number, line in lines if named.search(line)}:
                found |= self._running(file, at.__contains__)
        return found


def _mirroring(file: Path) -> list[str]:
    """The test files of the module's name, else those of its folder, for lines that only other
    processes run.
    """
    parts = file.parts[1:-1] if file.parts[0] == "pnpdepth_cli" else file.parts[:1]
    folder = ROOT.joinpath("tests", *parts)
    chosen = sorted(folder.glob(f"test_{file.stem}*.py"))
    while not (chosen := chosen or sorted(folder.glob("test_*.py"))):
        folder = folder.parent
    return [path.relative_to(ROOT).as_posix() for path in chosen]


class Trees:
    """Copies of the tree, one a job, in which mutants are tried."""

    def __init__(self, folder: Path, run_lines: RunLines, jobs: int, limit: float) -> None:
        self._free: SimpleQueue[Path] = SimpleQueue()
        self._run_lines, self._limit, self._sound = run_lines, limit, dict[str, bool]()
        ignored = shutil.ignore_patterns(".*", "__pycache__", "out", "dist", "build", "site")
        for number in range(jobs):
            shutil.copytree(ROOT, folder / str(number), ignore=ignored)
            compileall.compile_dir(folder / str(number), quiet=2)  # never of a mutant
            self._free.put(folder / str(number))

    def outcome(self, mutant: Mutant) -> str:
        """Returns `survived`, or what killed the mutant."""
        tree, broken = self._free.get(), list[str]()
        file = tree / mutant.file
        original = file.read_bytes()
        mutated = original[: mutant.start] + mutant.text + original[mutant.end :]
        try:
            chosen = self._run_lines.tests(mutant, self._limit)
            for tests in (chosen[:FIRST], chosen[FIRST:]):
                file.write_bytes(mutated)
                while tests and (failed := self._failed(tree, tests, broken)):
                    if failed == "time" or self._passes_without(failed, tree, file, original):
                        return failed
                    broken.append(failed)
                    file.write_bytes(mutated)
            return "survived"
        finally:
            file.write_bytes(original)
            self._free.put(tree)

    def _passes_without(self, test: str, tree: Path, file: Path, original: bytes) -> bool:
        if test not in self._sound:
            file.write_bytes(original)
            self._sound[test] = not self._failed(tree, [test], [])
        return self._sound[test]

    def _failed(self, tree: Path, tests: list[str], without: list[str]) -> str:
        """The first test that fails, `time` if it does not end, or an empty text."""
        options = ["-p", "no:cacheprovider", "-p", "tests.mutants", "--assert=plain", "--tb=no"]
        options += ["-x", "-q", "-rfE"]
        options += [*(f"--deselect={name}" for name in without), *tests]
        printed, limit = tree / "printed.txt", self._limit
        process = _FORKS.Process(target=_run_tests, args=(printed, limit, options))
        process.start()
        process.join(20 * limit)
        if process.is_alive() or (process.exitcode or 0) < 0:
            process.kill()
            return "time"
        if process.exitcode in (0, 5):  # 5: no test is left
            return ""
        named = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", printed.read_text(), re.MULTILINE)
        return named[1] if named else tests[0]


_FORKS = multiprocessing.get_context("forkserver")
_LIBRARIES = (
    *("pytest", "hypothesis.extra.numpy", "torch", "safetensors.torch", "cv2", "PIL.Image"),
    *("scipy.interpolate", "scipy.ndimage", "scipy.spatial", "scipy.stats", "click", "rich.table"),
)
_FORKS.set_forkserver_preload([*_LIBRARIES])


def _run_tests(printed: Path, limit: float, arguments: list[str]) -> None:
    """Ends the process, forked where the libraries are imported already, with pytest's exit code.

    It runs in the folder of `printed`, where pytest's output goes.
    """
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]  # of the tree that the mutants were chosen in
    with printed.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(printed.parent)
    sys.path[:0] = [str(printed.parent)]
    sys.dont_write_bytecode = True
    data = os.environ.get("PNPDEPTH_TEST_DATA", str(ROOT.parent / "shared" / "data"))
    os.environ |= {"PYTHONPATH": str(printed.parent), "PNPDEPTH_TEST_DATA": data}
    os.environ |= {"PNPDEPTH_MUTANT_LIMIT": str(limit), "PYTHONDONTWRITEBYTECODE": "1"}
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + HANGS_S,) * 2)
    sys.exit(int(pytest.main(arguments)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips the tests that begin after the limit, where pytest has this file as its plugin."""
    limit = float(os.environ.get("PNPDEPTH_MUTANT_LIMIT", "inf"))
    if time.process_time() > limit:
        pytest.skip("no time left for this mutant")


def main() -> None:
    """Tries random mutants, and prints a table by package and the survivors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    for name, default, text in (
        ("--count", 40, "number of mutants"),
        ("--seed", 0, "of the choice of mutants"),
        ("--only", "", "a file or folder, from the root of the tree"),
        ("--jobs", 1, "mutants at once"),
        ("--limit", 90.0, "seconds of processor time for a mutant's tests"),
        ("--lines", "", "folder for what the first tier runs; used again if it is there"),
    ):
        parser.add_argument(name, type=type(default), default=default, help=text)
    arguments = parser.parse_args()
    everything = mutants(arguments.only)
    chosen = random.Random(arguments.seed).sample(everything, min(arguments.count, len(everything)))
    tried, killed, lines = Counter[str](), Counter[str](), []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        run_lines = RunLines(Path(arguments.lines or f"{folder}/lines").resolve(), arguments.jobs)
        trees = Trees(Path(folder), run_lines, arguments.jobs, arguments.limit)
        for mutant, outcome in zip(chosen, pool.map(trees.outcome, chosen), strict=True):
            package = mutant.file.parts[1] if len(mutant.file.parts) > 2 else mutant.file.parts[0]
            tried[package] += 1
            killed[package] += outcome != "survived"
            print(f"{outcome}: {mutant.change}", file=sys.stderr, flush=True)
            lines += [mutant.change] if outcome == "survived" else []
    print(f"seed {arguments.seed}, {len(chosen)} of {len(everything):,} mutants\n")
    print("| package | mutants | killed | survived |\n|---|---|---|---|")
    tried["all"], killed["all"] = tried.total(), killed.total()
    for name, count in tried.items():
        print(f"| {name} | {count} | {killed[name]} | {count - killed[name]} |")
    print("\n" + "\n".join(lines))


if __name__ == "__main__":
    main()
