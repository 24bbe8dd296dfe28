"""Writes the files of a refined frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pnpdepth_cli.completion.interpolation import linear
from pnpdepth_cli.frames.frame import RefinedFrame, is_dense
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.cloud_files import write_cloud
from pnpdepth_cli.io.depth import write_depth
from pnpdepth_cli.io.visualisation import (
    improvement,
    improvement_at_points,
    preview,
    sigma_preview,
    write_mask,
)
from pnpdepth_cli.pipeline.refinement.inputs import Inputs
from pnpdepth_cli.pipeline.refinement.output_files import Outputs
from pnpdepth_cli.pipeline.refinement.output_range import output_scale
from pnpdepth_cli.pipeline.refinement.view_3d import write_view
from pnpdepth_cli.sensors.cloud import cloud_from_depth


def write_outputs(outputs: Outputs, inputs: Inputs, frame: RefinedFrame) -> dict[str, Any]:
    """Writes the depth and its images. Returns their entries of the record."""
    inputs = replace(inputs, rgb=inputs.registered(frame.registration))
    make_folder(outputs.depth.parent)
    write_depth(outputs.depth, frame.after, scale=output_scale(outputs, inputs))
    if outputs.sigma is not None and frame.sigma is not None:
        write_depth(outputs.sigma, frame.sigma)
    if outputs.sigma_preview is not None and frame.sigma is not None:
        sigma_preview(frame.sigma, frame.valid, outputs.sigma_preview, inputs.unit)
    if outputs.valid is not None and frame.valid is not None:
        write_mask(outputs.valid, frame.valid)
    record: dict[str, Any] = {"improved_fraction": None}
    if outputs.preview is not None:
        preview(
            inputs.rgb,
            inputs.points.xy.numpy(),
            inputs.points.depth.numpy(),
            frame.before,
            frame.after,
            outputs.preview,
            inputs.unit,
            valid=frame.valid,
            linear=None if is_dense(frame.used) else linear(frame.used).numpy(),
        )
    if outputs.improvement is not None:
        record["improved_fraction"] = _write_improvement(
            outputs.improvement, inputs, frame, outputs.colors
        )
    if outputs.cloud is not None:
        record["cloud"] = _write_cloud(outputs.cloud, inputs, frame)
    if outputs.view is not None:
        write_view(outputs.view, inputs, frame)
    record["outputs"] = {
        kind: None if path is None else str(path)
        for kind, path in (
            ("depth", outputs.depth),
            ("sigma", outputs.sigma),
            ("valid", outputs.valid),
            ("preview", outputs.preview),
            ("improvement", outputs.improvement),
            ("cloud", outputs.cloud),
            ("view", outputs.view),
        )
    }
    return record


def _write_cloud(path: Path, inputs: Inputs, frame: RefinedFrame) -> dict[str, Any]:
    """Writes the cloud of the refined depth, in the world's frame if the pose is known."""
    assert inputs.camera is not None
    parts = cloud_from_depth(frame.after, inputs.camera.camera, rgb=inputs.rgb, keep=frame.valid)
    pose = inputs.camera.pose
    points = write_cloud(path, (part if pose is None else part.transformed(pose) for part in parts))
    return {"points": points, "frame": "camera" if pose is None else "world"}


def _write_improvement(path: Path, inputs: Inputs, frame: RefinedFrame, colors: str) -> float:
    if inputs.gt is not None:
        return improvement(
            frame.before, frame.after, inputs.gt, path, rgb=inputs.rgb, colors=colors
        )
    points = frame.held_out if len(frame.held_out) else frame.used
    return improvement_at_points(
        inputs.rgb if inputs.rgb is not None else frame.before,
        points.xy.numpy(),
        points.depth.numpy(),
        points.sample(torch.from_numpy(frame.before)).numpy(),
        points.sample(torch.from_numpy(frame.after)).numpy(),
        held_out=bool(len(frame.held_out)),
        path=path,
        unit=inputs.unit,
        colors=colors,
    )
