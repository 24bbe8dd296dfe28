"""Text from outside, fit for one line of a terminal."""

from __future__ import annotations

_LONGEST = 2000


def printable(text: object) -> str:
    """Returns the text with unprintable characters, such as line breaks, as escapes."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )


def shortened(text: str) -> str:
    """Returns the text, without its middle where it is longer than 2,000 characters."""
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} … {text[-half:]}"
