"""``hjepa resume RUN``: take up an interrupted run with nothing but its directory.

The run remembers its settings (``config.toml``) and what it was given (``environment.json``).
"""

from pathlib import Path
from typing import Any

from hjepa_cli import torchrun
from hjepa_cli.checks import check_settings
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import load_settings
from hjepa_cli.storage.datasets import MANIFEST, load_dataset
from hjepa_cli.storage.runs import CONFIG, read_environment
from hjepa_cli.storage.shards import LOG, read_task


def run(directory: Path, screen: Screen) -> dict[str, Any]:
    """Continue the run in ``directory``, or tell the result of a finished one.

    Returns:
        The document of ``--json`` of the run's stage.

    Raises:
        MissingInputError: no such run, or an input of it is gone.
        DataError: its records are damaged.
        As the stage.
    """
    if not directory.is_dir():
        raise MissingInputError(f"run {directory} does not exist", hint="ls runs/*")
    if (directory / LOG).exists() or (directory / MANIFEST).exists():
        torchrun.refuse()
        return _collect(directory, screen)
    recorded = read_environment(directory)
    stage, inputs = recorded["stage"], recorded["inputs"]
    if stage != "train-encoder":
        torchrun.refuse()
    settings = load_settings(_preset(recorded, directory), directory / CONFIG)
    check_settings(settings)
    dataset = _path(inputs, "dataset")
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
    if stage == "reproduce":
        from hjepa_cli.stages import reproduce

        return reproduce.run(settings, screen, out=directory)
    raise DataError(f"{directory} holds a run of '{stage}', which this hjepa does not know")


def _collect(directory: Path, screen: Screen) -> dict[str, Any]:
    from hjepa_cli.stages import collect

    if (directory / MANIFEST).exists():
        screen.say(f"{directory} holds a finished dataset")
        return collect.describe(load_dataset(directory), 0.0, None)
    task = read_task(directory)
    flags = {key: value for key, value in task.items() if key != "preset"}
    for section in [key for key, value in flags.items() if isinstance(value, dict)]:
        flags |= {f"{section}.{key}": value for key, value in flags.pop(section).items()}
    settings = load_settings(_preset(task, directory), None, flags)
    check_settings(settings)
    return collect.run(settings, screen, out=directory)


def _preset(recorded: dict[str, Any], directory: Path) -> str | None:
    preset = recorded.get("preset")
    if preset is not None and not isinstance(preset, str):
        raise DataError(f"{directory} is of preset {preset!r}")
    return preset


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
