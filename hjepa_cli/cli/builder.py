"""The program is built of the list of commands, with signatures and the defaults in force in help.

Imports nothing heavy; see :mod:`hjepa_cli.cli.commands`.
"""

import copy
import inspect
import operator
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Self

import typer
from typer.core import TyperCommand

from hjepa_cli import __version__
from hjepa_cli.cli.commands import GROUPS, TOOLS, Command, commands
from hjepa_cli.cli.execution import execute
from hjepa_cli.cli.flags import INPUTS, NAMES, SCREEN, annotation, taken
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings

SETTING = "setting__"  # begins the name of a parameter that overrides one
ARGUMENTS = "hjepa.arguments"  # those of a command, where its help finds them
VERSION: dict[str, Any] = {
    "help": "Print the version.",
    "rich_help_panel": SCREEN,
    "is_eager": True,
    "show_default": False,
}


class ExplainedCommand(TyperCommand):
    """Its help shows the defaults of the preset that is named beside ``--help``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Remember the arguments: help is asked for before the others are read."""
        ctx.meta[ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write help, with the names that plugins of the same command line add."""
        given, _, _ = self.make_parser(ctx).parse_args(args=list(ctx.meta.get(ARGUMENTS, ())))
        flags = {"plant": given.get(f"{SETTING}plant")}
        shown = self.explained(load_settings(given.get("preset"), None, flags))
        super(ExplainedCommand, shown).format_help(ctx, formatter)

    def explained(self, settings: Settings) -> Self:
        """Return a copy whose help has names for ``{choices}``, and the defaults of settings."""
        shown = copy.copy(self)
        shown.params = [_explained(copy.copy(one), settings) for one in self.params]
        return shown


def build(words: Sequence[str] = ()) -> typer.Typer:
    """Return the program; only the command that a command line begins with, or its group, if any.

    The others would be made for nothing, which takes longer than some commands do.
    """
    named = words[0] if words else ""
    listed = commands()
    listed = tuple(one for one in listed if one.name.partition(" ")[0] == named) or listed
    program = typer.Typer(
        help="How many cart-poles does one radio cell support when a hierarchical JEPA drives "
        "them? The stages, in order: collect, train-encoder, train-hierarchy, eval, scale. The "
        "last two also work alone, on a zoo model.",
        pretty_exceptions_enable=False,
    )
    program.callback(invoke_without_command=True)(_root)
    groups = {"": program}
    for name, text in GROUPS.items():
        groups[name] = typer.Typer(help=text)
        groups[name].callback(invoke_without_command=True)(_print_help)
        program.add_typer(groups[name], name=name, rich_help_panel=TOOLS)
    for command in listed:
        group, _, name = command.name.rpartition(" ")
        panel = None if group else command.panel
        register = groups[group].command(
            name, cls=ExplainedCommand, help=command.help, rich_help_panel=panel
        )
        register(_callback(command))
    return program


def _callback(command: Command) -> Callable[..., None]:
    """Return a function with the signature that Typer makes a command of."""

    def call(**given: Any) -> None:
        execute(command, {_key(name): value for name, value in given.items()})

    parameters = []
    for name in command.all_taken:
        one = command.own.get(name) or taken(name)
        is_input = name in INPUTS or name in command.own
        word = name.partition(":")[0] if is_input else SETTING + name.replace(".", "__")
        default = inspect.Parameter.empty if one.default is ... else one.default
        how = {"default": default, "annotation": annotation(one)}
        parameters.append(inspect.Parameter(word, inspect.Parameter.KEYWORD_ONLY, **how))
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {}
    return call


def _key(identifier: str) -> str:
    """Return the dotted key, or the argument of a stage, behind the name of a parameter."""
    key = identifier.removeprefix(SETTING)
    return key if key == identifier else key.replace("__", ".")


def _explained(parameter: Any, settings: Settings) -> Any:
    """Write into an option what depends on the preset and on plugins."""
    if isinstance(parameter.show_default, str):  # Typer would write it in brackets
        parameter.default, parameter.show_default = parameter.show_default, True
    if not parameter.name.startswith(SETTING):
        return parameter
    key = _key(parameter.name)
    value = operator.attrgetter(key)(settings)
    if isinstance(value, float):
        value = f"{value / taken(key).unit:g}"
    elif isinstance(value, tuple):
        value = ", ".join(map(str, value))
    parameter.default, parameter.show_default = value, value != ""
    if key in NAMES:
        parameter.help = parameter.help.replace("{choices}", ", ".join(NAMES[key]))
        parameter.metavar = parameter.metavar or "|".join(NAMES[key])
    return parameter


def _root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", **VERSION)] = False
) -> None:
    if version:
        print(f"hjepa {__version__}")
        raise typer.Exit()
    _print_help(context)


def _print_help(context: typer.Context) -> None:
    """Show the help of a group that is called on its own."""
    if context.invoked_subcommand is None:
        print(context.get_help())
