"""The steps of a graph that was read from a file, run one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Value:
    """Stands for a value of the graph among the arguments of a step."""

    name: str


@dataclass(frozen=True, kw_only=True)
class Step:
    """One call; arguments may be lists. outputs: name of its result, or names of its parts.

    last_read: values that no later step reads.
    """

    run: Callable[..., Any]
    arguments: Sequence[Any]
    keywords: Mapping[str, Any] = field(default_factory=dict)
    outputs: str | Sequence[str | None]
    name: str = ""  # for messages
    last_read: frozenset[str] = frozenset()

    def names(self) -> set[str]:
        """Returns the values that the step reads or gives."""
        given = [self.outputs] if isinstance(self.outputs, str) else self.outputs
        return {*filter(None, given), *_names_in([*self.arguments, *self.keywords.values()])}


def with_ends(steps: Sequence[Step], outputs: Sequence[str]) -> list[Step]:
    """Returns the steps, each with the values but `outputs` that no later step reads."""
    last = {name: at for at, step in enumerate(steps) for name in step.names()}
    return [
        replace(step, last_read=frozenset(n for n in step.names() - {*outputs} if last[n] == at))
        for at, step in enumerate(steps)
    ]


def run_steps(steps: Sequence[Step], values: dict[str, Any]) -> Iterator[Step]:
    """Adds the results to the values; yields each step before what ends there is removed."""
    for step in steps:
        keywords = {name: _resolve(value, values) for name, value in step.keywords.items()}
        result = step.run(*_resolve(step.arguments, values), **keywords)
        if isinstance(step.outputs, str):
            values[step.outputs] = result
        else:
            values.update((n, r) for n, r in zip(step.outputs, result, strict=False) if n)
        yield step
        for name in step.last_read:
            values.pop(name, None)


def _resolve(argument: Any, values: Mapping[str, Any]) -> Any:
    if isinstance(argument, Value):
        return values[argument.name]
    is_list = isinstance(argument, list | tuple)
    return [_resolve(one, values) for one in argument] if is_list else argument


def _names_in(argument: Any) -> Iterator[str]:
    if isinstance(argument, Value):
        yield argument.name
    for one in argument if isinstance(argument, list | tuple) else ():
        yield from _names_in(one)
