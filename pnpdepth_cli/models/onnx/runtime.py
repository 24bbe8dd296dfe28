"""What onnxruntime computes: the check on the first image, and networks without a gradient."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.onnx.graph import OnnxGraph
from pnpdepth_cli.models.steps import largest_activation

MISMATCH = 1e-3
"""The largest deviation from onnxruntime's output, relative to that output's range."""

_HALF_MISMATCH = 1e-2  # half precision itself is no better
_ACTIVATION_BYTES = 8  # input and output of a node, in float32


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
    with _errors_name(file):
        return ort.InferenceSession(
            source, options, providers=["CPUExecutionProvider"], disabled_optimizers=disabled
        )


def _output_of(session: Any, inputs: Mapping[str, Tensor], file: Path) -> Tensor:
    """The first output in float32. ModelError, with the file, if it does not run."""
    halves = {i.name for i in session.get_inputs() if i.type == "tensor(float16)"}
    feed = {
        name: (value.half() if name in halves else value.float()).cpu().numpy()
        for name, value in inputs.items()
    }
    with _errors_name(file):
        return torch.from_numpy(session.run(None, feed)[0]).float()


@contextmanager
def _errors_name(file: Path) -> Iterator[None]:
    """Inside, what onnxruntime raises becomes a ModelError with the file."""
    from onnxruntime.capi import onnxruntime_pybind11_state as binding

    # It has a type for each of its status codes, and none for all of them.
    types = (kind for kind in vars(binding).values() if isinstance(kind, type))
    own = (kind for kind in types if issubclass(kind, Exception))
    raised: tuple[type[Exception], ...] = (*own, RuntimeError, ValueError)
    try:
        yield
    except raised as error:
        reason = describe(error)
        raise ModelError(f"ONNX file {file} does not run in onnxruntime: {reason}") from None


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
        expected = _output_of(session_of(self._source, self._file), inputs, self._file)
        deviation = _deviation(actual, expected)
        if not deviation <= (_HALF_MISMATCH if module.is_half else MISMATCH):
            raise ModelError(
                f"ONNX file {self._file}: its reading by torch differs from onnxruntime's by"
                f" {deviation:.2g} of the output's range"
            )
        self._note = f"ONNX: agrees with onnxruntime on this image to {deviation:.1g} of its range"
        return self._note


def _deviation(actual: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest expected value."""
    if actual.shape != expected.shape:
        return math.inf
    if not expected.numel():
        return 0.0
    known = expected.isfinite()
    both = known & actual.isfinite()  # a network may be inf or NaN in the sky
    if int((known != actual.isfinite()).sum()) > MISMATCH * expected.numel() or not both.any():
        return math.inf
    actual, expected = actual[both].float(), expected[both]
    largest, difference = float(expected.abs().amax()), float((actual - expected).abs().amax())
    return difference / largest if largest else difference


class Quantised(nn.Module):
    """A network whose activations are quantised: it predicts, but has no gradient.

    Its one layer, `output`, lets no gradient through.

    Args:
        source: File that onnxruntime reads, or the content of one.
        file: The network's file, for messages.
        stored: Bytes of its weights.
        input_name: Name of the image in the graph.

    Raises:
        ModelError: onnxruntime cannot open it.
    """

    def __init__(self, source: str | bytes, file: Path, stored: int, input_name: str) -> None:
        super().__init__()
        self._source, self._file, self._input_name = source, file, input_name
        self._given = stored
        self._session = self._session_for(stored)
        self.output = nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        """Returns the graph's output, each image of a batch on its own."""
        if image[0].numel() > self._given:  # larger images need more memory
            self._given = image[0].numel()
            self._session = self._session_for(2 * self._given)
        outputs = [
            _output_of(self._session, {self._input_name: one[None].detach()}, self._file)
            for one in image
        ]
        result: Tensor = self.output(torch.cat(outputs).to(image.device))
        return result.detach()

    def _session_for(self, given: int) -> Any:
        most = _ACTIVATION_BYTES * largest_activation(given)
        return session_of(self._source, self._file, most)
