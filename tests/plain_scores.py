"""Every score in plain NumPy, from its formula."""

from __future__ import annotations

import numpy as np


def brute(predicted: np.ndarray, gt: np.ndarray) -> dict[str, float]:
    known = np.isfinite(gt) & (gt > 0)
    scored = known & np.isfinite(predicted) & (predicted > 0)
    p = predicted[scored].astype(np.float64)
    g = gt[scored].astype(np.float64)
    logs = np.log(p) - np.log(g)
    inverse = 1 / p - 1 / g
    ratio = np.maximum(p / g, g / p)
    return {
        "rmse": np.sqrt(np.mean((p - g) ** 2)),
        "mae": np.mean(abs(p - g)),
        "mre": np.mean(abs(p - g) / g),
        **{f"delta{k}": np.mean(ratio < 1.25**k) for k in (1, 2, 3)},
        "irmse": 1000 * np.sqrt(np.mean(inverse**2)),
        "silog": 100 * np.std(logs),
        "sq_rel": np.mean((p - g) ** 2 / g),
        "log10": np.mean(abs(np.log10(p) - np.log10(g))),
        "rmse_log": np.sqrt(np.mean(logs**2)),
        "imae": 1000 * np.mean(abs(inverse)),
        "pixels": scored.sum(),
        "coverage": scored.sum() / known.sum(),
    }
