"""The settings of a refinement follow from the request and the network's defaults."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import click
import pytest

from pnpdepth_cli.cli.batch import batch
from pnpdepth_cli.cli.options import taken
from pnpdepth_cli.cli.refine import refine
from pnpdepth_cli.commands.refinement.request import FrameFiles, OutputOptions, RefineRequest
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, ModelDefinition, Multiple
from pnpdepth_cli.settings import PAPER, Settings, options_of
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
    assert resolve_settings(plain, METHOD) == PAPER


def test_the_users_options_override_the_definition_and_another_update_its_step() -> None:
    settings = resolve_settings(STRANGER, replace(METHOD, update="sign"))
    assert (settings.lr, settings.schedule, settings.blur) == (0.01, "constant", 0)
    for name in ("iterations", "loss"):
        assert getattr(settings, name) == getattr(UNTUNED_DEFAULTS, name)
    asked = replace(
        METHOD, update="adam", lr="2%", schedule="linear", blur=0.0, iterations=3
    )  # fmt: skip
    settings = resolve_settings(STRANGER, asked)
    assert {name: getattr(settings, name) for name in asked.given()} == asked.given()


@pytest.mark.parametrize("command", [refine, batch])
def test_names_and_values_reach_the_settings(command: click.Command) -> None:
    arguments = ["a", "-o", "b", "--set", "output-scale=2,sparse-size-ok"]
    arguments += ["--set", "precision=bf16"]
    arguments += ["--sparse", "s", "--scan", "extrinsics=pose.txt"] if command is refine else []
    params = dict(command.make_context("command", arguments).params)
    values = taken(FrameFiles, params) | taken(OutputOptions, params)
    assert params["precision"] == "bf16"
    assert params.get("extrinsics") == (Path("pose.txt") if command is refine else None)
    assert (values["output_scale"], values["sparse_size_ok"]) == (2.0, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lr=1", "choose from sparse-size-ok, "),
        ("output-scale", "--set output-scale must be output-scale="),
        ("sparse-size-ok=1", "must be sparse-size-ok"),
        ("precision=all", "'all' is not one of"),
        ("output-scale=x", "output-scale 'x' is neither"),
    ],
)
def test_what_is_no_name_or_no_value_is_refused(text: str, message: str) -> None:
    with pytest.raises((UsageError, click.UsageError), match=message):
        refine.make_context("refine", ["a.png", "--sparse", "s.png", "--set", text])


def test_every_field_belongs_to_one_group_and_its_option_is_one_of_refine() -> None:
    groups = [getattr(RefineRequest(), group.name) for group in fields(RefineRequest)]
    names = [each.name for group in groups for each in fields(group)]
    assert len(names) == len(set(names))
    spelled = {name for option in refine.params for name in option.opts}
    for group in groups:
        assert {each.flag.split()[0] for each in options_of(type(group))} <= spelled
