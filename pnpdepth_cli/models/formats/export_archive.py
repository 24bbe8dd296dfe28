"""Checks a torch.export archive before torch reads it.

`torch.export.load` trusts its file: it unpickles constants and inputs, evaluates expressions of
sizes and the code of guards, loads compiled libraries, finds functions by dotted names and writes
names into source code. Here everything but tensors as plain bytes, operators of torch and small
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

from torch.export.pt2_archive import PT2ArchiveReader

from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.weights.pickle_reader import PLAIN_NAMES, brief
from pnpdepth_cli.models.weights.torch_file import read_tensors

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
    (
        *("Symbol", "Integer", "Float", "Rational", "Add", "Mul", "Pow", "Max", "Min", "Abs"),
        *("Eq", "Equality", "Ne", "Unequality", "Lt", "StrictLessThan", "Le", "LessThan"),
        *("Gt", "StrictGreaterThan", "Ge", "GreaterThan", "And", "Or", "Not", "floor", "ceiling"),
        *("FloorDiv", "ModularIndexing", "Where", "PythonMod", "Mod", "CleanDiv", "CeilDiv"),
        *("CeilToInt", "FloorToInt", "TruncToInt", "TruncToFloat", "RoundToInt", "RoundDecimal"),
        *("ToFloat", "IntTrueDiv", "FloatTrueDiv", "PowByNatural", "FloatPow", "LShift", "RShift"),
        *("Identity", "IsNonOverlappingAndDenseIndicator"),
    )
)
_POWERS = frozenset({"Pow", "PowByNatural", "FloatPow", "LShift"})
_MAX_EXPONENT = 8
_MAX_POWERS = 4  # in one expression; together they keep every number below a few thousand digits
_MAX_EXPRESSION = 10_000  # characters
_MAX_DIGITS = 20
_EXPRESSIONS = (
    *(ast.Expression, ast.Call, ast.keyword, ast.Name, ast.Load, ast.Constant),
    *(ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Compare, ast.cmpop),
)


class _Refused(Exception):
    """What is refused, in a few words."""


def check_archive(file: Path) -> None:
    """Checks that reading and running the archive can only compute with tensors.

    Raises:
        ModelError: It could do something else.
    """
    reader = PT2ArchiveReader(str(file))
    try:
        names = reader.get_file_names()
        for name in names:
            if not _ENTRIES.fullmatch(name):
                raise _Refused(f"it holds {name[:80]!r}")
        with zipfile.ZipFile(file) as archive:  # torch reads an older layout by this, if it fails
            if sorted(name.partition("/")[2] for name in archive.namelist()) != sorted(names):
                raise _Refused("it holds other files for one reader than for another")
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise _Refused("it is compressed, which torch never does")
        for config in _CONFIGS:
            for name, meta in json.loads(reader.read_bytes(config))["config"].items():
                _word(name)
                if meta["use_pickle"] or not _WORD.fullmatch(meta["path_name"]):
                    raise _Refused(f"{name[:80]!r} is pickled")
        _check_inputs(reader.read_bytes(_INPUTS))
        _check(json.loads(reader.read_bytes(_MODEL)))
    except _Refused as refused:
        raise ModelError(
            f"exported program {file} is not read: {refused}, and only plain tensors and operators"
            " of torch are taken from such a file; export the network again, or to ONNX"
        ) from None


def _check_inputs(content: bytes) -> None:
    """The inputs are tensors in plain containers; anything else torch would unpickle and run."""
    try:
        _, named = read_tensors(io.BytesIO(content))
    except Exception as error:  # nothing but the file decides what is raised
        raise _Refused(f"its example inputs are not tensors ({brief(error)[:60]})") from None
    others = [name for name in named if not PLAIN_NAMES.fullmatch(name)]
    if others:
        raise _Refused(f"its example inputs are more than tensors ({', '.join(others)[:60]})")


def _check(value: Any) -> None:
    """Checks everything in the program that is called, evaluated or written as source code."""
    if isinstance(value, str):
        _word(value)
    for one in value if isinstance(value, list) else ():
        _check(one)
    for key, one in value.items() if isinstance(value, dict) else ():
        # The others are for people, or not evaluated (see `exported_definition`), or quoted.
        if key not in ("metadata", "guards_code", "as_string", "as_strings"):
            _check_entry(key, one)


def _check_entry(key: str, value: Any) -> None:
    if key == "range_constraints":
        _expressions(value)
    elif key == "expr_str":
        _expressions([value])
    elif key in ("in_spec", "out_spec") and isinstance(value, str):
        if not _TREE.fullmatch(value) or "\\u" in value or "__enum__" in value:
            raise _Refused(f"its {key} is not a nesting of plain containers")
    elif key == "target" and isinstance(value, str):
        called = _OPERATOR.fullmatch(value) and not _TOUCHES_FILES.match(value)
        if not called and not _ARITHMETIC.fullmatch(value):
            raise _Refused(f"it calls {value[:80]!r}")
    else:
        _word(key)
        _check(value)


def _word(text: str) -> None:
    if not _WORD.fullmatch(text):
        raise _Refused(f"{text[:80]!r} is not a name")


def _expressions(texts: Iterable[str]) -> None:
    for text in texts:
        try:
            nodes = list(ast.walk(ast.parse(text[:_MAX_EXPRESSION], mode="eval")))
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            nodes = []
        if not nodes or not all(map(_is_arithmetic, nodes)):
            raise _Refused(f"the size {text[:80]!r} is not arithmetic")
        powers = [exponent for node in nodes for exponent in _exponents(node)]
        if len(powers) > _MAX_POWERS or any(not _is_small(power) for power in powers):
            raise _Refused(f"the size {text[:80]!r} has powers without end")


def _is_arithmetic(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        short = len(node.value) <= _MAX_DIGITS or not node.value.isdigit()
        return short and _WORD.fullmatch(node.value) is not None
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return bool(abs(node.value) < 10**_MAX_DIGITS)
    return isinstance(node, _EXPRESSIONS)


def _exponents(node: ast.AST) -> list[ast.AST | None]:
    """The exponents of a power or of a shift; None for one that is given in no plain way."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow | ast.LShift):
        return [node.right]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _POWERS:
        return [node.args[1] if len(node.args) == 2 else None]
    return []


def _is_small(exponent: ast.AST | None) -> bool:
    """True for a small number, as 2, -1, Integer(2) or Rational(1, 2)."""
    if isinstance(exponent, ast.UnaryOp):
        return _is_small(exponent.operand)
    if isinstance(exponent, ast.Call) and isinstance(exponent.func, ast.Name):
        number = exponent.func.id in ("Integer", "Float", "Rational")
        return number and all(map(_is_small, exponent.args))
    value = exponent.value if isinstance(exponent, ast.Constant) else None
    try:
        return abs(float(value)) <= _MAX_EXPONENT  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
