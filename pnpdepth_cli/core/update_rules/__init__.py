"""U of equation 3: rules from the gradient at z to the direction of its update, one module each.

Every module has a function `update_rule()` that makes a new rule. A rule is called with the
gradients of one refinement, in order, and returns a direction of the same shape; z moves by
−α × direction. `pnpdepth_cli.choices.UPDATES` finds the modules by file name.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Update = Callable[[Tensor], Tensor]
