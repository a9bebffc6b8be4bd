"""What every command does around its work: settings, plan or result, and errors of its own.

Imports nothing heavy; see :mod:`hjepa_cli.cli`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from hjepa_cli import plan, torchrun
from hjepa_cli.checks import check_settings
from hjepa_cli.errors import HjepaError, Interrupted, StorageError, UsageError
from hjepa_cli.interrupts import exit_code, sigterm_raises
from hjepa_cli.screen import Screen
from hjepa_cli.settings import PRESETS, Settings, load_settings

Result = dict[str, Any]


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: end without a word."""

    exit_code = StorageError.exit_code


def resolve(preset: str | None, config: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Merge preset, file and flags; refuse values that make no sense before anything is touched."""
    plant = flags["plant"]
    settings = load_settings(preset, config, flags)
    if plant is not None and (own := load_settings(settings.preset).plant) != plant:
        named = plant if plant in PRESETS else "default"
        raise UsageError(
            f"preset '{settings.preset}' holds the ranges and noise of plant '{own}', "
            f"not of '{plant}'",
            hint=f"--preset {named} for plant {plant}; other values of it by --config FILE.toml",
        )
    check_settings(settings)
    return settings


def execute(
    screen: Screen,
    stage: Callable[[], Result],
    planned: Callable[[], plan.Plan] | None = None,
    *,
    dry_run: bool = False,
    product: str | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    shared: bool = False,
) -> None:
    """Run a stage, or show its plan, and print what it returns.

    Args:
        stage: the work.
        planned: its plan.
        dry_run: show the plan only.
        product: key of the result that a quiet run prints: the path that it made.
        workers, cluster: where its parallel work goes, as the user said.
        shared: several processes of torchrun may do it together.
    """
    with guard():
        if not shared:
            torchrun.refuse()
        if dry_run and planned is not None:
            planned().show(screen)
            return
        from hjepa_cli.core.executors import placed

        with placed(workers, cluster):
            result = stage()
        if torchrun.follows():
            return
        if screen.json:
            screen.emit(result)
        elif screen.quiet and product is not None:  # otherwise the stage has said where it is
            screen.result(str(result[product]))


@contextmanager
def guard() -> Iterator[None]:
    """Catch what Typer would turn into exit codes of its own."""
    try:
        with sigterm_raises():
            yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            "interrupted", hint="run the same command again", code=exit_code(error)
        ) from None
    except BrokenPipeError:
        raise PipeClosed("output closed") from None


def print_help(context: typer.Context) -> None:
    """A command group on its own shows its help."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit()
