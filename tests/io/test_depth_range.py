"""The line about the range of a depth file, and the warning about a wrong scale."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.depth import scale_warning
from pnpdepth_cli.io.formats import Reading

PNG = "16-bit PNG ÷ 256"


FLOAT = Reading("PFM", None, False)
BY_256, BY_1000 = (Reading("PNG", scale, False) for scale in (256.0, 1000.0))


@pytest.mark.parametrize("ratio", [np.nan, 0, 1, 2, 3.906 * 1.11, 3.906 / 1.11])
def test_a_ratio_that_no_wrong_scale_gives_needs_no_word(ratio: float) -> None:
    assert scale_warning("depths", ratio, {"--scale": BY_256, "--gt-scale": BY_256}) is None


def test_a_wrong_scale_that_was_assumed_is_an_error() -> None:
    kinds = {"--scale": FLOAT, "--gt-scale": BY_256._replace(assumed=True)}
    with pytest.raises(InputError):
        scale_warning("depths", 3.9, kinds)
