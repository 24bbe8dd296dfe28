"""`python -m tests.commands.killed_batches FOLDER KILLS`: a batch that is killed over and over.

torch is imported once and every run is forked from here, so a run starts in milliseconds; it is
killed by a real SIGKILL at a random moment. After each kill, what is there must be whole; at the
end, it must be what a run gives that nobody disturbs. Prints how it went as JSON.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import torch

from tests.commands.batches import batch, pairs_on_disk, results, times

NAMES = ("a", "b", "c", "sub/d", "sub/e")
OUT = Path("frames/out")


def fork_batch() -> int:
    """The process number of a batch that has just begun."""
    child = os.fork()
    if child:
        return child
    try:
        batch(Path("frames"))
    except BaseException as error:
        os.write(2, f"{error!r}\n".encode())
        os._exit(1)
    os._exit(0)


def finish(child: int) -> None:
    """The batch has come to its end."""
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


def recorded() -> tuple[str, ...]:
    """The names of the frames that have a record."""
    return tuple(name for name in NAMES if (OUT / f"{name}.json").exists())


def main(folder: Path, kills: int) -> None:
    """Kill it so often, and see."""
    torch.set_num_threads(1)
    folder.mkdir(exist_ok=True)
    os.chdir(folder)
    pairs_on_disk(Path("frames"), NAMES)
    started = time.monotonic()
    finish(fork_batch())
    longest = time.monotonic() - started
    undisturbed = results(OUT)
    shutil.rmtree(OUT)
    moments = random.Random(0)
    killed = interrupted = 0
    while killed < kills:
        # What is done must not be done again.
        done, before = recorded(), times(OUT)
        kept = {name: when for name, when in before.items() if name.startswith(done)}
        child = fork_batch()
        time.sleep(moments.uniform(0, longest))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not OUT.exists():
            longest *= 1.1  # nothing had begun: the machine is busier than at the start
            continue
        # What is there must be whole, but for hidden files, which were being written.
        there = {
            name: content
            for name, content in results(OUT).items()
            if not Path(name).name.startswith(".")
        }
        assert there.items() <= undisturbed.items(), "a file is half-written or wrong"
        now = times(OUT)
        assert kept.items() <= now.items(), "done work was done again"
        if os.WIFSIGNALED(status):
            killed += 1
            depths = {name.partition("_")[0] for name in there if name.endswith("_depth.png")}
            interrupted += bool(depths - {*recorded()}) or len(now) > len(there)
        else:
            shutil.rmtree(OUT)
    finish(fork_batch())
    assert results(OUT) == undisturbed, "the resumed run gave something else, or leftovers"
    assert recorded() == NAMES
    sys.stdout.write(json.dumps({"kills": killed, "interrupted": interrupted}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
