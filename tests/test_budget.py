"""One budget for all readers."""

from __future__ import annotations

import pytest

from pnpdepth_cli import budget
from pnpdepth_cli.budget import check_claim, set_max_pixels
from pnpdepth_cli.errors import InputError, ModelError


def test_the_default_is_64_megapixels_or_less_and_files_grow_with_max_pixels() -> None:
    try:
        for most, of_a_file in ((1 << 30, 1 << 32), (9, 1 << 20)):
            set_max_pixels(most)
            assert (budget.max_pixels(), budget.max_file_bytes()) == (most, of_a_file)
    finally:
        set_max_pixels(None)
    assert 1 << 20 < budget.max_pixels() <= 64_000_000
    assert budget.max_file_bytes() == 1 << 30
    assert budget.max_decoded_bytes() > 32 * budget.max_pixels()
    # A small file may hold an image of one colour, but not any number of values.
    assert budget.max_values_from(1) == 1 << 25
    assert budget.max_values_from(1 << 20) == min(budget.max_pixels(), 1032 << 20)


def test_a_claim_is_refused_above_the_most_and_below_nothing() -> None:
    check_claim("a has 5 bytes", 5, 5)
    with pytest.raises(InputError, match=r"^a has bytes, more than 5; make it smaller$"):
        check_claim("a has bytes", -1, 5, way_out="make it smaller")
    with pytest.raises(ModelError):
        check_claim("a has 6 bytes", 6, 5, error=ModelError)
