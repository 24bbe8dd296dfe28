"""Sources of sparse depth: projected scans, sampled dense depth, and simulated LiDARs.

All return `SparsePoints` of numpy arrays: N depths in metres at pixel coordinates of one image,
x right, y down, whole numbers at pixel centres. Nothing here reads a file.
"""
