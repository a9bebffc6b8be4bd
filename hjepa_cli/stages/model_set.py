"""``eval`` and ``scale`` measure a model for each method, found wherever it is.

The model that the user names, or the newest run's, or the zoo's, comes first. A method that it does
not hold is looked for in the other runs of the plant, newest first, and in the zoo.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from hjepa_cli.config.checks import needs_model, split_late, without_model
from hjepa_cli.config.schema import RECORDED, Settings
from hjepa_cli.core.control.drivers import as_trained, methods_of, offered_methods
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.evaluation.workers import ModelFile
from hjepa_cli.core.networks.model import ON_EMBEDDINGS, Model
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.inputs import brought_along, check_same_plant, open_dataset
from hjepa_cli.storage import runs, zoo
from hjepa_cli.storage.checkpoints import MODEL_FILE, load_checkpoint
from hjepa_cli.storage.zoo import CURVES_FILE

ALIKE = ("plant", "recorded")  # what a model must have in common with what it is to drive
TRAINING = ("train-encoder", "train-hierarchy", "train-reflex", "train-fusion")


@dataclasses.dataclass(frozen=True)
class ModelSet:
    """It holds a model to be evaluated, if any, those beside it, and the rollouts of its NMAE.

    Attributes:
        model: ``None`` when only true-state methods can be measured; ``path`` is its file.
        dataset: whose clean rollouts to use; ``None`` makes them again from the settings.
        further: of other models, for methods that this one does not hold.
    """

    settings: Settings
    model: Model | None
    path: Path | None
    dataset: Dataset | None
    further: tuple["ModelSet", ...] = ()

    @property
    def name(self) -> str:
        """Return the models' paths, for people."""
        return ", ".join(str(one.path) for one in (self, *self.further) if one.path) or "no model"

    @property
    def file(self) -> ModelFile | None:
        """Return the model as workers load it."""
        if self.model is None:
            return None
        path = self.path or Path(self.model.digest)
        return ModelFile(path.absolute(), self.model.digest, self.model)

    @property
    def held(self) -> tuple[str, ...]:
        """Return the methods that the first model offers."""
        return methods_of(self.model) if self.model else ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Return all methods that can be measured."""
        held = [name for one in (self, *self.further) for name in one.held]
        return tuple(dict.fromkeys([*held, *without_model()]))

    def measurable(self, methods: Sequence[str]) -> list[str]:
        """Return those of ``methods`` that can be measured, in their order."""
        return [name for name in methods if name in self.methods]

    def skipped(self, methods: Sequence[str]) -> dict[str, str]:
        """Return the methods without a model, with what would train it."""
        missing = [name for name in methods if name not in self.methods]
        return {name: how_to_train(name, self.settings) for name in missing}

    def say_skipped(self, methods: Sequence[str], screen: Screen) -> None:
        """Tell the user about them."""
        for name, how in self.skipped(methods).items():
            screen.say(f"{name} skipped, no model of it here: {how}")

    def of(self, method: str) -> "ModelSet":
        """Return the set whose first model holds a method, on time or late; else this one."""
        name, _ = split_late(method)
        return next((one for one in (self, *self.further) if name in one.held), self)

    def shared_out(self, methods: Iterable[str]) -> list[tuple["ModelSet", list[str]]]:
        """Share methods out to those that hold them."""
        shares: dict[Path | None, tuple[ModelSet, list[str]]] = {}
        for name in methods:
            holder = self.of(name)
            shares.setdefault(holder.path, (holder, []))[1].append(name)
        return list(shares.values())

    def training_seeds(self, methods: Iterable[str]) -> dict[str, int | None]:
        """Return the seed of each method's training, ``None`` if its model does not say.

        Methods without a model are left out.
        """
        holders = {name: self.of(name).model for name in methods if needs_model(name)}
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
        """Return the digest that this model's curves are measured under."""
        digest = self.model.digest if self.model else None
        return Digest.of(digest, self.settings, self.dataset.settings if self.dataset else None)

    def inputs(self, **flags: bool | float | None) -> dict[str, Any]:
        """Return what a run of these models was given, for :meth:`Run.create`."""
        given: dict[str, Any] = dict(flags)
        for number, one in enumerate((self, *self.further), start=1):
            if one.model and one.path:
                key = "checkpoint" if number == 1 else f"checkpoint {number}"
                given[key] = runs.describe_input(one.path, one.model.digest)
        if self.dataset:
            given["dataset"] = runs.describe_input(self.dataset.path, self.dataset.digest)
        return given

    def described(self, methods: Sequence[str]) -> dict[str, Any]:
        """Return what a result of these methods says of its models, plant and seed."""
        paths = {name: self.of(name).path for name in methods if needs_model(name)}
        return {
            "checkpoint": self.path,
            "checkpoints": {name: path for name, path in paths.items() if path},
            "training_seeds": self.training_seeds(methods),
            "plant": self.settings.plant,
            "seed": self.settings.seed,
        }

    @property
    def beside(self) -> list[Path]:
        """Return the file of the model's own curves; the zoo's is never written, a run's is."""
        return [self.path.with_name(CURVES_FILE)] if self.path else []


def open_model_set(
    settings: Settings,
    screen: Screen,
    checkpoint: str | Path | None,
    dataset: Path | None,
    further: Sequence[Path] | None = None,
    *,
    one_seed: bool = False,
) -> ModelSet:
    """Load what is to be evaluated, and say which models they are where the user did not.

    Args:
        settings: plant, seed, protocol and the methods to find models for.
        checkpoint: zoo name, run directory or file of the first model.
        dataset: whose clean rollouts to use.
        further: models of the other methods; ``None`` looks for them.
        one_seed: look for those only that were trained with the first model's seed.

    Raises:
        MissingInputError, DataError: no such file, damaged, or of another plant.
    """
    plant_of(settings)
    path, model = load_first(settings, screen, checkpoint)
    if model:
        if settings.plant == RECORDED and dataset:
            check_same_plant(model.metadata, settings, f"model {path}", dataset)
        if (trained_by := model.metadata["settings"].get("preset")) != settings.preset:
            screen.say(
                f"model {path} was trained by preset {trained_by}: its recipe and law count, not "
                f"those of preset {settings.preset}"
            )
        settings = under_law_of(model, settings)
    data = open_dataset(dataset, settings) if dataset else None
    first = ModelSet(settings, model, path, data)
    if further is None:
        seed = model.metadata.get("seed") if one_seed and model else None
        lacking = first.skipped(settings.methods)
        further = _find([*lacking], settings, screen, seed) if lacking else []
    others = []
    for one in further:
        other = Model.load(one, settings.device)
        others.append(ModelSet(under_law_of(other, settings), other, one, data))
        if others[-1].settings.control != settings.control:
            screen.say(f"{one} learned another law than {path or 'the settings'}")
        if model and not _embed_alike(model, other):
            screen.say(
                f"{one} is on another encoder than {path}: trainings are compared, not "
                f"methods; {how_to_train(methods_of(other)[0], settings)} trains it on this one"
            )
    return dataclasses.replace(first, further=tuple(others))


def load_first(
    settings: Settings, screen: Screen, checkpoint: str | Path | None
) -> tuple[Path | None, Model | None]:
    """Load the model that is named, else the default one; neither where there is none.

    Raises:
        MissingInputError, DataError: no such file, damaged, or of another plant.
    """
    path = zoo.resolve_model(checkpoint) if checkpoint else default_model(settings, screen)
    model = Model.load(path, settings.device) if path else None
    if model and model.plant_name != settings.plant:
        raise DataError(
            f"model {path} drives plant {model.plant_name}, not {settings.plant}",
            hint=f"add --plant {model.plant_name}, or pass another --checkpoint",
        )
    return path, model


def _embed_alike(one: Model, other: Model) -> bool:
    """Return whether both have the same encoder to the bit, or one is no model on embeddings."""
    if any(model.architecture["kind"] not in ON_EMBEDDINGS for model in (one, other)):
        return True
    ours, theirs = (model.networks["encoder"].state_dict() for model in (one, other))
    return ours.keys() == theirs.keys() and all(
        torch.equal(ours[name], theirs[name]) for name in ours
    )


def under_law_of(model: Model, settings: Settings) -> Settings:
    """Return settings with what a model brings along, for all beside it.

    Of a recorded plant it brings all that is known; of others what it was trained with, see
    :func:`~hjepa_cli.core.control.drivers.as_trained`.
    """
    found = brought_along(settings, model.metadata["settings"], model.digest)
    own = as_trained(settings, model)
    return dataclasses.replace(found, control=own.control, sensor=own.sensor)


def how_to_train(method: str, settings: Settings) -> str:
    """Return the command that trains the model of a method, on time or late."""
    return str(METHODS[split_late(method)[0]].trained_by(settings))


def default_model(settings: Settings, screen: Screen) -> Path | None:
    """Return the plant's newest finished run, one with a hierarchy before others, or the zoo's.

    Of the zoo the model with the settings' strides, if there is one.
    """

    mine = settings.as_dict()

    def fits(directory: Path, several: bool) -> bool:
        config = runs.read_config(directory)
        strides = {config.get("hierarchy", {}).get(name) for name in ("h", "m", "l")}
        alike = all(config.get(key) == mine.get(key) for key in ALIKE)
        return alike and (len(strides) > 1 or not several)

    for several in (True, False):
        directory = runs.newest_run(
            "train-hierarchy", lambda run, s=several: fits(run, s), preset=settings.preset
        )
        if directory:
            screen.say(f"model of the newest run, {directory}")
            return directory / MODEL_FILE
    if passed := runs.newest_run("train-hierarchy", lambda run: fits(run, False)):
        screen.say(f"{passed} is of preset smoke, too small to learn: not used unless it is named")
    hierarchy = settings.hierarchy
    path = zoo.find_model(settings.plant, (hierarchy.h, hierarchy.m, hierarchy.l))
    if path:
        other = "no other run" if passed else "no run"
        screen.say(f"{other} of train-hierarchy here: model {path.parent.name} of the zoo")
        return path
    screen.say(f"no model of plant {settings.plant}: true-state methods only")
    return None


def _find(
    missing: Sequence[str], settings: Settings, screen: Screen, seed: int | None
) -> list[Path]:
    """Return a model for each method that has one: of the newest run, else of the zoo.

    With a ``seed`` only models that were trained with it.
    """
    finished = runs.finished_runs(*TRAINING, preset=settings.preset)
    trained = (directory / MODEL_FILE for directory in finished)
    published = map(zoo.resolve_model, zoo.list_models())
    found = []
    for path in itertools.chain(filter(Path.is_file, trained), published):
        if not missing:
            break
        held: tuple[str, ...] = ()
        with contextlib.suppress(HjepaError, KeyError, TypeError):  # damaged ones hold nothing
            metadata = load_checkpoint(path).metadata
            if settings.plant == RECORDED:
                check_same_plant(metadata, settings, str(path))
            if metadata["plant"] == settings.plant and seed in (None, metadata.get("seed")):
                held = offered_methods(metadata["architecture"], plant_of(settings))
        if taken := [name for name in missing if name in held]:
            found.append(path)
            screen.say(f"{', '.join(taken)}: model {path}")
            missing = [name for name in missing if name not in held]
    return found
