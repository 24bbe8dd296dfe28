from __future__ import annotations

from pathlib import Path

import pytest

from pnpdepth_cli.errors import ClusterError
from pnpdepth_cli.pipeline.cluster.failures import check_facts, reason_of
from pnpdepth_cli.pipeline.cluster.worker import Facts, software

CAUSES = "Some common causes include: (1) the process was killed by the OOM killer"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "The actor died because of an error raised in its creation task,\n"
            "ModuleNotFoundError: No module named 'torch'\n",
            "ModuleNotFoundError: No module named 'torch'",
        ),
        ("ModuleNotFoundError: No module named 'pnpdepth_cli'", "pnpdepth is not installed on"),
        ("The actor died because its node has died. Node Id: 5", "its node is gone"),
        ("Task was killed due to the node running low on memory (OOM).", "out of memory"),
        (f"Worker exit type: SYSTEM_ERROR. {CAUSES}", "its process ended unexpectedly"),
    ],
)
def test_the_death_of_a_worker_in_a_few_words(text: str, reason: str) -> None:
    assert reason_of(RuntimeError(text)).startswith(reason)


def test_a_node_must_have_the_versions_of_the_driver_and_see_its_files() -> None:
    check_facts(Facts(node="n", pid=1, versions=software(), unseen=()))
    old = {**software(), "torch": "1.0"}
    with pytest.raises(ClusterError, match=r"node n has torch 1\.0, and here it is"):
        check_facts(Facts(node="n", pid=1, versions=old, unseen=()))
    for path, name in (
        (Path("frames"), "frames"),
        (Path("out/.0123456789ab"), "the output folder"),
    ):
        with pytest.raises(ClusterError, match=f"node n does not see {name}; name a folder"):
            check_facts(Facts(node="n", pid=1, versions=software(), unseen=(path,)))
