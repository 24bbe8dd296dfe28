"""The settings of a refinement follow from the request and the network's defaults."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
from click.testing import CliRunner

from pnpdepth_cli.cli.refine import refine
from pnpdepth_cli.cli.sweep import sweep
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, ModelDefinition, Multiple
from pnpdepth_cli.pipeline.refinement.request import RefineRequest
from pnpdepth_cli.settings import Settings, options_of
from tests.core.networks import UNet

METHOD = Settings()
STRANGER = ModelDefinition(
    name="stranger", input_kind="rgb", size=Multiple(8), build=UNet, defaults=UNTUNED_DEFAULTS
)


def test_without_a_word_the_settings_are_the_networks() -> None:
    settings = resolve_settings(STRANGER, METHOD)
    for name in ("iterations", "lr", "loss", "update", "schedule", "blur"):
        assert getattr(settings, name) == getattr(UNTUNED_DEFAULTS, name)
    plain = ModelDefinition(name="plain", input_kind="rgb", size=Multiple(8), build=UNet)
    assert resolve_settings(plain, METHOD) == Settings()


def test_another_update_starts_from_the_papers_step() -> None:
    settings = resolve_settings(STRANGER, replace(METHOD, update="sign"))
    paper = Settings()
    assert (settings.lr, settings.schedule, settings.blur) == (0.01, "constant", 0)
    assert (settings.lr, settings.schedule, settings.blur) == (
        paper.lr, paper.schedule, paper.blur,
    )  # fmt: skip
    assert (settings.iterations, settings.loss) == (
        UNTUNED_DEFAULTS.iterations,
        UNTUNED_DEFAULTS.loss,
    )


def test_the_users_options_override_the_definition() -> None:
    request = replace(
        METHOD, update="adam", lr="2%", schedule="linear", blur=0.5, keep_best=True,
        iterations=3, parameters="channels", proximity=0.5, line_search=True,
    )  # fmt: skip
    settings = resolve_settings(STRANGER, request)
    for name in (
        *("update", "lr", "schedule", "keep_best", "iterations"),
        *("parameters", "line_search"),
    ):
        assert getattr(settings, name) == getattr(request, name)
    assert (settings.blur, settings.proximity) == (request.blur, request.proximity)
    assert resolve_settings(STRANGER, replace(METHOD, blur=0)).blur == 0


@pytest.mark.parametrize("blur", [-0.1, float("nan"), float("inf")])
def test_a_blur_that_is_no_distance_is_refused(blur: float) -> None:
    with pytest.raises(UsageError, match="no distance"):
        resolve_settings(STRANGER, replace(METHOD, blur=blur))


@pytest.mark.parametrize("proximity", [-0.1, float("nan"), float("inf")])
def test_what_is_no_weight_is_refused(proximity: float) -> None:
    with pytest.raises(UsageError, match="is no weight; give 0 or more"):
        resolve_settings(STRANGER, replace(METHOD, proximity=proximity))


def test_every_field_belongs_to_one_group() -> None:
    names = [each.name for group in fields(RefineRequest()) for each in fields(_group(group.name))]
    assert len(names) == len(set(names))


def test_every_option_of_a_request_is_an_option_of_refine() -> None:
    spelled = {name for option in refine.params for name in option.opts}
    for group in fields(RefineRequest()):
        for each in options_of(type(_group(group.name))):
            assert each.flag in spelled


def test_a_sweep_takes_what_decides_a_depth_and_nothing_else() -> None:
    names = {option.name for option in sweep.params}
    assert {each.name for each in fields(Settings)} <= names
    assert not names & {"auto", "holdout", "uncertainty", "format", "overwrite", "tile"}


def test_former_spellings_are_accepted_and_not_shown() -> None:
    context = refine.make_context("refine", ["a.png", "--sparse", "s.png", "--spread", "2"])
    assert context.params["blur"] == 2.0
    assert "--spread" not in CliRunner().invoke(refine, ["--help"]).output


def _group(name: str) -> Any:
    return getattr(RefineRequest(), name)
