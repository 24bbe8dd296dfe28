"""A depth map on disk as a network, which returns the map that it is given."""

from __future__ import annotations

import torch
from torch import nn

from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import Network
from pnpdepth_cli.settings import Settings

_LAYER = "0"
"""Name of the only submodule of `_Same`, an nn.Sequential."""


def stored_map(number: int, count: int) -> Network:
    """Returns a network whose input is a depth map of the frame, and whose output is that map.

    What the map's numbers mean is decided from the points, as for any network that does not state
    it. z is the map itself. By default z is not updated, as no layers behind it spread an update.

    Args:
        number: Number of the map among those of the frame, from 0.
        count: How many maps a frame has; if more than one, the network's name has the number.
    """
    name = "depth map" if count == 1 else f"depth map {number + 1}"
    definition = ModelDefinition(
        name=name,
        summary="a depth map on disk",
        input_kind="map",
        map_number=number,
        size=Multiple(1),
        build=_Same,
        output_kind="unknown",
        output_scale="unknown",
        layers=(_LAYER,),
        defaults=Settings(layer=_LAYER, iterations=0),
        complete=True,
    )
    device = torch.device("cpu")
    return Network(definition=definition, module=_Same(), device=device, checkpoint=None)


class _Same(nn.Sequential):
    """The identity, with a layer to cut at."""

    def __init__(self) -> None:
        super().__init__(nn.Identity())
        self.eval()
