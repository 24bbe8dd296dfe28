"""What is wrong with a worker or its node, in the program's own errors."""

from __future__ import annotations

from typing import Any

from pnpdepth_cli.errors import ClusterError, PnpDepthError
from pnpdepth_cli.io.file_bytes import one_line
from pnpdepth_cli.pipeline.cluster.worker import Facts, software


def check_facts(facts: Facts) -> None:
    """Raises ClusterError if the worker's node differs from this one."""
    for name, here in software().items():
        there = facts.versions.get(name)
        if there != here:
            raise ClusterError(
                f"node {facts.node} has {name} {there}, and here it is {here}; install the same"
                " version on all nodes"
            )
    for path in facts.unseen:
        what = "the output folder" if path.name.startswith(".") else str(path)
        raise ClusterError(
            f"node {facts.node} does not see {what}; name a folder that all nodes share"
        )


def own_error(error: Any) -> PnpDepthError:
    """Returns what a call on a worker raised; raises it if it is a bug.

    Args:
        error: A RayTaskError.
    """
    cause = error.cause
    if isinstance(cause, PnpDepthError):
        return cause
    raise cause if isinstance(cause, Exception) else error


def reason_of(error: Exception) -> str:
    """Returns what Ray says of a worker's death, in a few words."""
    text = one_line(str(error))
    if "error raised in its creation task" in text:
        return str(error).strip().splitlines()[-1][:200]
    if "No module named 'pnpdepth_cli'" in text:
        return "pnpdepth is not installed on its node; install the same version on all nodes"
    if "out of memory" in text.lower() or "OOM" in text.split("Some common causes")[0]:
        return "out of memory"
    if "node" in text.lower() and "died" in text.split("Worker exit type")[0].lower():
        return "its node is gone"
    return "its process ended unexpectedly"
