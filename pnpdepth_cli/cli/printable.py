"""Text from outside, fit for one line of a terminal."""

from __future__ import annotations


def printable(text: object) -> str:
    """The text with what is no printable character, such as a new line, as an escape."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(text)
    )
