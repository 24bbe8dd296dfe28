"""One frame on disk: layouts to `FrameFiles`, and files to a `Frame`."""
