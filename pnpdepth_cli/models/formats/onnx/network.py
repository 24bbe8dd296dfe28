"""An ONNX file as a definition. Its reading by torch is not trusted: onnxruntime checks it.

`net.onnx`, or `net.onnx:OUTPUT` where the graph has several outputs. Needs `pip install
pnpdepth[onnx]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.user_code import describe
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.definition import FOREIGN, Fixed, ModelDefinition, Multiple
from pnpdepth_cli.models.formats.onnx.graph import OnnxGraph

MISMATCH = 1e-3
"""The largest deviation from onnxruntime's output, relative to that output's range."""

_HALF_MISMATCH = 1e-2  # half precision itself is no better
_NEWEST = 24
_MULTIPLE = 32


def onnx_definition(file: Path, output: str | None = None) -> ModelDefinition:
    """The definition of an ONNX depth network. ModelError where it cannot be run."""
    model = _inlined(_read(file))
    picture = _picture_of(model, file)
    chosen = _chosen_output(model, output, file)
    channels_last = _channels_last(picture)
    height, width = picture[1:3] if channels_last else picture[2:4]
    fixed = isinstance(height, int) and isinstance(width, int)
    return ModelDefinition(
        name=file.stem,
        input_kind="rgb",
        size=Fixed(int(height), int(width)) if fixed else Multiple(_patch(model) or _MULTIPLE),
        build=lambda: OnnxGraph(model, file, [chosen]),
        complete=True,
        normalisation=None,
        defaults=FOREIGN,
        summary=f"ONNX, opset {_opset(model)}, from {model.producer_name or 'an unknown program'}",
        output_kind="unknown",
        output_scale="unknown",
        checkpoint=file,
        arguments=lambda rgb, _: (_as_input(rgb, channels_last),),
        output=_as_map,
        verify=_FirstPictureCheck(file, chosen),
    )


def _as_input(rgb: Tensor | None, channels_last: bool) -> Tensor:
    assert rgb is not None
    return rgb.permute(0, 2, 3, 1).contiguous() if channels_last else rgb


def _as_map(output: Any) -> Tensor:
    tensor: Tensor = output
    last = tensor.ndim == 4 and tensor.shape[-1] == 1 and tensor.shape[1] != 1
    return tensor.permute(0, 3, 1, 2) if last else tensor


def _read(file: Path) -> Any:
    if not file.is_file():
        raise ModelError(f"ONNX file {file} does not exist")
    try:
        import onnx
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ModelError(
            f"{file} is an ONNX file, which needs the package {error.name!r}:"
            " pip install 'pnpdepth[onnx]'"
        ) from None
    try:
        model = onnx.load(str(file))
    except Exception as error:  # protobuf's own errors, missing external data, …
        raise ModelError(f"ONNX file {file} cannot be read: {describe(error)}") from None
    if not model.graph.node:
        raise ModelError(f"ONNX file {file} cannot be read: it holds no graph")
    if _opset(model) > _NEWEST:
        raise ModelError(
            f"ONNX file {file} is of opset {_opset(model)}, newer than {_NEWEST}; export an older"
        )
    return model


def _opset(model: Any) -> int:
    return max((o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), default=1)


def _inlined(model: Any) -> Any:
    """The model without functions of its own."""
    if not model.functions:
        return model
    from onnx import inliner

    return inliner.inline_local_functions(model)


def _picture_of(model: Any, file: Path) -> list[int | str]:
    """The shape of the only input. ModelError if that is no batch of one rgb picture."""
    constants = {tensor.name for tensor in model.graph.initializer}
    inputs = {i.name: _shape(i) for i in model.graph.input if i.name not in constants}
    said = ", ".join(f"{name} {'×'.join(map(str, shape))}" for name, shape in inputs.items())
    if len(inputs) != 1:
        raise ModelError(
            f"ONNX file {file} has {len(inputs)} inputs ({said}); only one, an rgb picture, can be"
            " handed in"
        )
    shape = next(iter(inputs.values()))
    channels = shape[-1] if len(shape) == 4 and _channels_last(shape) else shape[1:2] == [3]
    batch = not shape or not isinstance(shape[0], int) or shape[0] == 1
    if len(shape) != 4 or not channels or not batch:
        raise ModelError(
            f"ONNX file {file} takes {said}; one rgb picture 1×3×H×W or 1×H×W×3 is expected"
        )
    return shape


def _channels_last(shape: Sequence[int | str]) -> bool:
    return shape[3] == 3 and shape[1] != 3


def _shape(value: Any) -> list[int | str]:
    dims = value.type.tensor_type.shape.dim
    return [d.dim_value if d.dim_value > 0 else d.dim_param or "?" for d in dims]


def _chosen_output(model: Any, wanted: str | None, file: Path) -> str:
    outputs: dict[str, list[int | str]] = {o.name: _shape(o) for o in model.graph.output}
    if wanted is None and len(outputs) == 1:
        return next(iter(outputs))
    if wanted in outputs:
        return str(wanted)
    listed = ", ".join(f"{n} {'×'.join(map(str, s))}" for n, s in outputs.items())
    first = next(iter(outputs), "OUTPUT")
    asked = f"no output {wanted!r}" if wanted else f"{len(outputs)} outputs"
    raise ModelError(
        f"ONNX file {file} has {asked}; name the depth as --model {file}:{first}; it has {listed}"
    )


def _patch(model: Any) -> int | None:
    """The patch size of a vision transformer: a convolution that steps by its own kernel."""
    for node in model.graph.node:
        if node.op_type == "Conv":
            by_name = {a.name: list(a.ints) for a in node.attribute}
            kernel, stride = by_name.get("kernel_shape", []), by_name.get("strides", [])
            if kernel == stride and kernel and min(kernel) >= 8:
                return int(kernel[0])
    return None


class _FirstPictureCheck:
    """The network agrees with onnxruntime on the first picture that it is given."""

    def __init__(self, file: Path, output: str) -> None:
        self._file, self._output, self._note = file, output, ""

    def __call__(self, module: nn.Module, arguments: Sequence[Tensor]) -> str:
        """What to say of the check; it is made once. ModelError if they differ."""
        if self._note:
            return self._note
        assert isinstance(module, OnnxGraph)
        model = _read(self._file)
        inputs = [argument.detach().cpu() for argument in arguments]
        true = _run(model, [self._output], module.input_names, inputs, self._file)[0]
        with torch.no_grad():
            ours = module(*arguments).cpu()
        limit = _HALF_MISMATCH if _is_half(model) else MISMATCH
        off = _deviation(ours, true)
        if not off <= limit:
            raise ModelError(
                f"ONNX file {self._file}: its reading by torch differs from onnxruntime's by"
                f" {off:.2g} of the output's range{self._first_difference(model, module, inputs)}"
            )
        self._note = f"ONNX: agrees with onnxruntime on this picture to {off:.1g} of its range"
        return self._note

    def _first_difference(self, model: Any, module: OnnxGraph, inputs: list[Tensor]) -> str:
        import onnx

        module = module.cpu()
        with torch.no_grad():
            ours = [v for v in module.every_value(*inputs) if v[1] and v[2].is_floating_point()]
        known = {o.name for o in model.graph.output}
        model.graph.output.extend(
            onnx.ValueInfoProto(name=value) for _, value, _ in ours if value not in known
        )
        names = [value for _, value, _ in ours]
        theirs = _run(model, names, module.input_names, inputs, self._file)
        for (node, _, value), true in zip(ours, theirs, strict=True):
            if not _deviation(value, true) <= MISMATCH:
                return f"; the first node that differs is {node!r} ({module._modules[node]})"
        return "; no single node differs by as much"


def _run(
    model: Any, outputs: list[str], names: Sequence[str], inputs: Sequence[Tensor], file: Path
) -> list[Tensor]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        # By its path while it is as on disk: weights may lie in files beside it.
        source = str(file) if len(model.graph.output) == len(_read(file).graph.output) else None
        session = onnxruntime.InferenceSession(
            source or model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        halves = {i.name for i in session.get_inputs() if i.type == "tensor(float16)"}
        feed = {
            name: value.half().numpy() if name in halves else value.numpy()
            for name, value in zip(names, inputs, strict=True)
        }
        return [torch.from_numpy(value).float() for value in session.run(outputs, feed)]
    except Exception as error:  # onnxruntime has a type for each of its status codes
        raise ModelError(
            f"ONNX file {file} does not run in onnxruntime: {describe(error)}"
        ) from None


def _is_half(model: Any) -> bool:
    from onnx import TensorProto

    return any(t.data_type == TensorProto.FLOAT16 for t in model.graph.initializer)


def _deviation(ours: Tensor, true: Tensor) -> float:
    """The largest difference relative to the range of the true values."""
    if ours.shape != true.shape:
        return float("inf")
    if not true.numel():
        return 0.0
    spread = float(true.abs().max())
    return float((ours.float() - true).abs().max()) / spread if spread else float(ours.abs().max())
