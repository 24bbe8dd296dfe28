"""Random mutants of the package, and whether the tests notice them.

    python -m tests.mutants --count 40 --seed 0 --only pnpdepth_cli/core --jobs 2

One expression of a file is changed: a comparison, an arithmetic operator, a constant, `and`, a
returned value, min, any, floor, mean and the like. In a temporary copy of the tree the test files
that mirror the module or import it run first, then those of the modules that import it and the
others of its folder, then those of whole commands. A test that fails with the mutant and passes
without it kills it; so does a run without end. Prints a table by package, and each survivor with
its place and change.
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
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("pnpdepth_cli", "model_zoo_defs")
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
    """A file with bytes `start` to `end` changed, and the change in words."""

    file: Path
    start: int
    end: int
    text: bytes
    change: str


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


def places(node: ast.AST) -> Iterator[ast.AST]:
    """Yields the nodes that run: no annotations, texts or imports for types."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            typing = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
            if isinstance(child, ast.AST) and not typing:
                yield from places(child)


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
            for node in places(ast.parse(content)):
                for other in changed(node):
                    assert isinstance(node, ast.expr | ast.stmt)
                    text = ast.unparse(other)
                    if isinstance(other, ast.BinOp | ast.BoolOp | ast.Compare):
                        text = f"({text})"
                    start = starts[node.lineno - 1] + node.col_offset
                    end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
                    before = " ".join(content[start:end].decode().split())
                    change = f"{file}:{node.lineno}: {before}  ->  {text}"
                    found.append(Mutant(file, start, end, text.encode(), change))
    return found


def matching_tests(file: Path) -> list[list[str]]:
    """Returns the test files that mirror a module or import it, those that mirror modules which
    import it with the others of its folder, and those of whole commands.
    """
    folder, first = _mirrored(file)
    module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
    parent, _, last = module.rpartition(".")
    imports = re.compile(rf"{module}\b|from {parent} import [^)\n]*\b{last}\b")

    def importing(root: Path) -> list[Path]:
        return [path for path in sorted(root.rglob("*.py")) if imports.search(path.read_text())]

    first += [path for path in importing(ROOT / "tests") if path.name.startswith("test_")]
    near = [
        test
        for path in importing(ROOT / PACKAGES[0])
        for test in _mirrored(path.relative_to(ROOT))[1]
    ]
    while not (others := sorted(folder.glob("test_*.py"))):  # such as io/formats, tested in io
        folder = folder.parent
    lists = first, near + others, [ROOT / "tests" / "test_golden.py"]
    chosen = [[path.relative_to(ROOT).as_posix() for path in dict.fromkeys(each)] for each in lists]
    chosen[1] = [path for path in chosen[1] if path not in chosen[0]]
    return [paths for paths in chosen if paths]


def _mirrored(file: Path) -> tuple[Path, list[Path]]:
    """The folder of tests of a module's package, and the test files of the module's name there."""
    parts = file.parts[1:-1] if file.parts[0] == "pnpdepth_cli" else file.parts[:1]
    folder = ROOT.joinpath("tests", *parts)
    return folder, sorted(folder.glob(f"test_{file.stem}*.py"))


class Trees:
    """Copies of the tree, one a job, in which mutants are tried."""

    def __init__(self, folder: Path, arguments: argparse.Namespace) -> None:
        self._free: SimpleQueue[Path] = SimpleQueue()
        self._arguments, self._sound = arguments, dict[str, bool]()
        ignored = shutil.ignore_patterns(".*", "__pycache__", "out", "dist", "build", "site")
        for number in range(arguments.jobs):
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
            for tests in matching_tests(mutant.file):
                file.write_bytes(mutated)
                while failed := self._failed(tree, tests, broken):
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
        options += ["-x", "-q", "-rfE", "-m", self._arguments.marked]
        options += [*(f"--deselect={name}" for name in without), *tests]
        printed, limit = tree / "printed.txt", self._arguments.limit
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
        ("--marked", "not slow", "pytest's -m"),
    ):
        parser.add_argument(name, type=type(default), default=default, help=text)
    arguments = parser.parse_args()
    everything = mutants(arguments.only)
    chosen = random.Random(arguments.seed).sample(everything, min(arguments.count, len(everything)))
    tried, killed, lines = Counter[str](), Counter[str](), []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        trees = Trees(Path(folder), arguments)
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
