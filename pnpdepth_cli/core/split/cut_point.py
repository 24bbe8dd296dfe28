"""The layer where a network is cut: its notation, and the errors of one that cannot be cut."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.split.tensors import tensors_in
from pnpdepth_cli.errors import ModelError

_NAME = re.compile(r"(?P<module>[^#\[\]]*)(?:#(?P<call>\d+))?(?P<keys>(?:\[[^\[\]]+\])*)")
"""`module`, `module#2` for its second call, `module[key]` for one of its outputs."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CutPoint:
    """The layer to cut at, and the submodules around it."""

    layer: str  # the layer as the user named it
    name: str  # the submodule's
    call: int | None  # number of the submodule's call, from 1; None if there is one
    key: tuple[str, ...]  # path of z in nested containers; empty if there is one output
    module: nn.Module
    modules: Mapping[str, nn.Module]
    """All submodules by name; one with several names comes several times."""
    containers: frozenset[nn.Module]  # the submodules that contain the layer, itself included
    hooked: frozenset[str]  # names of the submodules with hooks
    around_hooks: frozenset[nn.Module]
    """The submodules with a hooked submodule, whose hooks would not run if they were cached."""

    @classmethod
    def find(cls, network: nn.Module, layer: str) -> CutPoint:
        """Returns the cut point of that name.

        Args:
            network: The network.
            layer: Name of a submodule, `NAME#2` for its second call, `NAME[KEY]` for one output.

        Raises:
            ModelError: The text is no such notation, or the network has no such submodule.
        """
        # The notation.
        match = _NAME.fullmatch(layer)
        if match is None or match["call"] == "0":
            raise ModelError(
                f"layer {layer!r} is no layer's name; the form is NAME, NAME#CALL or NAME[OUTPUT]"
            )
        # The submodule of that name.
        name = match["module"]
        modules = dict(network.named_modules(remove_duplicate=False))
        if name not in modules or not name:
            near = difflib.get_close_matches(name, filter(None, modules), n=3, cutoff=0.5)
            hint = f"did you mean {', '.join(near)}?"
            if not near:
                hint = "its named_modules() are its layers; `pnpdepth layers --all` lists them"
            raise ModelError(f"layer {name!r} is not in this network; {hint}")
        module = modules[name]
        # The submodules with hooks.
        hooked = [
            module_name
            for module_name, hooked_module in modules.items()
            if hooked_module._forward_hooks or hooked_module._forward_pre_hooks
        ]
        # Its names, of which it has several where it is shared.
        names = [other_name for other_name, other in modules.items() if other is module]
        return cls(
            layer=layer,
            name=name,
            call=int(match["call"]) if match["call"] else None,
            key=tuple(re.findall(r"\[([^\[\]]+)\]", match["keys"])),
            module=module,
            modules=modules,
            containers=_around(names, modules) | {module},
            hooked=frozenset(hooked),
            around_hooks=_around(hooked, modules),
        )

    def choose(self, output: object) -> tuple[tuple[str, ...], Tensor]:
        """Returns the path of z in the layer's output, and z itself, detached.

        The path is the keys of nested containers, as `tensors_in` yields it; () if the output is a
        tensor.

        Raises:
            ModelError: The output has no such tensor, or several and the name chooses none.
        """
        candidates = [
            (path, tensor)
            for path, tensor in tensors_in(output)
            if tensor.is_floating_point() and tensor.layout == torch.strided
        ]
        # Without a key every candidate is chosen, which is right if there is one.
        chosen = [(path, tensor) for path, tensor in candidates if self.key in ((), path)]
        if len(chosen) == 1:
            path, tensor = chosen[0]
            return path, tensor.detach()
        # The names of all candidates, such as `decoder[0][features]`.
        keys = ["".join(f"[{key}]" for key in path) for path, _ in candidates]
        names = ", ".join(self.name + key for key in keys)
        if self.key:
            problem = f"has no such output; it has {names}"
        elif candidates:
            problem = f"returns several tensors; say which: {names}"
        else:
            problem = "returns no tensor"
        raise ModelError(f"layer {self.layer!r} {problem}")

    def not_reached_error(self, ran: Collection[nn.Module], calls: int) -> ModelError:
        """Returns the error of a pass that did not reach the cut, which tells where else to cut.

        Args:
            ran: Submodules that ran in the pass.
            calls: How often the layer's submodule was called in it.
        """
        if self.module in ran:
            times = f"{calls} time{'s' if calls > 1 else ''}"
            return ModelError(f"layer {self.layer!r}: it is called only {times}")
        inside = [
            name
            for name, module in self.modules.items()
            if name.startswith(f"{self.name}.") and module in ran
        ]
        hint = f"cut at a part of it: {', '.join(inside[:4])}" if inside else "choose another layer"
        return ModelError(f"layer {self.layer!r} never runs in this network's forward; {hint}")


def _around(inner_names: list[str], modules: Mapping[str, nn.Module]) -> frozenset[nn.Module]:
    """The submodules that contain a submodule with one of these names; none contains itself.

    Args:
        inner_names: Names such as `decoder.up1`.
        modules: All submodules by name; the network itself has the name "".
    """
    around = set()
    for inner_name in inner_names:
        for name, module in modules.items():
            is_network = name == ""
            if inner_name != name and (is_network or inner_name.startswith(f"{name}.")):
                around.add(module)
    return frozenset(around)
