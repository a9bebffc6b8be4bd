"""Every command does this around its stage: plugins, settings, plan or result, interruptions.

Imports nothing heavy; see :mod:`hjepa_cli.cli.commands`.
"""

import inspect
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from hjepa_cli.cli.commands import Command, Given
from hjepa_cli.compute import torchrun
from hjepa_cli.compute.interrupts import exit_code, sigterm_raises
from hjepa_cli.config.checks import resolve
from hjepa_cli.config.schema import declared
from hjepa_cli.errors import HjepaError, Interrupted, StorageError, Unsealed
from hjepa_cli.output.screen import Screen


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: we end without a word."""

    exit_code = StorageError.exit_code


def execute(command: Command, given: Given) -> None:
    """Run a command's stage, or show its plan, and print what it returns."""
    screen = Screen(given.pop("quiet"), given.pop("json"))
    with _guard(screen):
        del given["plugin"]  # loaded before the commands were listed
        dry_run, _ = given.pop("dry_run", False), given.pop("debug")
        parallel = "workers" in given
        workers, cluster = given.pop("workers", None), given.pop("cluster", None)
        if command.prepare is not None:
            command.prepare(given)
        inputs = {"screen": screen, **(_settings(command, given) if command.resolves else given)}
        if not command.shared:
            torchrun.refuse()
        if dry_run and command.plan is not None:
            plan = getattr(command.plan, "function", command.plan)
            wanted = inspect.signature(plan).parameters.keys() & inputs.keys()
            plan(**{name: inputs[name] for name in wanted}).show(screen)
            return
        with _placed(workers, cluster) if parallel else nullcontext():
            result = command.run(**inputs)
        if torchrun.follows():
            return
        if screen.json:
            screen.emit(result)
        elif screen.quiet and command.product and (made := result[command.product]) is not None:
            screen.result(str(made))  # otherwise the stage has said where it is


def _placed(workers: int | None, cluster: str | None) -> AbstractContextManager[None]:
    """Place parallel work; a command that has none does not import what it takes."""
    from hjepa_cli.compute.executors import placed

    return placed(workers, cluster)


def _settings(command: Command, given: Given) -> Given:
    """Return what was given with the settings in place of what they are made of."""
    preset, config = given["preset"], given["config"]
    flags = {key: given[key] for key in given if key in declared() or key == "protocol"}
    del flags["preset"]
    settings = resolve(preset, config, flags)
    if command.check is not None:
        command.check(settings, given)
    others = {name: given[name] for name in given if name not in (*flags, "preset", "config")}
    return {"settings": settings, **others}


@contextmanager
def _guard(screen: Screen) -> Iterator[None]:
    """Catch what Typer would turn into exit codes of its own, and say warnings in our words."""
    try:
        with sigterm_raises(), warnings.catch_warnings():
            warnings.simplefilter("default", Unsealed)
            warnings.showwarning = lambda message, *_, **__: screen.say(f"warning: {message}")
            yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            "interrupted", hint="run the same command again", code=exit_code(error)
        ) from None
    except BrokenPipeError:
        raise PipeClosed("output closed") from None
