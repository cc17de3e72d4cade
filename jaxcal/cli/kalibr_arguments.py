"""Kalibr's way of writing options: several values in a row, names cut short, and options that are not needed here."""

import glob
import logging
import os
from collections.abc import Callable, Sequence
from typing import Any

import click


class Many(click.Option):
    """An option that takes one value or several in a row, `--topics a b`, or is repeated, `--topics a --topics b`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, multiple=True, **kwargs)


class KalibrCommand(click.Command):
    """A command whose options may be written as for Kalibr: see `spread`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        options = [parameter for parameter in self.params if isinstance(parameter, click.Option)]
        return super().parse_args(ctx, spread(args, options))


def spread(arguments: Sequence[str], options: Sequence[click.Option]) -> list[str]:
    """Arguments as click wants them: `--topics a b` as `--topics a --topics b`, and `--dont-show` in full.

    A row of values ends at the next option, at `--`, or, so that cameras may follow the models of their lenses, at a
    file or pattern of files where models are listed. Raises BadOptionUsage where a row is empty.
    """
    by_name = {name: option for option in options for name in (*option.opts, *option.secondary_opts)}
    found: list[str] = []
    left = list(arguments)
    while left:
        word = left.pop(0)
        if word == "--":
            return [*found, word, *left]
        name, equals, value = word.partition("=")
        name = _in_full(name, by_name)
        option = by_name.get(name)
        found.append(name + equals + value)
        if option is None or option.is_flag or equals:
            continue
        if not isinstance(option, Many):
            found += [left.pop(0) for _ in range(min(option.nargs, len(left)))]
            continue
        values: list[str] = []
        while left and not left[0].startswith("--") and (not values or _belongs(left[0], option)):
            values.append(left.pop(0))
        if not values:
            raise click.BadOptionUsage(name, f"Option '{name}' requires an argument, one or more.")
        found[-1:] = [part for value in values for part in (name, value)]
    return found


def _in_full(name: str, known: dict[str, click.Option]) -> str:
    """An option's name where only a beginning of it is given, as argparse takes it."""
    if name in known or not name.startswith("--") or name == "--help":
        return name
    longer = {option.name: other for other, option in known.items() if other.startswith(name)}
    return next(iter(longer.values())) if len(longer) == 1 else name


def _belongs(value: str, option: click.Option) -> bool:
    return option.name != "models" or not (os.path.exists(value) or glob.has_magic(value))


def not_needed(name: str, reason: str, kind: type | None = None) -> Callable:
    """An option of Kalibr's that has nothing to do here: accepted, and its absence explained in one line."""

    def say(_: click.Context, __: click.Parameter, value: Any) -> None:
        if value is not None and value is not False:
            note(f"{name}: {reason}")

    more: dict[str, Any] = {"is_flag": True} if kind is None else {"type": kind}
    return click.option(name, callback=say, expose_value=False, hidden=True, **more)


def note(text: str) -> None:
    """A line for a person, kept out of what a script reads."""
    click.echo(f"note: {text}", err=True)


def talk(_: click.Context, __: click.Parameter, value: bool) -> None:
    """The callback of --verbose: what the library logs is shown."""
    if value:
        logging.basicConfig(format="%(name)s: %(message)s")
        logging.getLogger("jaxcal").setLevel(logging.DEBUG)


def all_of(*decorators: Callable) -> Callable:
    """Several options as one decorator, in their order."""

    def decorate(function: Callable) -> Callable:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


# Options of both of Kalibr's calibrations.
SHARED_NOT_NEEDED = all_of(
    not_needed("--dont-show-report", "the report is a file that nobody opens for you."),
    not_needed("--show-extraction", "nothing is shown while detecting; the report shows the corners on the images."),
)
VERBOSE = click.option("--verbose", is_flag=True, callback=talk, expose_value=False, help="Say more on the way.")
