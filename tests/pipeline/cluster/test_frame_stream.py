"""Pieces of frames as a worker refines them, without Ray."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pnpdepth_cli.pipeline.batch.frames import find_frames
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.batch.settings import model_identity
from pnpdepth_cli.pipeline.batch.spread import RefineJob
from tests.pipeline.batches import batch, pairs_on_disk, refinement, results

NAMES = tuple(f"f{number:02}" for number in range(9))


def test_frames_that_come_in_pieces_have_the_results_of_one_batch(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, NAMES)
    (root / "sparse" / "f05.png").write_bytes(b"damaged")
    batch(root)
    plain = results(root / "out")
    (root / "out").rename(root / "plain")

    request = BatchRequest(source=root, output=root / "out", refine=refinement(root))
    frames = find_frames(request).frames
    job = RefineJob(
        request=request, model=model_identity(request.refine), deciding=tuple(frames[:1])
    )
    done: list[dict[str, Any]] = []
    with job.opened() as refine:
        for piece, finish in ((frames[:1], True), (frames[1:3], False), (frames[3:8], False)):
            done += (each.row for each in refine(piece, True, finish).results)
        assert 1 <= len(done) < 8, "frames are read while the next piece is fetched"
        done += (each.row for each in refine((), True, True).results)
        assert [row["name"] for row in done] == list(NAMES[:8])
        done += (each.row for each in refine(frames[8:], True, True).results)
    assert [row["name"] for row in done] == list(NAMES)
    assert [row["name"] for row in done if row["status"] == "failed"] == ["f05"]
    assert results(root / "out") == plain


def test_a_worker_that_ends_drops_what_it_has_not_begun(tmp_path: Path) -> None:
    root = pairs_on_disk(tmp_path, NAMES)
    request = BatchRequest(source=root, output=root / "out", refine=refinement(root))
    frames = find_frames(request).frames
    job = RefineJob(
        request=request, model=model_identity(request.refine), deciding=tuple(frames[:1])
    )
    with job.opened() as refine:
        refine(frames, True, False)
    assert len(results(root / "out")) < 4 * len(NAMES)
