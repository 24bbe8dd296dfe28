"""A method chooses the steps, and a setting tunes one of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pnpdepth_cli.completion.residual_field import ResidualField
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.frames.frame import Refined
from pnpdepth_cli.frames.method import Method
from pnpdepth_cli.frames.open_network import MIRRORED_BELOW
from pnpdepth_cli.models.network import load_network
from pnpdepth_cli.settings import Settings
from tests.frames.scenes import Brightness, Nearest, depth_of_scene, frame_in_memory, member

ONE_SETTING: tuple[dict[str, Any], ...] = (
    {"iterations": 1},
    {"iterations": 20},
    {"lr": "2%"},
    {"lr": 0.02},
    {"loss": "l2"},
    {"loss": "cauchy"},
    {"update": "sgd"},
    {"update": "adam"},
    {"layer": "layer"},
    {"align": "affine"},
    {"propagate": "local"},
)


def refined(
    network: type[Brightness] | type[Nearest],
    count: int = 60,
    *,
    uncertainty: bool = False,
    **asked: Any,
) -> Refined:
    """The scene, refined with these settings."""
    frame = frame_in_memory(count)
    networks = [member(network).network]
    asked_for = Settings(**asked)
    with Method(networks, asked_for, frame, uncertainty=uncertainty) as method:
        return method.refine(frame, with_stages=True)


@pytest.mark.parametrize("method", ["fused", "alone"])
@pytest.mark.parametrize("setting", ONE_SETTING, ids=str)
def test_a_setting_tunes_its_step_and_leaves_all_others(
    method: str, setting: dict[str, Any]
) -> None:
    plain = refined(Brightness, method=method)
    tuned = refined(Brightness, method=method, **setting)
    assert tuned.stages.keys() == plain.stages.keys()
    assert tuned.weights.keys() == plain.weights.keys()
    assert tuned.alignment is not None
    assert tuned.propagation == setting.get("propagate", "gp")
    gt = depth_of_scene().numpy()
    plain_error = np.abs(plain.depth - gt).mean()
    assert np.abs(tuned.depth - gt).mean() < 1.15 * plain_error + 0.002


def test_without_updates_all_other_steps_stay() -> None:
    plain = refined(Brightness)
    without = refined(Brightness, iterations=0)
    assert plain.stages.keys() - without.stages.keys() == {"updated"}


def test_without_propagation_all_other_steps_stay() -> None:
    plain = refined(Brightness)
    without = refined(Brightness, propagate="none")
    assert plain.stages.keys() - without.stages.keys() == {"propagated"}
    assert without.propagation == "none"
    assert without.alignment is not None


def test_without_alignment_all_other_steps_stay() -> None:
    plain = refined(Brightness)
    without = refined(Brightness, align="none")
    assert without.alignment is None
    assert without.stages.keys() == plain.stages.keys()


def test_the_papers_method_is_five_updates_of_one_network_and_nothing_else() -> None:
    paper = refined(Brightness, method="paper")
    assert len(paper.losses) == 6  # of z_0 and after each of 5 updates
    assert paper.propagation == "none"
    assert paper.alignment is None
    assert paper.validation is None
    assert paper.weights == {"brightness": 1.0}


def test_the_papers_method_makes_as_many_updates_as_are_asked_for() -> None:
    assert len(refined(Brightness, method="paper", iterations=9).losses) == 10


def test_the_papers_method_gains_a_step_that_is_asked_for() -> None:
    assert refined(Brightness, method="paper", align="affine").alignment is not None
    assert refined(Brightness, method="paper", propagate="gp").propagation == "gp"


def test_stated_updates_that_do_harm_are_not_used_which_is_said() -> None:
    plain = refined(Brightness, 100, method="alone", iterations=0)
    harmful = refined(Brightness, 100, method="alone", iterations=1, lr=0.8)
    assert any("updates of z are not used" in note for note in harmful.notes)
    assert "updated" in harmful.stages
    assert np.array_equal(harmful.depth, plain.depth)


def test_updates_of_the_included_network_that_do_harm_are_not_used_in_the_mirrored_frame() -> None:
    frame = frame_in_memory(MIRRORED_BELOW - 100)

    def refined_by_compact(**asked: Any) -> Refined:
        with Method([load_network("compact", None, "cpu")], Settings(**asked), frame) as method:
            return method.refine(frame)

    plain = refined_by_compact(iterations=0)
    harmful = refined_by_compact(iterations=1, lr=0.8)
    assert any("updates of z are not used" in note for note in harmful.notes)
    assert np.array_equal(harmful.depth, plain.depth)


def test_a_setting_that_nothing_uses_is_said() -> None:
    def unused(refined: Refined) -> list[str]:
        return [note for note in refined.notes if "not used" in note]

    (note,) = unused(refined(Nearest, lr="3%", loss="l2"))
    assert note.startswith("`lr`, `loss`:")
    assert unused(refined(Nearest, lr="3%", iterations=2)) == []
    assert unused(refined(Brightness, lr="3%")) == []


@pytest.mark.parametrize("count", [20, 100, 500])
@pytest.mark.parametrize("method", ["fused", "alone"])
def test_no_residual_field_is_made_twice(
    count: int, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Counter[tuple[bytes, bytes, bytes]]()
    build = ResidualField.__init__

    def counted(field: ResidualField, prediction: Any, points: Any, rgb: Any) -> None:
        arrays = (prediction, points.xy, points.depth)
        made[tuple(array.numpy().tobytes() for array in arrays)] += 1  # type: ignore[index]
        build(field, prediction, points, rgb)

    monkeypatch.setattr(ResidualField, "__init__", counted)
    refined(Brightness, count, method=method, uncertainty=True)
    assert made
    assert max(made.values()) == 1


def test_the_shipped_network_is_updated_where_the_user_says_so() -> None:
    frame = frame_in_memory(60)
    losses = []
    for asked in (Settings(), Settings(iterations=3), Settings(iterations=3, method="alone")):
        torch.manual_seed(0)
        with Method([load_network("compact", None)], asked, frame) as method:
            losses.append(len(method.refine(frame).losses))
    assert losses == [1, 4, 4]  # of few points it gains nothing, so that it is not by default


def with_map(values: torch.Tensor, count: int = 60, **asked: Any) -> Refined:
    """The scene, refined with a depth map in the place of a network's output."""
    frame = replace(frame_in_memory(count), predicted=(values,))
    with Method([load_network("compact", None)], Settings(**asked), frame) as method:
        return method.refine(frame, with_stages=True)


@pytest.fixture
def disparity() -> torch.Tensor:
    """The scene as disparity of unknown scale and shift, unknown in its first 9 rows."""
    values = 0.7 + 3 / depth_of_scene()
    values[:9] = torch.nan
    return values


def test_a_depth_map_takes_the_place_of_a_networks_output(disparity: torch.Tensor) -> None:
    result = with_map(disparity)
    assert [*result.stages] == ["before", "propagated", "alone"]
    assert not result.before[:9].any()


def test_a_map_of_disparity_is_recognised(disparity: torch.Tensor) -> None:
    alignment = with_map(disparity).alignment
    assert alignment is not None
    assert alignment.reading == "disparity"


def test_where_a_depth_map_is_unknown_the_result_is_known(disparity: torch.Tensor) -> None:
    result = with_map(disparity)
    assert result.depth.all()
    assert np.abs(result.depth - depth_of_scene().numpy())[9:].mean() < 0.01


def test_a_depth_map_alone_has_all_of_the_weight(disparity: torch.Tensor) -> None:
    assert with_map(disparity, method="alone").weights == {"depth map": 1.0}


def test_a_setting_of_updates_is_not_used_with_a_depth_map_which_is_said(
    disparity: torch.Tensor,
) -> None:
    notes = [note for note in with_map(disparity, lr="3%").notes if "not used" in note]
    assert [note.split(":")[0] for note in notes] == ["`lr`"]


@pytest.mark.parametrize("asked", [{"method": "paper"}, {"layer": "0"}], ids=str)
def test_what_needs_z_of_a_network_is_refused_beside_a_depth_map(asked: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="depth map"):
        with_map(depth_of_scene(), **asked)


def test_a_depth_map_of_another_scene_has_no_part() -> None:
    noise = torch.rand(*depth_of_scene().shape, generator=torch.Generator().manual_seed(1))
    result = with_map(noise, 100)
    assert result.weights["depth map"] < 0.01
    assert any("depth map has no part" in note for note in result.notes)
