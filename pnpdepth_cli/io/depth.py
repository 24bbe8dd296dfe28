"""Reading, writing and describing depth files; the one module to import for them."""

from __future__ import annotations

from pnpdepth_cli.io.depth_range import describe_range, implausible
from pnpdepth_cli.io.depth_reading import DepthImage, read_depth
from pnpdepth_cli.io.depth_writing import write_depth
from pnpdepth_cli.io.formats import DEPTH_SUFFIXES
from pnpdepth_cli.io.sparse_files import SparseFile, read_sparse

__all__ = [
    "DEPTH_SUFFIXES",
    "DepthImage",
    "SparseFile",
    "describe_range",
    "implausible",
    "read_depth",
    "read_sparse",
    "write_depth",
]
