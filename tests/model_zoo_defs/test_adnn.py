"""adnn: the solve against one in dense numpy, and the authors' variables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model_zoo_defs.adnn import Adnn
from pnpdepth_cli.errors import ModelError
from pnpdepth_cli.models.network import load_network

Array = NDArray[np.float64]
SHAPES = {"kernel0": (11, 11, 1, 8), "kernel1": (5, 5, 8, 16), "kernel2": (3, 3, 16, 32)}


def dense(kernel: Array, size: tuple[int, int]) -> Array:
    """The matrix of `analysed` for maps (c, h, w) of this size, element by element."""
    count, channels, k, _ = kernel.shape
    height, width = size
    rows, columns = -(-height // 2), -(-width // 2)
    matrix = np.zeros((count, rows, columns, channels, height, width))
    top = max((rows - 1) * 2 + k - height, 0) // 2
    left = max((columns - 1) * 2 + k - width, 0) // 2
    for i, j, a, b in np.ndindex(rows, columns, k, k):
        y, x = 2 * i + a - top, 2 * j + b - left
        if 0 <= y < height and 0 <= x < width:
            matrix[:, i, j, :, y, x] += kernel[:, :, a, b]
    return matrix.reshape(count * rows * columns, channels * height * width)


def solved(network: Adnn, sparse: Array, iterations: int) -> Array:
    """ADMM and the synthesis of depth with dense matrices, from the authors' update rules."""
    kernels = [getattr(network, f"kernel{i}").detach().numpy() for i in range(3)]
    penalty = [float(getattr(network, f"bias{i}").detach().abs()) / 1000 for i in range(3)]
    sizes = [sparse.shape]
    for _ in range(2):
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    wt = [dense(kernel, size) for kernel, size in zip(kernels, sizes, strict=True)]
    d = sparse.flatten()
    mask = [(d > 0).astype(float)]
    for kernel, size in zip(kernels[:2], sizes[:2], strict=True):
        seen = dense(np.ones((1, 1, *kernel.shape[2:])), size) @ (mask[-1].reshape(-1)) > 0
        mask.append(seen.astype(float))

    def masked(level: int, values: Array) -> Array:
        """Zero where the level's mask, the same for all channels, is."""
        return (values.reshape(-1, len(mask[level])) * mask[level]).flatten()

    z, y = [wt[0] @ d], []
    y.append(np.maximum(z[0] - penalty[0], 0))
    for i in (1, 2):
        z.append(wt[i] @ masked(i, y[i - 1]))
        y.append(np.maximum(z[i] - penalty[i], 0))
    multiplier = [np.zeros_like(level) for level in z]
    for _ in range(iterations):
        for i in range(3):
            target = masked(i, y[i - 1]) if i else d
            before = y[i] - multiplier[i]
            z[i] = wt[i] @ (target - masked(i, wt[i].T @ before)) / 2 + before
            if i < 2:
                wanted = z[i] + wt[i + 1].T @ z[i + 1]
                y[i] = np.maximum(wanted - (penalty[i] - multiplier[i]), 0) / 2
            else:
                y[i] = np.maximum(z[i] - (penalty[i] - multiplier[i]), 0)
            multiplier[i] = multiplier[i] + z[i] - y[i]
    return (wt[0].T @ (wt[1].T @ (wt[2].T @ z[2]))).reshape(sparse.shape)


@pytest.mark.parametrize("iterations", [0, 1, 10])
@pytest.mark.parametrize("size", [(16, 24), (17, 11)])
def test_depth_is_that_of_dense_matrices(size: tuple[int, int], iterations: int) -> None:
    torch.manual_seed(0)
    network = Adnn(filters=(3, 4, 5), iterations=iterations).double()
    for bias in network.biases:
        getattr(network, bias).data.fill_(-80.0)  # a penalty of 0.08
    rng = np.random.default_rng(0)
    sparse = rng.uniform(1, 9, size) * (rng.random(size) < 0.1)
    with torch.no_grad():
        depth = network(torch.from_numpy(sparse)[None, None])[0, 0].numpy()
    expected = solved(network, sparse, iterations)
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(depth, expected, rtol=1e-9, atol=1e-12)


def test_the_authors_variables_load_from_a_numpy_file_into_their_parameters(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in SHAPES.items()}
    arrays |= {f"bias{i}": np.array(0.5 + i, np.float32) for i in range(3)}
    np.save(tmp_path / "adnn.npy", arrays, allow_pickle=True)
    state = load_network("adnn", tmp_path / "adnn.npy").module.state_dict()
    assert state.keys() == arrays.keys()
    for name, array in arrays.items():
        assert np.array_equal(state[name], array.transpose(3, 2, 0, 1) if array.ndim else array)
    np.save(tmp_path / "adnn.npy", arrays | {"global_step": np.array(3)}, allow_pickle=True)
    with pytest.raises(ModelError):
        load_network("adnn", tmp_path / "adnn.npy")
