"""Sparse models of COLMAP: cameras, images and points, in text or binary.

Own readers, because pycolmap 4.2 aborts the process on truncated files and allocates what a count
claims.
"""
