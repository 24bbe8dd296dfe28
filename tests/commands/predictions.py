"""Predictions and their ground truth on disk, and their evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pnpdepth_cli.commands.eval import Evaluation, evaluate
from pnpdepth_cli.commands.requests.eval_request import EvalRequest
from pnpdepth_cli.io.depth import write_depth


def depth_file(path: Path, rows: Any, scale: float = 1000) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth(path, np.array(rows, np.float32), scale=scale)
    return path


def frame(root: Path, prediction: Any, gt: Any, name: str = "a") -> Path:
    """A prediction in out/ and its ground truth in gt/."""
    depth_file(root / "gt" / f"{name}.npy", gt)
    return depth_file(root / "out" / f"{name}_depth.npy", prediction)


def code_image(path: Path, codes: Any) -> None:
    """A PNG that does not say its scale."""
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), np.array(codes, np.uint16))


def scored(root: Path, **options: Any) -> Evaluation:
    return evaluate(EvalRequest(prediction=root / "out", ground_truth=root / "gt", **options))
