"""Writes the weighted mean of several weights of one network, as between the stages of `compact`.

python -m model_zoo_defs.training.learning.mean_weights --weights A B C --parts 2 2 1 --out MEAN
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from model_zoo_defs.compact import Compact
from model_zoo_defs.training.learning.learner import export


def mean_of(weights: Sequence[Mapping[str, Tensor]], parts: Sequence[float]) -> dict[str, Tensor]:
    """Returns the weighted mean of several weights of one network, in float32.

    Args:
        weights: Tensors by name, of the same names and shapes.
        parts: How much each of them counts.
    """
    total = sum(parts)
    mean = {}
    for name in weights[0]:
        addends = [
            part / total * tensors[name].float()
            for tensors, part in zip(weights, parts, strict=True)
        ]
        mean[name] = torch.stack(addends).sum(0)
    return mean


def main() -> None:
    """Reads the command line and writes the mean."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--weights", type=Path, required=True, nargs="+", help="of `compact`")
    parser.add_argument("--parts", type=float, nargs="+", help="how much each counts; alike")
    parser.add_argument("--out", type=Path, required=True, help="file for the mean")
    options = parser.parse_args()
    parts = options.parts or [1.0] * len(options.weights)
    if len(parts) != len(options.weights):
        parser.error(f"--parts has {len(parts)} numbers for {len(options.weights)} weights")
    network = Compact()
    network.load_state_dict(mean_of([load_file(path) for path in options.weights], parts))
    export(network, options.out)


if __name__ == "__main__":
    main()
