"""Golden output: what the commands of `pnpdepth` print and write, kept and compared.

    python -m benchmarks.golden write GOLDEN.json --shared ../shared/data
    python -m benchmarks.golden check GOLDEN.json --shared ../shared/data

`write` runs nearly three hundred small commands, each in a fork that starts with the heavy
libraries imported, and keeps their exit codes, messages and files. `check` runs them again, prints
a line for each difference and ends with 1 if there is one. Only the command line and files are
used, so that the code behind them may be moved about. Times, sizes of memory, versions and absolute
paths are left out. All runs on one thread: sums over several depend on how many there are. Golden
output holds for one kind of processor and one set of libraries; make it where you compare.

    --only 'batch*'      commands whose name fits (with `write`, the others in the file stay)
    --messages off       compare exit codes, data, files and depth, but nothing that is said
    --jobs 2             commands at once
    --keep FOLDER        keep everything that the commands wrote
"""

from __future__ import annotations

import argparse
import atexit
import csv
import difflib
import fnmatch
import gc
import hashlib
import importlib
import io
import json
import math
import os
import platform
import re
import runpy
import shlex
import shutil
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

Array = NDArray[Any]
Tell = Callable[[str, Mapping[str, Any]], None]
"""Told the name of a step that ended, and what it left."""

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "COLUMNS": "120",
    "TERM": "dumb",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "HF_HUB_OFFLINE": "1",
    "MPLBACKEND": "Agg",
    "PYTHONHASHSEED": "0",
}
"""Of all commands; the first ones are read when the libraries are imported."""
LIBRARIES = (
    *("numpy", "scipy.spatial", "scipy.ndimage", "scipy.sparse.linalg", "scipy.io", "cv2", "PIL"),
    *("OpenEXR", "h5py", "torch", "torch.export", "safetensors.torch", "click", "rich.console"),
    *("rich.table", "tqdm", "onnx", "onnxruntime", "transformers", "matplotlib.pyplot"),
)
"""What commands import and start sooner with; those that are absent here are left out."""
LONGEST_S = 1200
"""A command that takes longer is ended, and has the signal as its exit code."""


# --- the commands ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Step:
    """A command line, without `pnpdepth`, that runs in the folder of its group.

    Attributes:
        name: The group's and its own, `losses/l2`.
        line: The arguments, as a shell would read them.
        save: The file in the group's folder that gets what is printed on stdout.
        unordered: Lines may come in any order, where threads print them.
        figures: False where every number is a measurement, and left out.
        before: Done to the group's folder first.
    """

    name: str
    line: str
    save: str | None = None
    unordered: bool = False
    figures: bool = True
    before: Callable[[Path], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Group:
    """Steps that run one after another in one folder; shared: they need the real frames."""

    name: str
    steps: Sequence[Step]
    shared: bool = False


SMALL = "refine ../in/small/rgb.png --sparse ../in/small/sparse.png"
TRUTH = "--gt ../in/small/gt.png"
STREET = "--calib ../in/street_small/calib.txt"
KITTI = "../in/kitti_small"
USERS = "--model ../in/my_net.py:MyNet --checkpoint ../in/my_net.safetensors"


def groups() -> Iterator[Group]:
    """All of them, the longest first, so that several jobs end together."""
    yield from _of_shared_data()
    yield from _of_refinement()
    yield from _of_many_frames()
    yield from _of_sparse_depth()
    yield from _of_networks()
    yield from _of_errors()


def _group(
    name: str, *steps: tuple[str, str] | Step, shared: bool = False, unordered: bool = False
) -> Group:
    made = [
        step
        if isinstance(step, Step)
        else Step(name=f"{name}/{step[0]}", line=step[1], unordered=unordered)
        for step in steps
    ]
    return Group(name=name, steps=made, shared=shared)


def _apart(name: str, *steps: tuple[str, str], shared: bool = False) -> Iterator[Group]:
    """Steps that need nothing of one another, each a group of its own."""
    for step in steps:
        yield Group(
            name=f"{name}-{step[0]}",
            steps=[Step(name=f"{name}/{step[0]}", line=step[1])],
            shared=shared,
        )


def _of_shared_data() -> Iterator[Group]:
    data, onnx = "../shared", "--model ../shared/weights/fastdepth_nyu.onnx"
    scenes = f"{data}/7scenes/frame-000000"
    crop = f"{KITTI}/image/0000000005.png --sparse {KITTI}/velodyne_raw/0000000005.png"
    truth = f"--gt {KITTI}/groundtruth/0000000005.png"
    nconv = f"--model nconv --checkpoint {data}/weights/nconv"
    pncnn = f"--model pncnn --checkpoint {data}/weights/pncnn"
    yield _group(
        "kitti-dc",
        (
            "batch",
            f"batch {data}/kitti_dc -o out --limit 1 --workers 1 --model sparse2dense-tiny-kitti",
        ),
        (
            "eval",
            f"eval out {data}/kitti_dc --protocol kitti --sparse {data}/kitti_dc/velodyne_raw",
        ),
        shared=True,
        unordered=True,
    )
    yield _group(
        "kitti-object",
        ("dry-run", f"batch {data}/kitti_object -o out --dry-run"),
        ("batch", f"batch {data}/kitti_object -o out --limit 1 --model eigen-tiny --holdout 0.1"),
        shared=True,
        unordered=True,
    )
    yield from _apart(
        "kitti-scan",
        (
            "project",
            f"project {data}/kitti_object/velodyne/000001.bin --calib"
            f" {data}/kitti_object/calib/000001.txt --image {data}/kitti_object/image_2/000001.png"
            " -o scan.png --overlay overlay.png --json",
        ),
        (
            "keep-occluded",
            f"project {data}/kitti_object/velodyne/000002.bin --calib"
            f" {data}/kitti_object/calib/000002.txt --size 370x1224 --keep-occluded --camera 3"
            " --range --min-range 5 --max-range 40 -o scan.csv",
        ),
        (
            "raw",
            f"project {data}/kitti_object/velodyne/000003.bin --calib {data}/kitti_dc"
            " --size 375x1242 -o scan.npz",
        ),
        shared=True,
    )
    yield _group(
        "nconv",
        ("refine", f"refine {crop} {truth} {nconv}/CNN_ep0003.pth.tar -o out --json"),
        ("module", f"refine {crop} {truth} {nconv}/whole_module.pth -o depth.npy"),
        ("eval", f"eval depth.npy {KITTI}/groundtruth/0000000005.png --protocol kitti-devkit"),
        ("convert", f"models --convert {data}/weights/nconv/whole_module.pth nconv.safetensors"),
        ("converted", f"refine {crop} --model nconv --checkpoint nconv.safetensors -o d.exr"),
        shared=True,
    )
    yield _group(
        "pncnn",
        (
            "refine",
            f"refine {crop} {truth} {pncnn}/kitti_model_best.pth.tar --iterations 2 -o o"
            " --format exr",
        ),
        ("layers", f"layers {pncnn}/nyu_model_best.pth.tar --size 64x96 --json"),
        shared=True,
    )
    yield _group(
        "fastdepth",
        (
            "refine",
            f"refine {scenes}.color.jpg --sparse {scenes}.depth.png --depth-scale 1000 {onnx}"
            f" --gt {scenes}.depth.png --gt-scale 1000 --iterations 2 -o out",
        ),
        (
            "few-points",
            f"{SMALL} {onnx} --layer Relu_322 --update adam --lr 3% --iterations 5 --align auto"
            f" {TRUTH} --holdout 0.25 -o few --format tiff",
        ),
        ("check", f"models --check {data}/weights/fastdepth_nyu.onnx --image ../in/small/rgb.png"),
        Step(name="fastdepth/layers", line=f"layers {onnx} --sparse ../in/small/sparse.png --json"),
        ("no-layer", f"{SMALL} {onnx} --layer Relu_9999 -o none"),
        shared=True,
    )
    yield _group(
        "fastdepth-auto",
        ("auto", f"{SMALL} {onnx} --auto --baselines {TRUTH} -o out --format npy"),
        shared=True,
    )
    yield _group(
        "7scenes",
        (
            "batch",
            f"batch {data}/7scenes -o out --limit 2 --sample 300 --protocol nyu --workers 1"
            " --iterations 2 --batch-size 1",
        ),
        ("eval", f"eval out {data}/7scenes --bootstrap 50 --json"),
        shared=True,
        unordered=True,
    )
    yield _group(
        "icl",
        (
            "eigen",
            f"refine {data}/icl_nuim/image/00005.jpg --sparse ../in/points.csv --gt"
            f" {data}/icl_nuim/depth/00005.png --gt-scale 1000 --model eigen-tiny -o out",
        ),
        shared=True,
    )


def _of_refinement() -> Iterator[Group]:
    indoor = "refine ../in/indoor/rgb.png --sparse ../in/indoor/sparse.png"
    yield from _apart(
        "readme",
        ("indoor", f"{indoor} --gt ../in/indoor/gt.png -o out/ --overwrite"),
        ("default-output", f"{indoor} --model eigen-tiny"),
        (
            "scan",
            "refine ../in/street/rgb.png --sparse ../in/street/000000.bin --calib"
            " ../in/street/calib.txt --gt ../in/street/gt.png -o street-scan/ --iterations 1",
        ),
        (
            "settings",
            f"{indoor} --layer decoder.s8 --iterations 3 --lr 3% --loss l2 --update adam"
            " -o depth.exr",
        ),
    )
    yield from _apart(
        "auto",
        ("auto", f"{SMALL} {TRUTH} --auto --baselines --uncertainty -o best/"),
        ("no-time", f"{SMALL} {TRUTH} --auto --time-budget 0.000001s -o best/ --json"),
        ("few-points", "refine ../in/small/rgb.png --sparse ../in/few.csv --auto -o best/"),
        ("eigen", f"{SMALL} {TRUTH} --auto --model eigen-tiny --uncertainty -o best/"),
        ("gp", f"{SMALL} {TRUTH} --auto --propagate gp --layer decoder.s4 --seed 3 -o best/"),
        (
            "lines",
            "refine ../in/street_small/rgb.png --sparse ../in/street_small/sparse.png --auto"
            " --model sparse2dense-tiny --gt ../in/street_small/gt.png -o best/",
        ),
    )
    yield from _apart(
        "networks",
        *(
            (f"{name}-tiny", f"{indoor} --gt ../in/indoor/gt.png --model {name}-tiny -o out/")
            for name in ("eigen", "fcrn", "sfmlearner", "sparse2dense", "latefusion")
        ),
        ("sparseconv-tiny", f"{SMALL} {TRUTH} --model sparseconv-tiny -o out/ --format npy"),
        ("adnn-tiny", f"{SMALL} {TRUTH} --model adnn-tiny -o out/ --format exr"),
        (
            "sparse2dense-tiny-kitti",
            "refine ../in/street/rgb.png --sparse ../in/street/sparse.png --model"
            " sparse2dense-tiny-kitti -o out/ --format npz",
        ),
        ("sparse-only", "refine --sparse ../in/small/sparse.png --model sparseconv-tiny -o d.npy"),
        ("sfmlearner-align", f"{SMALL} {TRUTH} --model sfmlearner-tiny --align auto -o out/"),
        ("eigen-align-every", f"{SMALL} --model eigen-tiny --align affine --align-every -o out/"),
    )
    yield from _apart(
        "losses",
        *(
            (loss, f"{SMALL} {TRUTH} --loss {loss} -o out/ --format npy")
            for loss in ("l1", "l2", "huber", "berhu", "inverse", "log", "cauchy")
        ),
    )
    yield from _apart(
        "updates",
        *(
            (update, f"{SMALL} {TRUTH} --update {update} --lr 2% -o out/ --format npy")
            for update in ("sign", "sgd", "normalised", "momentum", "adam", "lbfgs")
        ),
        ("adam-own-lr", f"{SMALL} {TRUTH} --update adam -o out/ --format npy"),
    )
    yield from _apart(
        "options",
        ("linear", f"{SMALL} --schedule linear --lr 0.02 --iterations 3 -o out/"),
        ("spread", f"{SMALL} --spread 1.5 --update normalised --lr 5% -o out/"),
        ("channels", f"{SMALL} {TRUTH} --parameters channels -o out/"),
        ("channels-lbfgs", f"{SMALL} --parameters channels --update lbfgs -o out/ --iterations 3"),
        ("anchor", f"{SMALL} {TRUTH} --anchor 0.1 -o out/"),
        ("line-search", f"{SMALL} {TRUTH} --line-search --lr 30% -o out/"),
        ("keep-best", f"{SMALL} {TRUTH} --keep-best --lr 50% --iterations 8 -o out/"),
        ("plain", f"{SMALL} {TRUTH} --iterations 0 -o out/"),
        ("share", f"{SMALL} --layer 0.5 -o out/ --iterations 2"),
        ("layer", f"{SMALL} --layer decoder.s2 -o out/ --iterations 2"),
        ("gp", f"{SMALL} {TRUTH} --propagate gp --uncertainty -o out/"),
        ("diffusion", f"{SMALL} {TRUTH} --propagate diffusion -o out/"),
        ("baselines", f"{SMALL} {TRUTH} --baselines -o out/"),
        ("uncertainty", f"{SMALL} {TRUTH} --uncertainty --holdout 0.2 -o out/ --format exr"),
        ("holdout", f"{SMALL} --holdout 0.3 --seed 4 -o out/ --json"),
        ("tile", f"{SMALL} {TRUTH} --tile 96 -o out/"),
        ("bf16", f"{SMALL} {TRUTH} --precision bf16 -o out/"),
        ("align-median", f"{SMALL} {TRUTH} --align median -o out/"),
        ("align-scale", f"{SMALL} {TRUTH} --align scale -o out/"),
        ("align-affine", f"{SMALL} {TRUTH} --align affine -o out/"),
        ("align-auto", f"{SMALL} {TRUTH} --align auto -o out/"),
        (
            "wrong-scale",
            f"{SMALL} --depth-scale 100 --gt ../in/small/gt.png --gt-scale 256 -o out/",
        ),
        (
            "scan",
            f"refine ../in/street_small/rgb.png --sparse ../in/street_small/000000.bin {STREET}"
            " --gt ../in/street_small/gt.png --max-range 50 --holdout 0.1 -o out/",
        ),
        (
            "range",
            f"refine ../in/street_small/rgb.png --sparse ../in/street_small/000000.bin {STREET}"
            " --range --keep-occluded --min-range 4 --camera 3 --iterations 1 -o out/",
        ),
        ("csv-points", "refine ../in/small/rgb.png --sparse ../in/few.csv -o out/"),
        (
            "leak",
            "refine ../in/small/rgb.png --sparse ../in/small/gt.png --gt ../in/small/gt.png -o o",
        ),
        (
            "size",
            "refine ../in/small/rgb.png --sparse ../in/indoor/sparse.png --sparse-size-ok -o out/",
        ),
        ("grey", "refine ../in/grey.png --sparse ../in/small/sparse.png -o out/ --iterations 1"),
    )
    yield _group(
        "formats",
        *(
            (kind, f"{SMALL} -o {kind}/ --format {kind} --iterations 1")
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (
                f"read-{kind}",
                f"refine ../in/small/rgb.png --sparse ../in/small/sparse.png --gt"
                f" {kind}/rgb_depth.{kind} -o read-{kind}.npy --iterations 0",
            )
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (f"file-{kind}", f"{SMALL} -o depth.{kind} --iterations 1 {TRUTH}")
            for kind in ("png", "exr", "npy", "npz", "pfm", "tiff")
        ),
        *(
            (f"sparse-{kind}", f"sample npy/rgb_depth.npy --count 80 --seed 2 -o s-{kind}.{kind}")
            for kind in ("exr", "npz", "pfm", "tiff", "csv")
        ),
        *(
            (
                f"from-{kind}",
                f"refine ../in/small/rgb.png --sparse s-{kind}.{kind} -o from-{kind}.npy"
                " --iterations 1",
            )
            for kind in ("exr", "npz", "pfm", "tiff", "csv")
        ),
        ("exists", f"{SMALL} -o depth.npy"),
        ("overwrite", f"{SMALL} -o depth.npy --overwrite --iterations 1"),
    )


def _of_many_frames() -> Iterator[Group]:
    batch = "--workers 1 --batch-size 1 --iterations 2"
    yield _group(
        "batch",
        ("dry-run", f"batch ../in/pairs -o out {batch} --dry-run"),
        ("first", f"batch ../in/pairs -o out {batch} --limit 2"),
        ("rest", f"batch ../in/pairs -o out {batch} --html report --profile"),
        ("again", f"batch ../in/pairs -o out {batch}"),
        Step(
            name="batch/lost",
            line=f"batch ../in/pairs -o out {batch}",
            unordered=True,
            before=lambda folder: (folder / "out" / "b_depth.png").unlink(missing_ok=True),
        ),
        ("other-settings", f"batch ../in/pairs -o out {batch} --loss l2 --json --overwrite"),
        ("shard", f"batch ../in/pairs -o shard {batch} --shard 2/2"),
        ("eval", "eval out ../in/pairs --csv s.csv --markdown s.md --latex s.tex --html ev"),
        Step(
            name="batch/eval-json",
            line="eval out ../in/pairs --json --bootstrap 100 --sparse ../in/pairs/sparse",
            save="a.json",
            unordered=True,
        ),
        Step(
            name="batch/eval-other",
            line="eval shard ../in/pairs --json --bootstrap 100 --sparse ../in/pairs/sparse",
            save="b.json",
            unordered=True,
        ),
        Step(
            name="batch/eval-pooled",
            line="eval shard ../in/pairs --json --bootstrap 100 --exclude-sparse --sparse"
            " ../in/pairs/sparse --average pooled --max-depth 5",
            save="c.json",
            unordered=True,
        ),
        ("compare", "compare out/summary.json:before out/summary.json --csv c.csv --markdown c.md"),
        ("compare-json", "compare a.json b.json --bootstrap 200 --json --latex c.tex"),
        ("compare-other-rules", "compare a.json c.json"),
        ("compare-record", "compare out/a.json:before out/a.json"),
        unordered=True,
    )
    yield _group(
        "batch-auto",
        (
            "auto",
            "batch ../in/many -o out --workers 1 --batch-size 1 --limit 2 --auto --uncertainty"
            " --html report",
        ),
        unordered=True,
    )
    yield _group(
        "batch-together",
        ("together", "batch ../in/many -o out --workers 1 --batch-size 4 --iterations 2"),
        unordered=True,
    )
    yield _group(
        "manifests",
        ("csv", f"batch ../in/frames.csv -o csv {batch} --model eigen-tiny --format exr"),
        ("jsonl", f"batch ../in/frames.jsonl -o jsonl {batch} --holdout 0.2 --protocol whole"),
        ("broken", f"batch ../in/broken.csv -o broken {batch} --html report"),
        ("no-frames", f"batch ../in/empty -o none {batch}"),
        unordered=True,
    )
    sampled = f"{batch} --sample 200 --protocol whole --seed 1"
    yield _group(
        "layouts",
        *(
            (name, f"batch ../in/layouts/{name} -o {name} {sampled}")
            for name in ("7scenes", "tum", "synthia", "nyu-h5", "nyu-mat")
        ),
        ("kitti-object", f"batch ../in/layouts/kitti-object -o object {batch}"),
        (
            "kitti-odometry",
            f"batch ../in/layouts/kitti-odometry -o odometry {batch} --protocol whole",
        ),
        ("kitti-depth", f"batch ../in/layouts/kitti-depth -o depth {batch}"),
        ("kitti-tree", f"batch ../in/layouts/kitti-tree -o tree {batch}"),
        ("named", f"batch ../in/pairs -o pairs {batch} --layout pairs --limit 1 --sample lines:8"),
        ("wrong-layout", f"batch ../in/pairs -o wrong {batch} --layout tum"),
        ("too-small", f"batch ../in/layouts/tum -o small {batch} --sample 20 --protocol nyu"),
        unordered=True,
    )
    yield _group(
        "eval",
        ("predict", f"{SMALL} -o out --iterations 1"),
        ("file", "eval out/rgb_depth.png ../in/small/gt.png --markdown - --delta 1.01"),
        ("nyu", "eval ../in/indoor/gt.png ../in/indoor/gt.png --protocol nyu --csv -"),
        ("kitti", "eval ../in/street/sparse.png ../in/street/gt.png --protocol kitti --latex -"),
        ("devkit", "eval ../in/street/sparse.png ../in/street/gt.png --protocol kitti-devkit"),
        ("eigen", "eval ../in/street/sparse.png ../in/street/gt.png --protocol eigen --json"),
        ("garg", "eval ../in/street/sparse.png ../in/street/gt.png --protocol garg --no-clip"),
        (
            "crop",
            "eval out/rgb_depth.png ../in/small/gt.png --crop 10,10,60,50 --min-depth 1"
            " --max-depth 4 --average pooled --json",
        ),
        ("mask", "eval out/rgb_depth.png ../in/small/gt.png --mask ../in/grey.png"),
        ("resize", "eval out/rgb_depth.png ../in/indoor/gt.png --resize bilinear"),
        ("size", "eval out/rgb_depth.png ../in/indoor/gt.png"),
        ("scale", "eval out/rgb_depth.png ../in/small/gt.png --pred-scale 256"),
        ("leak", "eval out/rgb_depth.png ../in/small/gt.png --sparse ../in/small/sparse.png"),
        ("missing", "eval out ../in/pairs"),
        unordered=True,
    )
    sweep = "sweep ../in/pairs --limit 2"
    yield _group(
        "sweep",
        ("points", f"{sweep} -o s --sample 100 --vary iterations=0,1,3 --seeds 2"),
        ("more", f"{sweep} -o s --sample 100 --vary iterations=0,1,2,3 --seeds 2"),
        (
            "grid",
            f"{sweep} -o g --vary points=50%,100% --vary update=sign,adam --iterations 1 --no-plots"
            " --json",
        ),
        (
            "one-by-one",
            f"{sweep} -o o --one-by-one --sample grid:60 --vary lr=1%,10% --vary layer=0,1 --vary"
            " loss=l1,log --vary noise=0,0.1 --vary propagate=none,gp --iterations 1 --no-plots",
        ),
        (
            "sensors",
            "sweep ../in/layouts/kitti-depth -o k --vary sensor=own,vlp-16,lines:4 --no-plots"
            " --iterations 1 --limit 1",
        ),
        ("nonsense", f"{sweep} -o n --vary colour=red"),
        unordered=True,
    )


def _of_sparse_depth() -> Iterator[Group]:
    sample = "sample ../in/small/gt.png"
    yield _group(
        "sample",
        ("uniform", f"{sample} --pattern uniform --count 50 --seed 1 -o uniform.png"),
        ("bernoulli", f"{sample} --pattern bernoulli --count 5% --seed 2 -o bernoulli.npy"),
        ("grid", f"{sample} --pattern grid --count 60 -o grid.npz --json"),
        ("lines", f"{sample} --pattern lines --count 6 -o lines.exr"),
        (
            "features",
            f"{sample} --pattern features --count 40 --image ../in/small/rgb.png -o features.csv"
            " --overlay features_overlay.png",
        ),
        ("edges", f"{sample} --pattern edges --count 40 --image ../in/small/rgb.png -o e.tiff"),
        ("region", f"{sample} --pattern region --region 10,20,40,30 --count 30 -o region.pfm"),
        (
            "noise",
            f"{sample} --count 80 --noise 0.05 --relative-noise 0.02 --outliers 0.1 --jitter 1"
            " --seed 5 --output-scale 1000 -o noise.png",
        ),
        ("jitter-csv", f"{sample} --count 30 --jitter 0.4 -o jitter.csv"),
        ("no-image", f"{sample} --pattern features --count 40 -o none.png"),
        ("too-many", f"{sample} --count 10000000 -o many.png"),
    )
    simulate = "simulate ../in/street_small/gt.png"
    yield _group(
        "simulate",
        *(
            (sensor, f"{simulate} --sensor {sensor} {STREET} --seed 1 -o {sensor}.png")
            for sensor in ("vlp-16", "vlp-32c", "hdl-32e", "hdl-64e", "paper-vlp-16")
        ),
        ("at-scanner", f"{simulate} --sensor vlp-16 {STREET} --at-scanner --json -o at.npy"),
        (
            "own",
            f"{simulate} --sensor ../in/lidar.toml {STREET} --offset 0.1 -0.2 0.3 --rotation-noise"
            " 0.3 --angle-noise 0.02 --range-noise 0.1 --dropout 0.2 --max-range 30 --range"
            " --seed 7 -o own.csv",
        ),
        ("unknown", f"{simulate} --sensor vlp-17 {STREET} -o none.png"),
    )
    project = f"project ../in/street_small/000000.bin {STREET}"
    yield _group(
        "project",
        (
            "picture",
            f"{project} --image ../in/street_small/rgb.png -o scan.png --overlay overlay.png",
        ),
        ("exr", f"{project} --size 192x640 --keep-occluded -o kept.exr --json"),
        ("csv", f"{project} --size 192x640 --camera 0 --max-range 20 -o near.csv"),
        ("no-size", f"{project} -o none.png"),
        ("no-calib", "project ../in/street_small/000000.bin --size 192x640 -o none.png"),
    )


def _of_networks() -> Iterator[Group]:
    yield _group(
        "models",
        ("list", "models"),
        ("json", "models --json"),
        ("check-compact", "models --check compact --image ../in/small/rgb.png"),
        (
            "check-user",
            "models --check ../in/my_net.py:MyNet --checkpoint ../in/my_net.safetensors",
        ),
        ("check-json", "models --check eigen-tiny --json"),
        ("check-none", "models --check ../in/none.onnx"),
        ("convert", "models --convert ../in/my_net.pt weights.safetensors"),
        ("convert-json", "models --convert ../in/my_net.pt other.safetensors --json"),
        ("convert-exists", "models --convert ../in/my_net.pt weights.safetensors"),
        ("convert-picture", "models --convert ../in/small/rgb.png none.safetensors"),
        ("fetch-nonsense", "models --fetch nonsense"),
    )
    yield _group(
        "users-network",
        ("class", f"{SMALL} {TRUTH} {USERS} --layer encode -o class/"),
        (
            "torch-file",
            f"{SMALL} --model ../in/my_net.py:make --checkpoint ../in/my_net.pt --layer encode"
            " --output-kind inverse --normalise imagenet --align affine -o torch-file/",
        ),
        (
            "definition",
            f"{SMALL} {TRUTH} --model ../in/my_definition.py --checkpoint ../in/my_net.pt -o def/",
        ),
        ("layers", f"layers {USERS} --all --size 32x48"),
        ("layers-json", f"layers {USERS} --json --size 32x48"),
        (
            "other-weights",
            f"{SMALL} --model ../in/my_net.py:MyNet --checkpoint ../in/other.safetensors",
        ),
        ("no-weights", f"{SMALL} --model ../in/my_net.py:MyNet -o none"),
        ("no-class", f"{SMALL} --model ../in/my_net.py:YourNet -o none"),
        ("broken-file", f"{SMALL} --model ../in/broken.py -o none"),
        (
            "diverges",
            f"{SMALL} --model ../in/my_net.py:Exploding --checkpoint ../in/my_net.safetensors"
            " --layer encode --update sgd --lr 1e4 -o diverges/",
        ),
    )
    yield _group(
        "archive",
        ("refine", f"{SMALL} --model ../in/net.pt2 -o out/"),
        ("layers", "layers --model ../in/net.pt2 --json"),
    )
    yield _group(
        "hugging-face",
        ("refine", f"{SMALL} {TRUTH} --model ../in/depth_anything -o out/ --format npy"),
        ("check", "models --check ../in/depth_anything --image ../in/small/rgb.png"),
    )
    yield _group(
        "layers",
        ("compact", "layers --size 120x160"),
        ("json", "layers --json --size 96x128"),
        ("all", "layers --all --model eigen-tiny"),
        ("sparse", "layers --sparse ../in/small/sparse.png --model latefusion-tiny"),
    )
    bench = "bench --size 64x96 --repeats 1 --points 50"
    yield _group(
        "bench",
        Step(name="bench/compact", line=bench, figures=False),
        Step(name="bench/json", line=f"{bench} --json --model eigen-tiny", figures=False),
        Step(name="bench/layer", line=f"{bench} --layer nothing", figures=False),
    )


def _of_errors() -> Iterator[Group]:
    out = "-o out"
    yield _group(
        "help",
        *(
            (name, f"{name} --help")
            for name in (
                *("refine", "batch", "models", "layers", "project", "sample", "simulate", "eval"),
                *("compare", "sweep", "bench"),
            )
        ),
        ("help", "--help"),
        ("version", "--version"),
        ("nothing", ""),
        ("no-command", "refien"),
    )
    yield _group(
        "errors",
        ("no-image", f"refine none.png --sparse ../in/small/sparse.png {out}"),
        ("no-sparse", f"refine ../in/small/rgb.png --sparse none.png {out}"),
        ("no-gt", f"{SMALL} --gt none.png {out}"),
        ("sparse-not-said", "refine ../in/small/rgb.png"),
        ("unknown-option", f"{SMALL} --nonsense {out}"),
        ("unknown-loss", f"{SMALL} --loss l3 {out}"),
        ("negative", f"{SMALL} --iterations -2 {out}"),
        ("bad-lr", f"{SMALL} --lr fast {out}"),
        ("bad-budget", f"{SMALL} --auto --time-budget soon {out}"),
        ("budget-alone", f"{SMALL} --time-budget 3s {out}"),
        ("bad-spread", f"{SMALL} --spread nan {out}"),
        ("bad-anchor", f"{SMALL} --anchor -1 {out}"),
        ("bad-holdout", f"{SMALL} --holdout 1.5 {out}"),
        ("bad-tile", f"{SMALL} --tile 7 {out}"),
        ("wrong-layer", f"{SMALL} --layer decodr.s8 {out}"),
        ("wrong-model", f"{SMALL} --model compakt {out}"),
        ("needs-weights", f"{SMALL} --model eigen {out}"),
        ("wrong-checkpoint", f"{SMALL} --checkpoint ../in/my_net.safetensors {out}"),
        ("no-checkpoint", f"{SMALL} --checkpoint none.pt {out}"),
        ("text-checkpoint", f"{SMALL} --checkpoint ../in/few.csv {out}"),
        ("broken-image", f"refine ../in/broken.png --sparse ../in/small/sparse.png {out}"),
        ("broken-sparse", f"refine ../in/small/rgb.png --sparse ../in/broken.png {out}"),
        ("empty-sparse", f"refine ../in/small/rgb.png --sparse ../in/empty.npy {out}"),
        ("other-size", f"refine ../in/small/rgb.png --sparse ../in/indoor/sparse.png {out}"),
        (
            "scan-without-calib",
            f"refine ../in/small/rgb.png --sparse ../in/street/000000.bin {out}",
        ),
        ("calib-without-scan", f"{SMALL} {STREET} {out}"),
        (
            "broken-calib",
            "project ../in/street/000000.bin --calib ../in/few.csv --size 9x9 -o s.png",
        ),
        ("bad-scale", f"{SMALL} --depth-scale 0 {out}"),
        ("bad-output", f"{SMALL} -o ../in/few.csv/out"),
        ("bad-format", f"{SMALL} -o depth.jpg"),
        (
            "no-channel",
            f"refine ../in/small/rgb.png --sparse ../in/sparse.npz --channel Z {out}",
        ),
        ("no-device", f"{SMALL} --device nonsense {out}"),
        ("fp16-on-cpu", f"{SMALL} --precision fp16 {out}"),
        ("batch-no-folder", "batch none -o out"),
        ("batch-bad-shard", "batch ../in/pairs -o out --shard 5/4"),
        ("compare-one", "compare ../in/few.csv"),
        ("compare-text", "compare ../in/few.csv ../in/few.csv"),
        ("sweep-no-truth", "sweep ../in/layouts/kitti-object -o s --vary iterations=0,1"),
        ("eval-no-file", "eval none.png ../in/small/gt.png"),
        ("eval-bad-crop", "eval ../in/small/gt.png ../in/small/gt.png --crop 1,2,3"),
        ("eval-perfect", "eval ../in/small/gt.png ../in/small/gt.png"),
        unordered=True,
    )


# --- what the commands read -----------------------------------------------------------------------


_MY_NET = '''"""A small network of a user."""

import torch
from torch import nn


class MyNet(nn.Module):
    def __init__(self):
        super().__init__()
        self.encode = nn.Conv2d(3, 8, 3, stride=2, padding=1)
        self.decode = nn.ConvTranspose2d(8, 1, 4, stride=2, padding=1)

    def forward(self, rgb):
        return 3 + self.decode(torch.tanh(self.encode(rgb)))


class Exploding(MyNet):
    def forward(self, rgb):
        return torch.exp(self.decode(self.encode(rgb)))


def make():
    return MyNet()
'''
_DEFINITION = """
from pnpdepth_cli.models.definition import ModelDefinition, Multiple

definition = ModelDefinition(
    name="my-net", input_kind="rgb", size=Multiple(2), build=MyNet, layers=("encode",)
)
"""
_LIDAR = """elevations_deg = [4, 2, 0, -2, -4, -6, -8, -12]
azimuth_step_deg = 0.4
max_range = 60
range_noise = 0.02
"""


_PREPROCESSOR = {
    "image_processor_type": "DPTImageProcessor",
    "do_resize": True,
    "size": {"height": 56, "width": 56},
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 14,
    "resample": 3,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}


def make_inputs(root: Path, shared: Path | None) -> None:
    """Writes the small inputs of all commands into `root`, from the samples and the real frames."""
    shutil.copytree(ROOT / "samples", root, dirs_exist_ok=True)
    indoor = {name: Image.open(root / "indoor" / f"{name}.png") for name in ("rgb", "gt")}
    rgb = np.asarray(indoor["rgb"].convert("RGB"))
    gt = np.asarray(indoor["gt"]).astype(np.uint16)
    small, truth = _quarter(rgb), gt[2::4, 2::4]
    sparse = _some_of(truth, 150)
    _save(root / "small" / "rgb.png", small)
    _save(root / "small" / "gt.png", truth, scale=1000)
    _save(root / "small" / "sparse.png", sparse, scale=1000)
    _save(root / "grey.png", np.round(small.mean(axis=2)).astype(np.uint8))
    _points(root / "few.csv", sparse, every=8)
    _points(root / "points.csv", gt, every=len(np.argwhere(gt)) // 200)
    np.savez(root / "sparse.npz", depth=sparse / np.float32(1000), other=truth / np.float32(1000))
    np.save(root / "empty.npy", np.zeros((120, 160), np.float32))
    (root / "empty").mkdir()
    (root / "broken.png").write_bytes((root / "small" / "rgb.png").read_bytes()[:500])
    (root / "lidar.toml").write_text(_LIDAR)
    _make_pairs(root, rgb, gt)
    _make_street(root)
    _make_layouts(root, rgb, gt)
    _in_a_fork(lambda: _make_networks(root))
    if shared is not None:
        (root.parent / "shared").symlink_to(shared, target_is_directory=True)
        for kind in ("image", "velodyne_raw", "groundtruth"):
            folder = shared / "kitti_dc" / kind
            frame = np.asarray(Image.open(next(folder.glob("0000000005.*"))))
            part = frame[150:310, 400:720]
            scale = None if kind == "image" else 256
            part = part if kind == "image" else part.astype(np.uint16)
            _save(root / "kitti_small" / kind / "0000000005.png", part, scale=scale)


def _in_a_fork(work: Callable[[], None]) -> None:
    """Does what would leave threads behind, which must not be when commands are forked."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(code)
    if os.waitpid(pid, 0)[1]:
        sys.exit("the networks of the commands cannot be made")


def _save(path: Path, values: Array, *, scale: int | None = None) -> None:
    """A PNG; with a scale one of depth that says it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = PngInfo()
    if scale is not None:
        text.add_text("pnpdepth:scale", str(scale))
    Image.fromarray(np.ascontiguousarray(values)).save(path, pnginfo=text)


def _quarter(rgb: Array) -> Array:
    height, width = (side // 4 for side in rgb.shape[:2])
    blocks = rgb[: 4 * height, : 4 * width].reshape(height, 4, width, 4, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _some_of(truth: Array, count: int, seed: int = 0) -> Array:
    """The truth at so many pixels, 0 elsewhere."""
    rows, columns = np.nonzero(truth)
    chosen = np.random.default_rng(seed).choice(len(rows), min(count, len(rows)), replace=False)
    sparse = np.zeros_like(truth)
    sparse[rows[chosen], columns[chosen]] = truth[rows[chosen], columns[chosen]]
    return sparse


def _points(path: Path, depth: Array, every: int) -> None:
    rows, columns = (index[::every] for index in np.nonzero(depth))
    lines = [
        f"{x}.25 {y} {depth[y, x] / 1000}"
        for y, x in zip(rows.tolist(), columns.tolist(), strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")


def _make_pairs(root: Path, rgb: Array, gt: Array) -> None:
    """Five frames of 96×72, of which one is in a folder, nine of 48×32, and lists of frames."""
    rows = []
    for number, name in enumerate(("a", "b", "c", "d", "deep/e")):
        top, left = 40 * number, 80 * number
        part = np.s_[top : top + 288 : 4, left : left + 384 : 4]
        picture = _quarter(rgb[top : top + 288, left : left + 384])
        sparse = _some_of(gt[part], 80, seed=number)
        _save(root / "pairs" / "rgb" / f"{name}.png", picture)
        _save(root / "pairs" / "sparse" / f"{name}.png", sparse, scale=1000)
        _save(root / "pairs" / "gt" / f"{name}.png", gt[part], scale=1000)
        rows.append({"image": f"pairs/rgb/{name}.png", "sparse": f"pairs/sparse/{name}.png"})
    for number in range(9):
        part = np.s_[10 * number : 10 * number + 64 : 2, 30 * number : 30 * number + 96 : 2]
        _save(root / "many" / "rgb" / f"{number}.png", rgb[part])
        _save(root / "many" / "sparse" / f"{number}.png", _some_of(gt[part], 40), scale=1000)
    with (root / "frames.jsonl").open("w") as lines:
        for number, row in enumerate(rows[:2]):
            gt_of = row["image"].replace("rgb", "gt")
            lines.write(json.dumps(row | {"name": f"frame {number}", "gt": gt_of}) + "\n")
    with (root / "broken.csv").open("w") as file:
        file.write("name,image,sparse,gt\n")
        file.write(f"good,{rows[0]['image']},{rows[0]['sparse']},pairs/gt/a.png\n")
        file.write(f"damaged,broken.png,{rows[0]['sparse']},\n")
        file.write(f"absent,pairs/rgb/none.png,{rows[0]['sparse']},\n")
        file.write(f"empty,{rows[1]['image']},empty.npy,\n")


def _make_street(root: Path) -> None:
    """A window of the street, with the calibration that belongs to it."""
    rows, columns = slice(150, 342), slice(300, 940)
    for name in ("rgb", "gt", "sparse"):
        with Image.open(root / "street" / f"{name}.png") as picture:
            values = np.asarray(picture)[rows, columns]
        scale = None if name == "rgb" else 256
        values = values if name == "rgb" else values.astype(np.uint16)
        _save(root / "street_small" / f"{name}.png", values, scale=scale)
    shutil.copy(root / "street" / "000000.bin", root / "street_small" / "000000.bin")
    lines = []
    for line in (root / "street" / "calib.txt").read_text().splitlines():
        key, _, numbers = line.partition(":")
        matrix = np.array([float(number) for number in numbers.split()])
        if re.fullmatch(r"P\d", key):
            matrix = matrix.reshape(3, 4)
            matrix[0] -= columns.start * matrix[2]
            matrix[1] -= rows.start * matrix[2]
        lines.append(f"{key}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}")
    (root / "street_small" / "calib.txt").write_text("\n".join(lines) + "\n")


def _make_layouts(root: Path, rgb: Array, gt: Array) -> None:
    """A tiny folder in each layout."""
    import h5py

    folder, street = root / "layouts", root / "street_small"
    small, depth = rgb[:240:2, :320:2], gt[:240:2, :320:2]
    _save(folder / "7scenes" / "frame-000000.color.png", small)
    _save(folder / "7scenes" / "frame-000000.depth.png", depth)
    _save(folder / "7scenes" / "frame-000010.color.png", small)
    _save(folder / "tum" / "rgb" / "1.000.png", small)
    _save(folder / "tum" / "depth" / "1.010.png", depth * 5)
    (folder / "tum" / "rgb.txt").write_text("# time path\n1.000 rgb/1.000.png\n2.0 rgb/2.png\n")
    (folder / "tum" / "depth.txt").write_text("1.010 depth/1.010.png\n")
    for kind, values in (("RGB", small), ("Depth", depth // 10)):
        _save(folder / "synthia" / kind / "Stereo_Left" / "Omni_F" / "000001.png", values)
    for name in ("nyu-h5", "nyu-mat"):
        (folder / name).mkdir(parents=True)
    with h5py.File(folder / "nyu-h5" / "00001.h5", "w") as file:
        file["rgb"], file["depth"] = np.moveaxis(small, 2, 0), depth.astype(np.float32) / 1000
    with h5py.File(folder / "nyu-mat" / "nyu_depth_v2_labeled.mat", "w") as file:
        file["images"] = np.stack([small, small[:, ::-1]]).transpose(0, 3, 2, 1)
        file["depths"] = np.stack([depth, depth[:, ::-1]]).transpose(0, 2, 1).astype("f4") / 1000
    (folder / "nyu-mat" / "test.txt").write_text("2\n")
    kitti = folder / "kitti-object" / "training"
    for place, source in (("image_2/000000.png", "rgb.png"), ("velodyne/000000.bin", "000000.bin")):
        for part in (kitti, folder / "kitti-odometry" / "sequences" / "00"):
            (part / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(street / source, part / place)
    (kitti / "calib").mkdir()
    shutil.copy(street / "calib.txt", kitti / "calib" / "000000.txt")
    lines = (street / "calib.txt").read_text().replace("Tr_velo_to_cam", "Tr").splitlines()
    wanted = [line for line in lines if line.startswith(("P", "Tr:"))]
    odometry = folder / "kitti-odometry"
    (odometry / "sequences" / "00" / "calib.txt").write_text("\n".join(wanted) + "\n")
    (odometry / "poses").mkdir()
    (odometry / "poses" / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    selection, drive = folder / "kitti-depth", "2011_09_26_drive_0001_sync"
    name = f"{drive}_{{}}_0000000005_image_02.png"
    tree = folder / "kitti-tree" / drive
    for source, kind, place in (
        ("rgb", "image", "image_02/data"),
        ("sparse", "velodyne_raw", "proj_depth/velodyne_raw/image_02"),
        ("gt", "groundtruth_depth", "proj_depth/groundtruth/image_02"),
    ):
        for path in (selection / kind / name.format(kind), tree / place / "0000000005.png"):
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(street / f"{source}.png", path)
    (selection / "intrinsics").mkdir()
    (selection / "intrinsics" / name.format("image").replace(".png", ".txt")).write_text(
        "721.54 0 309.56 0 721.54 22.85 0 0 1\n"
    )


def _make_networks(root: Path) -> None:
    """A user's network with weights, an exported one, and a Hugging Face folder."""
    import torch
    from safetensors.torch import save_file

    (root / "my_net.py").write_text(_MY_NET)
    (root / "my_definition.py").write_text(_MY_NET + _DEFINITION)
    (root / "broken.py").write_text("import nothing_of_this_name\n")
    namespace = runpy.run_path(str(root / "my_net.py"))
    net = _with_weights(namespace["MyNet"]())
    weights = {name: value.detach() for name, value in net.state_dict().items()}
    save_file(weights, root / "my_net.safetensors")
    torch.save({"epoch": 3, "state_dict": weights}, root / "my_net.pt")
    other = {name.replace("encode", "encoder"): value for name, value in weights.items()}
    save_file(other, root / "other.safetensors")
    dim: Any = torch.export.Dim
    sides = {2: 2 * dim("rows", min=8), 3: 2 * dim("columns", min=8)}
    program = torch.export.export(net.eval(), (torch.zeros(1, 3, 64, 96),), dynamic_shapes=(sides,))
    torch.export.save(program, root / "net.pt2")
    try:
        import transformers
    except ImportError:
        return
    backbone = transformers.Dinov2Config(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, image_size=56, patch_size=14,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, apply_layernorm=True,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=24, head_hidden_size=8, patch_size=14,
        depth_estimation_type="relative", neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=8,
    )  # fmt: skip
    model = _with_weights(transformers.DepthAnythingForDepthEstimation(config))
    model.save_pretrained(root / "depth_anything")
    (root / "depth_anything" / "preprocessor_config.json").write_text(json.dumps(_PREPROCESSOR))


def _with_weights(net: Any) -> Any:
    """The network with weights that are the same everywhere, and drawn by nobody's generator."""
    import torch

    with torch.no_grad():
        for name, parameter in net.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()
            elif parameter.ndim > 1:
                count = parameter.numel()
                waves = torch.sin(torch.arange(count, dtype=torch.float64) * 12.9898) * 43758.5453
                values = (waves - waves.floor() - 0.5) / math.sqrt(count / len(parameter) / 3)
                parameter.copy_(values.reshape(parameter.shape).float())
    return net


# --- running --------------------------------------------------------------------------------------


def _run_here(arguments: Sequence[str], folder: Path) -> int:
    """Runs `pnpdepth` with the arguments in this process; its exit code."""
    os.chdir(folder)
    for number, name in ((0, os.devnull), (1, ".stdout"), (2, ".stderr")):
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open(name, flags, 0o644), number)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(  # noqa: SIM115
        2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False
    )
    signal.alarm(LONGEST_S)
    sys.argv = ["pnpdepth", *arguments]
    code = 0
    try:
        runpy.run_module("pnpdepth_cli", run_name="__main__")
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    return code & 255


@dataclass
class _Running:
    """A group of which a step is running."""

    group: Group
    folder: Path
    next_step: int = 0
    known: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)

    @property
    def step(self) -> Step:
        return self.group.steps[self.next_step]


class Runner:
    """Runs groups, so many at once.

    Attributes:
        found: What each step left, by its name.
        seconds: Of the processor, the same way.
    """

    def __init__(
        self, work: Path, shared: Path | None, jobs: int, tell: Tell | None = None
    ) -> None:
        self._tell = tell
        self._work, self._jobs = work, jobs
        self._norm = Normaliser(work, shared)
        self.found: dict[str, dict[str, Any]] = {}
        self.seconds: dict[str, float] = {}

    def run(self, wanted: Sequence[Group]) -> None:
        """Runs all steps of the groups."""
        waiting, running = list(wanted), dict[int, _Running]()
        while waiting or running:
            while waiting and len(running) < self._jobs:
                group = waiting.pop(0)
                folder = self._work / group.name
                folder.mkdir()
                self._start(_Running(group=group, folder=folder), running)
            pid, status, usage = os.wait4(-1, 0)
            each = running.pop(pid)
            self.seconds[each.step.name] = usage.ru_utime + usage.ru_stime
            self._finish(each, os.waitstatus_to_exitcode(status))
            if each.next_step < len(each.group.steps):
                self._start(each, running)

    def _start(self, each: _Running, running: dict[int, _Running]) -> None:
        step = each.step
        if step.before is not None:
            step.before(each.folder)
        each.known = _files_in(each.folder)
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            code = 70
            try:
                code = _run_here(shlex.split(step.line), each.folder)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        running[pid] = each

    def _finish(self, each: _Running, code: int) -> None:
        step = each.step
        each.next_step += 1
        said = {kind: each.folder / f".{kind}" for kind in ("stdout", "stderr")}
        texts = {kind: path.read_bytes().decode() for kind, path in said.items()}
        for path in said.values():
            path.unlink()
        now = _files_in(each.folder)
        files = {
            name: self._norm.file(each.folder / name, step)
            for name, state in now.items()
            if each.known.get(name) != state
        }
        self.found[step.name] = {
            "line": step.line,
            "exit": code,
            "stdout": self._norm.said(texts["stdout"], step),
            "stderr": self._norm.said(texts["stderr"], step),
            "files": files,
            "gone": sorted(set(each.known) - set(now)),
        }
        if self._tell is not None:
            self._tell(step.name, self.found[step.name])
        if step.save is not None:
            (each.folder / step.save).write_text(texts["stdout"], "utf-8")


def _files_in(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Size, time and number of every file below the folder, by its place."""
    return {
        path.relative_to(folder).as_posix(): (
            (state := path.stat()).st_size, state.st_mtime_ns, state.st_ino
        )
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }  # fmt: skip


# --- what is kept of it ---------------------------------------------------------------------------


_PROGRESS = re.compile(r"^\w+:\s+\d+%\|")
_TIME = re.compile(r"(?<![\w.,–-])\d[\d,]*(?:\.\d+)?(?:–\d[\d,.]*)? (?:ms|s|MB|frames/s)\b")
_SAID = (
    (re.compile(r"\d+(?:\.\d+)? × as fast"), "# × as fast"),
    (re.compile(r"\d+(?:\.\d+)? a second\b"), "# a second"),
    (re.compile(r"(pnpdepth,? (?:version )?)\d+\.\d+\.\d+\w*"), r"\1#"),
)
_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_MEASURED = re.compile(
    r"^(versions?|seconds(_\w+)?|\w+_(ms|mb|seconds)|mtime_ns|frames_per_second|network_busy)$"
)
_MESSAGES = re.compile(r"(^|\.)(notes|warnings|message|messages|problem|why)(\.|\[|$)")
_PICTURES = (".png", ".jpg", ".jpeg", ".tiff", ".tif")
_MOST_LINES = 120
"""Of a file; of longer ones some lines and the hash of all are kept."""


class Normaliser:
    """Makes of what a command printed and wrote what is the same in every run."""

    def __init__(self, work: Path, shared: Path | None) -> None:
        places = [(work / "in", "<in>"), (work / "shared", "<shared>")]
        if shared is not None:
            places.append((shared, "<shared>"))
        self._places = [(str(path), name) for path, name in places]
        self._work = re.compile(re.escape(str(work)) + r"/[\w.-]+")
        self._tree = re.compile(re.escape(str(ROOT)) + r"/(?:[\w.-]+/)*")

    def text(self, text: str) -> str:
        """Without absolute paths, times, memory and versions."""
        for place, name in self._places:
            text = text.replace(place, name)
        text = self._tree.sub("<tree>/", self._work.sub("<work>", text))
        text = _TIME.sub(lambda found: f"# {found[0].rsplit(' ', 1)[1]}", text)
        for pattern, by in _SAID:
            text = pattern.sub(by, text)
        return text

    def said(self, text: str, step: Step) -> Any:
        """What was printed: parsed where it is JSON, else its lines."""
        parsed = _parsed(text)
        if parsed is not None:
            return self.data(parsed, step)
        lines: list[str] = []
        for line in text.split("\n"):
            parts = [part for part in line.split("\r") if not _PROGRESS.match(part)]
            if "\r" in line:  # a bar, and the blanks that wiped it out
                parts = [part for part in parts if part.strip()]
                if not parts:
                    continue
            lines.append(self.text("".join(parts).rstrip()))
        while lines and not lines[-1]:
            lines.pop()
        if any(re.search(r" {2}.*# (ms|s)\b|│.*# (ms|s)\b|seconds ┃", line) for line in lines):
            lines = [re.sub(r"([ ─━┄])\1+", r"\1", line).strip() for line in lines]
        times = next((n for n, line in enumerate(lines) if "where the time went" in line), None)
        if times is not None:
            lines[times:] = [
                _NUMBER.sub("#", line) if line.startswith("│") else line for line in lines[times:]
            ]
        if not step.figures:
            lines = [re.sub(r"([ ─━])\1+", r"\1", _NUMBER.sub("#", line)).strip() for line in lines]
        return sorted(lines) if step.unordered else lines

    def data(self, value: Any, step: Step, key: str = "") -> Any:
        """Parsed JSON without measurements."""
        if _MEASURED.match(key) or (not step.figures and isinstance(value, float)):
            return _blank(value)
        if isinstance(value, dict):
            made = {str(name): self.data(each, step, str(name)) for name, each in value.items()}
            if key.endswith(".json"):  # a record, in which times are
                made |= {name: "#" for name in ("size", "sha256") if name in made}
            if str(made.get("checkpoint", "")).endswith(".pt2"):
                made["checkpoint_sha256"] = "#"  # torch.export writes other bytes every time
            return made
        if isinstance(value, list):
            return [self.data(each, step) for each in value]
        return self.text(value) if isinstance(value, str) else value

    def file(self, path: Path, step: Step) -> dict[str, Any]:
        """What is kept of a file that was written."""
        content, suffix = path.read_bytes(), path.suffix.lower()
        if suffix == ".json":
            return {"json": self.data(json.loads(content), step)}
        if suffix == ".jsonl":
            rows = [self.data(json.loads(line), step) for line in content.decode().splitlines()]
            return {"json": sorted(rows, key=lambda row: json.dumps(row, sort_keys=True))}
        if suffix == ".csv":
            return _some_lines(self._csv(content.decode()))
        if suffix in (".md", ".tex", ".txt"):
            return _some_lines(self.text(content.decode()).splitlines())
        if suffix == ".html":
            return self._page(content.decode(), step)
        kept: dict[str, Any] = {"bytes": _hash(content)}
        try:
            arrays = _arrays(path)
        except Exception as error:
            return kept | {"unreadable": type(error).__name__}
        return kept | {name: _described(values) for name, values in arrays.items()}

    def _csv(self, text: str) -> list[str]:
        rows = list(csv.reader(io.StringIO(text)))
        measured = [_MEASURED.match(name) is not None for name in rows[0]] if rows else []
        return [
            self.text(
                ",".join(
                    "#" if number and known and known[0] else cell
                    for cell, *known in _with(row, measured)
                )
            )
            for number, row in enumerate(rows)
        ]

    def _page(self, text: str, step: Step) -> dict[str, Any]:
        """A page: its parts that hold data as data, the rest as lines, or their hash."""
        kept: dict[str, Any] = {}

        def taken(found: re.Match[str]) -> str:
            parsed = _parsed(found[2])
            if parsed is None:
                kept[f"part {len(kept)}"] = _hash(found[2].encode())
            else:
                kept[f"data {len(kept)}"] = self.data(parsed, step)
            return f"{found[1]}…</"

        body = re.sub(r"(?s)(<(?:script|style)[^>]*>)(.*?)</", taken, text)
        lines = self.text(body).splitlines()
        short = [line if len(line) < 2000 else _hash(line.encode()) for line in lines]
        return kept | {"lines": short}


def _some_lines(lines: list[str]) -> dict[str, Any]:
    if len(lines) <= _MOST_LINES:
        return {"lines": lines}
    some = lines[:: len(lines) // 10]
    return {"count": len(lines), "hash": _hash("\n".join(lines).encode()), "lines": some}


def _with(row: Sequence[str], measured: Sequence[bool]) -> Iterator[tuple[Any, ...]]:
    for index, cell in enumerate(row):
        yield (cell, measured[index]) if index < len(measured) else (cell,)


def _parsed(text: str) -> Any:
    """The JSON in it, an object or a list; None if it is something else."""
    if not text.lstrip().startswith(("{", "[")):
        return None
    try:
        return json.loads(text)
    except ValueError:
        return None


def _blank(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _blank(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_blank(each) for each in value]
    return value if value is None or isinstance(value, bool) else "#"


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _arrays(path: Path) -> dict[str, Array]:
    """The numbers in a file of a picture, depth or weights; none of another kind of file."""
    suffix = path.suffix.lower()
    if suffix in _PICTURES:
        with Image.open(path) as picture:
            return {"picture": np.asarray(picture)}
    if suffix == ".npy":
        return {"array": np.load(path)}
    if suffix == ".npz":
        with np.load(path) as file:
            return {f"array {name}": file[name] for name in file.files}
    if suffix == ".pfm":
        return {"array": _read_pfm(path)}
    if suffix == ".exr":
        import OpenEXR

        with OpenEXR.File(str(path)) as file:
            return {f"channel {n}": c.pixels for n, c in sorted(file.channels().items())}
    if suffix == ".safetensors":
        from safetensors.numpy import load_file

        return {f"tensor {name}": values for name, values in sorted(load_file(path).items())}
    return {}


def _read_pfm(path: Path) -> Array:
    kind, size, scale, values = path.read_bytes().split(b"\n", 3)
    width, height = (int(side) for side in size.split())
    order = "<f4" if float(scale) < 0 else ">f4"
    channels = 3 if kind.strip() == b"PF" else 1
    return np.frombuffer(values, order)[: width * height * channels].reshape(height, -1)[::-1]


def _described(values: Array) -> dict[str, Any]:
    """Its hash, and figures that show how large a difference is."""
    flat = np.ascontiguousarray(values).ravel()
    described: dict[str, Any] = {
        "shape": list(values.shape),
        "dtype": values.dtype.name,
        "hash": _hash(flat.tobytes()),
    }
    known = flat[np.isfinite(flat)] if flat.dtype.kind in "fiu" else flat[:0]
    if known.size:
        numbers = (known.min(), known.max(), known.astype(np.float64).mean())
        described["low, high, mean"] = [float(f"{float(number):.6g}") for number in numbers]
        some = flat[np.linspace(0, flat.size - 1, 8).astype(int)]
        described["some"] = [f"{float(number):.6g}" for number in some]
    return described


# --- comparing ------------------------------------------------------------------------------------


def differences(kept: Any, now: Any, *, messages: bool, place: str = "") -> Iterator[str]:
    """A line for each difference between what was kept of a step and what it gave now."""
    if kept == now or (not messages and _is_message(place)):
        return
    if isinstance(kept, dict) and isinstance(now, dict):
        if _only_encoded(kept, now):
            yield f"{place}: other bytes, the same values"
            return
        if "hash" in kept and "hash" in now and kept["hash"] != now["hash"]:
            yield f"{place}: other values: {_short(_figures(kept))} -> {_short(_figures(now))}"
            return
        for name in [*kept, *(name for name in now if name not in kept)]:
            where = f"{place}.{name}" if place else name
            if name not in now:
                yield f"{where}: missing"
            elif name not in kept:
                yield f"{where}: new, {_short(now[name])}"
            else:
                yield from differences(kept[name], now[name], messages=messages, place=where)
        return
    if isinstance(kept, list) and isinstance(now, list):
        if all(isinstance(line, str) for line in (*kept, *now)):
            yield from _other_lines(kept, now, place)
            return
        if len(kept) == len(now):
            for number, (one, other) in enumerate(zip(kept, now, strict=True)):
                where = f"{place}[{number}]"
                yield from differences(one, other, messages=messages, place=where)
            return
    yield f"{place}: {_short(kept)} -> {_short(now)}"


def _is_message(place: str) -> bool:
    if place in ("stdout", "stderr"):
        return False  # looked at below, as data on stdout is no message
    return _MESSAGES.search(place) is not None


def _figures(described: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in described.items() if name != "hash"}


def _only_encoded(kept: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether a file has other bytes but the same values in it."""
    if "bytes" not in kept or kept.keys() != now.keys() or len(kept) == 1:
        return False
    return all(kept[name] == now[name] for name in kept if name != "bytes")


def _other_lines(kept: Sequence[str], now: Sequence[str], place: str) -> Iterator[str]:
    changes = [
        line
        for line in difflib.unified_diff(kept, now, n=0, lineterm="")
        if not line.startswith(("---", "+++", "@@"))
    ]
    for line in changes[:20]:
        yield f"{place}: {line[0]} {line[1:].strip()[:300]}"
    if len(changes) > 20:
        yield f"{place}: and {len(changes) - 20} lines more"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 160 else f"{text[:150]}… ({len(text)} characters)"


def compared(kept: Mapping[str, Any], now: Mapping[str, Any], *, messages: bool) -> list[str]:
    """The differences of one step; without `messages` of its data and files alone."""
    if not messages:
        kept, now = (
            {
                key: value
                for key, value in each.items()
                if key not in ("stdout", "stderr") or (key == "stdout" and _is_data(value))
            }
            for each in (kept, now)
        )
    return list(differences(kept, now, messages=messages))


def _is_data(said: Any) -> bool:
    return isinstance(said, dict) or (
        isinstance(said, list) and any(not isinstance(each, str) for each in said)
    )


# --- the two verbs --------------------------------------------------------------------------------


def _made_with() -> dict[str, str]:
    import torch

    return {
        "processor": torch.backends.cpu.get_cpu_capability(),
        "python": platform.python_version(),
        **{
            name: importlib.import_module(name).__version__
            for name in ("torch", "numpy", "cv2", "scipy", "PIL")
        },
    }


def _import_libraries() -> None:
    for name in LIBRARIES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            print(f"note: {name} is absent ({error})", file=sys.stderr)
    gc.freeze()


def _selected(only: str | None, shared: Path | None) -> list[Group]:
    """The groups that have a wanted step; the steps before it in its group run as well."""
    fits = [
        group
        for group in groups()
        if only is None or any(fnmatch.fnmatch(step.name, only) for step in group.steps)
    ]
    return [group for group in fits if shared is not None or not group.shared]


def _steady_environment() -> None:
    """Starts this program again where the environment is not that of all commands."""
    wanted = ENVIRONMENT | {"PYTHONPATH": str(ROOT)}
    if any(os.environ.get(name) != value for name, value in wanted.items()):
        kept = {name: value for name, value in os.environ.items() if "PNPDEPTH" not in name}
        command = [sys.executable, "-m", "benchmarks.golden", *sys.argv[1:]]
        os.execve(sys.executable, command, kept | wanted)


def _measure(given: argparse.Namespace, tell: Tell | None = None) -> Runner:
    shared = None if given.shared is None else Path(given.shared).resolve()
    if shared is not None and not shared.is_dir():
        sys.exit(f"{given.shared} is no folder")
    _import_libraries()
    wanted = _selected(given.only, shared)
    if given.keep is None:  # no TemporaryDirectory: forked commands would delete it as they end
        work = Path(tempfile.mkdtemp(prefix="golden-")).resolve()
    else:
        work = Path(given.keep).resolve()
        work.mkdir(parents=True)
    runner = Runner(work, shared, given.jobs, tell)
    try:
        make_inputs(work / "in", shared)
        before = _files_in(work / "in")
        runner.run(wanted)
        for name, state in _files_in(work / "in").items():
            if before.get(name) != state:
                print(f"note: an input was changed: {name}", file=sys.stderr)
    finally:
        if given.keep is None:
            shutil.rmtree(work)
    if given.slowest:
        print(f"{sum(runner.seconds.values()):6.1f} s of the processor", file=sys.stderr)
    for name in sorted(runner.seconds, key=lambda each: -runner.seconds[each])[: given.slowest]:
        print(f"{runner.seconds[name]:6.1f} s  {name}", file=sys.stderr)
    if given.only is not None:
        runner.found = {
            name: each for name, each in runner.found.items() if fnmatch.fnmatch(name, given.only)
        }
    return runner


def write(given: argparse.Namespace) -> int:
    """Runs the commands and keeps what they give."""
    path = Path(given.file)
    found = _measure(given).found
    if given.only is not None and path.exists():
        found = json.loads(path.read_text("utf-8"))["steps"] | found
    golden = {"made_with": _made_with(), "steps": dict(sorted(found.items()))}
    path.write_text(json.dumps(golden, ensure_ascii=False, indent=0) + "\n", "utf-8")
    print(f"{len(found)} commands kept in {path}, {path.stat().st_size / 1e6:.1f} MB")
    return 0


def check(given: argparse.Namespace) -> int:
    """Runs the commands and prints what is not as it was kept; 1 if something is not."""
    golden = json.loads(Path(given.file).read_text("utf-8"))
    made_with = _made_with()
    if made_with != golden["made_with"]:
        print(f"note: kept with {golden['made_with']}, now {made_with}", file=sys.stderr)
    kept, differing = golden["steps"], set[str]()

    def tell(name: str, now: Mapping[str, Any]) -> None:
        if given.only is not None and not fnmatch.fnmatch(name, given.only):
            return
        # what was kept went through JSON, so this does too
        again = json.loads(json.dumps(now))
        lines = (
            compared(kept[name], again, messages=given.messages == "on")
            if name in kept
            else ["is not in the file"]
        )
        for line in lines:
            print(f"{name}: {line}", flush=True)
            differing.add(name)

    found = _measure(given, tell).found
    absent = set(kept) - set(found)
    if given.only is None and absent:
        print(f"note: {len(absent)} commands in the file were not run", file=sys.stderr)
    print(f"{len(found)} commands, {len(differing)} differ")
    return 1 if differing else 0


def main() -> int:
    """Write or check; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(required=True)
    for verb, told in ((write, "keep what commands give"), (check, "compare with what was kept")):
        one = verbs.add_parser(verb.__name__, help=told)
        one.set_defaults(verb=verb)
        one.add_argument("file", metavar="GOLDEN.json")
        one.add_argument("--shared", metavar="FOLDER", help="the real frames and public weights")
        one.add_argument("--only", metavar="PATTERN", help="of names, such as 'batch/*'")
        one.add_argument("--jobs", type=int, default=1, help="commands at once")
        one.add_argument("--keep", metavar="FOLDER", help="for all that the commands write")
        one.add_argument("--slowest", type=int, default=0, metavar="N", help="print the N slowest")
        if verb is check:
            one.add_argument("--messages", choices=("on", "off"), default="on")
    given = parser.parse_args()
    _steady_environment()
    code: int = given.verb(given)
    return code


if __name__ == "__main__":
    sys.exit(main())
