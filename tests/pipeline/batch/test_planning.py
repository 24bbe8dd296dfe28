"""What a plan keeps in memory, and how a list of many frames is read."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.pipeline.batch import batch as batch_module
from pnpdepth_cli.pipeline.batch.batch import plan_batch
from pnpdepth_cli.pipeline.batch.frames import find_frames, task_of
from pnpdepth_cli.pipeline.batch.request import BatchRequest
from pnpdepth_cli.pipeline.refinement.request import RefineRequest


def many_frames(folder: Path, count: int) -> BatchRequest:
    (folder / "a.png").touch()
    lines = (f"d/f{number:04},a.png,a.png\n" for number in range(count))
    (folder / "list.csv").write_text("name,image,sparse\n" + "".join(lines))
    refine = RefineRequest.from_fields(preset="fast")
    return BatchRequest(source=folder / "list.csv", output=folder / "out", refine=refine)


def test_a_plan_keeps_no_settings_of_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[weakref.ref[Any]] = []
    most = 0

    def watched(request: BatchRequest, frame: Any) -> Any:
        nonlocal most
        task = task_of(request, frame)
        made.extend((weakref.ref(task), weakref.ref(task.request), weakref.ref(frame)))
        most = max(most, sum(each() is not None for each in made))
        return task

    monkeypatch.setattr(batch_module, "task_of", watched)
    planned = plan_batch(many_frames(tmp_path, 60), lambda text: None)
    assert len(planned) == 60
    assert len(made) == 3 * 60
    assert most <= 8


def test_frames_of_a_list_share_their_settings(tmp_path: Path) -> None:
    frames = find_frames(many_frames(tmp_path, 60)).frames
    assert len(list(frames.patterns())) == 2  # every 20th is compared with linear interpolation
    assert [frame.name for frame in frames] == [f"d/f{number:04}" for number in range(60)]
