"""Files of several frames: stacked NPY, monodepth2's gt_depths.npz, and what is refused."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.commands.evaluation.evaluate import EvalRequest, evaluate
from pnpdepth_cli.commands.evaluation.stacks import load_stacked, stack_size
from pnpdepth_cli.errors import InputError


def test_stacked_disparities_are_scored_as_monodepth2_does(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    gt = rng.uniform(1, 70, (6, 30, 40)).astype(np.float32)
    gt[rng.random(gt.shape) < 0.5] = 0
    disparity = (1 / (np.where(gt > 0, gt, 5) * rng.lognormal(0, 0.2, gt.shape))).astype("f4") / 30
    np.save(tmp_path / "disps.npy", disparity)
    np.savez_compressed(tmp_path / "gt_depths.npz", data=gt)
    result = evaluate(
        EvalRequest(
            prediction=tmp_path / "disps.npy",
            ground_truth=tmp_path / "gt_depths.npz",
            protocol="garg",
            changes={"prediction_kind": "disparity", "scale_by": "median"},
        )
    )
    errors, ratios = [], []
    for d, g in zip(disparity, gt, strict=True):  # monodepth2's evaluate_depth.py
        h, w = g.shape
        crop = np.array([0.40810811 * h, 0.99189189 * h, 0.03594771 * w, 0.96405229 * w]).astype(
            int
        )
        mask = (g > 1e-3) & (g < 80)
        inside = np.zeros(mask.shape, bool)
        inside[crop[0] : crop[1], crop[2] : crop[3]] = True
        mask &= inside
        p, t = (1 / d)[mask], g[mask]
        ratios.append(np.median(t) / np.median(p))
        p = np.clip(p * ratios[-1], 1e-3, 80)
        errors.append((np.mean(np.abs(t - p) / t), np.sqrt(np.mean((t - p) ** 2))))
    abs_rel, rmse = np.mean(errors, axis=0)
    assert [frame.name for frame in result.frames] == [f"{n:04}" for n in range(6)]
    assert result.mean["mre"] == pytest.approx(abs_rel, rel=1e-6)
    assert result.mean["rmse"] == pytest.approx(rmse, rel=1e-6)
    med = np.median(ratios)
    deviation = np.std(np.array(ratios) / med)
    assert any(
        note.startswith(f"scale-by median: factor {med:.4g}") and f"{deviation:.3f}" in note
        for note in result.notes
    )


def test_images_of_different_sizes_come_from_an_object_array(tmp_path: Path) -> None:
    maps = np.empty(2, object)
    maps[0], maps[1] = np.ones((2, 3), np.float32), np.full((4, 5), 2, np.float32)
    np.savez(tmp_path / "gt_depths.npz", data=maps)
    assert stack_size(tmp_path / "gt_depths.npz") == 2
    assert load_stacked(tmp_path / "gt_depths.npz", 1).values.tolist() == maps[1].tolist()


class _Attack:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("true",)


def test_an_object_array_of_anything_else_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(os, "system", calls.append)
    array = np.empty(1, object)
    array[0] = _Attack()
    np.save(tmp_path / "attack.npy", array, allow_pickle=True)
    assert stack_size(tmp_path / "attack.npy") is None
    assert calls == []


def test_single_maps_are_no_stack_and_numbers_of_frames_must_agree(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", np.ones((4, 5), np.float32))
    np.save(tmp_path / "channel.npy", np.ones((1, 4, 5), np.float32))
    np.save(tmp_path / "three.npy", np.ones((3, 4, 5), np.float32))
    np.save(tmp_path / "two.npy", np.ones((2, 4, 5), np.float32))
    assert stack_size(tmp_path / "one.npy") is None
    assert stack_size(tmp_path / "channel.npy") is None
    assert stack_size(tmp_path / "two.npy") == 2
    with pytest.raises(InputError, match=r"holds 3 frames but .* 2 frames"):
        evaluate(EvalRequest(prediction=tmp_path / "three.npy", ground_truth=tmp_path / "two.npy"))
