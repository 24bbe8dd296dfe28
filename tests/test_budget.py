"""One budget for all readers."""

from __future__ import annotations

import pytest

from pnpdepth_cli import budget
from pnpdepth_cli.budget import check_claim, set_max_pixels
from pnpdepth_cli.errors import InputError, ModelError


@pytest.mark.parametrize(("most", "of_a_file"), [(1 << 30, 1 << 32), (9, 1 << 20)])
def test_a_file_may_be_larger_where_more_pixels_are_allowed(most: int, of_a_file: int) -> None:
    try:
        set_max_pixels(most)
        assert (budget.max_pixels(), budget.max_file_bytes()) == (most, of_a_file)
    finally:
        set_max_pixels(None)


def test_the_default_is_64_megapixels_or_less() -> None:
    assert 1 << 20 < budget.max_pixels() <= 64_000_000


def test_by_default_a_file_has_one_gibibyte_at_most() -> None:
    assert budget.max_file_bytes() == 1 << 30


def test_decoded_values_have_more_than_32_bytes_for_a_pixel() -> None:
    assert budget.max_decoded_bytes() > 32 * budget.max_pixels()


def test_a_small_file_may_hold_an_image_of_one_colour_but_not_any_number_of_values() -> None:
    assert budget.max_values_from(1) == 1 << 25
    assert budget.max_values_from(1 << 20) == min(budget.max_pixels(), 1032 << 20)


def test_a_claim_is_refused_above_the_most_and_below_nothing() -> None:
    check_claim("a has 5 bytes", 5, 5)
    with pytest.raises(InputError, match=r"^a has bytes, more than 5; make it smaller$"):
        check_claim("a has bytes", -1, 5, way_out="make it smaller")
    with pytest.raises(ModelError):
        check_claim("a has 6 bytes", 6, 5, error=ModelError)
