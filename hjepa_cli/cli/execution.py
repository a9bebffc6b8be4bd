"""Every command does this around its stage: plugins, settings, plan or result, interruptions.

Imports nothing heavy; see :mod:`hjepa_cli.cli.commands`.
"""

import inspect
import sys
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from pathlib import Path

from hjepa_cli.cli.commands import Command, Given
from hjepa_cli.compute import memory, torchrun
from hjepa_cli.compute.interrupts import exit_code, sigterm_raises
from hjepa_cli.config.checks import resolve
from hjepa_cli.config.schema import RECORDED, declared
from hjepa_cli.config.settings import locate
from hjepa_cli.errors import Interrupted, Unlocked, Unsealed, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan
from hjepa_cli.storage.peeking import any_of

NAMING = ("dataset", "encoder", "checkpoint")  # inputs that say which plant they are of


def execute(command: Command, given: Given) -> None:
    """Run a command's stage, or show its plan, and print what it returns."""
    screen = Screen(given.pop("quiet"), given.pop("json"))
    with _guard(screen), _locating(command, given):
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
            parameters = inspect.signature(plan).parameters
            takes_all = any(one.kind is one.VAR_KEYWORD for one in parameters.values())
            wanted = [name for name in inputs if name in parameters or takes_all]
            wanted = [name for name in wanted if name != "screen" or name in parameters]
            planned = plan(**{name: inputs[name] for name in wanted})
            if not isinstance(planned, Plan):
                raise UsageError(f"{command.name} planned {planned!r}; expected a Plan")
            memory.check(planned.memory_bytes, command.name)
            planned.show(screen)
            return
        prints = redirect_stdout(sys.stderr) if screen.json else nullcontext()  # a plugin's
        with _placed(workers, cluster) if parallel else nullcontext(), prints:
            result = command.run(**inputs)
        if not isinstance(result, dict):
            raise UsageError(f"{command.name} returned {result!r}; expected a dict, for --json")
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
    if given["plant"] is None and any_of(RECORDED, map(given.get, NAMING)):
        given["plant"] = RECORDED  # an input says so
    preset, config, flags = _layers(given)
    settings = resolve(preset, config, flags)
    if command.check is not None:
        command.check(settings, given)
    others = {name: given[name] for name in given if name not in (*flags, "preset", "config")}
    return {"settings": settings, **others}


def _layers(given: Given) -> tuple[str | None, Path | None, Given]:
    """Return the preset, the file and the flags that settings are made of."""
    flags = {key: given[key] for key in given if key in declared() or key == "protocol"}
    return flags.pop("preset"), given["config"], flags


@contextmanager
def _locating(command: Command, given: Given) -> Iterator[None]:
    """Name the file and the line of a setting that is found wrong at any time."""
    try:
        yield
    except UsageError as error:
        if command.resolves:
            locate(error, *_layers(given))
        raise


@contextmanager
def _guard(screen: Screen) -> Iterator[None]:
    """Catch what Typer would turn into exit codes of its own, and say warnings in our words."""
    try:
        with sigterm_raises(), warnings.catch_warnings():
            for ours in (Unsealed, Unlocked):
                warnings.simplefilter("default", ours)
            warnings.showwarning = lambda message, *_, **__: screen.say(f"warning: {message}")
            yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            "interrupted", hint="run the same command again", code=exit_code(error)
        ) from None
