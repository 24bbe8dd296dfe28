"""Files that hold no run, and runs that repeat each other."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pnpdepth_cli.commands.compare import compare
from pnpdepth_cli.errors import InputError, UsageError
from pnpdepth_cli.io.file_bytes import write_json
from tests.commands.predictions import frame, scored
from tests.commands.runs import refined, run

BROKEN = ['{"frames": [1]}', '{"frames": [{"errors": {"ground_truth": {}}}]}', '{"measures": []}']


@pytest.mark.parametrize("text", BROKEN)
def test_a_file_without_scores_is_refused(tmp_path: Path, text: str) -> None:
    one = run(tmp_path / "one", [1.0])
    (tmp_path / "broken.json").write_text(text)
    for without_scores in (str(tmp_path / "broken.json"), f"{one}:before"):
        with pytest.raises(InputError, match=r"broken\.json|one") as error:
            compare([one, without_scores])
        assert "ValueError" not in str(error.value)


@pytest.mark.parametrize(
    "wrong", [{"better": None}, {"better": []}, {"decimals": "x"}, {"shown_factor": ""}, {"key": 5}]
)
def test_a_file_whose_measures_cannot_be_shown_is_refused(
    tmp_path: Path, wrong: dict[str, object]
) -> None:
    frame(tmp_path, [[11, 11]], [[10, 10]])
    good = scored(tmp_path).to_json()
    measures = good["measures"]
    assert isinstance(measures, list)
    for name, first in (("good", measures[0]), ("bad", measures[0] | wrong)):
        write_json(tmp_path / f"{name}.json", good | {"measures": [first, *measures[1:]]})
    paths = [str(tmp_path / f"{name}.json") for name in ("good", "bad")]
    compare([paths[0], paths[0]])
    with pytest.raises(InputError, match=r"bad\.json"):
        compare(paths)


def test_runs_without_updates_at_several_step_sizes_are_listed_once(tmp_path: Path) -> None:
    study = [
        refined(tmp_path, 0.5, iterations="0", lr="0.01"),
        refined(tmp_path, 0.4, iterations="5", lr="0.01"),
        refined(tmp_path, 0.5, iterations="0", lr="0.1"),
        refined(tmp_path, 0.3, iterations="5", lr="0.1"),
    ]
    found = compare(study)
    assert [run.path for run in found.runs] == [study[0], study[1], study[3]]
    assert found.reference.varied == {"iterations": "0"}
    (said,) = (note for note in found.notes if study[2] in note)
    assert study[0] in said
    # A run whose scores differ is another result, whatever its settings.
    other = refined(tmp_path, 0.6, iterations="0", lr="0.2")
    assert len(compare([study[0], other]).runs) == 2


def test_runs_that_all_gave_one_result_are_nothing_to_compare(tmp_path: Path) -> None:
    study = [refined(tmp_path, 0.5, iterations="0", lr=lr) for lr in ("0.01", "0.1")]
    with pytest.raises(UsageError, match=re.escape(study[1])):
        compare(study)
