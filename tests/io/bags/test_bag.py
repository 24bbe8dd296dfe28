"""Bags whose metadata is damaged."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.errors import FileFormatError
from pnpdepth_cli.io.bags.bag import Bag


class _Reader:
    @property
    def topics(self) -> dict[str, Any]:
        raise TypeError("unsupported operand type(s) for +: 'int' and 'NoneType'")


class _Types:
    deserialize_ros1 = deserialize_cdr = None


def test_a_bag_whose_message_counts_are_missing_is_damaged() -> None:
    bag = Bag(Path("drive"), _Reader(), _Types(), ros1=False)
    with pytest.raises(FileFormatError, match="drive"):
        bag.topics(["sensor_msgs/msg/Image"])
