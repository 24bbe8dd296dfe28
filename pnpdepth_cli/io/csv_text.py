"""CSV that a spreadsheet will open."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, TextIO

_STARTS_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def write_csv(file: TextIO, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes RFC 4180 with lines that end in \\n, each text as `text_cell`, None as nothing."""
    writer = csv.writer(file, lineterminator="\n")
    for row in itertools.chain([header], rows):
        writer.writerow([text_cell(each) if isinstance(each, str) else each for each in row])


def text_cell(text: str) -> str:
    """Returns the text so that no spreadsheet takes it for a formula: with a "'" before a "=".

    The same holds for "+", "-", "@", tab and carriage return, unless the text is a number; frame
    names and file names are other people's.
    """
    return f"'{text}" if text.startswith(_STARTS_FORMULA) and not _is_number(text) else text


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text[0] in "+-"
