"""Draws the imports of the package: `python -m benchmarks.structure`.

A room is a folder, or a file beside the folders. A room stands on the floor above the highest room
that it imports, so that floor 0 imports nothing of the package. Rooms that import each other are a
circle, and share a floor. The files of each folder and all files are drawn in the same way.

    python -m benchmarks.structure --imports batch

prints what each file of that name, or in the folder of that name, imports, and what imports it.

Imports within functions count. Those for type checkers alone count only with `--types`.
"""

from __future__ import annotations

import argparse
import ast
from collections import defaultdict
from collections.abc import Iterator, Mapping, Set
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "pnpdepth_cli"

Graph = Mapping[str, Set[str]]
"""What each node imports, by name."""


def module_name(file: Path, package: Path) -> str:
    """The dotted name of a file below the package, without the package's own."""
    parts = file.relative_to(package).with_suffix("").parts
    if parts[-1] == "__init__":
        parts = parts[:-1]
    return ".".join(parts) or package.name


def imports_of(tree: ast.AST, *, with_types: bool) -> Iterator[str]:
    """Yields the full names that a file imports, those of `from` imports with each alias."""
    for node in ast.iter_child_nodes(tree):
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if for_types and not with_types:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        yield from imports_of(node, with_types=with_types)


def file_graph(package: Path, *, with_types: bool = False) -> dict[str, set[str]]:
    """The files of a package, and which of its files each imports."""
    files = {module_name(file, package): file for file in sorted(package.rglob("*.py"))}
    graph: dict[str, set[str]] = {name: set() for name in files}
    for name, file in files.items():
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for imported in imports_of(tree, with_types=with_types):
            top, _, rest = imported.partition(".")
            if top != package.name:
                continue
            # The longest beginning that is a file: what follows is a name in it.
            parts = rest.split(".") if rest else []
            while parts and ".".join(parts) not in files:
                parts.pop()
            target = ".".join(parts) or package.name
            if target != name:
                graph[name].add(target)
    return graph


def room_graph(files: Graph) -> dict[str, set[str]]:
    """The folders of a package and the files beside them, and which of these each imports."""
    rooms: dict[str, set[str]] = defaultdict(set)
    for name, imported in files.items():
        room = name.partition(".")[0]
        rooms[room] |= {target.partition(".")[0] for target in imported} - {room}
    return dict(rooms)


def circles(graph: Graph) -> list[frozenset[str]]:
    """The strongly connected components of the graph (Tarjan, SIAM J. Comput. 1972)."""
    found: list[frozenset[str]] = []
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    on_path: set[str] = set()

    def visit(node: str) -> None:
        """Numbers a node and all that it reaches; adds the components that begin there."""
        # The lowest number that the node and those behind it lead back to.
        number[node] = len(number)
        lowest[node] = number[node]
        path.append(node)
        on_path.add(node)
        for target in sorted(graph[node]):
            if target not in number:
                visit(target)
                lowest[node] = min(lowest[node], lowest[target])
            elif target in on_path:
                lowest[node] = min(lowest[node], number[target])
        # The node is the first of its component: all that came after it is of the same one.
        if lowest[node] == number[node]:
            start = path.index(node)
            component = frozenset(path[start:])
            del path[start:]
            on_path.difference_update(component)
            found.append(component)

    for node in sorted(graph):
        if node not in number:
            visit(node)
    return found


def floors(graph: Graph) -> dict[str, int]:
    """The floor of every node: the length of the longest chain of imports below it.

    The nodes of a circle share a floor.
    """
    component_of = {node: component for component in circles(graph) for node in component}
    below = {
        component: {component_of[target] for node in component for target in graph[node]}
        - {component}
        for component in component_of.values()
    }
    floor: dict[frozenset[str], int] = {}
    for component in TopologicalSorter(below).static_order():
        floor[component] = 1 + max((floor[target] for target in below[component]), default=-1)
    return {node: floor[component_of[node]] for node in graph}


def drawing(graph: Graph) -> Iterator[str]:
    """Yields a line for each floor, the highest first, and one for each circle."""
    floor_of = floors(graph)
    for floor in range(max(floor_of.values()), -1, -1):
        nodes = sorted(node for node, its_floor in floor_of.items() if its_floor == floor)
        yield f"{floor:3}  {', '.join(nodes)}"
    for component in circles(graph):
        if len(component) > 1:
            yield f"circle of {len(component)}: {', '.join(sorted(component))}"


def neighbours(graph: Graph, word: str) -> Iterator[str]:
    """Yields what the files of this name, or in that folder, import, and what imports them."""
    for node in sorted(graph):
        if word in node.split("."):
            importers = sorted(name for name, imported in graph.items() if node in imported)
            yield node
            yield f"    imports      {', '.join(sorted(graph[node])) or '–'}"
            yield f"    imported by  {', '.join(importers) or '–'}"


def main() -> None:
    """Prints the drawings of rooms, of each room's files, and of all files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--package", type=Path, default=PACKAGE, help="folder of another package")
    parser.add_argument("--imports", metavar="NAME", help="only the imports of these files")
    parser.add_argument("--types", action="store_true", help="count imports for type checkers too")
    args = parser.parse_args()
    files = file_graph(args.package, with_types=args.types)
    if args.imports:
        print("\n".join(neighbours(files, args.imports)))
        return

    rooms = room_graph(files)
    print(f"{len(rooms)} rooms on {1 + max(floors(rooms).values())} floors\n")
    print("\n".join(drawing(rooms)))

    # Each folder by itself: imports of other folders do not raise its files.
    for room in sorted(rooms):
        own = {name for name in files if name.partition(".")[0] == room}
        if len(own) > 2:
            inner = {name: files[name] & own for name in own}
            print(f"\n{room}/: {len(own)} files on {1 + max(floors(inner).values())} floors\n")
            print("\n".join(drawing(inner)))

    print(f"\nall: {len(files)} files on {1 + max(floors(files).values())} floors\n")
    print("\n".join(drawing(files)))


if __name__ == "__main__":
    main()
