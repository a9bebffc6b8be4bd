"""``hjepa resume RUN``: take up an interrupted run with nothing but its directory.

The run remembers its settings (``config.toml``) and what it was given (``environment.json``).
"""

import dataclasses
import shlex
from pathlib import Path
from typing import Any

from hjepa_cli import __version__
from hjepa_cli.compute import torchrun
from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.datasets.dataset import MANIFEST, load_dataset
from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import plan
from hjepa_cli.storage.runs import (
    CONFIG,
    RESULT,
    load_recorded,
    read_environment,
    version_of,
)
from hjepa_cli.storage.shards import LOG, remove_log

STAGES = ("train-encoder", "train-hierarchy", "train-reflex", "eval", "scale", "reproduce")


def run(directory: Path, screen: Screen) -> dict[str, Any]:
    """Continue the run in ``directory``, or tell the result of a finished one.

    Returns:
        The document of ``--json`` of the run's stage.

    Raises:
        MissingInputError: no such run, or an input of it is gone.
        DataError: its records are damaged.
        As the stage.
    """
    if (directory / MANIFEST).exists():
        from hjepa_cli.stages import collect

        torchrun.refuse()
        remove_log(directory)  # a kill between the two has left it behind
        screen.say(f"{directory} holds a finished dataset")
        return collect.describe(load_dataset(directory), 0.0, None)
    stage, settings, inputs = recall(directory, screen)
    if stage != "train-encoder":
        torchrun.refuse()
    dataset = _path(inputs, "dataset")
    if stage == "collect":
        from hjepa_cli.stages import collect

        return collect.run(settings, screen, out=directory)
    if stage == "train-encoder":
        from hjepa_cli.stages import train_encoder

        return train_encoder.run(settings, screen, dataset=dataset, out=directory)
    if stage == "train-hierarchy":
        from hjepa_cli.stages import train_hierarchy

        encoder = _text(_path(inputs, "encoder"))
        return train_hierarchy.run(
            settings, screen, dataset=dataset, encoder=encoder, out=directory
        )
    checkpoint, remeasure = _text(_path(inputs, "checkpoint")), bool(inputs.get("remeasure"))
    if stage == "train-reflex":
        from hjepa_cli.stages import train_reflex

        return train_reflex.run(
            settings, screen, dataset=dataset, checkpoint=checkpoint, out=directory
        )
    if stage == "eval":
        from hjepa_cli.stages import evaluate

        return evaluate.run(
            settings,
            screen,
            checkpoint=checkpoint,
            dataset=dataset,
            out=directory,
            remeasure=remeasure,
            further=_further(inputs),
            figure=bool(inputs.get("figure")),
        )
    if stage == "scale":
        from hjepa_cli.stages import scale

        return scale.run(
            settings,
            screen,
            checkpoint=checkpoint,
            dataset=dataset,
            out=directory,
            remeasure=remeasure,
            verify=bool(inputs.get("verify")),
            further=_further(inputs),
        )
    from hjepa_cli.stages import reproduce

    return reproduce.run(settings, screen, out=directory)


def planned(directory: Path) -> plan.Plan:
    """Plan of ``hjepa resume``: of the command that it repeats, which skips what is there already.

    Raises:
        MissingInputError: no such run, or an input of it is gone.
        DataError: its records are damaged.
    """
    if any((directory / name).exists() for name in (MANIFEST, RESULT)):
        return plan.Plan(f"resume {directory}", [f"{directory}, which is finished"], [], [], 0, 0.0)
    stage, settings, inputs = recall(directory, Screen(quiet=True))
    dataset = _path(inputs, "dataset")
    checkpoint, encoder = _text(_path(inputs, "checkpoint")), _text(_path(inputs, "encoder"))
    remeasure, verify, figure = (
        bool(inputs.get(flag)) for flag in ("remeasure", "verify", "figure")
    )
    if stage == "collect":
        whole = plan.plan_collect(settings, directory)
    elif stage == "train-encoder":
        whole = plan.plan_train_encoder(settings, dataset, directory)
    elif stage == "train-hierarchy":
        whole = plan.plan_train_hierarchy(settings, dataset, encoder, directory)
    elif stage == "train-reflex":
        whole = plan.plan_train_reflex(settings, dataset, checkpoint, directory)
    elif stage == "eval":
        whole = plan.plan_eval(
            settings, checkpoint, dataset, directory, remeasure=remeasure, figure=figure
        )
    elif stage == "scale":
        from hjepa_cli.core.radio.capacity import parse_snr

        grid_db = parse_snr(settings.radio.snr_db)
        whole = plan.plan_scale(
            settings, checkpoint, dataset, directory, grid_db, remeasure=remeasure, verify=verify
        )
    else:
        whole = plan.plan_reproduce(settings, directory)
    work = ["go on where it was interrupted; from the start it would", *whole.work]
    return dataclasses.replace(whole, command=f"resume {directory}", work=work)


def recall(directory: Path, screen: Screen) -> tuple[str, Settings, dict[str, Any]]:
    """The stage, the settings and the inputs of an unfinished run.

    Raises:
        MissingInputError: no such run.
        UsageError: its settings are not those of this version.
        DataError: its records are damaged, or of a stage that this version does not know.
    """
    if not directory.is_dir():
        raise MissingInputError(f"run {directory} does not exist", hint="ls runs/*")
    if (directory / LOG).exists():
        from hjepa_cli.stages.collect import recorded_settings

        return "collect", recorded_settings(directory), {}
    found = read_environment(directory)
    if found["stage"] not in STAGES:
        raise DataError(
            f"{directory} holds a run of '{found['stage']}', which this hjepa does not know"
        )
    if not (directory / CONFIG).exists():
        raise MissingInputError(
            f"{directory} was stopped before its settings were kept: there is nothing to continue",
            hint=_begun_by(found),
        )
    made_by = version_of(found) or __version__
    try:
        settings = load_recorded(_preset(found, directory), directory)
        check_settings(settings)
    except UsageError as error:
        if made_by == __version__:
            raise
        raise UsageError(
            f"{directory} was made by hjepa {made_by}, this is {__version__}: {error.message}",
            hint=f"take it up with hjepa {made_by}; or anew: hjepa {found['stage']} --out DIR",
        ) from None
    if made_by != __version__:
        screen.say(f"begun by hjepa {made_by}, this is {__version__}: results may differ")
    return found["stage"], settings, found["inputs"]


def _preset(recorded: dict[str, Any], directory: Path) -> str | None:
    preset = recorded.get("preset")
    if preset is not None and not isinstance(preset, str):
        raise DataError(f"{directory} is of preset {preset!r}")
    return preset


def _begun_by(found: dict[str, Any]) -> str | None:
    """The command that began the run, as far as it was kept."""
    command = found.get("command")
    if not isinstance(command, list) or not all(isinstance(word, str) for word in command):
        return None
    return shlex.join(["hjepa", *command[1:]])


def _path(inputs: dict[str, Any], name: str) -> Path | None:
    """Where an input was; ``None`` if the run had none or is too old to say."""
    described = inputs.get(name)
    path = described.get("path") if isinstance(described, dict) else None
    return Path(path) if isinstance(path, str) else None


def _further(inputs: dict[str, Any]) -> list[Path]:
    """Where the models after the first one were."""
    paths = [_path(inputs, name) for name in inputs if name.startswith("checkpoint ")]
    return [path for path in paths if path is not None]


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
