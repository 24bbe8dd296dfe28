"""Records of frames for tests that write, read, count or print them."""

from __future__ import annotations

from typing import Any

from pnpdepth_cli.dataset.frame_record import (
    MethodRecord,
    ModelRecord,
    NetworkRecord,
    PointsRecord,
    ResultRecord,
)


def method_record(*networks: str, name: str = "fused", propagation: str = "gp") -> MethodRecord:
    """The method by which these networks were refined, the user's first, with the paper's."""
    return MethodRecord(
        name=name,
        propagation=propagation,
        networks=[
            NetworkRecord(
                name=network,
                layer="middle",
                iterations=5,
                lr=0.01,
                loss="l1",
                update="sign",
                schedule="constant",
                blur=0.0,
                align="none",
            )
            for network in networks
        ],
    )


def result_record(*networks: str, **fields: Any) -> ResultRecord:
    """A result of these networks, the user's first, with these fields in place of its own."""
    names = networks or ("net",)
    whole = {
        "size": (64, 48),
        "points": PointsRecord(used=9, held_out=0, nearest=0.5, farthest=4.5),
        "model": ModelRecord(name=names[0], spec=names[0]),
        "method": method_record(*names),
        "settings": {"align": "none", "iterations": 0, "propagate": "none"},
    }
    return ResultRecord(**(whole | fields))
