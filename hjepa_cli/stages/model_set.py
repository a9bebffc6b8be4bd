"""What ``eval`` and ``scale`` measure: a trained model for each method, found wherever it is.

The model that the user names, or the newest run's, or the zoo's, comes first. A method that it does
not hold is looked for in the other runs of the plant, newest first, and in the zoo.
"""

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import ANCHORS, RAW_FRAMES, REFLEXES, TRUE_STATE, split_late
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.evaluation.workers import ModelFile
from hjepa_cli.core.networks.model import Model, offered
from hjepa_cli.core.plants.named import plant, plant_of
from hjepa_cli.errors import DataError, HjepaError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import open_dataset
from hjepa_cli.storage import runs, zoo
from hjepa_cli.storage.checkpoints import MODEL_FILE, load_checkpoint
from hjepa_cli.storage.zoo import CURVES_FILE

TRAINING = ("train-encoder", "train-hierarchy", "train-reflex")


@dataclasses.dataclass(frozen=True)
class Subject:
    """What is evaluated: a model, if there is one, and the rollouts its NMAE is taken on.

    Attributes:
        settings: plant, seed, protocol.
        model: ``None`` when only true-state methods can be measured.
        path: the model's file.
        dataset: whose clean rollouts to use; ``None`` makes them again from the settings.
        further: of other models, for methods that this one does not hold.
    """

    settings: Settings
    model: Model | None
    path: Path | None
    dataset: Dataset | None
    further: tuple["Subject", ...] = ()

    @property
    def name(self) -> str:
        """The models' paths, for people."""
        return ", ".join(str(one.path) for one in (self, *self.further) if one.path) or "no model"

    @property
    def file(self) -> ModelFile | None:
        """The model as workers load it."""
        if self.model is None:
            return None
        path = self.path or Path(self.model.digest)
        return ModelFile(path.absolute(), self.model.digest, self.model)

    @property
    def methods(self) -> tuple[str, ...]:
        """All methods that can be measured."""
        held = [name for one in (self, *self.further) if one.model for name in one.model.methods]
        return tuple(dict.fromkeys([*held, *TRUE_STATE]))

    def measurable(self, methods: Sequence[str]) -> list[str]:
        """Those of ``methods`` that can be measured, in their order."""
        return [name for name in methods if name in self.methods]

    def of(self, method: str) -> "Subject":
        """Whose model holds a method, on time or late; this one for methods on the true state."""
        name, _ = split_late(method)
        holders = (one for one in (self, *self.further) if one.model and name in one.model.methods)
        return next(holders, self)

    def shared_out(self, methods: Iterable[str]) -> list[tuple["Subject", list[str]]]:
        """Methods by the subject that holds them."""
        shares: dict[Path | None, tuple[Subject, list[str]]] = {}
        for name in methods:
            holder = self.of(name)
            shares.setdefault(holder.path, (holder, []))[1].append(name)
        return list(shares.values())

    def training_seeds(self, methods: Iterable[str]) -> dict[str, int | None]:
        """The seed that the model of each method was trained with, ``None`` if it does not say.

        Methods without a model are left out.
        """
        holders = {name: self.of(name).model for name in methods if name not in TRUE_STATE}
        return {name: model.metadata.get("seed") for name, model in holders.items() if model}

    def check_one_training_seed(self) -> None:
        """Raise DataError if the models of the settings' methods come from different seeds."""
        seeds = self.training_seeds(self.measurable(self.settings.methods))
        if len(set(seeds.values())) > 1:
            of = ", ".join(f"{name}: {seed}" for name, seed in seeds.items())
            raise DataError(
                f"a figure of models that were trained with different seeds ({of}) compares "
                "trainings, not methods",
                hint="give models of one seed; for several trainings, hjepa compare",
            )

    @property
    def digest(self) -> Digest:
        """What curves must have been measured with to be this subject's."""
        return Digest.of(
            self.model.digest if self.model else None,
            self.settings,
            self.dataset.settings if self.dataset else None,
        )

    def inputs(self, **flags: bool) -> dict[str, Any]:
        """What a run of this subject was given, for :meth:`Run.create`."""
        given: dict[str, Any] = dict(flags)
        models = [
            "checkpoint",
            *(f"checkpoint {number + 2}" for number in range(len(self.further))),
        ]
        for key, one in zip(models, (self, *self.further), strict=True):
            if one.model and one.path:
                given[key] = runs.describe_input(one.path, one.model.digest)
        if self.dataset:
            given["dataset"] = runs.describe_input(self.dataset.path, self.dataset.digest)
        return given

    @property
    def beside(self) -> list[Path]:
        """Where the model's own curves are; the zoo's are never written, a run's are."""
        return [self.path.with_name(CURVES_FILE)] if self.path else []

    def skipped(self, methods: Sequence[str]) -> dict[str, str]:
        """The methods without a model, with what would train it."""
        missing = [name for name in methods if name not in self.methods]
        return {name: how_to_train(name, self.settings) for name in missing}

    def check_any(self, methods: Sequence[str]) -> None:
        """Check that there is a model of at least one of them.

        Raises:
            MissingInputError: naming all of them, and what trains the first.
        """
        skipped = self.skipped(methods)
        if len(skipped) == len(methods):
            raise MissingInputError(
                f"no model for {', '.join(skipped)}", hint=next(iter(skipped.values()))
            )

    def say_skipped(self, methods: Sequence[str], screen: Screen) -> None:
        """Tell the user about them."""
        for name, how in self.skipped(methods).items():
            screen.say(f"{name} skipped, no model of it here: {how}")


def open_subject(
    settings: Settings,
    screen: Screen,
    checkpoint: str | None,
    dataset: Path | None,
    further: Sequence[Path] | None = None,
    *,
    one_seed: bool = False,
) -> Subject:
    """Load what is to be evaluated, and say which models they are where the user did not.

    Args:
        settings: plant, seed, protocol and the methods to find models for.
        screen: where to say so.
        checkpoint: zoo name, run directory or file of the first model.
        dataset: whose clean rollouts to use.
        further: models of the other methods; ``None`` looks for them.
        one_seed: look for those only that were trained with the first model's seed.

    Raises:
        MissingInputError, DataError: no such file, damaged, or of another plant.
    """
    plant_of(settings)
    path = zoo.resolve_model(checkpoint) if checkpoint else default_model(settings, screen)
    model = Model.load(path, settings.device) if path else None
    if model and model.plant_name != settings.plant:
        raise DataError(
            f"model {path} drives plant {model.plant_name}, not {settings.plant}",
            hint=f"add --plant {model.plant_name}, or pass another --checkpoint",
        )
    data = open_dataset(dataset, settings) if dataset else None
    held = (*(model.methods if model else ()), *TRUE_STATE)
    lacking = [name for name in settings.methods if name not in held]
    if further is None:
        seed = model.metadata.get("seed") if one_seed and model else None
        further = _find(lacking, settings, screen, seed) if lacking else []
    others = tuple(
        Subject(settings, Model.load(other, settings.device), other, data) for other in further
    )
    for other in others:
        if model and other.model and not on_one_encoder(model, other.model):
            screen.say(
                f"{other.path} is on another encoder than {path}: trainings are compared, not "
                f"methods; {how_to_train(other.model.methods[0], settings)} trains it on this one"
            )
    return Subject(settings, model, path, data, others)


def on_one_encoder(first: Model, other: Model) -> bool:
    """Whether two models say that they have one encoder; those on raw frames need none."""
    theirs = other.metadata.get("encoder")
    return theirs in (None, first.digest, first.metadata.get("encoder"))


def how_to_train(method: str, settings: Settings) -> str:
    """The command that trains the model of a method."""
    if method not in RAW_FRAMES:
        train = "hjepa train-reflex" if method in REFLEXES else "hjepa train-hierarchy"
    else:
        kind, frames = method.split("-")
        train = f"hjepa train-encoder --method {kind}"
        train += f" --frames {frames}" if frames != "2" else ""
    if settings.preset != "default":
        train += f" --preset {settings.preset}"
    if method.startswith("ts-jepa-") and method != "ts-jepa-1":
        return f"{train} --h {method.removeprefix('ts-jepa-')}"
    if method in ANCHORS and len(plant(settings.plant).state_names) != 4:
        return f"{method} is for plants of four states"
    return train


def default_model(settings: Settings, screen: Screen) -> Path | None:
    """The newest finished run of the plant, one with a hierarchy before one without, or the zoo's.

    Of the zoo the model with the settings' strides, if there is one.
    """

    def fits(directory: Path, several: bool) -> bool:
        config = runs.read_config(directory)
        strides = {config.get("hierarchy", {}).get(name) for name in ("h", "m", "l")}
        return config.get("plant") == settings.plant and (len(strides) > 1 or not several)

    for several in (True, False):
        directory = runs.newest_run("train-hierarchy", lambda run, s=several: fits(run, s))
        if directory:
            screen.say(f"model of the newest run, {directory}")
            return directory / MODEL_FILE
    hierarchy = settings.hierarchy
    path = zoo.find_model(settings.plant, (hierarchy.h, hierarchy.m, hierarchy.l))
    if path:
        screen.say(f"no run of train-hierarchy here: model {path.parent.name} of the zoo")
        return path
    screen.say(f"no model of plant {settings.plant}: true-state methods only")
    return None


def _find(
    methods: Sequence[str], settings: Settings, screen: Screen, seed: int | None
) -> list[Path]:
    """A model for each method that has one: of the newest run, else of the zoo.

    With a ``seed`` only models that were trained with it.
    """
    missing, found = list(methods), []
    for path in _candidates():
        if not missing:
            break
        held = _held(path, settings.plant, seed)
        if taken := [name for name in missing if name in held]:
            found.append(path)
            screen.say(f"{', '.join(taken)}: model {path}")
            missing = [name for name in missing if name not in held]
    return found


def _candidates() -> Iterator[Path]:
    """The models of all finished training runs below ``runs/``, newest first; then the zoo's."""
    for directory in runs.finished_runs(*TRAINING):
        if (directory / MODEL_FILE).is_file():
            yield directory / MODEL_FILE
    yield from map(zoo.resolve_model, zoo.list_models())


def _held(path: Path, plant_name: str, seed: int | None) -> tuple[str, ...]:
    """The methods that a checkpoint offers to a plant.

    None if it is damaged, of another plant, or not trained with the ``seed`` that is asked for.
    """
    with contextlib.suppress(HjepaError, KeyError, TypeError):
        metadata = load_checkpoint(path).metadata
        if metadata["plant"] == plant_name and seed in (None, metadata.get("seed")):
            return offered(metadata["architecture"], len(plant(plant_name).state_names))
    return ()
