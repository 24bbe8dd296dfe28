"""The command lines whose output is kept, read from `commands.txt`.

There, `$NAME = TEXT` defines what `$NAME` stands for below; `[NAME FLAGS]` begins a group, whose
steps run one after another in one folder; and `NAME: LINE` is a step, the arguments of `pnpdepth`.
`NAME(a b): … * …` is a step for a and one for b. After the name, `> FILE` keeps what is printed on
stdout for later steps, and `- FILE` removes a file first. Flags: `single`, every step is a group of
its own; `shared`, the real frames are needed; `unordered`, lines may come in any order, where
threads print them; `measured`, every number is a measurement and left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

_STEP = re.compile(r"(?P<name>[^:]*?)(?: > (?P<save>\S+))?(?: - (?P<remove>\S+))?: ?(?P<line>.*)")
_ALTERNATIVES = re.compile(r"\((.+)\)")


@dataclass(frozen=True, kw_only=True)
class Step:
    """A command line that runs in the folder of its group; name: the group's and its own."""

    name: str
    line: str
    save: str | None = None
    remove: str | None = None
    unordered: bool = False
    figures: bool = True


@dataclass(frozen=True, kw_only=True)
class Group:
    """Steps that run one after another in one folder; shared: they need the real frames."""

    name: str
    steps: Sequence[Step]
    shared: bool = False


def groups() -> list[Group]:
    """Returns all groups in their order, the longest first, so that several jobs end together."""
    found: list[tuple[str, list[str], list[Step]]] = []
    names: dict[str, str] = {}
    for text in Path(__file__).with_name("commands.txt").read_text("utf-8").splitlines():
        if text.startswith("$"):
            name, value = text.split(" = ", 1)
            names[name] = value
        elif text.startswith("["):
            name, *flags = text.strip("[]").split()
            found.append((name, flags, []))
        elif text:
            # the longest first, as $CROP begins $CROPGT
            for name in sorted(names, key=len, reverse=True):
                text = text.replace(name, names[name])
            found[-1][2].extend(_steps(text, *found[-1][:2]))
    result = []
    for name, flags, steps in found:
        parts = [[step] for step in steps] if "single" in flags else [steps]
        for part in parts:
            own = part[0].name.replace("/", "-") if "single" in flags else name
            result.append(Group(name=own, steps=part, shared="shared" in flags))
    return result


def _steps(text: str, group: str, flags: list[str]) -> Iterator[Step]:
    match = _STEP.fullmatch(text)
    assert match is not None, text
    several = _ALTERNATIVES.search(match["name"])
    for each in several[1].split() if several else ["*"]:
        yield Step(
            name=f"{group}/{_ALTERNATIVES.sub(each, match['name'])}",
            line=(match["line"] or "").replace("*", each),
            save=match["save"],
            remove=match["remove"],
            unordered="unordered" in flags,
            figures="measured" not in flags,
        )
