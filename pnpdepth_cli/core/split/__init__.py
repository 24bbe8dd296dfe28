"""Cutting any network at any layer, or at its arguments: f = f_rear ∘ f_front."""

from pnpdepth_cli.core.split.split import InputSplit, Split, gradient_at

__all__ = ["InputSplit", "Split", "gradient_at"]
