"""A command line whose output is kept, and groups of them that run in one folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Step:
    """A command line, without `pnpdepth`, that runs in the folder of its group.

    Attributes:
        name: The group's and its own, `losses/l2`.
        line: The arguments, as a shell would read them.
        save: The file in the group's folder that gets what is printed on stdout.
        unordered: Lines may come in any order, where threads print them.
        figures: False where every number is a measurement, and left out.
        before: Done to the group's folder first.
    """

    name: str
    line: str
    save: str | None = None
    unordered: bool = False
    figures: bool = True
    before: Callable[[Path], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Group:
    """Steps that run one after another in one folder; shared: they need the real frames."""

    name: str
    steps: Sequence[Step]
    shared: bool = False


def group_of(
    name: str, *steps: tuple[str, str] | Step, shared: bool = False, unordered: bool = False
) -> Group:
    grouped = [
        step
        if isinstance(step, Step)
        else Step(name=f"{name}/{step[0]}", line=step[1], unordered=unordered)
        for step in steps
    ]
    return Group(name=name, steps=grouped, shared=shared)


def single_steps(name: str, *steps: tuple[str, str], shared: bool = False) -> Iterator[Group]:
    """Steps that need nothing of one another, each a group of its own."""
    for step in steps:
        yield Group(
            name=f"{name}-{step[0]}",
            steps=[Step(name=f"{name}/{step[0]}", line=step[1])],
            shared=shared,
        )
