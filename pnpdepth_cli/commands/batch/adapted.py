"""Weights that learn from the points of a sequence before its frames are refined: `--adapt`."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import numpy as np

from pnpdepth_cli.commands.batch.frames import task_of
from pnpdepth_cli.commands.batch.records import model_identity, settings_of
from pnpdepth_cli.commands.batch.request import BatchRequest
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.atomic import make_folder
from pnpdepth_cli.io.dataset import Frame
from pnpdepth_cli.io.fingerprint import fingerprint
from pnpdepth_cli.io.record import plain, read_json, write_json
from pnpdepth_cli.io.remote import RemotePath

LEAST_FRAMES = 8
"""Of a sequence; fewer teach too little."""
MOST_FRAMES = 64
"""Frames of a sequence that are learnt from, spread over it."""
STEPS, STEPS_A_FRAME = 100, 4
"""Updates at most, and for each frame that is learnt from."""
SIGNIFICANT = 0.05
"""Of the one-sided paired t test over the frames for validation."""


def with_adapted_weights(
    request: BatchRequest,
    sequence: str,
    frames: Sequence[Frame],
    say: Callable[[str], None],
    *,
    learn: bool = True,
) -> BatchRequest:
    """Returns the request for the frames of a sequence, with adapted weights where they help.

    The weights lie in OUTPUT/adapted with a record. They are used again while settings and files
    of the frames that they learnt from are the same.

    Args:
        request: The batch.
        sequence: Name of the sequence.
        frames: Its frames.
        say: Receives what was decided.
        learn: False uses only weights that exist.

    Raises:
        UsageError: The network takes no points, or the output folder lies in a store.
    """
    if isinstance(request.output, RemotePath):
        raise UsageError("--adapt needs a local output folder; give a local -o")
    name = re.sub(r"[^\w.-]+", "_", sequence) or "frames"
    if len(frames) < LEAST_FRAMES:
        say(f"adapt: {name}: {len(frames)} frames; at least {LEAST_FRAMES} are needed")
        return request
    spread = np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).round().astype(int)
    tasks = [task_of(request, frames[index]) for index in spread]
    files = [{part: fingerprint(p).sha256 for part, p in task.inputs.items()} for task in tasks]
    settings = settings_of(request.refine, model_identity(request.refine))
    learnt_from = json.dumps([settings, files, STEPS, STEPS_A_FRAME], sort_keys=True)
    digest = hashlib.sha256(learnt_from.encode()).hexdigest()
    folder = request.output / "adapted"
    weights, file = folder / f"{name}.safetensors", folder / f"{name}.json"
    record = read_json(file) if file.exists() else {}
    if record.get("digest") != digest or (record.get("better") and not weights.exists()):
        if not learn:
            return request
        from pnpdepth_cli.commands.adapt import adapt_to
        from pnpdepth_cli.commands.adapt_request import AdaptRequest
        from pnpdepth_cli.commands.refinement.inputs import read_inputs
        from pnpdepth_cli.frames.frame import is_dense

        if is_dense(read_inputs(tasks[0].request).points):
            say(f"adapt: {name}: points as dense as a LiDAR's teach nothing; not adapted")
            return request
        validated = max(2, min(5, len(tasks) // 3))
        make_folder(folder)
        asked = AdaptRequest(
            source=request.source,
            output=weights,
            refine=request.refine.with_fields(overwrite=True),
            steps=min(STEPS, STEPS_A_FRAME * (len(tasks) - len(tasks) // validated)),
            validated=validated,
        )
        adapted = adapt_to(tasks, asked, say, lambda done, of, text: None)
        better = adapted.p_value is not None and adapted.p_value < SIGNIFICANT
        record = {"digest": digest, "better": better, "change": adapted.change}
        write_json(file, plain(record | asdict(adapted)))
    change = f"{record['change']:+.1%} loss at hidden points of frames for validation"
    if not record["better"]:
        say(f"adapt: {name}: {change}, not beyond chance; the network's own weights are used")
        return request
    say(f"adapt: {name}: {change}; its frames are refined with {weights}")
    return replace(request, refine=request.refine.with_fields(checkpoint=weights))
