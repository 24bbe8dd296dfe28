"""Public networks on real frames: `python -m benchmarks.foreign --data PATH [--every 4]`.

FastDepth (ONNX) on 7-Scenes and two NYU frames with 100 and 500 random points: plain, with each
alignment, refined with the paper's setting at three layers, and with the untuned defaults for
users' networks. Frames are a 250/480 resize, its centre 228×304, scaled to the network's 224×224,
scored at that size; one NYU frame is published in that form.
nconv and pncnn on KITTI with its own LiDAR, before and after refinement.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.frames import (
    EvalFrame,
    drawn_inputs,
    kitti_dc,
    refined,
    seven_scenes,
)
from benchmarks.frames import nyu as nyu_frames
from pnpdepth_cli.core.metrics import score
from pnpdepth_cli.models.definition import Normalisation
from pnpdepth_cli.models.network import Network, load_network
from pnpdepth_cli.settings import Settings

PLAIN = Settings(iterations=0)
PAPER = Settings()
OURS = Settings(iterations=20, lr="3%", update="adam")
LAYERS = (0, 1, 2)
COMPLETION = (
    ("pncnn", "pncnn/kitti_model_best.pth.tar"),
    ("nconv", "nconv/CNN_ep0003.pth.tar"),
)


def as_fastdepth_sees_it(frame: EvalFrame) -> EvalFrame:
    """The frame at 224×224, cropped as the network's own evaluation does."""

    def cut(image: np.ndarray, how: int) -> np.ndarray:
        height, width = image.shape[0] * 250 // 480, image.shape[1] * 250 // 480
        image = cv2.resize(image, (width, height), interpolation=how)
        top, left = (height - 228) // 2, (width - 304) // 2
        return cv2.resize(image[top : top + 228, left : left + 304], (224, 224), interpolation=how)

    return EvalFrame(frame.name, cut(frame.rgb, cv2.INTER_AREA), cut(frame.gt, cv2.INTER_NEAREST))


def nyu(data: Path) -> list[EvalFrame]:
    """The two NYU frames, as FastDepth sees them."""
    small, *large = nyu_frames(data)
    return [small, *(as_fastdepth_sees_it(frame) for frame in large)]


def variants(network: Network) -> Iterator[tuple[str, str, Settings]]:
    """(title, layer, settings) of each row."""
    layers = network.definition.layers
    yield "raw", layers[0], PLAIN
    for kind in ("median", "scale", "affine", "auto"):
        yield f"aligned: {kind}", layers[0], replace(PLAIN, align=kind)
    for index in LAYERS:
        yield f"paper's setting at {layers[index]}", layers[index], PAPER
    for index in LAYERS:
        title = f"aligned: auto, then Adam 3 % ×20 at {layers[index]}"
        yield title, layers[index], replace(OURS, align="auto")
    yield f"Adam 3 % ×20 at {layers[0]}, not aligned", layers[0], OURS


def error(
    network: Network, layer: str, settings: Settings, frame: EvalFrame, count: int | None
) -> tuple[float, float, float, float]:
    """MAE and RMSE before and after, on all pixels with known ground truth."""
    result = refined(network, layer, settings, drawn_inputs(frame, count, seed=0))
    gt = torch.from_numpy(frame.gt)
    before, after = (score(torch.from_numpy(d), gt) for d in (result.before, result.after))
    return before.mae, before.rmse, after.mae, after.rmse


def fastdepth_table(data: Path, every: int, points: list[int]) -> None:
    network = load_network(str(data / "weights" / "fastdepth_nyu.onnx"), None)
    network = replace(
        network, definition=replace(network.definition, normalisation=Normalisation())
    )
    sets = {
        "7-Scenes": [as_fastdepth_sees_it(frame) for frame in list(seven_scenes(data))[::every]],
        "NYU": nyu(data),
    }
    for name, frames in sets.items():
        print(f"FastDepth, {name}, {len(frames)} frames: MAE / RMSE, m\n")
        print_rows(network, frames, points)
        print()


def print_rows(network: Network, frames: list[EvalFrame], points: list[int]) -> None:
    print("| | " + " | ".join(f"{count} points" for count in points) + " |")
    print("|---|" + "---|" * len(points))
    for title, layer, settings in variants(network):
        cells = []
        for count in points:
            table = np.array([error(network, layer, settings, f, count) for f in frames])
            cells.append("{:.3f} / {:.3f}".format(*table.mean(axis=0)[2:]))
        print(f"| {title} | " + " | ".join(cells) + " |", flush=True)


def completion_table(data: Path, every: int) -> None:
    frames = list(kitti_dc(data))[::every]
    print(f"KITTI, {len(frames)} frames, its LiDAR: MAE / RMSE, m\n")
    print("| network, layer | published weights | after the paper's setting |")
    print("|---|---|---|")
    for name, weights in COMPLETION:
        network = load_network(name, data / "weights" / weights)
        layer = network.definition.layers[0]
        table = np.array([error(network, layer, PAPER, frame, None) for frame in frames])
        before = "{:.3f} / {:.3f} | {:.3f} / {:.3f}".format(*table.mean(axis=0))
        print(f"| {name}, {layer} | {before} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--every", type=int, default=4, help="use every n-th frame of 7-Scenes")
    parser.add_argument("--points", type=int, nargs="+", default=[100, 500])
    parser.add_argument("--only", choices=("fastdepth", "completion"))
    args = parser.parse_args()
    if args.only != "completion":
        fastdepth_table(args.data, args.every, args.points)
    if args.only != "fastdepth":
        completion_table(args.data, 1)


if __name__ == "__main__":
    main()
