"""Work that is handed out in pieces, and in smaller ones where a piece kills its worker."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

_PIECE_S = 2.0
"""Seconds a piece takes: short enough to balance load, long enough that its call costs nothing."""
_MAX_ITEMS = 512


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Items that go to a worker together."""

    items: Sequence[Any]
    """What to do."""
    kills: int = 0
    """How often its worker died, if it is a single item."""
    checked: bool = False
    """Whether an error of the settings is this piece's own, as others succeeded with them."""
    alone: bool = False
    """Whether its worker is to do nothing else meanwhile, as one died of it."""


class Pieces:
    """Items that are not handed out yet.

    Args:
        items: All items.
        retries: How often an item may be tried again that was alone when its worker died.
    """

    def __init__(self, items: Sequence[Any], retries: int) -> None:
        self._items, self._retries = items, retries
        self._next = 0
        self._returned: deque[Piece] = deque()

    def __len__(self) -> int:
        """Number of items not handed out."""
        return len(self._items) - self._next + sum(len(each.items) for each in self._returned)

    def take(self, wanted: int) -> Piece | None:
        """Returns a piece of at most this many items, returned pieces first; None if all is out."""
        if self._returned:
            return self._returned.popleft()
        items = self._items[self._next : self._next + wanted]
        self._next += len(items)
        return Piece(items=items) if items else None

    def put_back(self, piece: Piece) -> None:
        """Hands the piece out again, before all others."""
        self._returned.appendleft(piece)

    def lost(self, piece: Piece) -> Any | None:
        """Hands out again what a worker died of: half by half, then item by item.

        Returns:
            An item that is given up; None otherwise.
        """
        count = len(piece.items)
        if count > 1:
            for half in (piece.items[count // 2 :], piece.items[: count // 2]):
                self.put_back(replace(piece, items=half, alone=True))
            return None
        if piece.kills >= self._retries:
            return piece.items[0]
        self.put_back(replace(piece, kills=piece.kills + 1, alone=True))
        return None

    def drop(self) -> None:
        """Hands out nothing more."""
        self._returned.clear()
        self._next = len(self._items)


def piece_size(left: int, workers: int, seconds_per_item: float | None, multiple: int) -> int:
    """Returns how many items a worker gets next.

    Args:
        left: Items that are not handed out.
        workers: Number of workers.
        seconds_per_item: Of this worker; None if it has done nothing yet.
        multiple: Items that the worker takes together.
    """
    if seconds_per_item is None:
        return 1
    size = min(_MAX_ITEMS, _PIECE_S / max(seconds_per_item, 1e-6), left / (2 * workers))
    return max(1, multiple * math.floor(size / multiple) or math.floor(size))
