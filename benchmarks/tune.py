"""The default settings of a definition, chosen on rendered frames that training did not see.

    python -m benchmarks.tune --data SHARDS [--model compact] [--frames 24] [--layers A,B] …

For every layer, update and step: the geometric mean over frames and patterns (100 and 500 uniform
points and LiDAR lines, or what --patterns names, as in 500,5%,lidar) of MAE and RMSE after
refinement over those before, against the perfect depth, in per cent, and the fraction of frames
whose MAE got worse. Never run it on frames that are reported.
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path

import numpy as np
import torch

from benchmarks.frames import Depth, frame_inputs, points_on_grid, refined
from model_zoo_defs.training.learning.dataset import Frames
from model_zoo_defs.training.learning.patterns import keep, scan_lines, uniform
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.settings import Settings


def drawn(pattern: str, rng: np.random.Generator, depth: Depth) -> Depth:
    """Sparse depth: a number of uniform points, a percentage of all pixels, or `lidar` lines."""
    if pattern == "lidar":
        return scan_lines(rng, depth)
    fraction = pattern.endswith("%")
    number = float(pattern.rstrip("%")) * (depth.size / 100 if fraction else 1)
    return keep(depth, uniform(rng, depth, round(number)))


def rendered_inputs(folder: Path, count: int, patterns: list[str]) -> list[Inputs]:
    """`count` frames evenly taken from the folder's shards, each with every pattern."""
    frames, ratios_of_frames = Frames(folder), []
    for index in np.linspace(0, len(frames) - 1, count).astype(int):
        rgb, depth = frames[int(index)]
        for pattern in patterns:
            sparse = drawn(pattern, np.random.default_rng(int(index)), depth)
            rows, columns = np.nonzero(sparse)
            if len(rows) >= 3:
                points = points_on_grid(rows, columns, sparse[rows, columns], depth.shape)
                ratios_of_frames.append(frame_inputs((rgb / 255).astype(np.float32), points, depth))
    return ratios_of_frames


def ratios(
    network: Network, layer: str, settings: Settings, some: list[Inputs]
) -> list[tuple[float, float]]:
    """MAE and RMSE after over those before, of every frame."""
    ratios_of_frames = []
    for inputs in some:
        assert inputs.gt is not None
        result = refined(network, layer, settings, inputs)
        gt = torch.from_numpy(inputs.gt)
        before, after = (score(torch.from_numpy(d), gt) for d in (result.before, result.after))
        ratios_of_frames.append((after.mae / before.mae, after.rmse / before.rmse))
    return ratios_of_frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", default="compact")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--patterns", default="100,500,lidar")
    parser.add_argument("--layers", help="comma-separated; default: the definition's")
    parser.add_argument("--updates", default="sign,adam")
    parser.add_argument("--lrs", default="0.3%,1%,3%,0.01")
    parser.add_argument("--iterations", default="5")
    parser.add_argument("--losses", default="l1")
    args = parser.parse_args()
    network = load_network(args.model, args.checkpoint)
    layers = args.layers.split(",") if args.layers else network.definition.layers
    some = rendered_inputs(args.data, args.frames, args.patterns.split(","))
    print(f"{len(some)} frames with points\n")
    print("| layer | update | lr | K | loss | MAE % | RMSE % | worse % |")
    print("|---|---|---|---|---|---|---|---|")
    choices = (args.updates, args.lrs, args.iterations, args.losses)
    for layer, *chosen in product(layers, *(text.split(",") for text in choices)):
        update, lr, iterations, loss = chosen
        settings = Settings(iterations=int(iterations), lr=lr, loss=loss, update=update)
        ratios_of_frames = np.array(ratios(network, layer, settings, some))
        mae, rmse = 100 * np.exp(np.log(ratios_of_frames).mean(axis=0))
        worse = 100 * (ratios_of_frames[:, 0] > 1).mean()
        row = " | ".join((layer, *chosen, f"{mae:.2f}", f"{rmse:.2f}", f"{worse:.0f}"))
        print(f"| {row} |", flush=True)


if __name__ == "__main__":
    main()
