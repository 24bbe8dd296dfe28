"""The pixels of a list of points, on arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pnpdepth_cli.dataset.pixel_checks import check_pixels
from pnpdepth_cli.errors import InputError, NoPointsError

RNG = np.random.default_rng(0)
LIST = RNG.uniform(0, 1, (100, 2)) * (639, 479)


@pytest.mark.parametrize(
    ("xy", "error", "said"),
    [
        (LIST / (640, 480), InputError, "a.csv"),
        (2 * LIST / (640, 480) - 1, InputError, "a.csv"),
        (LIST - np.array([320, 240]), InputError, "a.csv"),
        (LIST[:, ::-1], InputError, "swap x and y"),
        (LIST[:5] + 1000, NoPointsError, "a.csv"),
    ],
)
def test_a_list_whose_coordinates_are_no_pixels_is_refused(
    xy: np.ndarray, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        check_pixels(Path("a.csv"), xy, (480, 640))


@pytest.mark.parametrize(
    ("xy", "said"),
    [
        (LIST, []),
        (LIST + np.array([20, 0]), ["points outside the image"]),
        (LIST / 2, ["warning: "]),  # of a smaller image
        (LIST / 2 + np.array([0, 240]), []),
    ],
)
def test_pixels_are_in_the_image_or_said_to_be_outside(xy: np.ndarray, said: list[str]) -> None:
    inside, notes = check_pixels(Path("a.csv"), xy, (480, 640))
    np.testing.assert_array_equal(inside, xy[:, 0] < 639.5)
    assert [text in note for text, note in zip(said, notes, strict=True)] == [True] * len(said)
