"""The ONNX operators that depth networks use, in torch, each by the standard's own text.

https://onnx.ai/onnx/operators. Every version of an operator is read directly: what later became an
input is still taken as the attribute that it was.
"""

from __future__ import annotations

from pnpdepth_cli.models.formats.onnx.operators import (  # noqa: F401  (each fills the table)
    arithmetic,
    convolution,
    indexing,
    normalisation,
    resizing,
    shaping,
)
from pnpdepth_cli.models.formats.onnx.operators.table import OPERATORS, Node, Unsupported

__all__ = ["OPERATORS", "Node", "Unsupported"]
