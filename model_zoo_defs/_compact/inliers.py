"""A weight for every point from its agreement with the points around it."""

from __future__ import annotations

import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model_zoo_defs._compact.cloud import CHUNK, Cloud
from model_zoo_defs._compact.points import Points

# The weight of a point as a function of its log odds of being an inlier: steep, because a softmax
# over few candidates follows a doubtful point too far. Its half is at log odds of 2: an inlier
# that is left out costs less than an outlier that is kept.
STEEPNESS = 4.0
THRESHOLD = 2.0
# Up to the first expected fraction of outliers in an image their log odds gain the margin, which
# falls to 0 at the second: isolated points of clean images lie on thin objects.
CLEAN_FRACTION = 0.045
SPOILT_FRACTION = 0.075
CLEAN_MARGIN = 7.0
# Numbers in the state of a point.
WIDTH = 32
# Numbers in a message between two points.
MESSAGE = 48
# How often each point receives messages.
ROUNDS = 4
# Attention heads, over which the messages of the neighbours are weighed.
HEADS = 4
# Numbers for a pair of points: agreement in depth, agreement in colour, and position.
AGREEMENT = 6
COLOUR = 6
POSITION = 5


class InlierWeights(nn.Module):
    """A weight 0..1 for every point from its agreement with the points around it.

    A small graph network: every point has a state, and `Messages` of its nearest neighbours and
    the mean state of the image update it. A point of dense ones has the weight of the point that
    stands for it (`cloud.thinned`). A message depends on the differences of the two log
    depths and of the two colours and on where the neighbour is.
    """

    def __init__(self) -> None:
        super().__init__()
        self.enter = nn.Linear(2, WIDTH)
        self.rounds = nn.ModuleList(Messages() for _ in range(ROUNDS))
        self.score = nn.Linear(WIDTH, WIDTH)
        self.leave = nn.Linear(WIDTH, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.constant_(self.leave.bias, 4.0)  # weights of exactly 1

    def forward(self, points: Points, cloud: Cloud) -> Tensor:
        """Returns the weights (B, 1, H, W), 1 away from the points.

        Args:
            points: Points of the batch.
            cloud: The same points with their neighbours.
        """
        with torch.autocast(points.mask.device.type, enabled=False):
            log_odds = self.log_odds(cloud)[cloud.stand_in]
        images = torch.split(log_odds, list(cloud.of_images))
        log_odds = torch.cat([logits + self._margin(logits) for logits in images])
        weights = torch.sigmoid(STEEPNESS * (log_odds - THRESHOLD))
        return torch.ones_like(points.mask).masked_scatter(points.mask > 0, weights)

    def log_odds(self, cloud: Cloud) -> Tensor:
        """Returns each point's log odds (n,) of being an inlier."""
        # A state begins with the fraction of the neighbours that are there, and the spacing.
        neighbour_fraction = cloud.found.float().mean(1)
        state = F.relu(self.enter(torch.stack([neighbour_fraction, cloud.log_spacing / 3], 1)))
        pairs = [_pairs(cloud, chunk) for chunk in chunks(cloud)]
        for messages in self.rounds:
            state = messages(state, cloud, pairs)
        return cast(Tensor, self.leave(F.relu(self.score(state))).squeeze(1))

    @staticmethod
    def _margin(logits: Tensor) -> Tensor:
        """Returns what an image's log odds (n,) gain: much if it has hardly any outlier.

        That spares doubtful points, which lie on thin objects there.
        """
        outlier_fraction = torch.sigmoid(-logits).sum() / max(1, len(logits))
        spoilt = (outlier_fraction - CLEAN_FRACTION) / (SPOILT_FRACTION - CLEAN_FRACTION)
        return CLEAN_MARGIN * (1.0 - spoilt.clamp(0.0, 1.0))


class Messages(nn.Module):
    """One round of messages: the new state (n, WIDTH) of every point.

    Messages are averaged with weights that they predict themselves, and their maximum is taken.
    The layers that make messages are plain parameters, because they run once per CHUNK of points:
    how often a submodule runs may not depend on the number of points (`static_graph`).
    """

    def __init__(self) -> None:
        super().__init__()
        self.pair = _matrix(MESSAGE, AGREEMENT + COLOUR + POSITION)
        self.bias = nn.Parameter(torch.zeros(MESSAGE))
        self.neighbour = nn.Linear(WIDTH, MESSAGE, bias=False)
        self.message = _matrix(WIDTH, MESSAGE)
        self.message_bias = nn.Parameter(torch.zeros(WIDTH))
        self.attention = _matrix(HEADS, MESSAGE)
        self.update = nn.Linear(4 * WIDTH, 2 * WIDTH)
        self.change = nn.Linear(2 * WIDTH, WIDTH)
        nn.init.zeros_(self.change.weight)

    def forward(self, state: Tensor, cloud: Cloud, pairs: list[Tensor]) -> Tensor:
        """Returns the new state (n, WIDTH) of every point.

        Args:
            state: State (n, WIDTH).
            cloud: The points and their neighbours.
            pairs: What is known of the points and their neighbours (`_pairs`), chunk by chunk.
        """
        sent = self.neighbour(state) + self.bias
        # Messages of the neighbours, a chunk of the points at a time.
        messages = [
            self._received(sent, cloud, chunk, pairs_of_chunk)
            for chunk, pairs_of_chunk in zip(chunks(cloud), pairs, strict=True)
        ]
        received = torch.cat(messages) if messages else state.new_zeros((0, 2 * WIDTH))
        # The mean state of each image's senders, for each of its points.
        image_states = [
            states[sends].mean(0, keepdim=True).expand_as(states)
            for states, sends in zip(
                torch.split(state, list(cloud.counts)),
                torch.split(cloud.sends, list(cloud.counts)),
                strict=True,
            )
        ]
        hidden = self.update(torch.cat([state, received, torch.cat(image_states)], 1))
        return state + cast(Tensor, self.change(F.relu(hidden)))

    def _received(self, sent: Tensor, cloud: Cloud, chunk: slice, pairs: Tensor) -> Tensor:
        """Returns weighted mean and maximum (m, 2 WIDTH) of the messages to a chunk of m points.

        Args:
            sent: What each point sends (n, MESSAGE).
            cloud: The points and their neighbours.
            chunk: Numbers of the m points.
            pairs: What is known of them and their neighbours (m, NEIGHBOURS, 17).
        """
        near = cloud.near[chunk]
        found = cloud.found[chunk].unsqueeze(2)
        hidden = F.relu(F.linear(pairs, self.pair).add_(F.embedding(near, sent)), inplace=True)
        message = F.relu(F.linear(hidden, self.message, self.message_bias), inplace=True) * found
        attention = F.linear(hidden, self.attention).masked_fill(~found, -1e4).softmax(1)
        per_head = message.view(*message.shape[:2], HEADS, -1)
        mean = (attention.unsqueeze(3) * per_head).sum(1).flatten(1)
        return torch.cat([mean, message.amax(1)], 1)


def chunks(cloud: Cloud) -> list[slice]:
    """Returns the numbers of the points in chunks of at most CHUNK, which bounds the memory."""
    return [slice(first, first + CHUNK) for first in range(0, len(cloud.value), CHUNK)]


def _pairs(cloud: Cloud, chunk: slice) -> Tensor:
    """Returns what is known of m points and their neighbours (m, NEIGHBOURS, 17), 0 without one.

    In order: agreement in depth, agreement in colour, and where the neighbour is.

    Args:
        cloud: The points and their neighbours.
        chunk: Numbers of the m points.
    """
    near = cloud.near[chunk]
    found = cloud.found[chunk].unsqueeze(2)
    # Log depth, row, column and colour of the neighbours minus those of the point.
    table = torch.cat([cloud.value.unsqueeze(1), cloud.position, cloud.colour], 1)
    relative = F.embedding(near, table) - table[chunk].unsqueeze(1)
    difference = relative[..., 0]
    shift = relative[..., 1:3]
    colour = relative[..., 3:]
    distance = shift.square().sum(2, keepdim=True).sqrt()
    spacing = cloud.log_spacing[chunk].view(-1, 1, 1).expand_as(distance)
    place = [shift / 2, distance / 2, 1 / (distance + 0.3), spacing / 3]
    return torch.cat([_agreement(difference), _similarity(colour), *place], 2) * found


def _agreement(difference: Tensor) -> Tensor:
    """Returns differences of log depth (...,) at several scales (..., AGREEMENT)."""
    signed = [torch.tanh(difference / scale) for scale in (0.02, 0.06, 0.2, 0.7)]
    same = [torch.exp(-difference.abs() / scale) for scale in (0.03, 0.1)]
    return torch.stack(signed + same, -1)


def _similarity(difference: Tensor) -> Tensor:
    """Returns differences of colour (..., 3), and their size at several scales, (..., COLOUR)."""
    size = difference.abs().sum(-1, keepdim=True)
    near = [torch.exp(-size / scale) for scale in (0.3, 1.0)]
    return torch.cat([difference / 2, size / 3, *near], -1)


def _matrix(rows: int, columns: int) -> nn.Parameter:
    """Returns weights (rows, columns), initialised as those of `nn.Linear`."""
    bound = 1 / math.sqrt(columns)
    return nn.Parameter(torch.empty(rows, columns).uniform_(-bound, bound))
