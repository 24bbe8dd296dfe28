"""The influential field: how far one sparse point reaches through a cut network, by its shapes.

Both senses of the paper's term: the patch of z that the gradient of one point reaches (5×5 for two
3×3 convolutions), and the patch of the output that changes when that patch of z does (9×9 there).
All layers are measured in one pass, which may run on tensors without values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode

from pnpdepth_cli.core.split.cut_point import CutPoint
from pnpdepth_cli.core.split.tensors import tensors_in
from pnpdepth_cli.core.spread import Spread, spread_of
from pnpdepth_cli.errors import ModelError, wrap_user_errors

_POSITIONS = ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6))
"""Where points are placed, as fractions of height and width; a field may differ by a stride."""

Patch = tuple[int, int]
"""Height and width of a patch."""


class Field(NamedTuple):
    """What one point influences: a patch of z in elements, and of the output in pixels.

    The sizes are upper bounds: units that are zero for an image let nothing through. in_z: None if
    z has no two spatial axes. stride: pixels of the output for each element of z.
    """

    in_z: Patch | None
    in_output: Patch
    stride: float


def influential_fields(
    module: nn.Module,
    arguments: tuple[object, ...],
    layers: Iterable[str],
    prediction_of: Callable[[object], Tensor],
) -> dict[str, Field]:
    """Returns the largest fields of a few points near the centre of the image, by layer.

    A layer is left out that is not in the network, never runs, runs several times without a choice,
    or gives no single tensor.

    Args:
        module: The network, in eval mode.
        arguments: Its arguments for a frame.
        layers: Layers as `Split` takes them.
        prediction_of: Returns the prediction (1, 1, h, w) from what the network returns.
    """
    cuts: dict[str, CutPoint] = {}
    for layer in layers:
        with suppress(ModelError):
            cuts[layer] = CutPoint.find(module, layer)
    # One pass, which follows the output of every layer from the hook of that layer on.
    follower = _Follower()
    with ExitStack() as hooks, torch.no_grad(), wrap_user_errors("the network's forward"):
        for cut in cuts.values():
            if not isinstance(cut.module, torch.jit.ScriptModule):
                hooks.enter_context(cut.module.register_forward_hook(partial(follower.begin, cut)))
        with follower:
            prediction = prediction_of(module(*arguments))
    return {
        layer: _field(follower.followed(layer, prediction), shape, prediction)
        for layer, shape in follower.shapes.items()
        if cuts[layer].call is not None or follower.calls[layer] == 1
    }


def _field(spreads: list[Spread], shape: torch.Size, prediction: Tensor) -> Field:
    """The field of a layer whose output has this shape."""
    patches = [_patches(spreads, prediction, position) for position in _POSITIONS]
    in_z = _largest([patch.in_z for patch in patches])
    in_output = _largest([patch.in_output for patch in patches])
    if len(shape) != 4:  # z has no rows and columns
        return Field(None, in_output, stride=0.0)
    return Field(in_z, in_output, stride=prediction.shape[-2] / max(1, shape[-2]))


class _Patches(NamedTuple):
    """What one point influences: a patch of z in elements, and of the output in pixels."""

    in_z: Patch
    in_output: Patch


def _patches(spreads: list[Spread], prediction: Tensor, position: tuple[float, float]) -> _Patches:
    """The patches of a point at this position of the prediction, from its gradient and back."""
    in_z = [0, 0]
    in_output = [0, 0]
    for side, fraction in enumerate(position):
        # The spreads are those of the rows of z and of its columns, or of z as a whole.
        axis = prediction.ndim - 2 + side
        for spread in spreads[side : side + 1] or spreads:
            first, last = spread.first[:, axis], spread.last[:, axis]
            point = int(prediction.shape[axis] * fraction)
            # The rows of z on which the point depends, then what depends on those rows.
            reached = ((first <= point) & (point <= last)).nonzero()
            if len(reached):
                in_z[side] = int(reached[-1] - reached[0]) + 1
                in_output[side] = int(last[reached].max() - first[reached].min()) + 1
    if not all(in_z):
        return _Patches((0, 0), (0, 0))
    return _Patches((in_z[0], in_z[1]), (in_output[0], in_output[1]))


def _largest(patches: Sequence[Patch]) -> Patch:
    """The largest height and the largest width, which may be of two patches."""
    return max(height for height, _ in patches), max(width for _, width in patches)


_Geometry = tuple[int, torch.Size, tuple[int, ...]]
"""Offset, shape and strides of a tensor in its storage."""

_ROWS = 0
_COLUMNS = 1

_Source = tuple[str, int]
"""A layer, and `_ROWS` of its output, also for all of an output without rows, or `_COLUMNS`."""


class _Follower(TorchDispatchMode):
    """Follows what depends on the outputs of layers through every operation of a pass.

    A tensor is known by its place in memory, so that views and changes in place are followed too.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # as in `Watch`

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.shapes: dict[str, torch.Size] = {}
        """Shapes of the outputs of the layers that ran."""
        self.calls: Counter[str] = Counter()
        """How often each layer ran."""
        self._followed: dict[int, dict[_Geometry, dict[_Source, Spread]]] = {}
        """Spreads of tensors by storage, place in it, and source."""

    def begin(self, cut: CutPoint, _module: nn.Module, _inputs: object, output: object) -> None:
        """Follows a layer's output from here on, if this is the call that is cut at; a hook."""
        self.calls[cut.layer] += 1
        if self.calls[cut.layer] != (cut.call or 1):
            return
        with suppress(ModelError):
            _, z = cut.choose(output)
            self.shapes[cut.layer] = z.shape
            spreads = self._spreads_of(z)
            if z.ndim == 4:
                spreads[cut.layer, _ROWS] = Spread.of_axis(z.shape, 2)
                spreads[cut.layer, _COLUMNS] = Spread.of_axis(z.shape, 3)
            else:
                spreads[cut.layer, _ROWS] = Spread.whole(z.shape or (1,), 1)

    def followed(self, layer: str, tensor: Tensor) -> list[Spread]:
        """Returns where a tensor depends on the rows and the columns of a layer's output.

        One spread if the output has no rows and columns; none if the tensor does not depend on it.
        """
        spreads = self._spreads_of(tensor)
        return [spreads[layer, side] for side in (_ROWS, _COLUMNS) if (layer, side) in spreads]

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """Runs an operation of torch, and keeps where its outputs depend on the layers followed.

        Returns:
            What the operation gives.
        """
        kwargs = kwargs or {}
        # Inputs by the number of the argument; those in lists and keywords have none.
        inputs = [
            (int(path[0]) if len(path) == 1 else None, tensor) for path, tensor in tensors_in(args)
        ]
        inputs += [(None, tensor) for _, tensor in tensors_in(kwargs)]
        # Their spreads are copied first, as the operation may change an input in place.
        before = [(index, tensor, dict(self._spreads_of(tensor))) for index, tensor in inputs]
        result = func(*args, **kwargs)
        storages = {_storage(tensor) for _, tensor in inputs}
        for position, (_, output) in enumerate(tensors_in(result)):
            # Where the output depends on each source, through any of the inputs.
            output_spreads: dict[_Source, Spread] = {}
            for index, tensor, input_spreads in before:
                for source, spread in input_spreads.items():
                    moved = spread_of(func, args, index, tensor, spread, output, position)
                    if moved is not None:
                        output_spreads[source] = moved.joined(output_spreads.get(source))
            if _storage(output) not in storages:
                self._followed[_storage(output)] = {}  # new memory; what was there before is gone
            elif func._schema.is_mutable:
                self._spoil(output, output_spreads)
            self._followed.setdefault(_storage(output), {})[_geometry(output)] = output_spreads
        return result

    def _spreads_of(self, tensor: Tensor) -> dict[_Source, Spread]:
        """The spreads of a tensor by source, to read and to change; empty where it has none."""
        places = self._followed.setdefault(_storage(tensor), {})
        return places.setdefault(_geometry(tensor), {})

    def _spoil(self, written: Tensor, spreads: dict[_Source, Spread]) -> None:
        """Notes a change in place: other views of the same memory may depend on all of it."""
        for (_, shape, _), view_spreads in self._followed.get(_storage(written), {}).items():
            for source, spread in spreads.items():
                view_spreads[source] = Spread.whole(shape or (1,), len(spread.first))


def _storage(tensor: Tensor) -> int:
    """A number that tensors in the same memory share."""
    try:
        return int(tensor.untyped_storage()._cdata)
    except NotImplementedError:  # a sparse tensor has none
        return 0


def _geometry(tensor: Tensor) -> _Geometry:
    """Where in its storage a tensor lies; a sparse tensor is told by its shape alone."""
    if tensor.layout != torch.strided:
        return 0, tensor.shape, ()
    return int(tensor.storage_offset()), tensor.shape, tensor.stride()
