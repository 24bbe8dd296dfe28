"""What a torch.export archive may hold, looked at before torch reads it.

`torch.export.load` trusts its file: it unpickles constants and inputs, evaluates expressions of
sizes and the code of guards, loads compiled libraries, finds functions by dotted names and writes
names into source code. Here everything but tensors as plain bytes, operators of torch and
arithmetic is refused (layout and schema: torch/export/pt2_archive, torch/_export/serde/schema.py).
"""

from __future__ import annotations

import ast
import io
import json
import re
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch.export.pt2_archive import PT2ArchiveReader

from pnpdepth_cli.core.split.user_code import describe
from pnpdepth_cli.errors import ModelError

_MODEL = "models/model.json"
_INPUTS = "data/sample_inputs/model.pt"
_CONFIGS = ("data/weights/model_weights_config.json", "data/constants/model_constants_config.json")
_ENTRIES = re.compile(
    rf"{re.escape(_MODEL)}|{re.escape(_INPUTS)}|{'|'.join(map(re.escape, _CONFIGS))}"
    r"|data/weights/weight_\d+|data/constants/tensor_\d+|\.data/\w+|byteorder"
    r"|archive_format|archive_version|version"
)

_WORD = re.compile(r"[\w.+-]*")
_OPERATOR = re.compile(r"torch\.ops\.(aten|prims?|torchvision|quantized)\.\w+\.\w+")
_TOUCHES_FILES = re.compile(r"torch\.ops\.aten\.(from_file|save|_?load)\b")
_ARITHMETIC = re.compile(
    r"_operator\.(add|sub|mul|truediv|floordiv|mod|pow|neg|pos|abs|eq|ne|lt|le|gt|ge|and_|or_|not_"
    r"|getitem)|math\.(ceil|floor|trunc|sqrt)|torch\._?sym_\w+"
    r"|torch\.ops\.higher_order\.(cond|while_loop|wrap_with_set_grad_enabled|wrap_with_autocast)"
)
_TREE = re.compile(r'[\w\s.,:{}\[\]"\\-]*')

_FUNCTIONS = frozenset(
    {
        *("Symbol", "Integer", "Float", "Rational", "Add", "Mul", "Pow", "Max", "Min", "Abs"),
        *("Eq", "Equality", "Ne", "Unequality", "Lt", "StrictLessThan", "Le", "LessThan"),
        *("Gt", "StrictGreaterThan", "Ge", "GreaterThan", "And", "Or", "Not", "floor", "ceiling"),
        *("FloorDiv", "ModularIndexing", "Where", "PythonMod", "Mod", "CleanDiv", "CeilDiv"),
        *("CeilToInt", "FloorToInt", "TruncToInt", "TruncToFloat", "RoundToInt", "RoundDecimal"),
        *("ToFloat", "IntTrueDiv", "FloatTrueDiv", "PowByNatural", "FloatPow", "LShift", "RShift"),
        *("Identity", "IsNonOverlappingAndDenseIndicator"),
    }
)
_EXPRESSIONS = (
    *(ast.Expression, ast.Call, ast.keyword, ast.Name, ast.Load, ast.Constant),
    *(ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Compare, ast.cmpop),
)


class _Refused(Exception):
    """What is not taken, in a few words."""


def check_archive(file: Path) -> None:
    """ModelError if reading or running the archive could do anything but compute with tensors."""
    reader = PT2ArchiveReader(str(file))
    try:
        names = reader.get_file_names()
        for name in names:
            if not _ENTRIES.fullmatch(name):
                raise _Refused(f"it holds {name[:80]!r}")
        with zipfile.ZipFile(file) as archive:  # torch reads an older layout by this, if it fails
            if sorted(name.partition("/")[2] for name in archive.namelist()) != sorted(names):
                raise _Refused("it holds other files for one reader than for another")
        for name in _CONFIGS:
            _check_tensors(json.loads(reader.read_bytes(name)))
        _check_inputs(reader.read_bytes(_INPUTS))
        _check(json.loads(reader.read_bytes(_MODEL)))
    except _Refused as refused:
        raise ModelError(
            f"exported program {file} is not read: {refused}, and only plain tensors and operators"
            " of torch are taken from such a file; export the network again, or to ONNX"
        ) from None


def _check_tensors(config: Any) -> None:
    for name, meta in config["config"].items():
        if meta["use_pickle"] or not _WORD.fullmatch(meta["path_name"]):
            raise _Refused(f"{name[:80]!r} is pickled")
        _word(name)


def _check_inputs(content: bytes) -> None:
    try:
        torch.load(io.BytesIO(content), weights_only=True)
    except Exception as error:  # torch raises many kinds, all of which make it unpickle the rest
        raise _Refused(
            f"its example inputs are more than tensors ({describe(error)[:60]})"
        ) from None


def _check(value: Any) -> None:
    """Everything in the program: what is called, what is evaluated, what is written as source."""
    if isinstance(value, str):
        _word(value)
    elif isinstance(value, list):
        for one in value:
            _check(one)
    elif isinstance(value, dict):
        for key, one in value.items():
            _check_entry(key, one)


def _check_entry(key: str, value: Any) -> None:
    if key in ("metadata", "guards_code", "as_string", "as_strings"):
        return  # for people; not asked for (see `exported_definition`); quoted wherever it stands
    if key == "range_constraints":
        _expressions(value)
    elif key == "expr_str":
        _expressions([value])
    elif key in ("in_spec", "out_spec") and isinstance(value, str):
        if not _TREE.fullmatch(value) or "\\u" in value or "__enum__" in value:
            raise _Refused(f"its {key} is no nesting of plain containers")
    elif key == "target" and isinstance(value, str):
        called = _OPERATOR.fullmatch(value) and not _TOUCHES_FILES.match(value)
        if not called and not _ARITHMETIC.fullmatch(value):
            raise _Refused(f"it calls {value[:80]!r}")
    else:
        _word(key)
        _check(value)


def _word(text: str) -> None:
    if not _WORD.fullmatch(text):
        raise _Refused(f"{text[:80]!r} is no name")


def _expressions(texts: Iterable[str]) -> None:
    for text in texts:
        try:
            nodes = list(ast.walk(ast.parse(text, mode="eval")))
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            nodes = []
        if not nodes or not all(map(_is_arithmetic, nodes)):
            raise _Refused(f"the size {text[:80]!r} is no arithmetic")


def _is_arithmetic(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return _WORD.fullmatch(node.value) is not None
    return isinstance(node, _EXPRESSIONS)
