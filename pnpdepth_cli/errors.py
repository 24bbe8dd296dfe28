"""Every error a user can cause, as one tree; each class carries its exit code.

A message names the object, the fact and the remedy, on one line.
"""

from __future__ import annotations

from typing import Any, ClassVar


class PnpDepthError(Exception):
    """The root of the tree; `exit_code` is the exit status of the process."""

    exit_code: ClassVar[int] = 1


class UsageError(PnpDepthError):
    """An option or argument makes no sense."""

    exit_code = 2


class OutputError(UsageError):
    """The output path cannot be used."""


class StorageError(OutputError):
    """Nothing more can be written: the disk is full, gone or read-only."""


class InputError(PnpDepthError):
    """A file with image or depth data is invalid."""

    exit_code = 3


class FileFormatError(InputError):
    """A file is not of the expected format."""


class SizeError(InputError):
    """Image, sparse depth and ground truth differ in size."""


class NoPointsError(InputError):
    """There is no sparse depth to work with."""


class ModelError(PnpDepthError):
    """The network or its definition is invalid."""

    exit_code = 4


class LayerError(ModelError):
    """The network cannot be cut at the layer."""


class CheckpointError(ModelError):
    """The weights cannot be used."""


class DivergedError(PnpDepthError):
    """Refinement produced non-finite numbers; `last_good` holds the result before that."""

    exit_code = 5

    def __init__(self, message: str, last_good: Any = None) -> None:
        super().__init__(message)
        self.last_good = last_good


class DeviceError(PnpDepthError):
    """The device or the cluster is absent, or out of memory."""

    exit_code = 6


class FramesFailedError(PnpDepthError):
    """A batch finished, but some of its frames failed."""

    exit_code = 7
