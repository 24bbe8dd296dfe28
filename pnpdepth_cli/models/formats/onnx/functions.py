"""The functions that an ONNX model defines itself, written out in its graph."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import ModelError

MAX_NODES = 100_000
"""Nodes of the graph with all functions written out. Depth networks have up to 10,000."""

MAX_BYTES = 1 << 28
"""Bytes of them, without the weights that lie in the graph itself."""

_Key = tuple[str, str, str]


def inlined(model: Any, path: Path) -> Any:
    """Returns the model without functions of its own.

    Raises:
        ModelError: Functions call themselves, or become too large when they are written out.
    """
    if not model.functions:
        return model
    functions = {_key(f.domain, f.name, f): f for f in model.functions}
    sizes: dict[_Key, tuple[int, int]] = {}
    for key in functions:
        _measure(key, functions, sizes, path)
    calls = [_key(node.domain, node.op_type, node) for node in _nodes(model.graph.node)]
    nodes = sum(sizes[key][0] for key in calls if key in sizes)
    size = sum(sizes[key][1] for key in calls if key in sizes)
    if nodes > MAX_NODES or size > MAX_BYTES:
        raise ModelError(
            f"ONNX file {path}: its functions, written out, are more than {MAX_NODES:,} nodes or"
            f" {MAX_BYTES / 1e6:,.0f} MB"
        )
    from onnx import inliner

    return inliner.inline_local_functions(model)


def _key(domain: str, name: str, proto: Any) -> _Key:
    return domain, name, getattr(proto, "overload", "")


def _measure(
    first: _Key, functions: dict[_Key, Any], sizes: dict[_Key, tuple[int, int]], path: Path
) -> None:
    """Fills in nodes and bytes of a function, and of those it calls, when written out."""
    open_calls: list[_Key] = [first]
    while open_calls:
        key = open_calls[-1]
        if key in sizes:
            open_calls.pop()
            continue
        nodes = list(_nodes(functions[key].node))
        calls = [_key(node.domain, node.op_type, node) for node in nodes]
        missing = {call for call in calls if call in functions and call not in sizes}
        if missing & set(open_calls):
            raise ModelError(f"ONNX file {path}: its function {key[1][:60]!r} calls itself")
        if missing:
            open_calls += missing
            continue
        inner = [sizes[call] for call in calls if call in sizes]
        sizes[key] = (
            len(nodes) + sum(count for count, _ in inner),
            functions[key].ByteSize() + sum(size for _, size in inner),
        )


def _nodes(nodes: Iterable[Any]) -> Iterable[Any]:
    """The nodes, and those in the graphs that are their attributes."""
    for node in nodes:
        yield node
        for attribute in node.attribute:
            for graph in (*attribute.graphs, attribute.g):
                yield from _nodes(graph.node)
