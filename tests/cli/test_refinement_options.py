"""The settings of a refinement follow from the request and the network's defaults."""

from __future__ import annotations

from dataclasses import fields, replace

from pnpdepth_cli.cli.refine_commands import batch
from pnpdepth_cli.commands.refinement.refine_request import GROUPS, RefineRequest
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, ModelDefinition, Multiple
from pnpdepth_cli.settings import PAPER, Settings, flag_of, options_of
from tests.core.networks import UNet

METHOD = Settings()
PLAIN = ModelDefinition(name="plain", input_kind="rgb", size=Multiple(8), build=UNet)
STRANGER = replace(PLAIN, defaults=UNTUNED_DEFAULTS)


def test_settings_are_the_users_then_the_networks_then_the_papers() -> None:
    assert resolve_settings(PLAIN, METHOD) == PAPER.closed()
    settings = resolve_settings(STRANGER, METHOD)
    for name in ("iterations", "lr", "loss", "update", "schedule", "blur"):
        assert getattr(settings, name) == getattr(UNTUNED_DEFAULTS, name)
    # another update rule than the network's resets its step
    settings = resolve_settings(STRANGER, replace(METHOD, update="sign"))
    assert (settings.lr, settings.schedule, settings.blur) == (0.01, "constant", 0)
    asked = replace(METHOD, update="adam", lr="2%", schedule="linear", blur=0.0, iterations=3)
    settings = resolve_settings(STRANGER, asked)
    assert {name: getattr(settings, name) for name in asked.given()} == asked.given()


def test_every_field_belongs_to_one_group_and_its_option_is_one_of_batch() -> None:
    request = RefineRequest()
    groups = [request, *(getattr(request, name) for name in GROUPS)]
    names = [each.name for group in groups[1:] for each in fields(group)]
    names += [each.name for each in fields(request) if each.name not in GROUPS]
    assert len(names) == len(set(names))
    spelled = {name for option in batch.params for name in option.opts}
    for group in groups:
        assert {*map(flag_of, options_of(type(group)))} <= spelled
