"""Weights that learn from the points of a sequence before its frames are refined: `--adapt`."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from pnpdepth_cli.commands.batch.batch_request import BatchRequest, Listener
from pnpdepth_cli.commands.batch.find_frames import input_files, request_of
from pnpdepth_cli.commands.batch.records import Records
from pnpdepth_cli.commands.refinement.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.errors import DivergedError, InputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint, read_json, write_json

if TYPE_CHECKING:
    from pnpdepth_cli.frames.frame import Frame

MOST_FRAMES = 64
"""Frames of a sequence that are learnt from, spread over it."""


def with_adapted_weights(
    records: Records,
    sequence: str,
    frames: Sequence[FrameFiles],
    listener: Listener,
) -> BatchRequest:
    """Returns the request for the frames of a sequence, with adapted weights where they help.

    The weights lie in OUTPUT/adapted with a record. They are used again while settings and files
    of the frames that they learnt from are the same.

    Args:
        records: The results of the batch.
        sequence: Name of the sequence.
        frames: Frames of the sequence.
        listener: Receives what was decided; if it stops the batch, KeyboardInterrupt is raised.

    Raises:
        UsageError: The network takes no points.
    """
    request = records.request
    name = quote(sequence, safe="") or "frames"
    spread = np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).round().astype(int)
    lessons = [request_of(request, frames[index]) for index in spread]
    named = f"{sequence}: " if sequence else ""
    folder = request.output / "adapted"
    weights, file = folder / f"{name}.safetensors", folder / f"{name}.json"
    try:
        # What was learnt before, or is now.
        digest = _digest(records.settings, lessons)
        record = read_json(file) if file.exists() else {}
        if record.get("digest") != digest or not (record.get("why") or weights.exists()):
            why = _learn(lessons, weights, listener)
            record = {"digest": digest, "why": why}
            make_folder(folder)
            write_json(file, record)
    except (InputError, DivergedError) as error:
        record = {"why": str(error)}
    if record["why"]:
        listener.say(f"adapt: {named}the network's own weights are used: {record['why']}")
        return request
    listener.say(f"adapt: {named}{len(frames):,} frames are refined with {weights}")
    return replace(request, refine=request.refine.with_fields(checkpoint=weights))


def _learn(
    lessons: Sequence[RefineRequest],
    path: Path,
    listener: Listener,
) -> str | None:
    """Writes adapted weights if they are better beyond chance; returns why they are not."""
    from safetensors.torch import save_file  # these import torch

    from pnpdepth_cli.commands.refinement.refine_image import read_requested
    from pnpdepth_cli.frames.adapt import learn, too_little, weights_in_place
    from pnpdepth_cli.frames.resolve import resolve_definition
    from pnpdepth_cli.models.network import load_network

    def check() -> None:
        if listener.stopped():
            raise KeyboardInterrupt

    def read() -> Iterator[tuple[str, Frame]]:
        for each in lessons:
            check()
            yield each.files.name, read_requested(each)

    # The network learns from the frames, if they are enough.
    frames = read()
    name, first = next(frames)
    if why := too_little(len(lessons), first):
        return why
    choice = lessons[0].network
    network = load_network(choice.model, choice.checkpoint, choice.device)
    network = resolve_definition(network, first.registered())
    frames, seed = itertools.chain([(name, first)], frames), lessons[0].method.seed
    try:
        learnt = learn(network, frames, seed=seed, on_step=check)
    except UsageError as error:
        raise UsageError(
            "--adapt needs a network that takes points, such as compact, as the first --model"
        ) from error
    if not learnt.is_better:
        return str(learnt)
    listener.say(f"adapt: {learnt}")
    # All its tensors are written, those that learnt among them.
    with weights_in_place(network, learnt.weights):
        state = network.module.state_dict()
        copies = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    make_folder(path.parent)
    with atomic_path(path) as file:
        save_file(copies, file)
    return None


def _digest(settings: Mapping[str, object], lessons: Sequence[RefineRequest]) -> str:
    """The SHA-256 of the settings and files that the weights are learnt from."""
    files = [{part: fingerprint(p).sha256 for part, p in input_files(each)} for each in lessons]
    text = json.dumps([settings, files], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
