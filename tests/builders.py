"""Records of frames for tests that write, read, count or print them."""

from __future__ import annotations

from pnpdepth_cli.dataset.frame_record import MethodRecord, NetworkRecord


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
