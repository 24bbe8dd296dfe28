"""What `pnpdepth compare` finds: runs on their common frames, and gains over the first."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pnpdepth_cli.commands.shared.statistics import Clusters
from pnpdepth_cli.io.file_bytes import plain
from pnpdepth_cli.measures import Measure

Means = dict[str, float | None]
"""Means over frames by the key of their measure; None where no frame has a value."""

ALPHA = 0.05
"""Adjusted p below which a difference counts, the usual level."""


@dataclass(frozen=True)
class Gain:
    """How much better a run is than the first by one measure; NaN for what there is not."""

    percent: float
    """Gain in per cent of the first run's mean; positive is better."""
    low_percent: float
    """Lower end of the 95 % interval of `percent`."""
    high_percent: float
    """Upper end of the 95 % interval of `percent`."""
    p_value: float
    """Probability of a difference as large between equal runs."""
    p_adjusted: float
    """`p_value` adjusted for the number of tests, of all measures and runs."""


@dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A run on the frames that all runs scored."""

    name: str
    """Name of the run; its path where two runs have one name."""
    path: str
    """The run as the user named it."""
    mean: Means
    """Means over the frames on which all runs have the measure."""
    before: Means
    """Means of the same frames before refinement, where the run has them."""
    varied: dict[str, str]
    """Options that `batch --vary` varied, with their values; empty for other runs."""
    coverage: float | None
    """Mean fraction of the ground truth with a prediction. None: the run does not say."""
    gains: dict[str, Gain]
    """Gains by the key of the measure; empty for the reference, the first run that was given."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Runs on the frames that all of them scored, compared with the first."""

    frames: tuple[str, ...]
    """Names of the frames."""
    measures: tuple[Measure, ...]
    """What the runs are compared by."""
    scoring: dict[str, object]
    """The rules that decide the scores, as `EvalRequest.scoring` has them; those of all runs."""
    runs: tuple[ComparedRun, ...]
    """The runs of a study in the order of its values, others as they were given."""
    clusters: Clusters
    """The sets of frames that count as independent."""
    notes: list[str]
    """Lines for a person; a warning begins with "warning"."""

    @property
    def reference(self) -> ComparedRun:
        """The run that the others are compared with."""
        return next(run for run in self.runs if not run.gains)

    def to_json(self) -> dict[str, object]:
        """Returns what `compare --json` prints; NaN and infinity are None."""
        # Clusters and measures convert themselves; all other fields are plain values.
        converted = {
            "clusters": self.clusters.to_json(),
            "measures": [measure.to_json() for measure in self.measures],
        }
        return {"command": "compare", **plain(vars(self) | converted)}


def numbers_of(values: Iterable[str]) -> dict[str, float] | None:
    """Returns the number that each value is, of `3%` it is 3; None unless all are numbers."""
    try:
        return {value: float(value.removesuffix("%")) for value in values}
    except ValueError:
        return None


def positions_of(values: Iterable[str]) -> dict[str, float]:
    """Returns where each value of an option lies among the others, for an order or an axis.

    That is the number that it is, if all values are numbers; else 0, 1, … in the order given.
    """
    different = [*dict.fromkeys(values)]
    numbers = numbers_of(different)
    if numbers is not None:
        return numbers
    return {value: float(place) for place, value in enumerate(different)}
