"""Pages made from the code: docs/python-api.md, docs/record.md and its JSON schema.

`python -m tests.test_generated_pages` writes them anew.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

import pnpdepth_cli
from pnpdepth_cli import file_record
from pnpdepth_cli.dataset import frame_record

DOCS = Path(__file__).parent.parent / "docs"
BEGIN = "<!-- written by `python -m tests.test_generated_pages` -->\n"
END = "<!-- end of what is written -->\n"
WIDTH = 74
FOR_THE_PROGRAM = {
    "Scores": {"to_json"},
    "Settings": {"fixed_by", "is_paper", "given", "over", "closed"},
    "SparsePoints": {
        *("cropped", "joined", "known_in", "mirrored", "resized", "sample", "scatter", "select"),
        "tensors",
    },
    "Split": {"static_graph", "in_half"},
    "Network": {
        *("image_of", "arguments_of", "synthetic_arguments", "verify", "verified", "depth_of"),
        *("raw_of", "known_of"),
    },
    "ModelDefinition": {"default_layer", "default_alignment", "call_arguments"},
}
"""Methods that a user does not need."""
NOT_ON_THE_PAGE = {"BatchState", "FigureRecord"}
"""Types by which the program continues a batch and draws a report; the schema has them."""


def description(text: str | None) -> Iterator[str]:
    """The first sentence of a docstring, without the options' defaults."""
    first = " ".join((text or "").split("\n\n")[0].split()).split(" [default")[0]
    if first := re.split(r"(?<=\.) (?=[A-Z])", first)[0]:
        yield from ("    " + line for line in textwrap.wrap(f'"""{first}"""', WIDTH - 4))


def call_lines(head: str, node: ast.FunctionDef, returns: str) -> Iterator[str]:
    """A signature, an argument a line where it is long."""
    text = re.sub(r"^(self|cls)\b[^,]*(, )?", "", ast.unparse(node.args))
    parts = re.split(r", (?![^\[(]*[\])])", text) if text else []
    arguments = [re.sub(r"^(\w+: [^=]+)=(.*)$", r"\1 = \2", part) for part in parts]
    line = f"{head}({', '.join(arguments)}){returns}"
    if len(line) <= WIDTH:
        yield line
    else:
        yield from (f"{head}(", *(f"    {each}," for each in arguments), f"){returns}")


def function_lines(node: ast.FunctionDef) -> Iterator[str]:
    """A function, a method or a property, and the first sentence of its docstring."""
    returns = ast.unparse(node.returns)
    if any(ast.unparse(mark).endswith("property") for mark in node.decorator_list):
        yield f"{node.name}: {returns}"
    else:
        yield from call_lines(f"def {node.name}", node, f" -> {returns}")
    yield from description(ast.get_docstring(node))


def field_lines(node: ast.AnnAssign, after: ast.stmt | None, of_record: bool) -> Iterator[str]:
    """A field of a dataclass with its type, its description, and its default if it is no record."""
    described, default = None, node.value
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
        described = str(after.value.value)
    if isinstance(default, ast.Call) and ast.unparse(default.func) in ("option", "field"):
        if len(default.args) > 1:  # option(default, help)
            described = str(ast.literal_eval(default.args[1]))
        default = default.args[0] if default.args else None
    value = "" if default is None or of_record else f" = {ast.unparse(default)}"
    yield f"{ast.unparse(node.target)}: {ast.unparse(node.annotation)}{value}"
    yield from description(described)


def class_lines(node: ast.ClassDef, *, of_record: bool = False) -> Iterator[str]:
    """A class with its fields, and with its methods that a user needs if it is no record."""
    functions = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
    hidden = FOR_THE_PROGRAM.get(node.name, set())
    if "__init__" in functions:
        yield from call_lines(f"class {node.name}", functions["__init__"], "")
    else:
        yield f"class {node.name}"
    yield from description(ast.get_docstring(node))
    for each, after in zip(node.body, [*node.body[1:], None], strict=True):
        lines: Iterable[str] = ()
        if isinstance(each, ast.AnnAssign):
            lines = field_lines(each, after, of_record)
        elif isinstance(each, ast.FunctionDef) and not of_record:
            shown = each.name not in hidden and not each.name.startswith("_")
            lines = function_lines(each) if shown else ()
        yield from (f"    {line}" for line in lines)


def signatures() -> str:
    """All public names but the errors, as Markdown."""
    text = ""
    for name in pnpdepth_cli.__all__[1:]:
        if "Error" not in name:
            (node,) = ast.parse(inspect.getsource(getattr(pnpdepth_cli, name))).body
            lines = class_lines if isinstance(node, ast.ClassDef) else function_lines
            text += f"### {name}\n\n```python\n" + "\n".join(lines(node)) + "\n```\n\n"
    return text


def fields() -> str:
    """The dataclasses of a record that tell a user something, the frame's first."""
    nodes = [
        node
        for module in (frame_record, file_record)
        for node in ast.parse(inspect.getsource(module)).body
        if isinstance(node, ast.ClassDef) and node.name not in NOT_ON_THE_PAGE
    ]
    nodes.sort(key=lambda node: node.name != "FrameRecord")
    blocks = ("\n".join(class_lines(node, of_record=True)) for node in nodes)
    return "```python\n{}\n```\n\n".format("\n\n".join(blocks))


def pages() -> dict[Path, str]:
    schema = msgspec.json.schema(frame_record.FrameRecord)
    texts = {DOCS / "record.schema.json": json.dumps(schema, indent=1, sort_keys=True) + "\n"}
    for name, made in (("python-api.md", signatures()), ("record.md", fields())):
        before, begin, rest = (DOCS / name).read_text("utf-8").partition(BEGIN)
        texts[DOCS / name] = f"{before}{begin}\n{made}{END}{rest.partition(END)[2]}"
    return texts


def test_the_pages_are_those_of_the_code() -> None:
    for path, text in pages().items():
        assert path.read_text("utf-8") == text, "run: python -m tests.test_generated_pages"


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, "utf-8")
