"""An ONNX network with quantised activations: it predicts, by onnxruntime, but has no gradient."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError

_QUANTISES = re.compile("Quantize|QLinear|QGemm|Integer")  # not DequantizeLinear of weights


def quantises(model: Any) -> bool:
    """Returns whether an onnx.ModelProto quantises activations, so that it has no gradient."""
    return any(_QUANTISES.search(node.op_type) for node in model.graph.node)


class Quantised(nn.Module):
    """The network as a module with one layer, `output`, which lets no gradient through.

    Args:
        source: What onnxruntime reads: a file, or the content of one.
        file: The network's file, for messages.
        input_name: Name of the image in the graph.

    Raises:
        ModelError: onnxruntime cannot open it.
    """

    def __init__(self, source: str | bytes, file: Path, input_name: str) -> None:
        super().__init__()
        self._session, self._file, self._input_name = session_of(source, file), file, input_name
        self.output = nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        """Returns the graph's output, each image of a batch on its own."""
        outputs = [
            outputs_of(self._session, {self._input_name: one[None].detach().cpu()}, self._file)
            for one in image
        ]
        result: Tensor = self.output(torch.cat(outputs).to(image.device))
        return result.detach()


def session_of(source: str | bytes, file: Path) -> Any:
    """Returns an onnxruntime session on the CPU. ModelError, with the file, if it does not open."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a type for each of its status codes
        raise _does_not_run(file, error) from None


def outputs_of(session: Any, inputs: Mapping[str, Tensor], file: Path) -> Tensor:
    """Returns the first output in float32. ModelError, with the file, if it does not run."""
    halves = {i.name for i in session.get_inputs() if i.type == "tensor(float16)"}
    feed = {
        name: value.half().numpy() if name in halves else value.float().numpy()
        for name, value in inputs.items()
    }
    try:
        return torch.from_numpy(session.run(None, feed)[0]).float()
    except Exception as error:
        raise _does_not_run(file, error) from None


def _does_not_run(file: Path, error: Exception) -> ModelError:
    return ModelError(f"ONNX file {file} does not run in onnxruntime: {describe(error)}")
