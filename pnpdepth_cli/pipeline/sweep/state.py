"""Remembers the results of a sweep, and whether they are up to date."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from pnpdepth_cli.errors import OutputError
from pnpdepth_cli.io.fingerprint import Fingerprint, fingerprint, is_unchanged
from pnpdepth_cli.io.journal import Journal
from pnpdepth_cli.pipeline.sweep.plan import Run
from pnpdepth_cli.pipeline.sweep.points import OWN, calibration_file

RESULTS = ("sweep.json", "sweep.csv", "sweep_frames.csv", "sweep.tex")


class SweepState:
    """The results in `sweep.jsonl`, a line for each run.

    Raises:
        OutputError: If the folder has results that no sweep wrote.
    """

    def __init__(self, output: Path) -> None:
        path = output / "sweep.jsonl"
        unowned = [name for name in RESULTS if (output / name).exists()]
        if unowned and not path.exists():
            raise OutputError(
                f"{output / unowned[0]} exists, and no sweep wrote it; -o names another folder"
            )
        self._journal = Journal(path, "run")

    def notes(self) -> list[str]:
        """Returns a warning if the journal is damaged."""
        lost = self._journal.lost
        text = f"warning: {lost} lines of {self._journal.path} are damaged; their runs are repeated"
        return [text] if lost else []

    def result(self, key: str) -> dict[str, Any] | None:
        """Returns the run's line; None if it was not computed."""
        line = self._journal.newest(key)
        return line if line is not None and line.get("state") == "done" else None

    def is_done(self, run: Run) -> bool:
        """Returns True if all scores of the run exist, of the files as they are now."""
        line = self._still_good(run)
        return line is not None and {str(k) for k in run.iterations} <= line["scores"].keys()

    def add(self, run: Run, result: dict[str, Any]) -> None:
        """Records the result, with known scores after other numbers of updates."""
        before = self._still_good(run)
        if before is not None and "scores" in result:
            result = result | {"scores": before["scores"] | result["scores"]}
        self._journal.append(
            {
                "run": run.key,
                "frame": run.frame.name,
                "seed": run.seed,
                "sampling": asdict(run.sampling),
                "method": None if run.method is None else run.method.record(),
                "inputs": {name: fingerprint(p).as_record() for name, p in _files(run).items()},
                **result,
            }
        )

    def fail(self, run: Run, message: str) -> None:
        """Records why the run failed; the next sweep tries it again."""
        self._journal.append(
            {"run": run.key, "frame": run.frame.name, "seed": run.seed, "state": "failed",
             "message": message}
        )  # fmt: skip

    def _still_good(self, run: Run) -> dict[str, Any] | None:
        line, files = self.result(run.key), _files(run)
        if line is None or line["inputs"].keys() != files.keys():
            return None
        known = {name: Fingerprint(**seen) for name, seen in line["inputs"].items()}
        return line if all(is_unchanged(files[name], known[name]) for name in files) else None


def _files(run: Run) -> dict[str, Path]:
    """The files that decide the run."""
    calib = calibration_file(run.sampling, run.frame)
    own = run.sampling.sensor == OWN
    read = {name: p for name, p in run.task.inputs.items() if own or name in ("image", "gt")}
    return read | ({} if calib is None else {"calib": calib})
