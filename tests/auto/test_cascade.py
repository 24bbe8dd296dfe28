"""A network that takes another network's depth as a prior, and what competes with it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from pnpdepth_cli.auto.auto import refine_automatically
from pnpdepth_cli.auto.candidates import Candidate, RefinementConfig, cascades, default_config
from pnpdepth_cli.auto.choice import Competition
from pnpdepth_cli.auto.predictions import CandidateDepths, FramePasses, OpenNetworks
from pnpdepth_cli.core.refine import RefineSettings
from pnpdepth_cli.frames.frame import Frame
from pnpdepth_cli.models.definition import ModelDefinition, Multiple
from pnpdepth_cli.models.network import Network, load_network
from tests.auto.test_auto import in_memory
from tests.pipeline.frames import frame_on_disk

PLAIN = RefineSettings(iterations=0, align="none")


class Brightness(nn.Module):
    """Depth is the image's brightness, 1 to 2 m."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Identity()

    def forward(self, rgb: Tensor) -> Tensor:
        return self.layer(1.0 + rgb.mean(1, keepdim=True))


class TwicePrior(nn.Module):
    """Depth is twice the prior, or 5 m without one."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Identity()

    def forward(self, rgb: Tensor, sparse: Tensor, prior: Tensor | None = None) -> Tensor:
        return self.layer(torch.full_like(sparse, 5.0) if prior is None else 2.0 * prior)


def network(name: str, build: type[nn.Module], **of_definition: object) -> Network:
    definition = ModelDefinition(
        name=name, build=build, size=Multiple(4), layers=("layer",), **of_definition
    )
    module = build().eval()
    return Network(
        definition=definition, module=module, device=torch.device("cpu"), checkpoint=None
    )


BRIGHTNESS = network("brightness", Brightness, input_kind="rgb")
GIVEN = network("given", TwicePrior, input_kind="rgb+sparse", takes_prior=True)
NETWORKS = {"brightness": BRIGHTNESS, "given": GIVEN}
CONFIGS = tuple(RefinementConfig(network=name, layer="layer", settings=PLAIN) for name in NETWORKS)
CASCADE = Candidate(config=CONFIGS[1], prior=Candidate(config=CONFIGS[0]))


@pytest.fixture
def frame(tmp_path: Path) -> Frame:
    return in_memory(frame_on_disk(tmp_path))


def test_the_networks_that_take_a_prior_are_given_each_other_networks_depth() -> None:
    definitions = {name: each.definition for name, each in NETWORKS.items()}
    assert cascades(CONFIGS, definitions) == (CASCADE,)
    assert cascades(CONFIGS[1:], definitions) == ()


def test_the_prior_is_the_other_networks_depth(frame: Frame) -> None:
    with OpenNetworks(NETWORKS) as opened:
        depths = CandidateDepths(FramePasses(opened), frame, CONFIGS[0], CASCADE)
        prior = depths.dense(Candidate(config=CONFIGS[0]))
        assert torch.equal(depths.dense(CASCADE), 2.0 * prior)
        assert bool((depths.dense(Candidate(config=CONFIGS[1])) == 5.0).all())


def test_cascades_compete_and_are_recorded_by_their_names(frame: Frame) -> None:
    competition = Competition(configs=CONFIGS, cascades=(CASCADE,), propagations=("gp",))
    with OpenNetworks(NETWORKS) as opened:
        choice = refine_automatically(opened, competition, frame).choice
    tried = [one.candidate for one in choice.scored]
    assert CASCADE in tried
    assert str(CASCADE) == "given with brightness as prior"
    assert CASCADE.configs == (CONFIGS[1], CONFIGS[0])


def test_the_embedded_network_predicts_differently_with_a_prior(frame: Frame) -> None:
    compact = load_network("compact", None)
    config = default_config(compact.definition, "decoder.s8", PLAIN, network="compact")
    plain = Candidate(config=config)
    candidate = Candidate(config=config, prior=Candidate(config=CONFIGS[0]))
    with OpenNetworks({"brightness": BRIGHTNESS, "compact": compact}) as opened:
        depths = CandidateDepths(FramePasses(opened), frame, CONFIGS[0], plain)
        assert not torch.equal(depths.dense(candidate), depths.dense(plain))
        assert bool((depths.dense(candidate) > 0).all())
