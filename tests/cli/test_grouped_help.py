"""The help of a command with many options: in groups, and short unless all is wanted."""

from __future__ import annotations

import math
from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from pnpdepth_cli.cli.main import cli
from pnpdepth_cli.cli.options import GroupedCommand

GROUPED = ("refine", "batch", "eval")


MOST_OPTIONS = {"refine": 30, "batch": 45}
MOST_IN_ALL = 150
MOST_COMMON = 12


def options_of(command: click.Command) -> list[click.Option]:
    """The options of a command itself, without those that print help."""
    found = (each for each in command.params if isinstance(each, click.Option))
    return [each for each in found if each.opts[-1] not in ("--help", "--help-all")]


def help_of(*arguments: str) -> str:
    result = CliRunner().invoke(cli, arguments, terminal_width=80, prog_name="pnpdepth")
    assert result.exit_code == 0, result.output
    return result.output


def command(name: str) -> GroupedCommand:
    command_of_name = cli.get_command(click.Context(cli), name)
    assert isinstance(command_of_name, GroupedCommand)
    return command_of_name


@pytest.mark.parametrize("name", GROUPED)
def test_every_option_has_one_group_of_the_longer_help_and_those_that_matter_are_common(
    name: str,
) -> None:
    grouped = command(name)
    shown = help_of(name, "--help-all").split()
    members = [option for options in grouped.groups.values() for option in options]
    names = {each.opts[-1] for each in options_of(grouped)}
    assert len(members) == len(set(members))
    assert names <= {*members} & {*shown}
    assert grouped.common - {"--help", "--help-all"} <= names
    assert len(grouped.common) <= MOST_COMMON + 2


def test_the_longer_help_is_printed_before_anything_is_checked() -> None:
    assert help_of("refine", "missing.png", "--iterations", "x", "--help-all").startswith("Usage")


def commands_of(group: click.Group) -> Iterator[click.Command]:
    for name in group.list_commands(click.Context(group)):
        each = group.get_command(click.Context(group), name)
        assert each is not None
        yield from commands_of(each) if isinstance(each, click.Group) else [each]


def test_every_default_that_is_a_number_or_a_name_is_in_the_help() -> None:
    silent = [
        (each.name, option.opts)
        for each in commands_of(cli)
        for option in each.params
        if isinstance(option, click.Option)
        and isinstance(option.default, str | int | float)
        and option.default not in (False, math.inf)
        and not option.show_default
    ]
    assert silent == []


def test_no_command_has_too_many_options() -> None:
    counts = {each.name: len(options_of(each)) for each in commands_of(cli)}
    for name, most in MOST_OPTIONS.items():
        assert counts[name] <= most
    assert sum(counts.values()) + len(options_of(cli)) <= MOST_IN_ALL


def test_no_option_holds_others_in_its_value() -> None:
    listing = [
        (each.name, option.opts[-1])
        for each in commands_of(cli)
        for option in options_of(each)
        if "NAME=VALUE" in f"{option.metavar} {option.help}"
    ]
    assert listing == [("batch", "--vary")]


def test_options_of_one_name_say_the_same_thing_in_every_command() -> None:
    texts: dict[str, set[str | None]] = {}
    for each in commands_of(cli):
        for option in options_of(each):
            texts.setdefault(option.opts[-1], set()).add(option.help)
    own = {
        *("--output", "--image", "--calib", "--poses", "--html", "--csv", "--latex", "--protocol"),
        *("--model", "--max-depth", "--columns"),
    }
    assert {name for name, helps in texts.items() if len(helps) > 1} <= own
