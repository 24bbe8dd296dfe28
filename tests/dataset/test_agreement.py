"""Order, ratio and spread of two depths of one frame."""

from __future__ import annotations

import numpy as np
import pytest

from pnpdepth_cli.completion.two_depths import Agreement, compare_depths
from pnpdepth_cli.dataset.agreement import check_order, unit_warning
from pnpdepth_cli.errors import InputError
from pnpdepth_cli.io.formats import Reading

RNG = np.random.default_rng(0)
DEPTH = RNG.uniform(1, 60, (40, 50)).astype(np.float32)
NOISY = DEPTH * np.exp(RNG.normal(0, 0.05, DEPTH.shape)).astype(np.float32)
FLOAT = Reading("PFM")
BY_256, BY_1000 = (Reading("PNG", scale) for scale in (256.0, 1000.0))


@pytest.mark.parametrize(
    ("product", "advice"), [(1.0, "inverse"), (386.1, "disparity:386"), (0.1, "disparity:0.1")]
)
def test_a_reversed_order_names_what_reads_it(product: float, advice: str) -> None:
    text = check_order("a and b", product / NOISY, DEPTH)
    assert text is not None
    assert f"--sparse-kind {advice}" in text
    assert check_order("a and b", NOISY, DEPTH) is None
    assert check_order("a and b", RNG.permuted(DEPTH), DEPTH) is None


@pytest.mark.parametrize(
    ("factor", "depth", "truth", "advice"),
    [
        (3.906, BY_256, FLOAT, "--scale 1000 (now 256)"),
        (0.256, FLOAT, BY_256, "--gt-scale 1000 (now 256)"),
        (0.001, BY_1000, None, "--scale 1 (now 1000)"),
        (39.37, FLOAT, FLOAT, "--scale 39.3701 (now 1)"),
        (2.2, BY_256, FLOAT, "--scale 56"),
    ],
)
def test_a_unit_names_the_scale_that_removes_it(
    factor: float, depth: Reading, truth: Reading | None, advice: str
) -> None:
    found = compare_depths(factor * NOISY, DEPTH)
    by_option = {"--scale": depth, "--gt-scale": truth}
    assert advice in str(unit_warning("depths", found, by_option))
    assumed = {
        option: reading and reading._replace(assumed=True) for option, reading in by_option.items()
    }
    if depth.scale or (truth and truth.scale):
        with pytest.raises(InputError, match="keeps it"):
            unit_warning("depths", found, assumed)


def test_no_quotient_is_advised_where_the_ratio_varies() -> None:
    found = compare_depths(1000 * RNG.permuted(DEPTH), DEPTH)
    text = str(unit_warning("depths", found, {"--scale": BY_256, "--gt-scale": FLOAT}))
    assert text.startswith("warning")
    assert "--scale" not in text
    near = compare_depths(2 * RNG.permuted(DEPTH), DEPTH)  # as a network without a scale may be
    assert unit_warning("predictions", near, {"--scale": FLOAT}, fitted=True) is None
    assert unit_warning("depths", compare_depths(NOISY, DEPTH), {"--scale": FLOAT}) is None


@pytest.mark.parametrize(
    "per_metre",
    [
        pytest.param(1000.0, id="millimetres"),
        pytest.param(256.0, id="KITTI"),
        pytest.param(5000.0, id="TUM"),
        pytest.param(100.0, id="centimetres"),
        pytest.param(10.0, id="decimetres"),
        pytest.param(4000.0, id="quarters of a millimetre"),
        pytest.param(6553.5, id="Replica"),
        pytest.param(39.3701, id="inches"),
        pytest.param(3.28084, id="feet"),
    ],
)
def test_a_ratio_near_a_scale_in_use_names_that_scale(per_metre: float) -> None:
    found = Agreement(pairs=1000, rank=1.0, ratio=1.02 * per_metre, spread=0.01)
    text = str(unit_warning("depths", found, {"--scale": FLOAT, "--gt-scale": FLOAT}))
    assert f"--scale {per_metre:.6g} (now 1)" in text


def test_ten_pairs_show_a_unit_and_nine_do_not() -> None:
    assert Agreement(pairs=10, rank=1.0, ratio=1000.0, spread=0.01).is_unit
    assert not Agreement(pairs=9, rank=1.0, ratio=1000.0, spread=0.01).is_unit


@pytest.mark.parametrize(("pairs", "is_certain"), [(10, False), (100, True)])
def test_an_order_that_chance_may_explain_is_none(pairs: int, is_certain: bool) -> None:
    assert Agreement(pairs=pairs, rank=0.9, ratio=1.0, spread=0.1).is_ordered == is_certain
    assert Agreement(pairs=pairs, rank=-0.9, ratio=1.0, spread=0.1).is_reversed == is_certain
