"""Help texts with the options in groups: `--help` shows the common ones, `--help-all` all.

Plain click, because cloup and rich-click double the time of `pnpdepth --help`, and neither has a
short and a long form of the help.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from pnpdepth_cli.settings import options_of

_NAME_COLUMN = 22
_HELP = ("--help", "--help-all")
_SHOW_ALL = "pnpdepth.help_all"


class GroupedCommand(click.Command):
    """A command whose help lists its options in groups.

    Args:
        groups: Members of each group by its title, in the order of the help. A member is the long
            name of an option, or a dataclass of a request, which stands for those of its options
            that are named nowhere else. What the command does not have is skipped.
        common: Long names of the options that `--help` shows.
    """

    def __init__(
        self,
        *args: Any,
        groups: Mapping[str, tuple[str | type, ...]],
        common: frozenset[str],
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.common = common
        self.groups: dict[str, list[str]] = {}
        named = {member for of in groups.values() for member in of if isinstance(member, str)}
        for title, members in groups.items():
            flags = self.groups[title] = []
            for member in members:
                if isinstance(member, str):
                    flags.append(member)
                else:
                    flags += [each.flag for each in options_of(member) if each.flag not in named]
                    named |= {*flags}
        show_all = click.Option(
            ["--help-all"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_show_all,
            help="Show all options and exit.",
        )
        self.params.append(show_all)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes one section per group."""
        shown = None if ctx.meta.get(_SHOW_ALL) else {*self.common, *_HELP}
        options = {long_name(o): o for o in self.get_params(ctx) if isinstance(o, click.Option)}
        for title, names in {**self.groups, "Help": _HELP}.items():
            records = (
                options[name].get_help_record(ctx)
                for name in names
                if name in options and (shown is None or name in shown)
            )
            if rows := [row for row in records if row is not None]:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=_NAME_COLUMN)


def long_name(option: click.Option) -> str:
    """Returns the first of the option's names that starts with two dashes."""
    return next(name for name in option.opts if name.startswith("--"))


def _show_all(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value and not context.resilient_parsing:
        context.meta[_SHOW_ALL] = True
        click.echo(context.get_help(), color=context.color)
        context.exit()
