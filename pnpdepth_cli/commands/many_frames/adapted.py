"""Weights that learn from the points of a sequence before its frames are refined: `--adapt`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from pnpdepth_cli.commands.many_frames.find_frames import input_files, request_of, sequences_of
from pnpdepth_cli.commands.many_frames.records import Records
from pnpdepth_cli.commands.requests.batch_request import Listener
from pnpdepth_cli.commands.requests.refine_request import RefineRequest
from pnpdepth_cli.dataset.frame_files import FrameFiles
from pnpdepth_cli.errors import DivergedError, InputError, UsageError
from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.file_bytes import fingerprint, read_json, write_json

MOST_FRAMES = 64
"""Frames of a sequence that are learnt from, spread over it."""


def with_adapted_weights(
    own: Records, frames: Sequence[FrameFiles], listener: Listener
) -> dict[str, Records]:
    """Returns the records of each frame by its name, with adapted weights where they help.

    The weights of a sequence lie in OUTPUT/adapted with a record. They are used again while
    settings and files of the frames that they learnt from are the same.

    Args:
        own: The records of the batch, with the network's own weights.
        frames: All frames of the batch.
        listener: Receives what was decided.

    Raises:
        UsageError: The network takes no points.
        KeyboardInterrupt: The listener stops the batch.
    """
    request = own.request
    of_frame = dict[str, Records]()
    for sequence, indices in sequences_of(frames).items():
        # A sequence is learnt from once, and its weights lie in a file of its name.
        name = quote(sequence, safe="") or "frames"
        weights = request.output / "adapted" / f"{name}.safetensors"
        count = min(len(indices), MOST_FRAMES)
        places = np.linspace(0, len(indices) - 1, count).round().astype(int)
        lessons = [request_of(request, frames[indices[place]]) for place in places]
        # A sequence that cannot be learnt from is refined with the network's own weights.
        try:
            why_not = _learn_once(own, lessons, weights, listener)
        except (InputError, DivergedError) as error:
            why_not = str(error)
        beginning = f"adapt: {sequence}: " if sequence else "adapt: "
        if why_not is None:
            listener.say(f"{beginning}{len(indices):,} frames are refined with {weights}")
            refine = replace(request.refine, checkpoint=weights)
            records = Records(replace(request, refine=refine))
        else:
            listener.say(f"{beginning}the network's own weights are used: {why_not}")
            records = own
        of_frame |= dict.fromkeys([frames[index].name for index in indices], records)
    return of_frame


def _learn_once(
    own: Records, lessons: Sequence[RefineRequest], weights: Path, listener: Listener
) -> str | None:
    """Writes adapted weights unless they are there; returns why not to use them, None if they help.

    Args:
        own: The records of the batch, with the network's own weights.
        lessons: The frames to learn from, and how each is refined.
        weights: File of the adapted weights; beside it lies a record of what was decided.
        listener: Receives what was learnt, and may stop the batch.

    Raises:
        UsageError: The network takes no points.
        InputError: A frame cannot be read.
        DivergedError: The weights diverged.
        KeyboardInterrupt: The listener stops the batch.
    """
    # A digest of the settings and the files. What was decided for the same digest holds still.
    files = [
        {name: fingerprint(path).sha256 for name, path in input_files(lesson)} for lesson in lessons
    ]
    text = json.dumps([own.settings, files], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    file = weights.with_suffix(".json")
    record: dict[str, str | None] = read_json(file) if file.exists() else {}
    is_decided = bool(record.get("why")) or weights.exists()
    if record.get("digest") != digest or not is_decided:
        record = {"digest": digest, "why": _learn(lessons, weights, listener)}
        make_folder(file.parent)
        write_json(file, record)
    return record["why"]


def _learn(lessons: Sequence[RefineRequest], path: Path, listener: Listener) -> str | None:
    """Writes adapted weights if they are better beyond chance; returns why not, None if written.

    Args:
        lessons: The frames to learn from, and how each is refined.
        path: File of the weights.
        listener: Receives what was learnt, and may stop the batch.

    Raises:
        UsageError: The network takes no points.
        InputError: A frame cannot be read.
        DivergedError: The weights diverged.
        KeyboardInterrupt: The listener stops the batch.
    """
    # Imported where they are used, as they import torch.
    from safetensors.torch import save_file

    from pnpdepth_cli.commands.refinement.requested import read_requested
    from pnpdepth_cli.frames.adapt import learn, reason_not_to_learn, weights_in_place
    from pnpdepth_cli.frames.resolve import resolve_definition
    from pnpdepth_cli.models.network import load_network

    def stop_if_asked() -> None:
        """Raises KeyboardInterrupt if the listener stops the batch."""
        if listener.stopped():
            raise KeyboardInterrupt

    # The network learns from the frames, if they are enough.
    request = lessons[0]  # all are refined alike
    first = read_requested(request)
    why_not = reason_not_to_learn(len(lessons), first)
    if why_not is not None:
        return why_not
    # What the network's definition leaves open is found on the first frame.
    network = load_network(request.model, request.checkpoint, request.device)
    network = resolve_definition(network, first.registered())
    frames = ((lesson.files.name, read_requested(lesson)) for lesson in lessons)
    try:
        learnt = learn(network, frames, seed=request.method.seed, on_step=stop_if_asked)
    # The Python API's error does not know of the options.
    except UsageError as error:
        raise UsageError(
            "--adapt needs a network that takes points, such as compact, as the first --model"
        ) from error
    if not learnt.is_better:
        return str(learnt)
    listener.say(f"adapt: {learnt}")
    # All its tensors are written, those that learnt among them; each as memory of its own, which
    # safetensors asks for.
    make_folder(path.parent)
    with weights_in_place(network, learnt.weights), atomic_path(path) as file:
        state = network.module.state_dict()
        tensors = {name: tensor.cpu().clone().contiguous() for name, tensor in state.items()}
        save_file(tensors, file)
    return None
