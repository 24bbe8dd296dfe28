"""Measures the paper's table of times (Table IV) for its networks, K = 5."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from pnpdepth_cli.pipeline.bench.bench import Bench, BenchRequest, run_bench


@dataclass(frozen=True, kw_only=True)
class PaperTime:
    """A network of the paper, and the times that the paper prints."""

    name: str
    """The paper's name of it."""
    model: str
    """Ours."""
    data: str
    """The data set."""
    size: tuple[int, int]
    """(H, W) of its frames."""
    before: float | None = None
    """Seconds of the network on the paper's GPU, which it does not name; None if not printed."""
    after: float | None = None
    """Seconds with refinement."""

    @property
    def forwards(self) -> float | None:
        """The paper's refinement in forward passes."""
        return None if self.before is None or self.after is None else self.after / self.before


_NYU, _KITTI = (228, 304), (352, 1216)

PAPER_TIMES = (
    PaperTime(name="Eigen", model="eigen", data="NYU", size=_NYU),
    PaperTime(name="FCRN", model="fcrn", data="NYU", size=_NYU),
    PaperTime(name="Zhou", model="sfmlearner", data="KITTI", size=(128, 416)),
    PaperTime(
        name="Uhrig", model="sparseconv", data="KITTI", size=_KITTI, before=0.0311, after=0.1614
    ),
    PaperTime(name="Chodosh", model="adnn", data="KITTI", size=_KITTI, before=0.0320, after=0.0447),
    PaperTime(
        name="Ma",
        model="sparse2dense-r18-deconv3",
        data="NYU",
        size=_NYU,
        before=0.0046,
        after=0.0233,
    ),
    PaperTime(
        name="Jaritz", model="latefusion", data="NYU", size=(224, 320), before=0.0484, after=0.1593
    ),
)
"""Wang et al. (ICRA 2019), Table IV, and the three networks that it leaves out."""


@dataclass(frozen=True, kw_only=True)
class TableRow:
    """A network of the paper, and our measurement."""

    paper: PaperTime
    """What the paper prints."""
    bench: Bench
    """Measured at full size."""

    def record(self) -> dict[str, Any]:
        """Returns the row in JSON's own types."""
        return {"paper": asdict(self.paper), "bench": self.bench.record()}


def bench_table(
    *,
    repeats: int,
    precision: str,
    device: str,
    on_network: Callable[[int, int, str], None] = lambda done, of, name: None,
) -> list[TableRow]:
    """Returns the times of the paper's networks, full size, random weights, K = 5.

    Args:
        repeats: Measured runs of each part.
        precision: Of convolutions and matrix products.
        device: Torch's name of the device.
        on_network: Called with (done, of, name) before each network.
    """
    rows = []
    for number, paper in enumerate(PAPER_TIMES):
        on_network(number, len(PAPER_TIMES), paper.model)
        request = BenchRequest(
            model=paper.model,
            size=paper.size,
            iterations=5,
            precision=precision,
            device=device,
            repeats=repeats,
            files=False,
        )
        rows.append(TableRow(paper=paper, bench=run_bench(request)))
    return rows
