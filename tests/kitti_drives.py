"""Calibrations of a KITTI raw drive, for tests."""

from __future__ import annotations

from pathlib import Path


def write_calibrations(
    folder: Path, *, focal_px: float = 60.0, size: tuple[int, int] = (48, 64)
) -> None:
    """The scanner at the camera: x forward, y left, z up."""
    folder.mkdir(parents=True, exist_ok=True)
    height, width = size
    intrinsics = f"{focal_px} 0 {(width - 1) / 2} 0 0 {focal_px} {(height - 1) / 2} 0 0 0 1 0"
    (folder / "calib_cam_to_cam.txt").write_text(
        f"P_rect_02: {intrinsics}\nR_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: {width} {height}\n"
    )
    (folder / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
