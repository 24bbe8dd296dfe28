"""The page made from the code, docs/record.md, and its JSON schema.

`python -m tests.test_generated_pages` writes them anew.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import msgspec

from pnpdepth_cli import file_record
from pnpdepth_cli.dataset import frame_record

DOCS = Path(__file__).parent.parent / "docs"
BEGIN = "<!-- written by `python -m tests.test_generated_pages` -->\n"
END = "<!-- end of what is written -->\n"
WIDTH = 74
NOT_ON_THE_PAGE = {"BatchState", "FigureRecord"}
"""Types by which the program continues a batch and draws a report; the schema has them."""


def description(text: str | None) -> Iterator[str]:
    """The first sentence of a docstring, without the options' defaults."""
    first = " ".join((text or "").split("\n\n")[0].split()).split(" [default")[0]
    if first := re.split(r"(?<=\.) (?=[A-Z])", first)[0]:
        yield from ("    " + line for line in textwrap.wrap(f'"""{first}"""', WIDTH - 4))


def field_lines(node: ast.AnnAssign, after: ast.stmt | None) -> Iterator[str]:
    """A field of a dataclass with its type and its description."""
    described = None
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
        described = str(after.value.value)
    yield f"{ast.unparse(node.target)}: {ast.unparse(node.annotation)}"
    yield from description(described)


def class_lines(node: ast.ClassDef) -> Iterator[str]:
    """A class with its fields."""
    yield f"class {node.name}"
    yield from description(ast.get_docstring(node))
    for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign):
            yield from (f"    {line}" for line in field_lines(statement, after))


def fields() -> str:
    """The dataclasses of a record that tell a user something, the frame's first."""
    nodes = [
        node
        for module in (frame_record, file_record)
        for node in ast.parse(inspect.getsource(module)).body
        if isinstance(node, ast.ClassDef) and node.name not in NOT_ON_THE_PAGE
    ]
    first = ["FrameRecord", "ResultRecord"]
    nodes.sort(key=lambda node: first.index(node.name) if node.name in first else len(first))
    blocks = ("\n".join(class_lines(node)) for node in nodes)
    return "```python\n{}\n```\n\n".format("\n\n".join(blocks))


def pages() -> dict[Path, str]:
    schema = msgspec.json.schema(frame_record.FrameRecord)
    texts = {DOCS / "record.schema.json": json.dumps(schema, indent=1, sort_keys=True) + "\n"}
    before, begin, rest = (DOCS / "record.md").read_text("utf-8").partition(BEGIN)
    texts[DOCS / "record.md"] = f"{before}{begin}\n{fields()}{END}{rest.partition(END)[2]}"
    return texts


def test_the_pages_are_those_of_the_code() -> None:
    for path, text in pages().items():
        assert path.read_text("utf-8") == text, "run: python -m tests.test_generated_pages"


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, "utf-8")
