"""One table for every place it goes to: the terminal, CSV, Markdown and LaTeX."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pnpdepth_cli.io.atomic import atomic_path
from pnpdepth_cli.io.csv_text import write_csv

Style = Literal["", "bold", "dim", "good", "bad"]

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
        "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
        "δ": r"$\delta$", "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "−": "$-$",
        "·": r"$\cdot$", "×": r"$\times$", "°": r"$^\circ$", "<": "$<$", "–": "--",
        "…": r"\ldots{}", "\n": " ",
    }
)  # fmt: skip
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")


class Cell(str):
    """A cell with a style: Markdown and LaTeX show "bold", the terminal all."""

    style: Style

    def __new__(cls, text: str, style: Style = "") -> Cell:
        """Returns the text with the style."""
        cell = super().__new__(cls, text)
        cell.style = style
        return cell


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows; the first column is left-aligned, the others, of numbers, right-aligned."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    """Texts; for CSV, also numbers and None."""
    caption: str = ""

    def csv(self) -> str:
        """Returns the table as `write_csv` writes it."""
        buffer = io.StringIO()
        write_csv(buffer, self.header, self.rows)
        return buffer.getvalue()

    def latex(self) -> str:
        """Returns a tabular with rules of the package booktabs; its caption is a comment above."""
        header, *rows = (
            " & ".join(map(_in_latex, line)) + r" \\" for line in (self.header, *self.rows)
        )
        return "\n".join(
            (
                f"% {' '.join(self.caption.split())}",
                rf"\begin{{tabular}}{{l{'r' * (len(self.header) - 1)}}}",
                r"\toprule",
                header,
                r"\midrule",
                *rows,
                r"\bottomrule",
                r"\end{tabular}",
                "",
            )
        )


def _in_latex(cell: str) -> str:
    text = _THOUSANDS.sub("", cell).translate(_LATEX)
    return rf"\textbf{{{text}}}" if getattr(cell, "style", "") == "bold" else text


def write_text(path: Path, text: str) -> None:
    """Writes the text whole or not at all; characters of a name that is not UTF-8 as escapes."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8", "backslashreplace"))
