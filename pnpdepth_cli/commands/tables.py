"""One table for every place it goes to: the terminal, CSV, LaTeX and the page of a report."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pnpdepth_cli.io.atomic import atomic_path, make_folder
from pnpdepth_cli.io.file_bytes import write_csv
from pnpdepth_cli.measures import Measure

Style = Literal["", "bold", "dim", "good", "bad"]

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
        "δ": r"$\delta$", "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "−": "$-$",
        "·": r"$\cdot$", "×": r"$\times$", "°": r"$^\circ$", "<": "$<$", "–": "--",
        "…": r"\ldots{}", "σ": r"$\sigma$", "\n": " ",
    }
)  # fmt: skip
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")


class Cell(str):
    """A text with a style: LaTeX shows "bold", the terminal all."""

    style: Style

    def __new__(cls, text: str, style: Style = "") -> Cell:
        """Returns the text with the style."""
        cell = super().__new__(cls, text)
        cell.style = style
        return cell


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of cells; the first column is left-aligned, the others, of numbers, right-aligned."""

    title: str = ""
    columns: Sequence[Measure | str]
    """A measure, or the heading of any other column."""
    rows: Sequence[Sequence[Any]]
    """Texts, numbers, and None."""

    @property
    def headings(self) -> list[str]:
        """The headings of the columns."""
        return [c.heading if isinstance(c, Measure) else c for c in self.columns]

    @property
    def texts(self) -> list[list[str]]:
        """The cells as they are shown."""
        return [list(map(_text, row)) for row in self.rows]

    def csv(self) -> str:
        """Returns the cells as they are, below the keys of the measures, as `write_csv` does."""
        buffer = io.StringIO()
        keys = [c.key if isinstance(c, Measure) else c for c in self.columns]
        write_csv(buffer, keys, self.rows)
        return buffer.getvalue()

    def latex(self) -> str:
        """Returns a tabular with rules of the package booktabs; its title is a comment above."""
        header, *rows = (
            " & ".join(map(_in_latex, line)) + r" \\" for line in (self.headings, *self.texts)
        )
        lines = (
            f"% {' '.join(self.title.split())}",
            rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
            *(r"\toprule", header, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}", ""),
        )
        return "\n".join(lines)


def _text(cell: Any) -> str:
    if isinstance(cell, str):
        return cell
    return "" if cell is None else f"{cell:,}"


def _in_latex(cell: str) -> str:
    text = _THOUSANDS.sub("", cell).translate(_LATEX)
    return rf"\textbf{{{text}}}" if getattr(cell, "style", "") == "bold" else text


def count_of(number: int, noun: str) -> str:
    """Returns a text such as `1 frame` or `2,000 frames`."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def write_text(path: Path, text: str) -> None:
    """Writes the text whole or not at all; characters of a name that is not UTF-8 as escapes."""
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))
