"""A graph that was read from a file, as a torch module that is run without endless memory.

ConstantOfShape, Tile, Pad, Expand and many other operators can turn a few bytes of a file into
gigabytes; `SizeLimit` knows the size of every result before it is allocated.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, fx, nn
from torch._ops import OpOverload
from torch.fx.node import Argument, Target
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only
from torch.utils.flop_counter import flop_registry

from pnpdepth_cli.errors import ModelError

_ACTIVATION_ELEMENTS = 1 << 28
_ACTIVATION_GROWTH = 64
"""One activation may have so many elements (1 GB), or so many times those of input and weights."""

_WORK_PER_PIXEL = 1 << 24
"""Products summed, and elements read, for each pixel of the first input. Depth Anything V2 has
3.4e6 with ViT-L and about 8e6 with ViT-g, Depth Pro about 4e6 (parameters × tokens ÷ pixels)."""

_LEAST_PIXELS = 1 << 16
"""Inputs of fewer pixels may take as much arithmetic as one of 256×256: half a minute of a core."""

_NUMBERS = ("item", "_local_scalar_dense", "equal")
"""Operators of torch whose result is a Python number."""

_BATCH_NORMS = ("native_batch_norm", "_native_batch_norm_legit_no_training")

_TRUTH_VALUES = (
    "eq",
    "ne",
    "lt",
    "le",
    "gt",
    "ge",
    "isnan",
    "isinf",
    "isfinite",
    "isposinf",
    "isneginf",
    "signbit",
    "logical_and",
    "logical_or",
    "logical_xor",
    "logical_not",
    "isclose",
    "isreal",
)
"""Functions of single elements whose result is true or false."""


class Operation(nn.Module):
    """One operation of a graph: a function, and what it is called in messages.

    A ModelError of the function says what use of the operator is not covered.
    """

    def __init__(self, title: str, function: Callable[..., object]) -> None:
        super().__init__()
        self.title, self._function = title, function

    def forward(self, *args: object, **kwargs: object) -> object:
        """Returns the function's result."""
        try:
            return self._function(*args, **kwargs)
        except ModelError as error:
            raise ModelError(f"{self.title} is not covered: {error}") from None


class FileGraph(nn.Module):
    """A graph as a module: called with its inputs in order, it returns its outputs.

    Its operations are submodules in the file's order, so that the network can be cut at them. The
    first run for inputs of a size gives no result far larger than inputs and weights.
    """

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, fx.Node] = {}
        """What the graph computes so far, by the file's names; empty once it has its outputs."""
        self._graph = fx.Graph()
        self._allowed: set[tuple[torch.Size, ...]] = set()

    @property
    def inputs(self) -> list[str]:
        """The names of the inputs."""
        return [str(node.target) for node in self._graph.nodes if node.op == "placeholder"]

    def add_input(self, name: str) -> None:
        """Adds an input behind the others."""
        self.values[name] = self._graph.create_node("placeholder", name)

    def add_tensor(self, name: str, tensor: Tensor) -> fx.Node:
        """Returns the value of a weight or another constant, which is added without gradient."""
        attribute = f"tensor{len(self.values)}"
        if tensor.is_floating_point():
            self.register_parameter(attribute, nn.Parameter(tensor, requires_grad=False))
        else:
            self.register_buffer(attribute, tensor)
        self.values[name] = self._graph.create_node("get_attr", attribute)
        return self.values[name]

    def add_operation(
        self,
        name: str,
        operation: Operation,
        inputs: Sequence[Argument],
        keywords: Mapping[str, Argument],
        outputs: str | Sequence[str | None],
        *,
        is_layer: bool = True,
    ) -> None:
        """Adds a call whose result, or the parts of it, are further values.

        Args:
            name: Name of the submodule; one that is taken gets an underscore.
            operation: What is called.
            inputs: Positional arguments, with values of the graph in them.
            keywords: Keyword arguments.
            outputs: Name of the result, or names of its parts, empty for one that nothing reads.
            is_layer: Whether the operation is a submodule.
        """
        while hasattr(self, name) or name in self._modules:  # as of a node named `to`
            name += "_"
        kind: str = "call_module" if is_layer else "call_function"
        if is_layer:
            self._modules[name] = operation  # not add_module, which refuses dots
        target = name if is_layer else operation
        result = self._graph.create_node(kind, target, tuple(inputs), dict(keywords), name)
        if isinstance(outputs, str):
            self.values[outputs] = result
            return
        for index, output in enumerate(outputs):
            if output:
                self.values[output] = self._graph.call_function(operator.getitem, (result, index))

    def set_outputs(self, names: Sequence[str]) -> None:
        """Ends the graph: these values are returned, a single one alone."""
        values = tuple(self.values[name] for name in names)
        self._graph.output(values if len(values) > 1 else values[0])
        self.values.clear()

    def forward(self, *inputs: Tensor) -> object:
        """Returns the output, or a tuple of several.

        Raises:
            ModelError: A result is too large, all at a time are, or it is too much arithmetic.
        """
        sizes = tuple(tensor.shape for tensor in inputs)
        if sizes in self._allowed:
            return _Runner(self, math.inf).run(*inputs)
        given = _elements([*inputs, *self.parameters(), *self.buffers()])
        largest = max(_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH * given)
        pixels = max([tensor.shape[-2:].numel() for tensor in inputs], default=0)
        work = _WORK_PER_PIXEL * max(pixels, _LEAST_PIXELS)
        with SizeLimit(largest, work=work, work_is="of any published depth network"):
            result = _Runner(self, 2 * largest).run(*inputs)
        self._allowed.add(sizes)
        return result


class _Runner(fx.Interpreter):
    """Runs a graph with so many elements at a time; a value is dropped behind its last use."""

    def __init__(self, module: FileGraph, most: float) -> None:
        super().__init__(module, graph=module._graph)
        self.extra_traceback = False
        self._most = most

    def call_module(
        self, target: Target, args: tuple[Argument, ...], kwargs: dict[str, object]
    ) -> object:
        """The result of a submodule, whose name may have dots in it."""
        return self.submodules[str(target)](*args, **kwargs)

    def run_node(self, node: fx.Node) -> object:
        """The node's result, without what debuggers of graphs would note of it."""
        args, kwargs = self.fetch_args_kwargs_from_env(node)
        result = getattr(self, node.op)(node.target, args, kwargs)
        if self._most < math.inf and _elements([*self.env.values(), result]) > self._most:
            raise ModelError(
                f"operation {node.name!r}: more than {self._most:,} elements at a time, far more"
                " than image and weights"
            )
        return result


def _elements(values: object) -> int:
    return sum(map(torch.numel, _tensors_in(values)))


class SizeLimit(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Inside, an operation with a result of too many elements raises ModelError without being run.

    Args:
        largest: Elements of one result.
        in_all: Elements of all results together, or no limit.
        work: Elements read and products summed by all operations together, or no limit.
        work_is: What `work` is far more than, for the message.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # As in `Watch`: without this mark, torch would import its whole compiler.
        return False

    def __init__(
        self,
        largest: int,
        in_all: float = math.inf,
        work: float = math.inf,
        work_is: str = "on constants that networks have",
    ) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._largest = largest
        self._left = in_all
        self._work = work
        self._work_is = work_is

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: tuple[object, ...] = (),
        kwargs: dict[str, object] | None = None,
    ) -> object:
        """Runs the operation if its result fits; see TorchDispatchMode."""
        kwargs = kwargs or {}
        expected = _shaped_result(func, args, kwargs)
        elements = [tensor.numel() for tensor in _tensors_in(expected)]
        in_place_or_view = any(returned.alias_info is not None for returned in func._schema.returns)
        self._left -= 0 if in_place_or_view else sum(elements)
        if max(elements, default=0) > self._largest or self._left < 0:
            raise ModelError(f"a result of {sum(elements):.3g} elements")
        self._work -= sum(map(torch.numel, _tensors_in((args, kwargs))))
        if elements and func.overloadpacket in flop_registry:
            self._work -= flop_registry[func.overloadpacket](*args, **kwargs, out_val=expected) / 2
        if self._work < 0:
            raise ModelError(f"far more arithmetic than that {self._work_is}")
        return func(*args, **kwargs)


def _shaped_result(func: OpOverload, args: tuple[object, ...], kwargs: dict[str, object]) -> object:
    """Tensors without memory that are at least as large as the operation's results."""
    without = {"device": "meta"} if "device" in kwargs or not _tensors_in((args, kwargs)) else {}
    args, kwargs = tree_map_only(Tensor, lambda tensor: tensor.to("meta"), (args, kwargs))
    try:
        return result_without_values(func, args, kwargs | without)
    except NotImplementedError:
        if func._opname not in _NUMBERS:
            raise ModelError("a result of a size that only its values tell") from None
        return None
    except (RuntimeError, ValueError, TypeError, IndexError):  # running it says what is wrong
        return None


def result_without_values(
    func: OpOverload, args: Sequence[object], kwargs: Mapping[str, object]
) -> object:
    """Returns the result of an operation on tensors of the meta device.

    Where torch would write it out in smaller operations, it imports its compiler, which takes 1 s.
    The commonest operations need none.
    """
    tensors = _tensors_in((args, kwargs))
    first = tensors[0] if tensors else None
    if first is None or not all(tensor.is_meta for tensor in tensors):
        return func(*args, **kwargs)
    if func._opname in _BATCH_NORMS:
        return torch.empty_like(first), first.new_empty(0), first.new_empty(0)
    plain = torch.Tag.pointwise in func.tags and not func._schema.is_mutable
    plain = plain and func._opname not in _TRUTH_VALUES and len(func._schema.returns) == 1
    same = all(tensor.dtype == first.dtype for tensor in tensors)
    if plain and same and first.dtype == torch.float32:
        return first.new_empty(_broadcast([tensor.shape for tensor in tensors]))
    if (
        func._opname == "cat"
        and same
        and len({tensor.ndim for tensor in tensors}) == 1
        and first.ndim
    ):
        axis = int(args[1]) if len(args) > 1 else 0  # type: ignore[call-overload]
        shape = list(first.shape)
        shape[axis] = sum(tensor.shape[axis] for tensor in tensors)
        return first.new_empty(shape)
    return func(*args, **kwargs)


def _broadcast(shapes: Sequence[Sequence[int]]) -> list[int]:
    """The shape of a function of single elements of tensors that have these shapes."""
    # torch.broadcast_shapes imports a package for symbols.
    sides = itertools.zip_longest(*map(reversed, shapes), fillvalue=1)
    return [next((size for size in sizes if size != 1), 1) for sizes in sides][::-1]


def _tensors_in(value: object) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]
