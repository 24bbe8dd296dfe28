"""Propagation by diffusion that stops at edges."""

from __future__ import annotations

from pnpdepth_cli.completion.diffusion import diffuse
from pnpdepth_cli.completion.propagation import Propagation

propagation = Propagation(title="edge-aware diffusion", dense=diffuse)
