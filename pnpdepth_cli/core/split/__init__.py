"""Cutting any network at any layer: f = f_rear ∘ f_front."""

from pnpdepth_cli.core.split.split import Split, gradient_at

__all__ = ["Split", "gradient_at"]
