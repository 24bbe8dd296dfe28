"""Exit codes that no error stands for."""

from __future__ import annotations

import signal

INTERRUPTED = 128 + signal.SIGINT
