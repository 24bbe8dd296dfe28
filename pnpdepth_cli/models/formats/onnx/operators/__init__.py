"""The ONNX operators that depth networks use, in torch, each as the standard defines it.

https://onnx.ai/onnx/operators. Every version of an operator is covered: an attribute that later
became an input is read as either.
"""

from __future__ import annotations

from pnpdepth_cli.models.formats.onnx.operators import (  # noqa: F401  (each registers its operators)
    arithmetic,
    layers,
    resizing,
    tensors,
)
from pnpdepth_cli.models.formats.onnx.operators.table import (
    HOST_INPUTS,
    OPERATORS,
    Node,
    Unsupported,
)

__all__ = ["HOST_INPUTS", "OPERATORS", "Node", "Unsupported"]
