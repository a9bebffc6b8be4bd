"""``hjepa resume RUN`` takes up an interrupted run with nothing but its directory.

The run remembers its settings (``config.toml``) and what it was given (``environment.json``).
"""

import dataclasses
from pathlib import Path
from typing import Any

from hjepa_cli import __version__
from hjepa_cli.compute import torchrun
from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.datasets.dataset import MANIFEST
from hjepa_cli.errors import DataError, MissingInputError, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import STAGES
from hjepa_cli.stages import import_data
from hjepa_cli.stages.collect import describe_finished, recorded_settings
from hjepa_cli.stages.plan import Plan
from hjepa_cli.stages.stage import Stage
from hjepa_cli.storage.runs import (
    CONFIG,
    RESULT,
    anew,
    check_plugins,
    load_recorded,
    read_environment,
    version_of,
)
from hjepa_cli.storage.shards import LOG


def run(directory: Path, screen: Screen) -> dict[str, Any]:
    """Continue the run in ``directory``, or tell a finished one's result: its stage's document.

    Raises:
        MissingInputError: no such run, or an input of it is gone.
        DataError: its records are damaged.
        As the stage.
    """
    if (directory / MANIFEST).exists():
        torchrun.refuse()
        return describe_finished(directory, screen)
    if (directory / LOG).exists() and import_data.is_import(directory):
        torchrun.refuse()
        return import_data.resume(directory, screen)
    stage, settings, inputs = recall(directory, screen)
    if not stage.shared:
        torchrun.refuse()
    return stage.run(settings=settings, screen=screen, out=directory, **given_to(stage, inputs))


def plan(directory: Path) -> Plan:
    """Plan the command that is repeated, which skips what is there already; raises as it."""
    if any((directory / name).exists() for name in (MANIFEST, RESULT)):
        return Plan(f"resume {directory}", [f"{directory}, which is finished"], [], [], 0, 0.0)
    if (directory / LOG).exists() and import_data.is_import(directory):
        whole = import_data.plan_resume(directory)
    else:
        stage, settings, inputs = recall(directory, Screen(quiet=True))
        whole = stage.plan(settings=settings, out=directory, **given_to(stage, inputs))
    work = ["go on where it was interrupted; from the start it would", *whole.work]
    return dataclasses.replace(whole, command=f"resume {directory}", work=work)


def given_to(stage: Stage, inputs: dict[str, Any]) -> dict[str, Any]:
    """Return the inputs that a run recorded as the keyword arguments that its stage takes.

    What it recorded of a file is where that was; of a flag, the flag.

    Raises:
        DataError: it was given something that its stage does not take: without it the result would
            be another one.
    """
    given: dict[str, Any] = {"further": []}
    for name, value in inputs.items():
        if value not in (None, False) and name.partition(" ")[0] not in stage.inputs:
            raise DataError(f"the run was given '{name}', which hjepa {stage.name} does not take")
    for name, value in inputs.items():
        if isinstance(value, bool | int | float | str):
            given[name] = value
        elif isinstance(value, dict) and isinstance(value.get("path"), str):
            given[name] = path = Path(value["path"])
            given["further"] += [path] * name.startswith("checkpoint ")
    return {name: given[name] for name in stage.inputs if name in given}


def recall(directory: Path, screen: Screen) -> tuple[Stage, Settings, dict[str, Any]]:
    """Return the stage, the settings and the recorded inputs of an unfinished run.

    Raises:
        MissingInputError: no such run.
        UsageError: its settings are not those of this version.
        DataError: its records are damaged, or of a stage that this version does not know.
    """
    if not directory.is_dir():
        raise MissingInputError(f"run {directory} does not exist", hint="ls runs/*")
    if (directory / LOG).exists():
        return STAGES["collect"], recorded_settings(directory), {}
    found = read_environment(directory)
    check_plugins(directory, found)
    if found["stage"] not in STAGES:
        raise DataError(
            f"{directory} holds a run of '{found['stage']}', which this hjepa does not know"
        )
    if not (directory / CONFIG).exists():
        words = found.get("command")
        kept = isinstance(words, list) and all(isinstance(word, str) for word in words)
        raise MissingInputError(
            f"{directory} was stopped before its settings were kept: there is nothing to continue",
            hint=shell(["hjepa", *words[1:]]) if kept else None,
        )
    preset, made_by = found.get("preset"), version_of(found) or __version__
    if preset is not None and not isinstance(preset, str):
        raise DataError(f"{directory} is of preset {preset!r}")
    try:
        settings = load_recorded(preset, directory)
        check_settings(settings)
    except UsageError as error:
        if made_by == __version__:
            raise
        raise UsageError(
            f"{directory} was made by hjepa {made_by}, this is {__version__}: {error.message}",
            hint=f"take it up with that version; or anew: {anew(found)} --out DIR",
        ) from None
    if made_by != __version__:
        screen.say(f"begun by hjepa {made_by}, this is {__version__}: results may differ")
    return STAGES[found["stage"]], settings, found["inputs"]
