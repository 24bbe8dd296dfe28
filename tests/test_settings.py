"""Settings: what is open, what wins, and which values are refused."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from torch import nn

from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.resolve import resolve_settings
from pnpdepth_cli.models.definition import UNTUNED_DEFAULTS, ModelDefinition, Multiple
from pnpdepth_cli.settings import PAPER, ClosedSettings, Settings

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(("stated", "number"), [("1e-2", 0.01), (np.float32(0.5), 0.5)])
def test_a_rate_is_the_same_as_text_or_as_a_number_of_numpy(stated: Any, number: float) -> None:
    assert Settings(lr=stated) == Settings(lr=number)


def test_what_is_left_open_is_the_papers() -> None:
    assert Settings().closed() == PAPER.closed() == ClosedSettings()


def test_the_papers_settings_are_5_updates_by_the_sign_of_0_01_for_l1_unaligned() -> None:
    paper = (PAPER.iterations, PAPER.lr, PAPER.loss, PAPER.update, PAPER.align)
    assert paper == (5, 0.01, "l1", "sign", "none")


def test_given_are_the_settings_that_were_stated_and_zero_is_stated() -> None:
    assert Settings(iterations=3, blur=0.0).given() == {"iterations": 3, "blur": 0.0}


def test_of_two_settings_the_first_win() -> None:
    user = Settings(lr="3%", blur=0.0)
    network = Settings(lr=0.5, blur=2.0, loss="l2")
    assert user.over(network) == Settings(lr="3%", blur=0.0, loss="l2")


def test_what_the_user_leaves_open_is_the_networks_and_then_the_papers() -> None:
    plain = ModelDefinition(name="plain", input_kind="rgb", size=Multiple(8), build=nn.Identity)
    stranger = replace(plain, defaults=UNTUNED_DEFAULTS)
    assert resolve_settings(plain, Settings()) == PAPER.closed()
    assert resolve_settings(stranger, Settings()) == UNTUNED_DEFAULTS.over(PAPER).closed()
    # another update rule than the network's resets its step
    settings = resolve_settings(stranger, Settings(update="sign"))
    assert (settings.lr, settings.schedule, settings.blur) == (0.01, "constant", 0)
    asked = Settings(update="adam", lr="2%", schedule="linear", blur=0.0, iterations=3)
    settings = resolve_settings(stranger, asked)
    assert {name: getattr(settings, name) for name in asked.given()} == asked.given()


def test_settings_that_only_updates_use_are_those_of_equation_3() -> None:
    assert Settings().of_updates == Settings(seed=3, align="auto", propagate="gp").of_updates == []
    asked = Settings(method="paper", lr="3%", layer="0.5", iterations=2)
    assert asked.of_updates == ["layer", "iterations", "lr"]


def test_a_setting_that_does_not_exist_is_refused_with_the_likely_one() -> None:
    with pytest.raises(UsageError, match="did you mean 'iterations'"):
        Settings(iteration=3)
    with pytest.raises(UsageError, match="there are method, layer"):
        Settings(x=3)
    assert copy.copy(Settings(lr="3%")) == pickle.loads(pickle.dumps(Settings(lr="3%")))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("iterations", value) for value in ("5", -1, 2.0, True)),
        *(("lr", value) for value in ("x%", "", "%", "3%%", "0%", 0, -1, "nan", INF)),
        *(("blur", value) for value in (-1, NAN, INF)),
        ("method", "foo"),
        ("schedule", "foo"),
        ("align", ["auto"]),
        ("layer", 3),
        ("seed", -1),
    ],
)
def test_a_value_that_refinement_cannot_use_is_refused_by_name(field: str, value: Any) -> None:
    with pytest.raises(UsageError, match=f"^{field} must be .*, got "):
        Settings(**{field: value})
