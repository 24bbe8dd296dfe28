"""An evaluation on a Ray cluster: workers read and score frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from pnpdepth_cli.pipeline.cluster.options import Spread
from pnpdepth_cli.pipeline.cluster.pool import Lost, worker_pool
from pnpdepth_cli.pipeline.cluster.worker import Done, Work
from pnpdepth_cli.pipeline.evaluation.frame_reading import Scales
from pnpdepth_cli.pipeline.evaluation.frame_scoring import (
    FrameScores,
    ScoredFrame,
    scored_or_error,
)
from pnpdepth_cli.pipeline.evaluation.pairing import FramePair
from pnpdepth_cli.pipeline.evaluation.protocols import EvalProtocol
from pnpdepth_cli.pipeline.evaluation.result import EvalRequest

Numbered = tuple[int, FramePair]


def spread_scores(
    frames: Sequence[FramePair],
    protocol: EvalProtocol,
    request: EvalRequest,
    spread: Spread,
    say: Callable[[str], None],
) -> Iterator[ScoredFrame]:
    """Yields the scores of the frames in their order.

    Args:
        frames: What to score.
        protocol: How.
        request: What is asked for.
        spread: The workers.
        say: Receives notes.

    Raises:
        ClusterError: The cluster cannot be used.
    """
    inputs = [request.prediction, request.ground_truth]
    numbered = [(number, _without_chain(frame)) for number, frame in enumerate(frames)]
    early: dict[int, ScoredFrame] = {}
    following = 0
    with worker_pool(spread, say, inputs=inputs) as pool:
        job = ScoreJob(protocol=protocol, scales=request.scales)
        for part in pool.results(job, numbered):
            for (number, pair), result in part:
                scored = result
                if isinstance(result, Lost):
                    row = FrameScores(pair=pair, values={}, error=result.message)
                    scored = ScoredFrame(row=row)
                early[number] = replace(scored, row=replace(scored.row, pair=frames[number]))
            while following in early:
                yield early.pop(following)
                following += 1


def _without_chain(frame: FramePair) -> FramePair:
    """The frame with the one before it, and not all before that."""
    if frame.previous is None:
        return frame
    return replace(frame, previous=replace(frame.previous, previous=None))


@dataclass(frozen=True, kw_only=True)
class ScoreJob:
    """Scores frames on a worker."""

    protocol: EvalProtocol
    """How."""
    scales: Scales
    """Codes per metre of integer files."""

    @contextmanager
    def opened(self) -> Iterator[Work]:
        """Yields a function that scores frames."""

        def score(frames: Sequence[Numbered], checked: bool, finish: bool) -> Done:
            results = [scored_or_error(pair, self.protocol, self.scales) for _, pair in frames]
            return Done(results=results)

        yield score
