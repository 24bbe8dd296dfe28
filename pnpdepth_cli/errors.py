"""Every error a user can cause, as one tree; each class carries its exit code.

    PnpDepthError                1  our own bug, when raised as itself
    ├── UsageError               2  an option or argument makes no sense
    │   └── OutputError          2  the place to write to cannot be used
    │       └── StorageError     2  nothing more can be written there: it is full, say
    ├── InputError               3  a file with image or depth data is at fault
    │   ├── FileFormatError      3  it cannot be read as what it should be
    │   ├── SizeError            3  image, sparse depth and ground truth do not fit together
    │   └── NoPointsError        3  there is no sparse depth to work with
    ├── ModelError               4  the network or its definition is at fault
    │   ├── LayerError           4  the layer cannot be cut at
    │   ├── BatchError           4  the network does not take several frames at once
    │   └── CheckpointError      4  the weights cannot be used
    ├── DivergedError            5  refinement produced non-finite numbers
    ├── DeviceError              6  the device is absent or out of memory
    └── FramesFailedError        7  a batch went through, but not all of its frames

A message names the thing, the fact and the way out, on one line.
"""

from __future__ import annotations

from typing import Any, ClassVar


class PnpDepthError(Exception):
    """The root of the tree; `exit_code` is what the process returns."""

    exit_code: ClassVar[int] = 1


class UsageError(PnpDepthError):
    """An option or argument makes no sense."""

    exit_code = 2


class OutputError(UsageError):
    """The place to write to cannot be used."""


class StorageError(OutputError):
    """Nothing more can be written there, whatever it is: the disk is full or gone, or read-only."""


class InputError(PnpDepthError):
    """A file with image or depth data is at fault."""

    exit_code = 3


class FileFormatError(InputError):
    """A file cannot be read as what it should be."""


class SizeError(InputError):
    """Image, sparse depth and ground truth do not fit together."""


class NoPointsError(InputError):
    """There is no sparse depth to work with."""


class ModelError(PnpDepthError):
    """The network or its definition is at fault."""

    exit_code = 4


class LayerError(ModelError):
    """The layer cannot be cut at."""


class BatchError(ModelError):
    """The network does not take several frames at once; one at a time it may."""


class CheckpointError(ModelError):
    """The weights cannot be used."""


class DivergedError(PnpDepthError):
    """Refinement produced non-finite numbers; `last_good` holds the result before that."""

    exit_code = 5

    def __init__(self, message: str, last_good: Any = None) -> None:
        super().__init__(message)
        self.last_good = last_good


class DeviceError(PnpDepthError):
    """The device is absent or out of memory."""

    exit_code = 6


class FramesFailedError(PnpDepthError):
    """A batch went through, but not all of its frames."""

    exit_code = 7
