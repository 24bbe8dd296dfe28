"""The benchmark of sequences that share their alignment."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.frames import EvalFrame
from benchmarks.steady import (
    STRETCHED,
    Sequenced,
    alignments_of,
    change_with_interval,
    drifting,
    measure,
    print_tables,
    shake,
    standardised,
)


def slanted(count: int) -> list[EvalFrame]:
    """Frames of a floor that comes nearer, metres."""
    rows, _ = np.indices((24, 32), dtype=np.float32)
    return [
        EvalFrame(
            f"{number}", np.full((24, 32, 3), 0.5, np.float32), 4 - 0.1 * rows - 0.05 * number
        )
        for number in range(count)
    ]


def sequence_of(
    frames: list[EvalFrame], maps: list[np.ndarray], count: int, noise: float = 0.0
) -> Sequenced:
    """The maps with points, off by a factor of this standard deviation."""
    generator = torch.Generator().manual_seed(0)
    points = []
    for number, frame in enumerate(frames):
        given = frame.points(count, number).tensors()
        factor = torch.exp(noise * torch.randn(count, generator=generator))
        points.append(type(given)(xy=given.xy, depth=given.depth * factor, size=given.size))
    return Sequenced([torch.from_numpy(values) for values in maps], points)


def mean_error(depths: list[torch.Tensor], frames: list[EvalFrame]) -> float:
    pairs = zip(depths, frames, strict=True)
    return float(np.mean([np.abs(depth.numpy() - frame.gt).mean() for depth, frame in pairs]))


def test_without_drift_all_maps_have_one_scale_and_shift() -> None:
    disparity = [1 / frame.gt for frame in slanted(3)]
    fits = [
        np.polyfit(true.ravel(), drifted.ravel(), 1)
        for true, drifted in zip(disparity, drifting(disparity, "none", 0), strict=True)
    ]
    np.testing.assert_allclose(fits, [fits[0]] * 3, rtol=1e-3)


def test_a_drift_moves_scale_and_shift_further_with_each_frame() -> None:
    disparity = [np.linspace(0.1, 1, 20, dtype=np.float32).reshape(4, 5)] * 400
    fits = np.array(
        [
            np.polyfit(true.ravel(), drifted.ravel(), 1)
            for true, drifted in zip(disparity, drifting(disparity, "5 %", 0), strict=True)
        ]
    )
    assert np.diff(np.log(fits[:, 0])).std() == pytest.approx(0.05, rel=0.15)


def test_stretched_maps_are_from_0_to_1() -> None:
    for values in drifting([1 / frame.gt for frame in slanted(2)], STRETCHED, 0):
        assert (values.min(), values.max()) == (0, 1)


def test_depth_that_is_off_by_one_factor_in_all_frames_does_not_shake() -> None:
    frames = slanted(4)
    depths = [torch.from_numpy(1.1 * frame.gt) for frame in frames]
    assert shake(depths, frames) == pytest.approx(0, abs=1e-6)
    depths[1::2] = [depth / 1.21 for depth in depths[1::2]]
    # Steps of log 1.21, down, up and down.
    assert shake(depths, frames) == pytest.approx(np.log(1.21) * np.sqrt(8) / 3, rel=1e-4)


def test_exact_disparity_is_aligned_to_the_truth() -> None:
    frames = slanted(6)
    maps = drifting([1 / frame.gt for frame in frames], "none", 0)
    for alignment, depths in alignments_of(sequence_of(frames, maps, 10)).items():
        # The scales that pooling divides by are those of what is seen, which changes.
        tolerance = 0.1 if alignment.startswith("pooled") else 0.01
        assert mean_error(depths, frames) < tolerance


def test_tied_lines_are_nearer_to_the_truth_and_shake_less_than_lines_of_few_noisy_points() -> None:
    frames = slanted(12)
    maps = drifting([1 / frame.gt for frame in frames], "1 %", 0)
    found = alignments_of(sequence_of(frames, maps, 5, noise=0.05))
    alone, tied = found["disparity"], found["tied"]
    assert mean_error(tied, frames) < 0.8 * mean_error(alone, frames)
    assert shake(tied, frames) < 0.8 * shake(alone, frames)


def test_scale_and_shift_of_a_map_have_no_effect_on_the_standardised_one() -> None:
    x = torch.linspace(0, 1, 12).square().reshape(3, 4)
    torch.testing.assert_close(standardised(7 * x + 3), standardised(x))


def test_the_tables_have_a_line_for_each_number_of_points(
    capsys: pytest.CaptureFixture[str],
) -> None:
    frames = slanted(4)
    disparity = [1 / frame.gt for frame in frames]
    runs = [
        run | {"set": "floor", "faults": "none"}
        for count in (5, 7)
        for run in measure(frames, disparity, "1 %", count, 0)
    ]
    print_tables(runs)
    printed = capsys.readouterr().out
    assert "| floor | 5 |" in printed
    assert "| floor | 7 |" in printed


def test_a_change_that_all_frames_have_is_certain() -> None:
    assert change_with_interval(np.log(np.full(5, 0.9))) == "-10.0 % (-10.0 … -10.0)"
