"""What onnxruntime computes: the check on the first image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.onnx.graph import OnnxGraph

MISMATCH = 1e-3
"""The largest deviation from onnxruntime's output, relative to that output's range."""

_HALF_MISMATCH = 1e-2  # half precision itself is no better


class FirstImageCheck:
    """Compares the network with onnxruntime on the first image.

    Args:
        source: File that onnxruntime reads, or the content of one.
        file: The network's file, for messages.
    """

    def __init__(self, source: str | bytes, file: Path) -> None:
        self._source, self._file, self._note = source, file, ""

    def __call__(self, module: nn.Module, arguments: Sequence[Tensor]) -> str:
        """Returns how well they agree; compares only once. ModelError if they differ."""
        if self._note:
            return self._note
        assert isinstance(module, OnnxGraph)
        inputs = {n: a.detach() for n, a in zip(module.input_names, arguments, strict=True)}
        with torch.no_grad():
            actual = module(*arguments).cpu()  # first, since it allocates no more than it should
        deviation = _deviation(actual, self._expected(inputs))
        if not deviation <= (_HALF_MISMATCH if module.is_half else MISMATCH):
            raise ModelError(
                f"ONNX file {self._file}: its reading by torch differs from onnxruntime's by"
                f" {deviation:.2g} of the output's range"
            )
        self._note = f"ONNX: agrees with onnxruntime on this image to {deviation:.1g} of its range"
        return self._note

    def _expected(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """The output of onnxruntime on the CPU, in float32. ModelError if it does not run."""
        import onnxruntime as ort
        from onnxruntime.capi import onnxruntime_pybind11_state as binding

        options = ort.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = torch.get_num_threads()
        # It has a type of error for each of its status codes, and none for all of them.
        types = [kind for kind in vars(binding).values() if isinstance(kind, type)]
        own = [kind for kind in types if issubclass(kind, Exception)]
        raised: tuple[type[Exception], ...] = (*own, RuntimeError, ValueError)
        try:
            session = ort.InferenceSession(
                self._source, options, providers=["CPUExecutionProvider"]
            )
            halves = {i.name for i in session.get_inputs() if i.type == "tensor(float16)"}
            feed = {
                name: (value.half() if name in halves else value.float()).cpu().numpy()
                for name, value in inputs.items()
            }
            return torch.from_numpy(session.run(None, feed)[0]).float()
        except raised as error:
            reason = describe(error)
            raise ModelError(
                f"ONNX file {self._file} does not run in onnxruntime: {reason}"
            ) from None


def _deviation(actual: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest expected value."""
    if actual.shape != expected.shape:
        return math.inf
    known = expected.isfinite()
    both = known & actual.isfinite()  # a network may be inf or NaN in the sky
    if int((known != actual.isfinite()).sum()) > MISMATCH * expected.numel() or not both.any():
        return math.inf
    actual, expected = actual[both].float(), expected[both]
    largest, difference = float(expected.abs().amax()), float((actual - expected).abs().amax())
    return difference / largest if largest else difference
