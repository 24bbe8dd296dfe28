"""The sign of the gradient, the paper's choice (after Kurakin et al. 2017)."""

from __future__ import annotations

import torch

from pnpdepth_cli.core.update_rules import Update


def update_rule() -> Update:
    """Returns the rule g → sign(g)."""
    return torch.sign
