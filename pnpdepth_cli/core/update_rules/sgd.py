"""Gradient descent."""

from __future__ import annotations

from pnpdepth_cli.core.update_rules import Update


def update_rule() -> Update:
    """Returns the rule g → g."""
    return lambda gradient: gradient
