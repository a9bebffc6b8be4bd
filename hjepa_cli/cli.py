"""The command line: flags to settings, stages to results, errors to one line and an exit code.

Nothing heavy is imported here: a command imports its stage when it runs, so that ``--help`` answers
at once. Defaults live in ``presets/default.toml``, not in the signatures below: a flag that is not
given is ``None`` and changes nothing.
"""

import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.main import get_command

from hjepa_cli import __version__
from hjepa_cli.checks import METHODS, check_settings
from hjepa_cli.errors import HjepaError, StorageError
from hjepa_cli.plan import Plan, plan_stage
from hjepa_cli.screen import Screen, one_line
from hjepa_cli.settings import PRESETS, Settings, load_settings

Result = dict[str, Any]

PIPELINE = (
    "hjepa collect --trajectories 200 | hjepa train-encoder | "
    "hjepa train-hierarchy --h 4 --m 2 --l 1 | hjepa eval | hjepa scale --snr 10:30"
)

app = typer.Typer(
    help="Semantic predictive control over radio links with a hierarchical JEPA: how many "
    "cart-poles does one radio cell support when a predictive world model drives them?",
    epilog="The five stages, in order: collect, train-encoder, train-hierarchy, eval, scale. "
    "eval and scale also work on their own, with a trained model of the zoo.",
    rich_markup_mode=None,
    add_completion=True,
)
models_app = typer.Typer(
    help="List, describe and verify trained models.", rich_markup_mode=None, no_args_is_help=True
)
app.add_typer(models_app, name="models", rich_help_panel="Models")


class Interrupted(HjepaError):
    """Ctrl-C."""

    exit_code = 130


# --- options: one type per flag, so that each has one help text -----------------------------------


def _whole_number(minimum: int) -> Callable[[str], int]:
    """Parser of whole numbers of at least ``minimum``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise typer.BadParameter(f"'{text}' is not a whole number of at least {minimum}")
        return value

    return parse


def _number(minimum: float) -> Callable[[str], float]:
    """Parser of finite numbers of at least ``minimum``; NaN and infinities are refused."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not minimum <= value < float("inf"):
            raise typer.BadParameter(f"'{text}' is not a finite number of at least {minimum:g}")
        return value

    return parse


def _choices(*choices: str) -> Callable[[str], list[str]]:
    """Shell completion from a fixed list."""
    return lambda incomplete: [choice for choice in choices if choice.startswith(incomplete)]


def _option(panel: str, flag: str, help_text: str, metavar: str | None = None, **more: Any) -> Any:
    return typer.Option(
        flag, help=help_text, metavar=metavar, rich_help_panel=panel, show_default=False, **more
    )


DATA, MODEL, LOOP, RADIO = "Data", "Model", "Closed loop", "Radio cell"
FILES, SETTINGS, OUTPUT = "Files", "Settings", "Screen"

Trajectories = Annotated[
    int | None,
    _option(
        DATA, "--trajectories", "Training trajectories.", "N", parser=_whole_number(1)
    ),
]
TestTrajectories = Annotated[
    int | None,
    _option(DATA, "--test-trajectories", "Held-out trajectories.", "N", parser=_whole_number(1)),
]
