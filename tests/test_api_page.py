"""docs/python-api.md: the signatures in it are those of the code.

`python -m tests.test_api_page` writes them anew.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pnpdepth_cli

PAGE = Path(__file__).parent.parent / "docs" / "python-api.md"
BEGIN = "<!-- signatures, written by `python -m tests.test_api_page` -->\n"
END = "<!-- end of the signatures -->\n"
FOR_THE_PROGRAM = {
    "Scores": {"to_json"},
    "Settings": {"fixed_by", "is_paper", "given", "over", "closed"},
    "SparsePoints": {
        *("cropped", "joined", "resized", "sample", "scatter", "select", "tensors"),
    },
    "Split": {"static_graph", "in_half"},
    "Network": {
        *("image_of", "arguments_of", "synthetic_arguments", "verify", "verified", "depth_of"),
        *("raw_of", "known_of"),
    },
    "ModelDefinition": {"default_layer", "default_alignment", "call_arguments"},
}
"""Methods that a user does not need."""
WIDTH = 74


def description(text: str | None) -> Iterator[str]:
    """The first sentence of a docstring, without the options' defaults."""
    first = " ".join((text or "").split("\n\n")[0].split()).split(" [default")[0]
    first = re.split(r"(?<=\.) (?=[A-Z])", first)[0]
    if first:
        yield from textwrap.wrap(
            f'"""{first}"""', WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 4
        )


def arguments_of(node: ast.arguments) -> list[str]:
    """The arguments of a function as its signature has them."""
    text = re.sub(r"^(self|cls)\b[^,]*(, )?", "", ast.unparse(node))
    parts = re.split(r", (?![^\[(]*[\])])", text) if text else []
    return [re.sub(r"^(\w+: [^=]+)=(.*)$", r"\1 = \2", part) for part in parts]


def call_lines(head: str, node: ast.FunctionDef, returns: str) -> Iterator[str]:
    """A signature, an argument a line where it is long."""
    arguments = arguments_of(node.args)
    line = f"{head}({', '.join(arguments)}){returns}"
    if len(line) <= WIDTH:
        yield line
    else:
        yield from (f"{head}(", *(f"    {each}," for each in arguments), f"){returns}")


def function_lines(node: ast.FunctionDef) -> Iterator[str]:
    """A function, a method or a property, and the first line of its docstring."""
    assert node.returns is not None
    returns = ast.unparse(node.returns)
    if any(ast.unparse(mark).endswith("property") for mark in node.decorator_list):
        yield f"{node.name}: {returns}"
    else:
        yield from call_lines(f"def {node.name}", node, f" -> {returns}")
    yield from description(ast.get_docstring(node))


def field_lines(
    node: ast.AnnAssign, after: ast.stmt | None, *, of_record: bool = False
) -> Iterator[str]:
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
    hidden = {*functions} if of_record else FOR_THE_PROGRAM.get(node.name, set())
    if "__init__" in functions:
        yield from call_lines(f"class {node.name}", functions["__init__"], "")
    else:
        yield f"class {node.name}"
    yield from description(ast.get_docstring(node))
    for each, after in zip(node.body, [*node.body[1:], None], strict=True):
        lines: Iterator[str] = iter(())
        if isinstance(each, ast.AnnAssign):
            lines = field_lines(each, after, of_record=of_record)
        elif isinstance(each, ast.FunctionDef) and each.name not in hidden:
            lines = iter(()) if each.name.startswith("_") else function_lines(each)
        yield from (f"    {line}" for line in lines)


def lines_of(name: str) -> Iterator[str]:
    """What the page shows of a public name."""
    module = importlib.import_module(getattr(pnpdepth_cli, name).__module__)
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            yield from class_lines(node)
        elif isinstance(node, ast.FunctionDef) and node.name == name:
            yield from function_lines(node)


def signatures() -> str:
    """All public names but the errors, as Markdown."""
    values = {name: getattr(pnpdepth_cli, name) for name in pnpdepth_cli.__all__[1:]}
    error = pnpdepth_cli.PnpDepthError
    shown = [n for n, v in values.items() if not (isinstance(v, type) and issubclass(v, error))]
    blocks = {name: "\n".join(lines_of(name)) for name in shown}
    return "\n".join(f"### {n}\n\n```python\n{block}\n```\n" for n, block in blocks.items())


def test_the_signatures_of_the_page_are_those_of_the_code() -> None:
    shown = PAGE.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]
    assert shown.strip() == signatures().strip(), "run: python -m tests.test_api_page"


def write() -> None:
    """Writes the signatures into the page."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    text = f"{before}{BEGIN}\n{signatures()}\n{END}{rest.partition(END)[2]}"
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write()
