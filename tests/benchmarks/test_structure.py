"""The figures of the source tree, on a small tree and on this one; every benchmark is imported."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import pytest

import benchmarks
from benchmarks.structure import ROOT, figures, hops_of

NAMES = [module.name for module in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")]


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_is_importable(name: str) -> None:
    importlib.import_module(name)


def test_the_figures_of_a_small_tree(tmp_path: Path) -> None:
    (tmp_path / "pnpdepth_cli").mkdir()
    (tmp_path / "README.md").write_text("# one\n\ntwo three\n")
    (tmp_path / "pnpdepth_cli" / "a.py").write_text(
        "from dataclasses import dataclass\n\n\n"
        "@dataclass(frozen=True)\nclass Pair:\n    left: int\n    right: int\n\n\n"
        "def wide(a, b, c, d, e, f, g):\n    return a\n\n\n"
        "class B:\n    def method(self, a):\n        return a\n"
    )
    values = figures(tmp_path, hops=False)
    assert values["Python files (without tests, benchmarks)"] == 1
    assert values["functions"] == 2
    assert values["functions over 6 parameters"] == 1
    assert values["largest dataclass"] == "Pair, 2 fields"
    assert (values["README, lines"], values["README, words"]) == (3, 4)


@pytest.mark.slow
def test_few_functions_lie_between_the_command_and_equation_3() -> None:
    names = hops_of(ROOT)
    assert names[0] == "refine_command.refine"
    assert len(names) <= 6, names
