"""``hjepa train-fusion`` trains what a hierarchy makes of packets that are not quite right.

Trained hierarchy + conditions → the same with one more network, its posterior: from the embedding
that was predicted for a moment and the packet of that moment it tells where the device is.
"""

import copy
import functools
import math
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.planners import corrected
from hjepa_cli.core.networks.model import Model, load_modules
from hjepa_cli.core.plants.conditions import altered
from hjepa_cli.core.training.fusion_loops import Heard, ends_of_gaps, listen
from hjepa_cli.core.training.losses import cosine_loss
from hjepa_cli.core.training.optimiser import Optimiser, name_samples
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.output.tables import show_fusion
from hjepa_cli.stages.embedding_training import begin, fit_network, round_weights, save
from hjepa_cli.stages.inputs import brought_along, refuse_recorded
from hjepa_cli.stages.plan import Plan, found
from hjepa_cli.stages.train_reflex import open_model
from hjepa_cli.stages.training import (
    Drawn,
    TrainingRun,
    open_training_data,
    plan_training,
    planned_data,
    run_training,
)
from hjepa_cli.storage.checkpoints import Checkpoint

STREAM = 6  # this stage's branch of the seed tree


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train a posterior beside a frozen hierarchy; return the document of ``--json``.

    Raises:
        UsageError: no such device, or the model has one predictor only.
        MissingInputError: no dataset or no model.
        DataError: model and dataset belong to different plants.
        NumericalError: training diverged.
    """
    refuse_recorded(settings, "a posterior is trained in closed loops")
    data = open_training_data(dataset, settings)
    settings = brought_along(settings, data[0].settings, data[0].path)
    source = open_hierarchy(checkpoint, settings, screen, data[0].path)
    train, name = functools.partial(train_on, source), "train-fusion"
    return run_training(
        name, out, data, settings, screen, train=train, show=show_fusion, checkpoint=source
    )


def plan(
    settings: Settings,
    *,
    dataset: Path | None = None,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
) -> Plan:
    """Plan the rounds of loops and of training."""
    options = settings.fusion
    refuse_recorded(settings, "a posterior is trained in closed loops")
    data, dataset_line, settings = planned_data(dataset, settings)
    quiet, path = Screen(quiet=True), data.path if data else None
    find = functools.partial(open_hierarchy, checkpoint, settings, quiet, path)
    model, model_line = found("model", find, checkpoint, "hjepa train-hierarchy")
    loops = 2 * options.rounds * options.devices * options.loop_steps
    shortest, longest = ends_of_gaps(settings.protocol.gaps)
    architecture = dict(model.metadata["architecture"]) if model else {}
    return plan_training(
        "train-fusion",
        settings,
        out,
        architecture | {"fusion": True},
        reads=[dataset_line, model_line],
        work=[
            f"{options.rounds} rounds: drive {2 * options.devices} devices for "
            f"{options.loop_steps} steps, then train on their packets for {options.steps} steps"
        ],
        amounts={
            "device-steps on embeddings": loops,
            # Each packet is seen twice, as it comes and in a clean picture.
            "closed-loop frames": 2 * loops / math.sqrt(shortest * longest),
            "level training steps": options.rounds * options.steps / 10,
        },
    )


def open_hierarchy(
    name: str | Path | None, settings: Settings, screen: Screen, dataset: Path | None
) -> Checkpoint:
    """Open the hierarchy to build on, as :func:`~hjepa_cli.stages.train_reflex.open_model`."""
    source = open_model(name, settings, screen, dataset)
    kind = source.metadata["architecture"]["kind"]
    if kind != "hierarchy":
        raise UsageError(
            f"{source.path} is of kind '{kind}'; fusion needs the predictors of a hierarchy",
            hint="hjepa train-hierarchy, or pass its --checkpoint",
        )
    return source


def train_on(source: Checkpoint, run: TrainingRun) -> dict[str, Any]:
    """Train beside a checkpoint's networks and save; return the result."""
    settings, screen, options = run.settings, run.screen, run.settings.fusion
    trained = load_modules(source)
    screen.say(f"dataset {run.dataset.path}, model {source.path}, run {run.record.directory}")
    architecture = source.metadata["architecture"] | {"fusion": True}
    others = [name for name in trained if name != "posterior"]
    modules = begin(architecture, trained, settings, taken=others)
    for name in others:
        modules[name].requires_grad_(False).eval()
    about = {
        "encoder": source.metadata.get("encoder", source.digest),
        "health": source.metadata["health"],
        "fusion": {"conditions": altered(settings.as_dict()), "payload": settings.protocol.payload},
    }
    metadata = run.metadata(architecture, **about)
    model = Model(modules, metadata, "", settings.device)

    modules["before"] = copy.deepcopy(modules["posterior"])
    for number in range(options.rounds):
        train_round(run, modules, model, number)
    del modules["before"]
    round_weights(modules)
    heard = listen(model, modules["posterior"], settings, options.rounds)
    save(run, modules, metadata)
    found = examine(modules["posterior"], heard)
    result = run.finish(fusion=about["fusion"], packets=len(heard.true), distances=found)
    show_fusion(result, screen)
    screen.say(
        f"model {result['checkpoint']} in {result['seconds']:.0f} s; "
        "next: hjepa eval --methods hjepa,hjepa-fused"
    )
    return result


def train_round(run: TrainingRun, modules: nn.ModuleDict, model: Model, number: int) -> None:
    """Train on loops that the posterior drives as it is before this round.

    That one is kept beside it, since a round that is taken up needs the same loops again.
    """
    settings, options = run.settings, run.settings.fusion
    modules["before"].load_state_dict(modules["posterior"].state_dict())
    stream = generator(settings.seed, STREAM, number)
    optimiser = Optimiser(
        modules["posterior"].parameters(),
        name="adamw",
        schedule="one-cycle",
        steps=options.steps,
        learning_rate=options.learning_rate,
        weight_decay=options.weight_decay,
        gradient_clip=options.gradient_clip,
    )

    @functools.cache
    def heard() -> Heard:  # after the state of an interrupted round is put back
        return listen(model, modules["before"], settings, number)

    def draw() -> Drawn:
        rows = torch.from_numpy(stream.integers(len(heard().true), size=options.batch))
        corrections = corrected(
            modules["posterior"], heard().predicted[rows], heard().packets[rows]
        )
        loss = cosine_loss(corrections, heard().true[rows])
        return loss, functools.partial(name_samples, "packets", rows)

    fit_network(
        run, modules, "posterior", optimiser, stream, draw, phase=f"fusion round {number + 1}"
    )


@torch.inference_mode()
def examine(posterior: nn.Module, heard: Heard) -> dict[str, float]:
    """Return mean distances 1 − cos from the truth: of predictions, packets and corrections."""
    embeddings = {
        "predicted": heard.predicted,
        "packets": heard.packets,
        "corrected": corrected(posterior, heard.predicted, heard.packets),
    }
    return {name: float(cosine_loss(z, heard.true)) for name, z in embeddings.items()}
