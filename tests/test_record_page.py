"""docs/record.md and its JSON schema: both are those of the types.

`python -m tests.test_record_page` writes them anew.
"""

from __future__ import annotations

import ast
import inspect
import json
from pathlib import Path

import msgspec

from pnpdepth_cli import file_record
from pnpdepth_cli.dataset import frame_record
from pnpdepth_cli.dataset.frame_record import FrameRecord
from tests.test_api_page import class_lines

FOR_THE_PROGRAM = {"BatchState", "FigureRecord"}
"""Types by which the program continues a batch and draws a report; the schema has them."""
DOCS = Path(__file__).parent.parent / "docs"
PAGE, SCHEMA = DOCS / "record.md", DOCS / "record.schema.json"
BEGIN = "<!-- fields, written by `python -m tests.test_record_page` -->\n"


def fields() -> str:
    """The dataclasses of a record that tell a user something, the frame's first."""
    found = {}
    for module in (frame_record, file_record):
        tree = ast.parse(inspect.getsource(module))
        found |= {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    found = {name: node for name, node in found.items() if name not in FOR_THE_PROGRAM}
    ordered = [found.pop("FrameRecord"), *found.values()]
    blocks = ("\n".join(class_lines(node, of_record=True)) for node in ordered)
    return f"{BEGIN}\n```python\n" + "\n\n".join(blocks) + "\n```\n"


def schema() -> str:
    """The JSON schema of a record."""
    return json.dumps(msgspec.json.schema(FrameRecord), indent=1, sort_keys=True) + "\n"


def test_the_page_and_the_schema_are_those_of_the_types() -> None:
    written = PAGE.read_text("utf-8")
    assert written[written.index(BEGIN) :] == fields(), "run: python -m tests.test_record_page"
    assert json.loads(SCHEMA.read_text("utf-8")) == json.loads(schema())


if __name__ == "__main__":
    head = PAGE.read_text("utf-8").split(BEGIN)[0]
    PAGE.write_text(head + fields(), "utf-8")
    SCHEMA.write_text(schema(), "utf-8")
