"""What a first result costs: `python -m benchmarks.first_result [--fastdepth FILE] [--runs 3]`.

Whole commands, `pnpdepth refine` of the indoor sample, in turn with a bare script that loads the
same network by its own package and runs one forward pass. The networks are Hugging Face folders
with random weights of the shapes of Depth Anything V2 Small and of DPT Hybrid, a graph of 6 million
parameters in ONNX, FastDepth if its file is given, `fcrn-tiny`, and `compact`. The first command
finds an empty cache, the second one what the first has decided.

Seconds are those of the processor, user and system: they hold also where other programs run. The
yardstick of a machine is `compact, bare`: other machines' times are about in proportion.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.frames import print_row

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "samples" / "indoor"
HEAD_BIAS = 1.0  # of random networks, so that their last ReLU lets everything through

BARE_FOLDER = """
import sys, torch
from transformers import AutoModelForDepthEstimation
network = AutoModelForDepthEstimation.from_pretrained(sys.argv[1]).eval()
height, width = map(int, sys.argv[2:])
with torch.no_grad():
    network(torch.rand(1, 3, height, width))
"""
BARE_ONNX = """
import sys, numpy, onnxruntime
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession(sys.argv[1], options)
height, width = map(int, sys.argv[2:])
image = numpy.random.rand(1, 3, height, width).astype("float32")
session.run(None, {session.get_inputs()[0].name: image})
"""
BARE_OWN = """
import sys, torch
import pnpdepth_cli
network = pnpdepth_cli.load_network(sys.argv[1])
from pnpdepth_cli.models.frame_map import FrameMap
frame = FrameMap.fit(network.definition.size, *map(int, sys.argv[2:]))
with torch.no_grad():
    network.module(*network.synthetic_arguments(frame))
"""


class Case(NamedTuple):
    """A network, and the bare script that runs it once on an image of this size."""

    name: str
    model: str
    script: str
    size: tuple[int, int]


class Spent(NamedTuple):
    """What a process took."""

    cpu_s: float
    wall_s: float


def written_folder(folder: Path, kind: str, config: dict[str, Any], processing: Any) -> str:
    """Writes a Hugging Face folder of random weights; returns its path.

    The network's output varies over the image, as that of a trained one does.

    Args:
        folder: The folder.
        kind: Name of the architecture in transformers.
        config: Settings of the architecture.
        processing: Content of its preprocessor_config.json.
    """
    import transformers

    torch.manual_seed(0)
    settings = transformers.AutoConfig.for_model(kind, **config)
    network = transformers.AutoModelForDepthEstimation.from_config(settings)
    last = None
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            layer.reset_parameters()
        if isinstance(layer, nn.Conv2d) and layer.out_channels == 1:
            last = layer
    assert last is not None
    nn.init.constant_(last.bias, HEAD_BIAS)
    network.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processing))
    return str(folder)


def anything_small(folder: Path) -> str:
    """Writes a folder of the shape of Depth Anything V2 Small, 24.8 million parameters."""
    backbone = {
        "model_type": "dinov2", "hidden_size": 384, "num_hidden_layers": 12,
        "num_attention_heads": 6, "image_size": 518, "patch_size": 14,
        "out_indices": [3, 6, 9, 12], "reshape_hidden_states": False, "apply_layernorm": True,
    }  # fmt: skip
    config = {
        "backbone_config": backbone, "reassemble_hidden_size": 384, "fusion_hidden_size": 64,
        "neck_hidden_sizes": [48, 96, 192, 384], "head_hidden_size": 32, "patch_size": 14,
    }  # fmt: skip
    size = {"height": 518, "width": 518}
    processing = {"keep_aspect_ratio": True, "ensure_multiple_of": 14, "size": size}
    return written_folder(folder, "depth_anything", config, processing)


def dpt_hybrid(folder: Path) -> str:
    """Writes a folder of the shape of DPT Hybrid, 122 million parameters; returns its path."""
    config = {
        "is_hybrid": True, "backbone_out_indices": [2, 5, 8, 11],
        "neck_hidden_sizes": [256, 512, 768, 768],
    }  # fmt: skip
    processing = {"size": {"height": 384, "width": 384}}
    return written_folder(folder, "dpt", config, processing)


class Block(nn.Module):
    """An inverted residual block."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        inner = 6 * inputs
        self.skips = inputs == outputs and stride == 1
        self.body = nn.Sequential(
            nn.Conv2d(inputs, inner, 1, bias=False),
            nn.BatchNorm2d(inner),
            nn.ReLU6(),
            nn.Conv2d(inner, inner, 3, stride, 1, groups=inner, bias=False),
            nn.BatchNorm2d(inner),
            nn.ReLU6(),
            nn.Conv2d(inner, outputs, 1, bias=False),
            nn.BatchNorm2d(outputs),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x) if self.skips else self.body(x)


class Light(nn.Module):
    """An encoder of 30 blocks and a decoder with skips, 6 million parameters."""

    STAGES = ((24, 1), (32, 4), (56, 7), (112, 10), (184, 10))
    """Channels and blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, 24, 3, 2, 1)
        stages = list[nn.Module]()
        inputs = 24
        for outputs, count in self.STAGES:
            blocks = [Block(inputs, outputs, 2 if stages else 1)]
            blocks += [Block(outputs, outputs, 1) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inputs = outputs
        self.stages = nn.ModuleList(stages)
        channels = [outputs for outputs, _ in self.STAGES][::-1]
        pairs = itertools.pairwise(channels)
        self.ups = nn.ModuleList(nn.Conv2d(a + b, b, 3, padding=1) for a, b in pairs)
        self.head = nn.Conv2d(channels[-1], 1, 3, padding=1)

    def forward(self, rgb: Tensor) -> Tensor:
        """Returns positive depth (B, 1, H, W) of images (B, 3, H, W); sides are multiples of 32."""
        x = self.stem(rgb)
        skips = list[Tensor]()
        for stage in self.stages:
            x = stage(x)
            skips.append(x)
        # The last features are x itself: the others, from the smallest on.
        for up, skip in zip(self.ups, reversed(skips[:-1]), strict=True):
            x = torch.cat([nn.functional.interpolate(x, scale_factor=2.0), skip], dim=1)
            x = up(x).relu()
        x = self.head(nn.functional.interpolate(x, scale_factor=2.0))
        return nn.functional.softplus(x)


def light_onnx(path: Path) -> str:
    """Writes `Light` as an ONNX file of about 25 MB; returns its path.

    Its batch normalisations are not folded into the convolutions.
    """
    torch.manual_seed(0)
    torch.onnx.export(
        Light().eval(),
        (torch.rand(1, 3, 480, 640),),
        str(path),
        dynamo=False,
        do_constant_folding=False,
        training=torch.onnx.TrainingMode.PRESERVE,
        input_names=["image"],
        output_names=["depth"],
    )
    return str(path)


def cases(folder: Path, fastdepth: Path | None) -> list[Case]:
    """Returns the networks, those of random weights written to a folder."""
    small = anything_small(folder / "anything-small")
    hybrid = dpt_hybrid(folder / "dpt-hybrid")
    listed = [
        Case("Depth Anything V2 Small", small, BARE_FOLDER, (518, 686)),
        Case("DPT Hybrid", hybrid, BARE_FOLDER, (384, 384)),
        Case("ONNX, 6 M", light_onnx(folder / "light.onnx"), BARE_ONNX, (480, 640)),
        Case("fcrn-tiny", "fcrn-tiny", BARE_OWN, (480, 640)),
        Case("compact", "compact", BARE_OWN, (480, 640)),
    ]
    if fastdepth is not None:
        listed.insert(3, Case("FastDepth", str(fastdepth), BARE_ONNX, (224, 224)))
    return listed


def run(command: list[str], cache: Path) -> Spent:
    """Returns what a process on one thread took; ends the program with its errors if it fails.

    Args:
        command: The program and its arguments.
        cache: Folder that the command keeps its cache in.
    """
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PNPDEPTH_CACHE": str(cache)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=ROOT, env=environment
    )
    wall_s = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Spent(cpu_s, wall_s)


def measure(case: Case, folder: Path, runs: int) -> dict[str, list[Spent]]:
    """Returns what each run took: of the bare script, and of the command with and without cache.

    The "first" command of a run finds an empty cache, the "second" what the first left.
    """
    python = sys.executable
    files = [str(SAMPLE / "rgb.png"), "--sparse"]
    files += [str(SAMPLE / "sparse.png"), "--gt", str(SAMPLE / "gt.png")]
    refine = [python, "-m", "pnpdepth_cli", "refine", *files, "--model", case.model]
    refine += ["-o", str(folder / "out"), "--overwrite"]
    bare = [python, "-c", case.script, case.model, *map(str, case.size)]
    spent: dict[str, list[Spent]] = {"bare": [], "first": [], "second": []}
    for number in range(runs):
        cache = folder / f"cache-{case.name}-{number}"
        spent["bare"].append(run(bare, cache))
        spent["first"].append(run(refine, cache))
        spent["second"].append(run(refine, cache))
    return spent


def main() -> None:
    """Measures the networks in turn, and prints a table as it comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fastdepth", type=Path, help="ONNX file of FastDepth")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--only", nargs="+", help="parts of the names of networks")
    args = parser.parse_args()
    print_row("network", "bare", "first", "second", "first / bare", "wall, first", head=True)
    median: Callable[[list[float]], float] = statistics.median
    with tempfile.TemporaryDirectory() as name:
        for case in cases(Path(name), args.fastdepth):
            if args.only and not any(word in case.name for word in args.only):
                continue
            spent = measure(case, Path(name), args.runs)
            cpu = {kind: median([of_run.cpu_s for of_run in runs]) for kind, runs in spent.items()}
            wall = median([of_run.wall_s for of_run in spent["first"]])
            texts = [f"{cpu[kind]:.2f} s" for kind in ("bare", "first", "second")]
            print_row(case.name, *texts, f"{cpu['first'] / cpu['bare']:.1f}", f"{wall:.1f} s")


if __name__ == "__main__":
    main()
