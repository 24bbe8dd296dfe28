"""Figures of the source tree: sizes of files and functions, parameters, fields, hops, README.

    python -m benchmarks.structure                 # this tree
    python -m benchmarks.structure OLD . --markdown

Trees are folders with `pnpdepth_cli` and `model_zoo_defs`. Hops are the functions of the package on
the stack from `refine` (`--preset paper`) to equation 3, without the cut, on the sample frame.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MOST_PARAMETERS = 6

_HOPS = """
import sys, traceback
from pathlib import Path
import torch
import pnpdepth_cli
package = Path(pnpdepth_cli.__file__).parent
backward, stacks = torch.Tensor.backward, []
def watched(*args, **kwargs):
    stacks.append(traceback.extract_stack())
    return backward(*args, **kwargs)
torch.Tensor.backward = watched
from pnpdepth_cli.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as stop:
    assert not stop.code, stop.code
files = [Path(frame.filename) for frame in stacks[0]]
own = [frame for frame, file in zip(stacks[0], files) if file.is_relative_to(package)]
own = [frame for frame in own if "core/split" not in Path(frame.filename).as_posix()]
in_cli = [frame.filename.endswith("cli/refine_command.py") for frame in own]
starts = [number for number, there in enumerate(in_cli) if there]
names = [f"{Path(f.filename).stem}.{f.name}" for f in own[starts[0]:]]
print("HOPS", " > ".join(names))
"""


def main() -> None:
    """Prints the figures of each tree side by side."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("trees", nargs="*", type=Path, default=[ROOT])
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")
    parser.add_argument("--no-hops", action="store_true", help="run nothing")
    options = parser.parse_args()
    columns = [figures(tree.resolve(), hops=not options.no_hops) for tree in options.trees]
    if not options.markdown:
        print(json.dumps(columns, indent=2, ensure_ascii=False))
        return
    print("| |" + "".join(f" {tree.name or tree} |" for tree in options.trees))
    print("|---|" + "---|" * len(columns))
    for name in columns[0]:
        print(f"| {name} |" + "".join(f" {column[name]} |" for column in columns))


def figures(tree: Path, *, hops: bool = True) -> dict[str, str | int]:
    """Returns the figures of a tree by name."""
    files = [*sources(tree, "pnpdepth_cli"), *sources(tree, "model_zoo_defs")]
    modules = {file: ast.parse(file.read_text(encoding="utf-8")) for file in files}
    lengths = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in files}
    functions = [each for module in modules.values() for each in functions_of(module)]
    wide = [f for f in functions if parameters(f) > MOST_PARAMETERS]
    largest = max((d for m in modules.values() for d in dataclasses_of(m)), key=fields)
    readme = (tree / "README.md").read_text(encoding="utf-8")
    longest = max(lengths, key=lambda file: lengths[file])
    result: dict[str, str | int] = {
        "Python files (without tests, benchmarks)": len(files),
        "lines": sum(lengths.values()),
        "median file, lines": round(statistics.median(lengths.values())),
        "longest file": f"{longest.relative_to(tree)}, {lengths[longest]}",
        "files over 300 lines": sum(length > 300 for length in lengths.values()),
        "functions": len(functions),
        "median function, lines": round(statistics.median(map(length_of, functions))),
        "functions over 50 lines": sum(length_of(function) > 50 for function in functions),
        f"functions over {MOST_PARAMETERS} parameters": len(wide),
        "largest dataclass": f"{largest.name}, {fields(largest)} fields",
        "README, lines": len(readme.splitlines()),
        "README, words": len(readme.split()),
    }
    if hops:
        names = hops_of(tree)
        result["functions from `refine` to equation 3"] = len(names)
        result["these"] = " > ".join(names)
    return result


def sources(tree: Path, package: str) -> list[Path]:
    """Returns the Python files of a package in order."""
    return sorted((tree / package).rglob("*.py"))


def functions_of(module: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yields every function and method."""
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def length_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Returns the number of lines of a function, with its signature and docstring."""
    return (function.end_lineno or function.lineno) - function.lineno + 1


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Returns the number of parameters without self and cls."""
    arguments = function.args
    names = [each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def dataclasses_of(module: ast.Module) -> Iterator[ast.ClassDef]:
    """Yields the classes with a decorator `dataclass`."""
    for node in ast.walk(module):
        if isinstance(node, ast.ClassDef):
            calls = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
            if any(isinstance(call, ast.Name) and call.id == "dataclass" for call in calls):
                yield node


def fields(node: ast.ClassDef) -> int:
    """Returns the number of annotated attributes."""
    return sum(isinstance(statement, ast.AnnAssign) for statement in node.body)


def hops_of(tree: Path) -> list[str]:
    """Returns the functions on the stack from the command to the gradient, outermost first."""
    sample = tree / "samples" / "indoor"
    command = ["refine", str(sample / "rgb.png"), "--sparse", str(sample / "sparse.png")]
    choices = tree / "pnpdepth_cli" / "choices.py"
    if choices.is_file() and "PRESETS" in choices.read_text(encoding="utf-8"):
        command += ["--preset", "paper"]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", _HOPS, *command, "-o", f"{folder}/depth.npy"],
            env={**os.environ, "PYTHONPATH": str(tree)},
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
    lines = [line for line in done.stdout.splitlines() if line.startswith("HOPS ")]
    if not lines:
        raise RuntimeError(done.stderr)
    return lines[0].removeprefix("HOPS ").split(" > ")


if __name__ == "__main__":
    main()
