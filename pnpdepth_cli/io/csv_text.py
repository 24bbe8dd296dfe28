"""Text for the cells of a CSV file that a spreadsheet will open."""

from __future__ import annotations

_STARTS_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def text_cell(text: str) -> str:
    """Returns the text so that no spreadsheet takes it for a formula: with a "'" before a "=".

    The same holds for "+", "-", "@", tab and carriage return; frame names are other people's.
    """
    return f"'{text}" if text.startswith(_STARTS_FORMULA) else text
