"""The settings of a refinement follow from the request and the network's defaults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.models.definition import FOREIGN, ModelDefinition, Multiple
from pnpdepth_cli.pipeline.refinement.request import RefineRequest, effective_settings
from tests.core.networks import UNet

REQUEST = RefineRequest(image=None, sparse=Path("points.npy"))
STRANGER = ModelDefinition(
    name="stranger", input_kind="rgb", size=Multiple(8), build=UNet, defaults=FOREIGN
)


def test_without_a_word_the_settings_are_the_networks() -> None:
    settings = effective_settings(STRANGER, REQUEST)
    for name in ("iterations", "lr", "loss", "update", "schedule", "blur"):
        assert getattr(settings, name) == getattr(FOREIGN, name)
    plain = ModelDefinition(name="plain", input_kind="rgb", size=Multiple(8), build=UNet)
    assert effective_settings(plain, REQUEST) == RefineSettings()


def test_another_update_starts_from_the_papers_step() -> None:
    settings = effective_settings(STRANGER, replace(REQUEST, update="sign"))
    paper = RefineSettings()
    assert (settings.lr, settings.schedule, settings.blur) == (0.01, "constant", 0)
    assert (settings.lr, settings.schedule, settings.blur) == (
        paper.lr, paper.schedule, paper.blur,
    )  # fmt: skip
    assert (settings.iterations, settings.loss) == (FOREIGN.iterations, FOREIGN.loss)


def test_what_the_user_says_holds() -> None:
    asked = replace(
        REQUEST, update="adam", lr="2%", schedule="linear", spread=0.5, keep_best=True,
        iterations=3, parameters="channels", anchor=0.5, line_search=True,
    )  # fmt: skip
    settings = effective_settings(STRANGER, asked)
    for name in (
        *("update", "lr", "schedule", "keep_best", "iterations"),
        *("parameters", "line_search"),
    ):
        assert getattr(settings, name) == getattr(asked, name)
    assert (settings.blur, settings.proximity) == (asked.spread, asked.anchor)
    assert effective_settings(STRANGER, replace(REQUEST, spread=0)).blur == 0


@pytest.mark.parametrize("spread", [-0.1, float("nan"), float("inf")])
def test_a_spread_that_is_no_distance_is_refused(spread: float) -> None:
    with pytest.raises(UsageError, match="no distance"):
        effective_settings(STRANGER, replace(REQUEST, spread=spread))


@pytest.mark.parametrize("anchor", [-0.1, float("nan"), float("inf")])
def test_what_is_no_weight_is_refused(anchor: float) -> None:
    with pytest.raises(UsageError, match="is no weight; give 0 or more"):
        effective_settings(STRANGER, replace(REQUEST, anchor=anchor))
