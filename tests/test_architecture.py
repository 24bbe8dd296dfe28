"""The arrows of the layout, and what a command may not import."""

from __future__ import annotations

import ast
import functools
import importlib
import re
import subprocess
import sys
import traceback
from collections import Counter
from pathlib import Path

import pytest
import torch

from pnpdepth_cli.cli.main import COMMANDS, run

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "pnpdepth_cli"
GROUND_FLOOR = (
    "version",
    "errors",
    "measures",
    "camera",
    "points",
    "protocols",
    "choices",
    "file_record",
    "settings",
    "budget",
    "scan_pattern",
    "spent",
)
"""Each imports only those before it."""
MAY_IMPORT = {
    **{name: {*GROUND_FLOOR[:number]} for number, name in enumerate(GROUND_FLOOR)},
    "core": {*GROUND_FLOOR},
    "sensors": {*GROUND_FLOOR},
    "io": {*GROUND_FLOOR},
    "completion": {*GROUND_FLOOR, "core"},
    "models": {*GROUND_FLOOR, "core", "completion"},
    "frames": {*GROUND_FLOOR, "core", "completion", "models"},
    "dataset": {*GROUND_FLOOR, "completion", "frames", "sensors", "io"},
    "commands": {
        *GROUND_FLOOR,
        "core",
        "completion",
        "models",
        "frames",
        "sensors",
        "io",
        "dataset",
        "refiner",  # the self-test of `doctor`
    },
    "cli": {*GROUND_FLOOR, "commands", "dataset"},
    "refiner": {*GROUND_FLOOR, "completion", "models", "frames", "dataset"},
    "api": {*GROUND_FLOOR, "core", "completion", "models", "frames", "refiner"},
}

IN_COMMANDS = {
    "requests": set[str](),
    "shared": {"requests"},
    "bag_frames": {"requests", "shared"},
    "comparisons": {"requests", "shared"},
    "evaluation": {"requests", "shared"},
    "exports": {"shared"},
    "refinement": {"requests", "shared"},
    "many_frames": {"requests", "shared", "refinement"},
}
"""Which folders of `commands` each folder imports; a command imports any folder, and no command."""


@functools.cache
def imported_modules(file: Path) -> frozenset[str]:
    modules = set[str]()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(modules)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_imports_only_what_its_arrow_allows(package: str) -> None:
    folder = PACKAGE / package
    for file in folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]:
        parts = (name.split(".") for name in imported_modules(file))
        used = {p[1] for p in parts if p[0] == "pnpdepth_cli" and len(p) > 1}
        assert used & MAY_IMPORT.keys() <= MAY_IMPORT[package] | {package}, file


@pytest.mark.parametrize("room", [*IN_COMMANDS, *COMMANDS])
def test_a_command_uses_no_other_command(room: str) -> None:
    folder = PACKAGE / "commands" / room
    allowed = IN_COMMANDS.get(room, {*IN_COMMANDS}) | {room}
    for file in folder.glob("*.py") if room in IN_COMMANDS else [folder.with_suffix(".py")]:
        parts = (name.split(".") for name in imported_modules(file))
        used = {p[2] for p in parts if p[:2] == ["pnpdepth_cli", "commands"] and len(p) > 2}
        assert used <= allowed, file


@pytest.mark.parametrize("package", ["commands", "cli"])
def test_a_command_is_one_file_of_its_name(package: str) -> None:
    files = {file.stem for file in (PACKAGE / package).glob("*.py")}
    of_all = {
        "commands": {"__init__"},
        "cli": {"__init__", "main", "options", "printing", "terminal"},
    }
    assert files - of_all[package] == {*COMMANDS}


@pytest.mark.parametrize("package", ["core", "completion", "models", "frames"])
def test_errors_of_the_python_api_name_no_options_of_the_command_line(package: str) -> None:
    for file in (PACKAGE / package).rglob("*.py"):
        nodes = ast.walk(ast.parse(file.read_text()))
        for raised in [ast.unparse(node) for node in nodes if isinstance(node, ast.Raise)]:
            assert not re.search(r"[ ('\"]--[a-z]", raised), raised


def test_a_network_file_knows_nothing_of_the_program_but_the_definition_contract() -> None:
    for file in (ROOT / "model_zoo_defs").glob("*.py"):
        ours = {n for n in imported_modules(file) if n.split(".")[0] == "pnpdepth_cli"}
        assert all(name.startswith("pnpdepth_cli.models.definition") for name in ours), file


@pytest.mark.parametrize(
    ("libraries", "folders"),
    [
        ("click rich tqdm", {*MAY_IMPORT} - {"cli"}),
        ("torch", {"io", "sensors"}),
        ("cv2", {"core", "models"}),
        ("numpy", {"core"}),
    ],
)
def test_a_library_is_imported_only_where_it_belongs(libraries: str, folders: set[str]) -> None:
    for file in PACKAGE.rglob("*.py"):
        tops = {name.split(".")[0] for name in imported_modules(file)}
        assert file.relative_to(PACKAGE).parts[0] not in folders or not tops & {*libraries.split()}


def imports_nothing_of(heavy: str, code: str, *arguments: str) -> str:
    """What a process printed that ran the code and had none of these modules at its end."""
    check = f"\nimport sys\nbad = {set(heavy.split())} & set(sys.modules)\nassert not bad, bad"
    command = [sys.executable, "-c", code + check, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_help_imports_neither_torch_nor_numpy_nor_rich() -> None:
    commands = ["", *COMMANDS, "models check"]
    code = (
        "import sys\nfrom pnpdepth_cli.cli.main import run\n"
        "assert not any([run([*line.split(), '--help']) for line in sys.argv[1:]])"
    )
    shown = imports_nothing_of("torch numpy cv2 rich tqdm", code, *commands)
    assert shown.count("Usage: pnpdepth") == len(commands)


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("pnpdepth_cli, pnpdepth_cli.points, pnpdepth_cli.measures", "torch numpy"),
        ("pnpdepth_cli.models.definition", "torch"),
        ("pnpdepth_cli.io.depth, pnpdepth_cli.io.rgb", "OpenEXR PIL torch scipy"),
        ("pnpdepth_cli.io.visualisation, pnpdepth_cli.io.file_bytes", "OpenEXR PIL torch scipy"),
    ],
)
def test_an_import_is_light(module: str, heavy: str) -> None:
    imports_nothing_of(heavy, f"import {module}")


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda f: f.stem)
def test_a_benchmark_is_importable(file: Path) -> None:
    importlib.import_module(f"benchmarks.{file.stem}")


def test_few_functions_wrap_equation_3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stacks = []
    backward = torch.Tensor.backward

    def watched(tensor: torch.Tensor) -> None:
        stacks.append(traceback.extract_stack())
        backward(tensor)

    monkeypatch.setattr(torch.Tensor, "backward", watched)
    sample = ROOT / "samples" / "indoor"
    files = [str(sample / "rgb.png"), "--sparse", str(sample / "sparse.png")]
    method = ["--model", "fcrn-tiny", "--method", "paper", "-o", str(tmp_path / "depth.npy")]
    assert run(["refine", *files, *method]) == 0
    calls = [(call.name, Path(call.filename)) for call in stacks[0]]
    of_package = [(name, file) for name, file in calls if PACKAGE in file.parents]
    split = PACKAGE / "core" / "split"
    outside = [(name, file) for name, file in of_package if split not in file.parents]
    names = [name for name, file in outside if file.parent.name != "cli"]
    assert names[0] == "refine_image"
    assert len(names) <= 5, names


def test_a_name_is_a_place() -> None:
    """No two classes, and no two files but `__init__` and a command's pair, have one name."""
    files = sorted(PACKAGE.rglob("*.py"))
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    classes = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    pairs = {PACKAGE / "cli" / f"{command}.py" for command in COMMANDS}
    modules = Counter(file.stem for file in files if file not in pairs and file.stem != "__init__")
    assert [name for name, count in [*classes.items(), *modules.items()] if count > 1] == []
