"""A graph that was read from a file, as a torch module that takes no more memory than it may.

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
    """One operation of a graph, as a module that calls a function.

    Args:
        title: The operation's name in messages, with its file.
        function: Function that computes it. Its ModelError says what use of the operator is not
            covered.
    """

    def __init__(self, title: str, function: Callable[..., object]) -> None:
        super().__init__()
        self.title = title
        self._function = function

    def forward(self, *args: object, **kwargs: object) -> object:
        """Returns the function's result.

        Raises:
            ModelError: This use of the operator is not covered; the message begins with the title.
        """
        try:
            return self._function(*args, **kwargs)
        except ModelError as error:
            raise ModelError(f"{self.title} is not covered: {error}") from None


class FileGraph(nn.Module):
    """A graph as a module: called with its inputs in order, it returns its outputs.

    Its operations are submodules in the file's order, so that the network can be cut at them. The
    first run for inputs of a size gives no result far larger than inputs and weights.

    It is built by `add_input`, `add_tensor` and `add_operation`, and finished by `set_outputs`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, fx.Node] = {}
        """What the graph computes so far, by the file's names; empty once it has its outputs."""
        self._graph = fx.Graph()
        self._checked_sizes: set[tuple[torch.Size, ...]] = set()
        """Shapes of all inputs with which a run stayed within its limits."""

    @property
    def inputs(self) -> list[str]:
        """The names of the inputs."""
        return [str(node.target) for node in self._graph.nodes if node.op == "placeholder"]

    def add_input(self, name: str) -> None:
        """Adds an input of this name behind those that were added before."""
        self.values[name] = self._graph.create_node("placeholder", name)

    def add_tensor(self, name: str, tensor: Tensor) -> fx.Node:
        """Adds a weight or another constant under its name in the file; returns its graph node.

        A gradient of it is never computed.
        """
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
        """Adds an operation whose result, or the entries of it, are further values of the graph.

        Args:
            name: Name of the submodule; one that is taken gets an underscore.
            operation: Operation that is called.
            inputs: Positional arguments, with values of the graph in them.
            keywords: Keyword arguments.
            outputs: Name of the result; or, of a tuple, the names of its entries, empty or None for
                one that nothing reads.
            is_layer: Whether the operation is a submodule, at which the network can be cut.
        """
        # A node of the file may be called `to`, as a method of every module is.
        while hasattr(self, name) or name in self._modules:
            name += "_"
        # fx calls a submodule by its name, and a function itself.
        if is_layer:
            self._modules[name] = operation  # not add_module, which refuses dots
            kind: str = "call_module"
            target: str | Operation = name
        else:
            kind = "call_function"
            target = operation
        result = self._graph.create_node(kind, target, tuple(inputs), dict(keywords), name)
        if isinstance(outputs, str):
            self.values[outputs] = result
            return
        for index, output in enumerate(outputs):
            if output:
                self.values[output] = self._graph.call_function(operator.getitem, (result, index))

    def set_outputs(self, names: Sequence[str]) -> None:
        """Ends the graph: forward returns the values of these names, a single one without a tuple.

        No more can be added afterwards.
        """
        values = tuple(self.values[name] for name in names)
        self._graph.output(values if len(values) > 1 else values[0])
        self.values.clear()

    def forward(self, *inputs: Tensor) -> object:
        """Returns the output, or a tuple of several.

        Raises:
            ModelError: One result is too large, all values at a time are, or there is too much
                arithmetic.
        """
        sizes = tuple(tensor.shape for tensor in inputs)
        if sizes in self._checked_sizes:
            return _Runner(self, math.inf).run(*inputs)
        # The first run of a size is under limits that follow from inputs and weights.
        stored_elements = _elements([*inputs, *self.parameters(), *self.buffers()])
        largest = max(_ACTIVATION_ELEMENTS, _ACTIVATION_GROWTH * stored_elements)
        pixels = max([tensor.shape[-2:].numel() for tensor in inputs], default=0)
        work = _WORK_PER_PIXEL * max(pixels, _LEAST_PIXELS)
        with SizeLimit(largest, work=work, work_is="of any published depth network"):
            result = _Runner(self, 2 * largest).run(*inputs)
        self._checked_sizes.add(sizes)
        return result


class _Runner(fx.Interpreter):
    """Runs a graph, and drops each value behind its last use.

    Args:
        module: The graph.
        most_elements: Elements that all values may have together at a time; infinite for no limit.
    """

    def __init__(self, module: FileGraph, most_elements: float) -> None:
        super().__init__(module, graph=module._graph)
        self.extra_traceback = False  # errors are shown by the operation's title
        self._most_elements = most_elements

    def call_module(
        self, target: Target, args: tuple[Argument, ...], kwargs: dict[str, object]
    ) -> object:
        """Returns the result of a submodule, whose name may have dots in it; fx calls this."""
        return self.submodules[str(target)](*args, **kwargs)

    def run_node(self, node: fx.Node) -> object:
        """Returns the result of one node of the graph; fx calls this.

        Unlike fx's own, it notes nothing for debuggers of graphs.

        Raises:
            ModelError: All values together have too many elements.
        """
        args, kwargs = self.fetch_args_kwargs_from_env(node)
        result = getattr(self, node.op)(node.target, args, kwargs)
        is_limited = self._most_elements < math.inf
        if is_limited and _elements([*self.env.values(), result]) > self._most_elements:
            raise ModelError(
                f"operation {node.name!r}: more than {self._most_elements:,} elements at a time,"
                " far more than image and weights"
            )
        return result


def _elements(values: object) -> int:
    """Returns the number of elements of all tensors in a nested structure."""
    return sum(map(torch.numel, _tensors_in(values)))


class SizeLimit(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Inside, an operation of torch that goes beyond a limit raises ModelError without being run.

    Args:
        largest: Elements that one operation's result may have.
        in_all: Elements that all results together may have; infinite for no limit.
        work: Elements read and products summed by all operations together; infinite for no limit.
        work_is: Arithmetic that is far less than `work`, as in "of any published depth network",
            for the message.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # without this mark, torch would import its whole compiler

    def __init__(
        self,
        largest: int,
        in_all: float = math.inf,
        work: float = math.inf,
        work_is: str = "on constants that networks have",
    ) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._largest = largest
        self._elements_left = in_all
        self._work_left = work
        self._work_is = work_is

    def __torch_dispatch__(
        self,
        func: OpOverload,
        types: object,
        args: tuple[object, ...] = (),
        kwargs: dict[str, object] | None = None,
    ) -> object:
        """Returns the operation's result if it is within the limits; torch calls this.

        See TorchDispatchMode.
        """
        kwargs = kwargs or {}
        # How large the result will be. A view, or a result in place, takes no memory.
        expected = _result_without_memory(func, args, kwargs)
        elements = [tensor.numel() for tensor in _tensors_in(expected)]
        is_view_or_in_place = any(entry.alias_info is not None for entry in func._schema.returns)
        if not is_view_or_in_place:
            self._elements_left -= sum(elements)
        if max(elements, default=0) > self._largest or self._elements_left < 0:
            raise ModelError(f"a result of {sum(elements):.3g} elements")
        # What it takes: the elements that are read, and half of torch's count of operations, as it
        # has a product and its sum as two.
        self._work_left -= sum(map(torch.numel, _tensors_in((args, kwargs))))
        count_operations = flop_registry.get(func.overloadpacket)
        if elements and count_operations is not None:
            self._work_left -= count_operations(*args, **kwargs, out_val=expected) / 2
        if self._work_left < 0:
            raise ModelError(f"far more arithmetic than that {self._work_is}")
        return func(*args, **kwargs)


def _result_without_memory(
    func: OpOverload, args: tuple[object, ...], kwargs: dict[str, object]
) -> object:
    """Returns tensors of the meta device that are at least as large as the operation's results.

    None if the result is a number, or the operation will fail.

    Args:
        func: Operation of torch.
        args: Positional arguments, with tensors of any device.
        kwargs: Keyword arguments, the same.

    Raises:
        ModelError: The size of the result follows from values.
    """
    # An operation that gets no tensor, or a device, makes a tensor; it is told the meta device.
    makes_tensor = "device" in kwargs or not _tensors_in((args, kwargs))
    args, kwargs = tree_map_only(Tensor, lambda tensor: tensor.to("meta"), (args, kwargs))
    if makes_tensor:
        kwargs = kwargs | {"device": "meta"}
    try:
        return result_without_values(func, args, kwargs)
    except NotImplementedError:  # torch says so where the meta device cannot know a result
        if func._opname not in _NUMBERS:
            raise ModelError("a result of a size that only its values tell") from None
        return None
    except (RuntimeError, ValueError, TypeError, IndexError):  # running it says what is wrong
        return None


def result_without_values(
    func: OpOverload, args: Sequence[object], kwargs: Mapping[str, object]
) -> object:
    """Returns the result of an operation on tensors of the meta device, which have no values.

    Where torch would write the operation out in smaller ones, it imports its compiler, which takes
    1 s. So the commonest operations are done here: batch normalisation, functions of single
    elements, and concatenation. All others are left to torch.
    """
    tensors = _tensors_in((args, kwargs))
    if not tensors or not all(tensor.is_meta for tensor in tensors):
        return func(*args, **kwargs)
    first = tensors[0]
    if func._opname in _BATCH_NORMS:
        # The output, and the statistics of the batch, which there are none of outside training.
        return torch.empty_like(first), first.new_empty(0), first.new_empty(0)
    has_one_dtype = all(tensor.dtype == first.dtype for tensor in tensors)
    if _is_elementwise(func) and has_one_dtype and first.dtype == torch.float32:
        return first.new_empty(_broadcast([tensor.shape for tensor in tensors]))
    has_one_rank = all(tensor.ndim == first.ndim for tensor in tensors)
    if func._opname == "cat" and has_one_dtype and has_one_rank and first.ndim > 0:
        axis = int(args[1]) if len(args) > 1 else 0  # type: ignore[call-overload]
        shape = list(first.shape)
        shape[axis] = sum(tensor.shape[axis] for tensor in tensors)
        return first.new_empty(shape)
    return func(*args, **kwargs)


def _is_elementwise(func: OpOverload) -> bool:
    """Whether an operation makes one new tensor, each element from one element of each argument.

    Those whose results are true or false do not count: the result has the arguments' type.
    """
    if torch.Tag.pointwise not in func.tags or func._schema.is_mutable:
        return False
    return func._opname not in _TRUTH_VALUES and len(func._schema.returns) == 1


def _broadcast(shapes: Sequence[Sequence[int]]) -> list[int]:
    """Returns the shape that tensors of these shapes are broadcast to, by the rules of NumPy.

    torch.broadcast_shapes does the same, but imports a package for symbols.
    """
    # Shapes are aligned at their last axis; missing axes have length 1.
    from_last = itertools.zip_longest(*map(reversed, shapes), fillvalue=1)
    broadcast = [next((side for side in sides if side != 1), 1) for sides in from_last]
    return broadcast[::-1]


def _tensors_in(value: object) -> list[Tensor]:
    """Returns all tensors in a nested structure, in order."""
    return [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]
