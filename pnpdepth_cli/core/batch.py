"""Several frames in one pass: the part of each frame in z and in the network's output."""

from __future__ import annotations

from typing import Any

from pnpdepth_cli.core.split.structure import map_tensors, tensors_in
from pnpdepth_cli.errors import BatchError


def frame_parts(structure: Any, frames: int) -> list[Any]:
    """Returns the part of each frame, with a batch axis of 1; for one frame the whole structure.

    Args:
        structure: A tensor, or tensors in nested containers, with the frames along axis 0.
        frames: The number of frames.

    Raises:
        BatchError: A tensor does not have one element per frame along axis 0.
    """
    if frames == 1:
        return [structure]
    for path, tensor in tensors_in(structure):
        if tensor.shape[:1] != (frames,):
            name = ".".join(path) or "the tensor"
            raise BatchError(
                f"{name} of shape {tuple(tensor.shape)}, at the cut or in the output, has not one"
                f" part for each of {frames} frames; refine them one at a time"
            )
    parts = {path: tensor.tensor_split(frames) for path, tensor in tensors_in(structure)}

    def of_frame(index: int) -> Any:
        return map_tensors(structure, lambda path, _: parts[path][index])

    return [of_frame(index) for index in range(frames)]
