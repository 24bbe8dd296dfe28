"""Networks that stay cut from frame to frame and compute nothing twice for one image.

For one image and several sets of points, a network that takes the image alone runs once, as long
as z is not updated, and its front runs once in any case. So does the image encoder that a
definition names. `prepare` makes a frame the network's input.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from pnpdepth_cli.core.losses import checked_loss
from pnpdepth_cli.core.refine_z import Refinement, refine
from pnpdepth_cli.core.split import Split
from pnpdepth_cli.core.split.replay import Run, intercepted
from pnpdepth_cli.errors import (
    DivergedError,
    NoPointsError,
    out_of_memory_is_a_device_error,
    wrap_user_errors,
)
from pnpdepth_cli.frames.frame import Frame, Prediction, is_dense
from pnpdepth_cli.models.aligned_depth import AlignedDepth
from pnpdepth_cli.models.frame_map import FrameMap
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.points import SparsePoints
from pnpdepth_cli.settings import ClosedSettings

FEW_POINTS = 50
"""With fewer points, updates of a network that takes them gain nothing: on even frames 2 to 3 %
with 500 points, 1 % with 100, nothing with 20. A point that contradicts its neighbours may then be
all that is seen of a small object."""
MIRRORED_BELOW = 200
"""With fewer points, the network that takes a prior is not updated, but sees the mirrored frame
too, in the same time (docs/notes/fusion.md)."""


@dataclass(frozen=True, kw_only=True)
class PreparedFrame:
    """A frame as the network takes it."""

    map: FrameMap  # from pixels of the image to those of the network
    arguments: tuple[Tensor, ...]
    points: SparsePoints
    """The points that the network sees, in its pixels and on its device, without outliers."""
    arguments_for: Callable[[SparsePoints], tuple[Tensor, ...]]
    """Function that returns the arguments for other points in the network's pixels; all else is the
    same."""

    def to_image(self, depth: Tensor) -> Tensor:
        """Returns a depth (1, 1, h, w) of the network's pixels as (H, W) of the image, on the CPU.

        Both are in metres. The result is 0 = unknown where the depth is not finite or not above 0,
        and where the network does not see the image.
        """
        image = self.map.depth_to_image(depth).cpu()
        return torch.where(image.isfinite() & (image > 0), image, 0.0).float()


class OpenNetwork:
    """A network whose layer and settings are decided; a context manager.

    It is cut when z is first updated, and stays cut from frame to frame.

    Args:
        network: The network, its definition with nothing left open.
        layer: Layer to cut at.
        settings: How its output is aligned and z is updated.
        coarse: Whether the gradient of the updates of z is taken of a smaller depth of the same
            view, which is faster, if the definition gives one (`ModelDefinition.coarse`).
        always_updated: Whether z is updated in every frame, also where that gains nothing.
        tuned: Whether the user states how z is updated, so that validation points tell whether that
            gains anything.
    """

    def __init__(
        self,
        network: Network,
        layer: str,
        settings: ClosedSettings,
        *,
        coarse: bool = False,
        always_updated: bool = False,
        tuned: bool = False,
    ) -> None:
        # What the network is and takes.
        definition = network.definition
        self.network = network
        self.layer = layer
        self.settings = settings
        self.name = definition.name
        self.weighs_points = definition.weighs_points
        self.takes_points = "sparse" in definition.input_kind
        self.takes_prior = definition.takes_prior
        self.always_updated = always_updated
        self.tuned = tuned
        self._coarse = definition.coarse if coarse else None
        self._of_image_only = definition.input_kind in ("rgb", "map")
        # What is kept: the cut until it is closed, the others until the next image.
        self._open = ExitStack()
        self._split: Split | None = None
        self._z0: Tensor | None = None
        self._output: object = None  # what the network returns for z_0
        self._encoded: dict[str, object] = {}  # output of the image encoder by its name

    def __enter__(self) -> OpenNetwork:
        self._open.enter_context(encoding_once(self.network, self._encoded))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
        self._split = None
        self.next_image()

    def next_image(self) -> None:
        """Forgets what was computed for the last image, so that the next call may have another."""
        self._z0 = self._output = None
        self._encoded.clear()

    def cut(self) -> Split:
        """Returns the network cut at the layer, open. Raises ModelError if it has no such layer."""
        if self._split is None:
            self._split = self._open.enter_context(self.network.cut_at(self.layer))
        return self._split

    def sees(self, frame: Frame) -> bool:
        """Returns whether any of the frame's points lies in the crop that the network sees."""
        to_network = FrameMap.fit(self.network.definition.size, *frame.size)
        return len(to_network.points_to_network(frame.points)) > 0

    def is_updated(self, frame: Frame) -> bool:
        """Returns whether z is updated in this frame.

        It is where that gains anything, or where the user states the number of updates.
        """
        if not self.settings.iterations:
            return False  # no updates are wanted
        if self.always_updated or not self.takes_points:
            return True
        # Updates of a network that takes the points gain nothing with few points. With points as
        # dense as a LiDAR's they gain 1 % and take as long as all else.
        fewest_points = MIRRORED_BELOW if self.takes_prior else FEW_POINTS
        return len(frame.points) >= fewest_points and not is_dense(frame.points)

    def refine(self, frame: Frame, *, updates: bool = True) -> Prediction:
        """Returns what this network gives for the frame, its residual not propagated.

        Args:
            frame: The image, the same in all calls until `next_image`, and the points of this call.
            updates: Whether z may be updated; it is where that gains anything (`is_updated`).

        Raises:
            PnpDepthError: The refinement fails.
        """
        diverged = None
        with out_of_memory_is_a_device_error(self.network.device):
            # The frame is made the network's input, and its output is read as metres.
            prepared = prepare(self.network, frame)
            self._check_seen(prepared, frame)
            reader = AlignedDepth(self.network, prepared.points, self.settings.align)
            try:
                if updates and self.is_updated(frame):
                    z0 = self._front(prepared)
                    with self._smaller_depth() as full_outputs:
                        refinement = refine(
                            self.cut(),
                            prepared.arguments,
                            prepared.points,
                            self.settings,
                            depth_of=reader,
                            z0=z0,
                        )
                    refinement = _at_full_size(refinement, full_outputs, reader)
                else:
                    # One pass of the whole network is enough.
                    refinement = self._plain(prepared, reader)
            except DivergedError as error:
                # A refinement that diverges ends with its last good depth, if it has one.
                if error.last_good is None:
                    raise
                diverged = error
                refinement = error.last_good
        aligned = prepared.to_image(refinement.before)
        updated = aligned
        if refinement.after is not refinement.before:  # z was updated
            updated = prepared.to_image(refinement.after)
        return Prediction(
            aligned=aligned,
            updated=updated,
            losses=refinement.losses,
            step=refinement.step,
            diverged=diverged,
            alignment=reader.alignment,
            notes=reader.notes,
        )

    def _check_seen(self, prepared: PreparedFrame, frame: Frame) -> None:
        """Raises NoPointsError if none of the points lies in the crop that the network sees.

        Args:
            prepared: The frame as the network takes it.
            frame: The frame.
        """
        if not len(prepared.points):
            top, left, height, width = prepared.map.crop
            raise NoPointsError(
                f"none of the {len(frame.points)} sparse points lies in rows {top} to"
                f" {top + height - 1} and columns {left} to {left + width - 1}, which is what"
                f" network {self.name!r} sees of the image; use another network, or crop the"
                " image"
            )

    def _front(self, prepared: PreparedFrame) -> Tensor:
        """z_0, the output of the cut layer for a frame, before any update.

        It is the same for all points if the network takes the image alone. Then it is kept until
        the next image.
        """
        z0 = self._z0
        if z0 is None:
            with torch.no_grad():
                z0 = self.cut().front(*prepared.arguments)
        self._z0 = z0 if self._of_image_only else None
        return z0

    def _output_for(self, prepared: PreparedFrame) -> object:
        """What the network's forward returns for a frame, z not updated; `AlignedDepth` reads it.

        It is the same for all points if the network takes the image alone. Then it is kept until
        the next image.
        """
        output = self._output
        may_be_updated = self._of_image_only and self.settings.iterations > 0
        if output is None and may_be_updated and self._coarse is None:
            # Updates may follow from the same z_0, which is kept. Those by a smaller depth cannot
            # use it: they make the smaller depth in a pass of their own.
            output = self.cut().rear(self._front(prepared))
        elif output is None:
            # A network whose z is never updated need not be cut.
            with wrap_user_errors("the network's forward"):
                output = self.network.module(*prepared.arguments)
        self._output = output if self._of_image_only else None
        return output

    def _plain(self, prepared: PreparedFrame, reader: AlignedDepth) -> Refinement:
        """The depth of one pass of the network, z not updated, and its loss at the points.

        Args:
            prepared: The frame as the network takes it.
            reader: Reads the network's output as metres.
        """
        with torch.no_grad():
            depth = reader(self._output_for(prepared)).detach()
        at_points = prepared.points.sample(depth)
        is_known = at_points.isfinite()  # NaN where a network leaves depth unknown
        loss_of = checked_loss(self.settings.loss)
        loss = loss_of(at_points[is_known], prepared.points.depth[is_known])
        return Refinement(before=depth, after=depth, losses=(float(loss),), step=0.0)

    def _smaller_depth(self) -> AbstractContextManager[list[Any]]:
        """Returns a context in which the network gives the smaller depth of its definition.

        The context's value is a list. What forward returns for the full depth is added to it, in
        the first forward and in each without gradients. The list stays empty where the definition
        gives no smaller depth, or where the user states the layer to cut at.
        """
        if self._coarse is None:
            return nullcontext([])
        return self._coarse(self.network.module)


def _at_full_size(
    refinement: Refinement, full_outputs: Sequence[object], reader: AlignedDepth
) -> Refinement:
    """A refinement whose depths before and after the updates of z are those of full size.

    z may have been updated by a smaller depth of the same view, which is faster.

    Args:
        refinement: The refinement, its depths as they were used for the updates.
        full_outputs: What the network returned for the full depth, the first for z_0 and the last
            for the updated z. Empty if the depths of the refinement have full size.
        reader: Function from the network's output to depth (1, 1, h, w) in metres.
    """
    if not full_outputs:
        return refinement
    before = reader(full_outputs[0])
    after = reader(full_outputs[-1])
    return replace(refinement, before=before, after=after)


def prepare(network: Network, frame: Frame) -> PreparedFrame:
    """Returns the frame as the network takes it: resized, its points in the network's pixels.

    It has no points if all of them lie outside the crop of the image that the network sees.

    Args:
        network: The network, whose definition says what it takes.
        frame: The frame.

    Raises:
        UsageError: The network needs an image or intrinsics, and the frame has none.
        ModelError: The definition's function for the network's arguments fails.
    """
    to_network = FrameMap.fit(network.definition.size, *frame.size)
    image = network.image_of(to_network, None if frame.rgb is None else frame.rgb[None])
    prior = None
    camera = frame.camera
    if frame.prior is not None and network.definition.takes_prior:
        prior = to_network.prior_to_network(frame.prior[None, None]).to(network.device)
    intrinsics = None if camera is None else to_network.intrinsics_to_network(camera)

    def arguments_for(points: SparsePoints) -> tuple[Tensor, ...]:
        """The network's arguments for points in its pixels.

        A stored depth map in place of a network has itself as its only argument.
        """
        if network.definition.input_kind == "map":
            return (frame.predicted[network.definition.map_number][None, None],)
        return network.arguments_of(image, points, prior, intrinsics)

    # A network that weighs its points is given the outliers, too: it finds them itself.
    inliers = to_network.points_to_network(frame.points)
    input_points = inliers
    if frame.outliers is not None and network.definition.weighs_points:
        input_points = inliers.joined(to_network.points_to_network(frame.outliers))
    return PreparedFrame(
        map=to_network,
        arguments=arguments_for(input_points),
        points=inliers.tensors(network.device),
        arguments_for=arguments_for,
    )


@contextmanager
def encoding_once(network: Network, encoded: dict[str, object]) -> Iterator[None]:
    """Inside, the network's image encoder runs once for an image, and its output is used again.

    That is so if the definition names an encoder.

    Args:
        network: The network.
        encoded: Output of the encoder by its name, which this fills; the caller clears it for
            another image.
    """
    name = network.definition.image_encoder
    if name is None:  # nothing depends on the image alone
        yield
        return

    def encode(_module: nn.Module, _inputs: object, run: Run) -> object:
        """The output of the encoder's first call; later calls return the same one."""
        if name not in encoded:
            encoded[name] = run()
        return encoded[name]

    with intercepted([network.module.get_submodule(name)], encode):
        yield
