"""Depth maps of several views as one triangle mesh, by Open3D.

Each depth map is fused into a truncated signed distance function in blocks of voxels near the
surface (Curless and Levoy, SIGGRAPH 1996; blocks as of Zhou and Koltun, SIGGRAPH 2013).
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pnpdepth_cli.budget import budget
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.sensors.camera import Camera
from pnpdepth_cli.sensors.cloud import View

_VOXEL_PX = 3.0
"""Default side of a voxel, in pixels at the median depth of the first view."""
_TRUNCATION = 4
"""Voxels beyond which a distance to the surface is cut off."""
_BLOCK = 16
_BLOCK_BYTES = 20 * _BLOCK**3  # distance, weight and colour of a voxel, each 32 bits
_GROWTH = 3  # growing copies the blocks into twice the room


class MeshVolume:
    """Fuses depth maps; memory grows with the surface, and is bounded."""

    def __init__(self, voxel: float | None) -> None:
        """`voxel` is the side of a voxel. Raises UsageError where Open3D is not installed."""
        try:
            self._open3d: Any = importlib.import_module("open3d")
        except (ImportError, OSError):  # OSError: a library of the system is missing
            raise UsageError("--mesh needs Open3D: pip install 'pnpdepth[mesh]'") from None
        self._open3d.utility.set_verbosity_level(self._open3d.utility.VerbosityLevel.Error)
        self.voxel = voxel
        self._grid: Any = None

    def add(self, view: View, rgb: NDArray[np.float32] | None) -> None:
        """Fuses the depth of a view with the colours (H, W, 3) 0…1 of its pixels.

        Raises:
            InputError: The voxels would take more than half of the machine's memory.
        """
        if not view.known.size:
            return
        if self.voxel is None:
            median = float(np.median(view.depth.ravel()[view.known]))
            self.voxel = _VOXEL_PX * median / float(view.camera.intrinsics[0, 0])
        if self._grid is None:
            self._grid = self._empty_grid(self.voxel)
        core, image, grid = self._open3d.core, self._open3d.t.geometry.Image, self._grid
        depth = image(core.Tensor(_without_lens(view.depth, view.camera)[..., None]))
        colours = np.zeros((*view.depth.shape, 3), np.float32) if rgb is None else rgb
        # Open3D rounds pixel coordinates down; here whole numbers are the centres of pixels.
        half_pixel = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        camera = core.Tensor(view.camera.intrinsics + half_pixel)
        to_camera = core.Tensor(np.linalg.inv(np.vstack([view.pose, [0, 0, 0, 1]])))
        limits = (1.0, float(view.depth.max()) + 1, float(_TRUNCATION))
        blocks = grid.compute_unique_block_coordinates(depth, camera, to_camera, *limits)
        most = budget().max_decoded_bytes // (_GROWTH * _BLOCK_BYTES)
        if grid.hashmap().size() + len(blocks) > most:
            raise InputError(
                f"--mesh with voxels of {self.voxel:.3g} needs more than half of the memory; give a"
                " larger --voxel or a smaller --max-depth"
            )
        colour = image(core.Tensor(_without_lens(colours, view.camera)))
        grid.integrate(blocks, depth, colour, camera, camera, to_camera, *limits)

    def write(self, path: Path, *, coloured: bool) -> int:
        """Writes the mesh as PLY with normals, and returns the number of its triangles.

        Raises:
            InputError: There is none.
            OSError: The file cannot be written.
        """
        mesh = self._grid.extract_triangle_mesh(0.0).to_legacy() if self._grid else None
        if mesh is None or not len(mesh.triangles):
            raise InputError("--mesh: the depth gives no triangle; give another --voxel")
        if not self._open3d.io.write_triangle_mesh(str(path), mesh, write_vertex_colors=coloured):
            raise OSError("by Open3D")
        return len(mesh.triangles)

    def _empty_grid(self, voxel: float) -> Any:
        number = self._open3d.core.float32
        return self._open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(number, number, number),
            attr_channels=(1, 1, 3),
            voxel_size=voxel,
            block_resolution=_BLOCK,
            block_count=1000,
        )


def _without_lens(values: NDArray[Any], camera: Camera) -> NDArray[Any]:
    """The image as a camera of the same intrinsics without distortion sees it; 0 is unknown."""
    if not camera.has_lens:
        return np.ascontiguousarray(values)
    height, width = values.shape[:2]
    xy = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(height))), axis=-1).reshape(
        -1, 2
    )
    rays = replace(camera, lens="radial-tangential", distortion=()).unproject(xy, np.ones(len(xy)))
    seen = np.nan_to_num(camera.pixels_of(rays), nan=-1).astype(np.float32)
    columns, rows = (axis.reshape(height, width) for axis in seen.T)
    return np.asarray(cv2.remap(values, columns, rows, cv2.INTER_NEAREST))
