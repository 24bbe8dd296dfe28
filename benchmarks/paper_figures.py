"""What Wang et al. (ICRA 2019) print in their tables I and II, and what they measured it with."""

from __future__ import annotations

from dataclasses import dataclass

from pnpdepth_cli.protocols import ODOMETRY_PART, WHOLE, FramePart

MEASURES = ("rmse", "mae", "mre", "delta1", "delta2", "delta3")
FINE_THRESHOLDS = (1.01, 1.01**2, 1.01**3)
"""Of the δ in the depth completion rows (†); the paper does not say so, its released code does."""

Figures = tuple[float, ...]
"""RMSE and MAE in metres, MRE, δ1 to δ3 in per cent."""


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """A pair of lines of the tables: a network before and after, and the protocol of both."""

    name: str
    """The paper's name of the network."""
    kind: str
    """Its inputs."""
    family: str
    """Of our networks."""
    layer: str
    """The paper's z."""
    points: int | None
    """Uniform random points; None for a LiDAR's."""
    street: bool
    """True in table II, KITTI; False in table I, NYU."""
    before: Figures
    """Without refinement."""
    after: Figures
    """With refinement."""
    gains: Figures
    """Of RMSE and MAE in per cent, as printed; two are 0.1 below those of the printed errors."""
    cut: FramePart = WHOLE
    """The crop of a larger frame."""
    missing: str = ""
    """Why there is no such network of ours."""

    @property
    def fine(self) -> bool:
        """True for the rows of depth completion (†), whose δ are at 1.01^k."""
        return self.points is None

    def takes(self, network: str) -> bool:
        """True if a network of this name belongs in the row."""
        if network.partition("-")[0] != self.family:
            return False
        sized = self.family in ("eigen", "sparse2dense")  # these take images of one size
        return not sized or network.endswith("-kitti") == self.street


_TABLES = """
    Eigen   rgb    eigen        coarse.conv5        100  I 0.8933 0.7076 0.2862 52.1 82.3 93.8
        0.5021 0.3765 0.1497 80.5 94.8 98.8 43.8  46.8
    FCRN    rgb    fcrn         layer1_BN           100  I 0.5111 0.3665 0.1369 81.5 95.4 98.8
        0.3720 0.2438 0.0890 91.5 98.3 99.6 27.2  33.5
    Uhrig   sd     sparseconv   sparse_convs.0[0]  3466  I 0.1154 0.0500 0.0177 99.3 99.9 99.9
        0.1050 0.0441 0.0162 99.4 99.9 99.9  8.9  11.8
    Ma      rgb+sd sparse2dense bn2                 500  I 0.1982 0.1125 0.0398 97.9 99.6 99.9
        0.1782 0.0870 0.0315 98.2 99.7 99.9 10.1  22.7
    Jaritz  rgb+sd latefusion   decoder.s8          500  I 0.1712 0.0996 0.0343 98.7 99.7 99.9
        0.1598 0.0817 0.0320 98.7 99.7 99.9  6.7  17.9
    Eigen   rgb    eigen        coarse.conv5        500 II 6.6128 3.9234 0.2249 58.9 86.4 94.7
        5.1395 2.8633 0.1790 75.1 91.7 97.0 22.3    27
    Zhou    rgb    sfmlearner   conv7               500 II 7.2722 4.1411 0.2895 63.6 85.7 93.3
        6.0726 3.4042 0.2269 71.0 89.6 95.2 16.5  17.8
    Uhrig   sd     sparseconv   sparse_convs.0[0] LiDAR II 1.6616 0.5188 0.0311 39.0 66.9 81.6
        1.6244 0.4533 0.0275 50.7 75.7 86.1  2.2  12.6
    Chodosh sd     adnn         solve             LiDAR II 1.3859 0.4813 0.0276 34.7 64.4 80.0
        1.3602 0.4192 0.0233 52.7 75.8 85.1  1.9  12.9
    Ma      rgb+sd sparse2dense bn2                 500 II 3.0272 1.1879 0.0703 94.8 97.9 99.0
        2.9754 1.0241 0.0579 94.9 98.0 99.0  1.7 13.79
"""
"""Network, input, family, z, points, table; before and after: RMSE, MAE, MRE, δ1 to δ3; gains.

MAE after of Ma in table I is printed as 0.0087 (+22.7 %), which is 0.0870.
"""
_ODOMETRY = ("eigen", "sfmlearner", "sparse2dense")
"""Of table II: on frames of KITTI odometry."""
_MISSING = "eigen-tiny is fully connected for NYU's size and learnt rooms, so it has no street row"


def _row(text: str) -> PaperRow:
    """Returns the row of two lines of `_TABLES`, joined."""
    name, kind, family, layer, points, table, *numbers = text.split()
    values = [float(number) for number in numbers]
    street = table == "II"
    return PaperRow(
        name=name,
        kind=kind.replace("+", " + "),
        family=family,
        layer=layer,
        points=None if points == "LiDAR" else int(points),
        street=street,
        before=tuple(values[:6]),
        after=tuple(values[6:12]),
        gains=tuple(values[12:]),
        cut=ODOMETRY_PART if street and family in _ODOMETRY else WHOLE,
        missing=_MISSING if street and family == "eigen" else "",
    )


_LINES = [line for line in _TABLES.split("\n") if line]
ROWS = tuple(_row(a + b) for a, b in zip(_LINES[::2], _LINES[1::2], strict=True))
