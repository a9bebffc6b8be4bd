"""What every command does around its work: settings, plan or result, and errors of its own.

Imports nothing heavy; see :mod:`hjepa_cli.cli.app`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from hjepa_cli.compute import torchrun
from hjepa_cli.compute.interrupts import exit_code, sigterm_raises
from hjepa_cli.errors import HjepaError, Interrupted, StorageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import plan

Result = dict[str, Any]


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: end without a word."""

    exit_code = StorageError.exit_code


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
        from hjepa_cli.compute.executors import placed

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
