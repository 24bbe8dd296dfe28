"""A frame as a network takes it, and the network's depth at the size of the image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pnpdepth_cli.errors import NoPointsError
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.models.aligned import AlignedDepth
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints


@dataclass(frozen=True, kw_only=True)
class PreparedFrame:
    """A frame as the network takes it."""

    network: Network
    frame: Frame  # the same at the size of the image
    map: FrameMap  # from pixels of the image to those of the network
    image: Tensor | None  # None if the network takes none
    arguments: tuple[Tensor, ...]
    points: SparsePoints
    """The points that the network sees, in its pixels and on its device, without outliers."""
    prior: Tensor | None = None
    """(1, 1, h, w) metres, 0 = unknown: the dense prior in the network's pixels. None without."""
    intrinsics: Tensor | None = None
    """(1, 3, 3): the camera matrix in the network's pixels. None where it is unknown."""

    def arguments_for(self, points: SparsePoints) -> tuple[Tensor, ...]:
        """Returns the arguments of the network for some of the points; the image is the same."""
        return self.network.arguments_of(self.image, points, self.prior, self.intrinsics)

    def depth_reader(self, align: str) -> AlignedDepth:
        """Returns a new reader of the network's output in metres, (1, 1, h, w).

        Args:
            align: Kind of alignment with the points, one of `choices.ALIGNMENTS`.
        """
        return AlignedDepth(self.network, self.points, align)

    def to_image(self, depth: Tensor) -> Tensor:
        """Returns depth (1, 1, h, w) of the network's pixels as (H, W) of the image.

        0 where it is unknown.
        """
        image = self.map.depth_to_image(depth).cpu()
        return torch.where(image.isfinite() & (image > 0), image, 0.0).float()

    def no_points_error(self) -> NoPointsError:
        """Returns the error of a frame none of whose points the network sees."""
        return NoPointsError(
            f"none of the {len(self.frame.points)} sparse points lies inside the part of the image"
            f" that network {self.network.definition.name!r} sees (rows and columns"
            f" {self.map.crop})"
        )


def prepare(network: Network, frame: Frame) -> PreparedFrame:
    """Returns the frame as the network takes it; `points` may be empty.

    Raises:
        UsageError: The network needs an image or intrinsics, and the frame has none.
        ModelError: The definition does not make arguments of it.
    """
    to_network = FrameMap.fit(network.definition.size, *frame.size)
    points = to_network.points_to_network(frame.points)
    given = points
    if frame.outliers is not None and network.definition.weighs_points:
        given = points.joined(to_network.points_to_network(frame.outliers))
    image = network.image_of(to_network, None if frame.rgb is None else frame.rgb[None])
    prior = None
    if frame.prior is not None and network.definition.takes_prior:
        prior = to_network.prior_to_network(frame.prior[None, None]).to(network.device)
    camera = frame.camera
    intrinsics = None if camera is None else to_network.intrinsics_to_network(camera)
    return PreparedFrame(
        network=network,
        frame=frame,
        map=to_network,
        image=image,
        arguments=network.arguments_of(image, given, prior, intrinsics),
        points=points.tensors(network.device),
        prior=prior,
        intrinsics=intrinsics,
    )
