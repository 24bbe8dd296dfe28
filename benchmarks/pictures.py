"""Draws README's first picture: `python -m benchmarks.pictures --data PATH -o docs/room.jpg`.

A frame of ICL-NUIM with 500 points, FastDepth at each stage, and the error of each. Needs
matplotlib and pillow.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.frames import SETS, by_default, drawn_inputs, opened
from pnpdepth_cli.measures import PROPAGATED

FRAME = "00025"
"""Of ICL-NUIM."""
COUNT = 500
"""Points that are drawn."""
SEED = 0
"""Random seed of the points."""


@click.command()
@click.option("--data", type=click.Path(path_type=Path), required=True, help="Folder of the data.")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="JPG or PNG.")
def main(data: Path, output: Path) -> None:
    """Draw image, points, and depth and error of the stages."""
    from matplotlib.figure import Figure

    # The frame, refined.
    network = opened("fastdepth", data)
    frame = next(frame for frame in SETS["icl_nuim"](data) if frame.name == FRAME)
    inputs = drawn_inputs(frame, COUNT, SEED)
    refined = by_default(network, inputs, SEED)
    own = network.definition.name
    weight = sum(weight for name, weight in refined.weights.items() if own in name)
    columns = {
        "FastDepth aligned": refined.before,
        "z updated, propagated": refined.stages[PROPAGATED],
        f"fused (FastDepth {100 * weight:.0f} %)": refined.depth,
    }
    # One scale for all depths, one for all errors.
    depth = inputs.points.depth.numpy()
    low, high = np.quantile(depth, (0.02, 0.98))
    of_depth: dict[str, Any] = {"cmap": "turbo_r", "vmin": low, "vmax": high}
    of_error: dict[str, Any] = {"cmap": "magma", "vmin": 0, "vmax": 0.4}
    figure = Figure(figsize=(13.2, 5.4), dpi=100, layout="constrained")
    axes = figure.subplots(2, 4)
    axes[0, 0].imshow(frame.rgb)
    axes[0, 0].set_title("Image")
    axes[1, 0].imshow(frame.rgb.mean(axis=2) / 2, cmap="gray", vmin=0, vmax=1)
    axes[1, 0].scatter(
        *inputs.points.xy.numpy().T, c=depth, s=9, edgecolors="k", linewidths=0.4, **of_depth
    )
    axes[1, 0].set_title(f"{COUNT} points")
    for (above, below), (title, values) in zip(axes[:, 1:].T, columns.items(), strict=True):
        error = np.where(frame.gt > 0, np.abs(values - frame.gt), 0)
        shown = above.imshow(values, **of_depth)
        wrong = below.imshow(error, **of_error)
        above.set_title(title)
        below.set_title(f"error: MAE {error[frame.gt > 0].mean():.3f} m")
    for panel in axes.flat:
        panel.set_xticks([])
        panel.set_yticks([])
    figure.colorbar(shown, ax=axes[0, 3], label="m")
    figure.colorbar(wrong, ax=axes[1, 3], label="m")
    figure.savefig(output)


if __name__ == "__main__":
    main()
