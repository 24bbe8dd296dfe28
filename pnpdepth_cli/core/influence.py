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
from pnpdepth_cli.core.split.tensors import storage_of, tensors_in
from pnpdepth_cli.core.spread import Spread, spread_of
from pnpdepth_cli.errors import ModelError, wrap_user_errors

_POSITIONS = ((0.5, 0.5), (0.35, 0.4), (0.65, 0.6))
"""Where points are placed, as fractions of height and width.

There are several, as what points influence differs by up to a stride."""

Patch = tuple[int, int]
"""Height and width of a patch."""


class Field(NamedTuple):
    """The influential field of a layer whose output is z: what one sparse point influences.

    The sizes are upper bounds: units that are zero for an image let nothing through.
    """

    in_z: Patch | None
    """Patch of z that the point's gradient reaches, in elements; None if z has no rows, columns."""
    in_output: Patch
    """Patch of the predicted depth that changes when that patch of z does, in pixels."""
    stride: float
    """Pixels of the predicted depth for each element of z; 0 if z has no rows and columns."""


def influential_fields(
    module: nn.Module,
    arguments: tuple[object, ...],
    layers: Iterable[str],
    prediction_of: Callable[[object], Tensor],
) -> dict[str, Field]:
    """Returns how far a sparse point near the image's centre reaches, by layer.

    A layer's sizes are the largest ones of a few points. A layer is left out that is not in the
    network, never runs, runs several times without a choice, or gives no single tensor.

    Args:
        module: The network, in eval mode.
        arguments: Its arguments for one frame, such as an image (1, 3, H, W); tensors on the device
            "meta", which have no values, are enough.
        layers: Names of layers as `Split` takes them.
        prediction_of: Function that takes what the network returns to its prediction, a tensor
            whose last two axes are rows and columns.

    Raises:
        ModelError: The network's forward fails.
    """
    # The layers that are in the network.
    cuts: dict[str, CutPoint] = {}
    for layer in layers:
        with suppress(ModelError):
            cuts[layer] = CutPoint.find(module, layer)
    # One pass, which follows the output of every layer from the hook of that layer on.
    follower = _Follower()
    with ExitStack() as hooks, torch.no_grad(), wrap_user_errors("the network's forward"):
        for cut in cuts.values():
            if not isinstance(cut.module, torch.jit.ScriptModule):  # which takes no such hook
                hooks.enter_context(cut.module.register_forward_hook(partial(follower.begin, cut)))
        with follower:
            prediction = prediction_of(module(*arguments))
    # What the prediction depends on in each layer that ran once, or in the call that was chosen.
    fields: dict[str, Field] = {}
    for layer, z_shape in follower.z_shapes.items():
        if cuts[layer].call is not None or follower.calls[layer] == 1:
            fields[layer] = _field(follower.spreads_from(layer, prediction), z_shape, prediction)
    return fields


def _field(spreads: list[Spread], z_shape: torch.Size, prediction: Tensor) -> Field:
    """What one point influences through a layer: the largest patches of points at `_POSITIONS`.

    Args:
        spreads: Where the prediction depends on the layer's output z, as `_Follower.spreads_from`
            gives it.
        z_shape: Shape of z.
        prediction: The prediction, whose last two axes are rows and columns.
    """
    patches = [_patches(spreads, prediction.shape, position) for position in _POSITIONS]
    in_z = _largest([patch.in_z for patch in patches])
    in_output = _largest([patch.in_output for patch in patches])
    if len(z_shape) != 4:  # z has no rows and columns
        return Field(None, in_output, stride=0.0)
    return Field(in_z, in_output, stride=prediction.shape[-2] / max(1, z_shape[-2]))


class _Patches(NamedTuple):
    """What one point influences."""

    in_z: Patch  # in elements of z
    in_output: Patch  # in pixels of the prediction


def _patches(
    spreads: list[Spread], prediction_shape: torch.Size, position: tuple[float, float]
) -> _Patches:
    """The patch of z that one pixel depends on, and the patch of pixels that depends on that one.

    Both are 0 × 0 if the pixel does not depend on z.

    Args:
        spreads: Where the prediction depends on the rows and on the columns of z; one of all of z
            if z has no rows and columns; none if the prediction does not depend on z.
        prediction_shape: Shape of the prediction, whose last two axes are rows and columns.
        position: Place of the pixel, as fractions of height and width.
    """
    nothing = _Patches((0, 0), (0, 0))
    if not spreads:
        return nothing
    # Height and width of the patches, one after the other.
    sizes_in_z: list[int] = []
    sizes_in_output: list[int] = []
    for number, fraction in enumerate(position):
        spread = spreads[number] if len(spreads) == 2 else spreads[0]
        axis = len(prediction_shape) - 2 + number
        first = spread.first[:, axis]
        last = spread.last[:, axis]
        # The rows (or columns) of z on which the pixel depends, then what depends on those.
        pixel = int(prediction_shape[axis] * fraction)
        reached = ((first <= pixel) & (pixel <= last)).nonzero()
        if not len(reached):
            return nothing
        sizes_in_z.append(int(reached[-1] - reached[0]) + 1)
        sizes_in_output.append(int(last[reached].max() - first[reached].min()) + 1)
    return _Patches((sizes_in_z[0], sizes_in_z[1]), (sizes_in_output[0], sizes_in_output[1]))


def _largest(patches: Sequence[Patch]) -> Patch:
    """The largest height and the largest width, which may be of two patches."""
    return max(height for height, _ in patches), max(width for _, width in patches)


_Geometry = tuple[int, torch.Size, tuple[int, ...]]
"""Offset, shape and strides of a tensor in its storage."""

_ROWS = 0
_COLUMNS = 1

_Source = tuple[str, int]
"""A layer, and whether the rows of its output are followed (`_ROWS`) or its columns (`_COLUMNS`).

An output without rows and columns is followed as a whole, under `_ROWS`."""


class _Input(NamedTuple):
    """An input of an operation, as it was before the operation ran."""

    place: int | None  # number of the argument; None of a tensor in a list or a keyword
    tensor: Tensor
    spreads: dict[_Source, Spread]  # where it depended on each source


class _Follower(TorchDispatchMode):
    """Follows what depends on the outputs of layers through every operation of a pass.

    A tensor is known by its place in memory, so that views and changes in place are followed too.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """False, for the reason that `core.split.watch.Watch` states."""
        return False

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.z_shapes: dict[str, torch.Size] = {}
        """Shape of z, the output, of each layer that is followed."""
        self.calls: Counter[str] = Counter()
        """How often each layer ran."""
        self._spreads: dict[int, dict[_Geometry, dict[_Source, Spread]]] = {}
        """Spreads of tensors by storage, place in it, and source."""

    def begin(self, cut: CutPoint, _module: nn.Module, _inputs: object, output: object) -> None:
        """Follows a layer's output from here on: a forward hook of the layer, after `cut`.

        Only one call of the layer is followed, the one that the cut names, or the first. An output
        without the tensor that the cut names is not followed.
        """
        self.calls[cut.layer] += 1
        followed_call = 1 if cut.call is None else cut.call
        if self.calls[cut.layer] != followed_call:
            return
        with suppress(ModelError):  # of `choose`, if there is no such tensor
            _, z = cut.choose(output)
            self.z_shapes[cut.layer] = z.shape
            spreads = self._spreads_of(z)
            if z.ndim == 4:
                spreads[cut.layer, _ROWS] = Spread.of_axis(z.shape, 2)
                spreads[cut.layer, _COLUMNS] = Spread.of_axis(z.shape, 3)
            else:
                spreads[cut.layer, _ROWS] = Spread.whole(z.shape or (1,), 1)

    def spreads_from(self, layer: str, tensor: Tensor) -> list[Spread]:
        """Returns where a tensor depends on the rows, and where on the columns of a layer's output.

        One spread if the output has no rows and columns; none if the tensor does not depend on it.
        """
        spreads = self._spreads_of(tensor)
        sources = [(layer, _ROWS), (layer, _COLUMNS)]
        return [spreads[source] for source in sources if source in spreads]

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: Sequence[object] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """Runs an operation of torch, and keeps where its outputs depend on the layers followed.

        Torch calls this for every operation while the mode is active.

        Returns:
            What the operation gives.
        """
        kwargs = kwargs or {}
        # The inputs. Their spreads are copied, as the operation may change an input in place.
        inputs: list[_Input] = []
        for path, tensor in tensors_in(args):
            place = int(path[0]) if len(path) == 1 else None  # a longer path leads into a list
            inputs.append(_Input(place, tensor, dict(self._spreads_of(tensor))))
        for _, tensor in tensors_in(kwargs):
            inputs.append(_Input(None, tensor, dict(self._spreads_of(tensor))))
        result = func(*args, **kwargs)
        input_storages = {storage_of(input_.tensor) for input_ in inputs}
        for number, (_, output) in enumerate(tensors_in(result)):
            # Where the output depends on each source, through any of the inputs.
            output_spreads: dict[_Source, Spread] = {}
            for place, tensor, input_spreads in inputs:
                for source, spread in input_spreads.items():
                    moved = spread_of(func, args, place, tensor, spread, output, number)
                    if moved is not None:
                        output_spreads[source] = moved.joined(output_spreads.get(source))
            if storage_of(output) not in input_storages:
                self._spreads[storage_of(output)] = {}  # new memory; what was there before is gone
            elif func._schema.is_mutable:
                self._widen_views(output, output_spreads)
            self._spreads.setdefault(storage_of(output), {})[_geometry(output)] = output_spreads
        return result

    def _spreads_of(self, tensor: Tensor) -> dict[_Source, Spread]:
        """The spreads of a tensor by source, to read and to change; empty where it has none."""
        places = self._spreads.setdefault(storage_of(tensor), {})
        return places.setdefault(_geometry(tensor), {})

    def _widen_views(self, written: Tensor, spreads: dict[_Source, Spread]) -> None:
        """After a change in place, every view of that memory depends on its sources everywhere.

        Which elements of another view were changed is not worked out.

        Args:
            written: The tensor that was changed.
            spreads: Where it depends on each source since.
        """
        for (_, shape, _), view_spreads in self._spreads.get(storage_of(written), {}).items():
            for source, spread in spreads.items():
                view_spreads[source] = Spread.whole(shape or (1,), len(spread.first))


def _geometry(tensor: Tensor) -> _Geometry:
    """Where in its storage a tensor lies: offset, shape and strides.

    A sparse tensor has no storage: its offset is 0, and it has no strides.
    """
    if tensor.layout != torch.strided:
        return 0, tensor.shape, ()
    return int(tensor.storage_offset()), tensor.shape, tensor.stride()
