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
from pnpdepth_cli.models.onnx.limits import largest_activation, nodes_in

_QUANTISES = re.compile("Quantize|QLinear|QGemm|Integer")  # not DequantizeLinear of weights

_ENDLESS = ("Loop", "Scan")
_ACTIVATION_BYTES = 8  # input and output of a node, in float32


def quantises(model: Any) -> bool:
    """Returns whether an onnx.ModelProto quantises activations, so that it has no gradient."""
    return any(_QUANTISES.search(node.op_type) for node in model.graph.node)


class Quantised(nn.Module):
    """The network as a module with one layer, `output`, which lets no gradient through.

    Args:
        source: File that onnxruntime reads, or the content of one.
        file: The network's file, for messages.
        model: The onnx.ModelProto.
        input_name: Name of the image in the graph.

    Raises:
        ModelError: onnxruntime cannot open it, or it has loops.
    """

    def __init__(self, source: str | bytes, file: Path, model: Any, input_name: str) -> None:
        super().__init__()
        if any(node.op_type in _ENDLESS for node in nodes_in(model.graph.node)):
            raise ModelError(f"ONNX file {file} is quantised and has loops, which are not covered")
        self._source, self._file, self._input_name = source, file, input_name
        self._given = sum(tensor.ByteSize() for tensor in model.graph.initializer)
        self._session = session_of(
            source, file, _ACTIVATION_BYTES * largest_activation(self._given)
        )
        self.output = nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        """Returns the graph's output, each image of a batch on its own."""
        if image[0].numel() > self._given:  # larger images need more memory
            self._given = image[0].numel()
            most = _ACTIVATION_BYTES * largest_activation(2 * self._given)
            self._session = session_of(self._source, self._file, most)
        outputs = [
            outputs_of(self._session, {self._input_name: one[None].detach().cpu()}, self._file)
            for one in image
        ]
        result: Tensor = self.output(torch.cat(outputs).to(image.device))
        return result.detach()


def session_of(source: str | bytes, file: Path, most_bytes: int | None = None) -> Any:
    """Returns an onnxruntime session on the CPU. ModelError, with the file, if it does not open.

    Args:
        source: A file, or the content of one.
        file: File of the network, for messages.
        most_bytes: Largest memory of the session; None is no limit.
    """
    import onnxruntime as ort

    options, disabled = ort.SessionOptions(), []
    options.log_severity_level = 4
    options.intra_op_num_threads = torch.get_num_threads()
    if most_bytes is not None:
        arena = ort.OrtMemoryInfo(
            "Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT
        )
        # With another strategy, the arena doubles.
        limits = ort.OrtArenaCfg({"max_mem": most_bytes, "arena_extend_strategy": 1})
        ort.create_and_register_allocator(arena, limits)  # in place of the one before
        options.add_session_config_entry("session.use_env_allocators", "1")
        disabled = ["ConstantFolding"]  # which allocates elsewhere
    try:
        return ort.InferenceSession(
            source, options, providers=["CPUExecutionProvider"], disabled_optimizers=disabled
        )
    except _errors_of_onnxruntime() as error:
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
    except _errors_of_onnxruntime() as error:
        raise _does_not_run(file, error) from None


def _errors_of_onnxruntime() -> tuple[type[Exception], ...]:
    """It has a type for each of its status codes, and none for all of them."""
    from onnxruntime.capi import onnxruntime_pybind11_state as binding

    types = (value for value in vars(binding).values() if isinstance(value, type))
    own = (kind for kind in types if issubclass(kind, Exception))
    return (*own, RuntimeError, ValueError)


def _does_not_run(file: Path, error: Exception) -> ModelError:
    return ModelError(f"ONNX file {file} does not run in onnxruntime: {describe(error)}")
