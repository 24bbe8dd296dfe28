"""Adapted weights on disk, and the model card beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from safetensors.torch import save_file
from torch import Tensor, nn

from pnpdepth_cli import __version__
from pnpdepth_cli.io.atomic import all_or_none, atomic_path
from pnpdepth_cli.pipeline.adaptation.request import AdaptRequest


@dataclass(frozen=True, kw_only=True)
class Adapted:
    """What was learnt, and from what."""

    network: str
    """Name of the network."""
    checkpoint: str | None
    """The weights it began with. None: its own."""
    source: str
    """The frames."""
    output: str
    """The file of the adapted weights."""
    training_frames: int
    """Frames learnt from."""
    validation_frames: int
    """Frames that decided which weights are written."""
    steps: int
    """Updates of the weights."""
    kept: int
    """Updates after which the weights are those written; 0 leaves them as they were."""
    lr: float
    """Step size at the start."""
    seed: int
    """Of masks and order."""
    loss: str
    """Name of the loss at hidden points."""
    hidden: float
    """Fraction of the points that was hidden at every update."""
    losses: dict[int, float]
    """Loss at hidden points of the validation frames by the number of updates."""

    @property
    def change(self) -> float:
        """Loss of the written weights over that of the first, minus 1."""
        return self.losses[self.kept] / self.losses[0] - 1


def write_adapted(
    request: AdaptRequest,
    adapted: Adapted,
    module: nn.Module,
    moved: Mapping[nn.Parameter, Tensor],
) -> None:
    """Writes all tensors of the network with those that moved, and the card; both or none.

    Raises:
        OutputError: A file cannot be written.
    """
    state = dict(module.state_dict())
    for name, parameter in module.named_parameters(remove_duplicate=False):
        if parameter in moved:
            state[name] = moved[parameter]
    copies = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    with all_or_none((request.output, request.card)):
        with atomic_path(request.output) as path:
            save_file(copies, path)
        with atomic_path(request.card) as path:
            path.write_text(card_of(adapted, request.output.name), encoding="utf-8")


def card_of(adapted: Adapted, file: str) -> str:
    """Returns the model card in Markdown."""
    rows = "\n".join(f"| {updates} | {loss:.5f} |" for updates, loss in adapted.losses.items())
    return f"""# {file}

Weights of `{adapted.network}`, adapted to the frames of `{adapted.source}` by
`pnpdepth adapt` {__version__}. Use: `--model {adapted.network} --checkpoint {file}`.

- **Start**: {adapted.checkpoint or "the network's own weights"}.
- **Data**: frames to learn from: {adapted.training_frames}; for validation:
  {adapted.validation_frames}; images and sparse depth, no ground truth.
- **Method**: {adapted.hidden:.0%} of the points of a frame are hidden from the input, and the
  loss (`{adapted.loss}`) is taken at these. {adapted.steps} updates, step size {adapted.lr:g},
  seed {adapted.seed}.
- **Written**: the weights after {adapted.kept} updates, whose validation loss is the smallest:
  {adapted.change:+.1%} against the start.
- **Limits**: adapted to this camera, sensor and scene; others may get worse. The licence of the
  start and that of the frames apply.

| updates | loss at hidden points of the validation frames |
|---|---|
{rows}
"""
