"""Options of the commands: in groups of the help, and few."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

import click
import pytest
from click.testing import CliRunner

from pnpdepth_cli.cli.main import cli
from pnpdepth_cli.cli.options import GroupedCommand
from pnpdepth_cli.commands.requests.refine_request import GROUPS, RefineRequest
from pnpdepth_cli.settings import flag_of, options_of

MOST_OPTIONS = {"refine": 32, "batch": 47}
MOST_IN_ALL = 156
MOST_COMMON = 13


def commands_of(group: click.Group) -> Iterator[click.Command]:
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        yield from commands_of(command) if isinstance(command, click.Group) else [command]


def own_options(command: click.Command) -> dict[str, click.Option]:
    """The options of a command by their long names, without those that print help."""
    options = [param for param in command.params if isinstance(param, click.Option)]
    by_name = {option.opts[-1]: option for option in options}
    return {name: by_name[name] for name in by_name if name not in ("--help", "--help-all")}


COMMANDS = {str(command.name): command for command in commands_of(cli)}


@pytest.mark.parametrize("name", ["refine", "batch", "eval"])
def test_every_option_has_one_group_of_the_longer_help_and_few_are_common(name: str) -> None:
    # The help is printed before anything is checked.
    arguments = [name, "missing.png", "--help-all"]
    result = CliRunner().invoke(cli, arguments, terminal_width=80, prog_name="pnpdepth")
    grouped = COMMANDS[name]
    names = {*own_options(COMMANDS[name])}
    assert isinstance(grouped, GroupedCommand)
    members = [option for options in grouped.groups.values() for option in options]
    assert len(members) == len(set(members))
    assert names <= {*members} & {*result.output.split()}
    common = grouped.common - {"--help", "--help-all"}
    assert common <= names
    assert len(common) <= MOST_COMMON


def test_no_command_has_too_many_options_and_none_but_vary_holds_others_in_its_value() -> None:
    options = {name: own_options(command) for name, command in COMMANDS.items()}
    assert all(len(options[name]) <= most for name, most in MOST_OPTIONS.items())
    assert sum(map(len, options.values())) + len(own_options(cli)) <= MOST_IN_ALL
    found = [option for of_command in options.values() for option in of_command.values()]
    assert [o.name for o in found if "NAME=VALUE" in f"{o.metavar} {o.help}"] == ["vary"]


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_every_command_has_the_longer_help(name: str) -> None:
    words = {"check": ["models", "check"]}.get(name, [name] if name else [])
    result = CliRunner().invoke(cli, [*words, "--help-all"], prog_name="pnpdepth")
    assert result.exit_code == 0
    assert "Usage: pnpdepth" in result.output
    shown = {*own_options(COMMANDS[name])} if name else {"--version"}
    assert shown <= {*result.output.replace(",", " ").split()}


@pytest.mark.parametrize(
    "line",
    [
        ["refine", "i.png", "--sparse", "s.png", "-o", ""],
        ["refine", "", "--sparse", "s.png"],
        ["refine", "i.png", "--sparse", "s.png", "--checkpoint", ""],
        ["batch", "folder", "-o", ""],
        ["cloud", "d.png", "-o", ""],
        ["frames", "a.bag", "-o", ""],
    ],
)
def test_an_empty_text_is_no_file_and_not_the_current_folder(line: list[str]) -> None:
    result = CliRunner().invoke(cli, line)
    assert result.exit_code == 2
    assert "empty" in result.output


def test_every_field_of_a_request_has_one_name_and_its_option_is_one_of_batch() -> None:
    request = RefineRequest()
    groups = [request, *(getattr(request, name) for name in GROUPS)]
    every = [field.name for group in groups for field in fields(group)]
    names = [name for name in every if name not in GROUPS]
    assert len(names) == len(set(names))
    flags = {flag_of(option) for group in groups for option in options_of(type(group))}
    assert flags <= {name for option in COMMANDS["batch"].params for name in option.opts}
