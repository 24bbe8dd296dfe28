"""Times of the paper's networks beside its Table IV: `python -m benchmarks.table_iv [REPEATS]`.

Random weights, K = 5, full size, on this machine's CPU; with what the paper prints for its GPU.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

from pnpdepth_cli.commands.bench import run_bench


class PaperTime(NamedTuple):
    """A network of the paper's Table IV, and the seconds that the paper prints."""

    name: str
    """The paper's name of it."""
    model: str
    """Ours."""
    data: str
    size: tuple[int, int]
    """(H, W) of its frames."""
    before: float | None = None
    """The network alone, on a GPU that the paper does not name; None if not printed."""
    after: float | None = None


PAPER_TIMES = (
    PaperTime("Eigen", "eigen", "NYU", (228, 304)),
    PaperTime("FCRN", "fcrn", "NYU", (228, 304)),
    PaperTime("Zhou", "sfmlearner", "KITTI", (128, 416)),
    PaperTime("Uhrig", "sparseconv", "KITTI", (352, 1216), 0.0311, 0.1614),
    PaperTime("Chodosh", "adnn", "KITTI", (352, 1216), 0.0320, 0.0447),
    PaperTime("Ma", "sparse2dense", "NYU", (228, 304), 0.0046, 0.0233),
    PaperTime("Jaritz", "latefusion", "NYU", (224, 320), 0.0484, 0.1593),
)
"""Wang et al. (ICRA 2019), Table IV, and the three networks that it leaves out."""


def main(repeats: int) -> None:
    """Prints a row of a Markdown table for each network."""
    header = "network|paper's name|size|forward|refinement|×|limit|paper: forward|refinement|×"
    print(f"|{header}|\n|{'---|' * (header.count('|') + 1)}")
    for paper in PAPER_TIMES:
        result = run_bench(paper.model, size=paper.size, iterations=5, repeats=repeats)
        forward, refined = result["parts"]["forward"], result["parts"]["refinement"]
        times = [forward["median_s"], refined["median_s"], paper.before, paper.after]
        ms = ["" if time is None else f"{1000 * time:,.1f} ms" for time in times]
        ratio = f"{paper.after / paper.before:.2f}" if paper.before and paper.after else ""
        ours = (*ms[:2], f"{refined['forwards']:.2f}", f"{result['limit']:.2f}")
        size = "×".join(map(str, paper.size))
        name = f"{paper.name}, {paper.data}"
        print(f"|{'|'.join((paper.model, name, size, *ours, *ms[2:], ratio))}|")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
