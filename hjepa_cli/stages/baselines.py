"""``hjepa train-encoder --method supervised|autoencoder`` trains the baselines on raw frames.

They see windows of both laws, worse ones among them, in as many steps of the same optimiser: the
supervised network in one loop, the auto-encoder in two, first to reconstruct, then to act on what
it reconstructed.
"""

import functools
from typing import Any

import torch
from torch import nn

from hjepa_cli.compute.device import autocast, resolve_device
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.decoder import Decoder, read_frames
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training.frame_policies import Imitation, Reconstruction
from hjepa_cli.core.training.rendered import RenderedSplit, standardisation_sample
from hjepa_cli.stages.frame_training import fit, recorded
from hjepa_cli.stages.inputs import embed, pictures
from hjepa_cli.stages.training import TrainingRun

LOOK_EVERY = 4  # steps between the held-out frames that watch training
LOOK_FRAMES = 500  # of them, for the reconstruction error


def describe_architecture(settings: Settings) -> dict[str, Any]:
    """Return the architecture of a baseline, as it goes into the checkpoint."""
    encoder, actor = settings.encoder, settings.actor
    return {
        "kind": encoder.method,
        **recorded(encoder, "frames", "embedding", "frame_input", "centre", "mirror"),
        "actor_hidden": actor.hidden,
        "actor_dropout": actor.dropout,
        **pictures(settings),
    }


def train(
    networks: nn.ModuleDict, run: TrainingRun, train: RenderedSplit, test: RenderedSplit
) -> dict[str, Any]:
    """Train a baseline in place; return its held-out health."""
    device, options = resolve_device(run.settings.device), run.settings.encoder
    _standardise(networks, standardisation_sample(train.frames, options.look))
    watch = functools.partial(_look, networks, test, run.settings)
    trained: tuple[str, ...] = ("encoder", "actor")
    if "decoder" in networks:
        fit(run, train, "autoencoder", Reconstruction(networks, device), watch)
        trained = ("reader", "actor")
    fit(run, train, "actor", Imitation(networks, trained, device), watch)
    networks.eval()
    run.screen.say("measuring health on all frames")
    return examine(networks, train, test, run.settings)


def examine(
    networks: nn.ModuleDict, train: RenderedSplit, test: RenderedSplit, settings: Settings
) -> dict[str, Any]:
    """Return the health of what the actor listens to, and of the actor; there is no predictor."""
    train_z, test_z = (_read(networks, split, settings, every=1) for split in (train, test))
    names, states = plant_of(settings).state_names, (train.states_at(1), test.states_at(1))
    report = {
        **health.of_embeddings(train_z, states[0], test_z, states[1], names),
        "action_sensitivity": None,
        "actor_nrmse": _actor_error(networks, test_z, test, every=1),
    }
    if "decoder" in networks:
        report["reconstruction_mse"] = _reconstruction_error(networks, test, settings)
    return report


def _look(
    networks: nn.ModuleDict, test: RenderedSplit, settings: Settings, terms: dict[str, float]
) -> dict[str, Any]:
    """Return a row of ``metrics.csv``: the loss, and the held-out error of what is trained."""
    networks.eval()
    [(phase, loss)] = terms.items()
    row: dict[str, Any] = {"term": phase, "loss": loss, "reconstruction_mse": None}
    if phase == "reconstruction":
        row["reconstruction_mse"] = _reconstruction_error(networks, test, settings)
        return row | {"actor_nrmse": None}
    z = _read(networks, test, settings, every=LOOK_EVERY)
    return row | {"actor_nrmse": _actor_error(networks, z, test, every=LOOK_EVERY)}


def _standardise(networks: nn.ModuleDict, sample: torch.Tensor) -> None:
    """Measure what all networks take for mean and scale of a picture."""
    encoder = networks["encoder"]
    encoder.fit_standardisation(sample)  # type: ignore[operator]
    for network in networks.values():
        if isinstance(network, Encoder | Decoder):
            network.input_mean.copy_(encoder.input_mean)
            network.input_std.copy_(encoder.input_std)


def _read(
    networks: nn.ModuleDict, split: RenderedSplit, settings: Settings, *, every: int
) -> torch.Tensor:
    """Return what the actor listens to in every ``every``-th step: embeddings [N · K, D]."""
    read, options = functools.partial(read_frames, networks), settings.encoder
    return embed(read, split, settings, every=every, look=options.look).flatten(0, 1)


@torch.inference_mode()
def _actor_error(
    networks: nn.ModuleDict, z: torch.Tensor, split: RenderedSplit, *, every: int
) -> float | None:
    """Return the NRMSE of the actor on embeddings [N · K, D]."""
    actor = networks["actor"]
    forces = actor.act(z.to(next(actor.parameters()).device)).cpu()  # type: ignore[operator]
    return health.nrmse(forces, split.labels_at(every))


@torch.inference_mode()
def _reconstruction_error(
    networks: nn.ModuleDict, split: RenderedSplit, settings: Settings
) -> float:
    """Return mean squared error ÷ variance of a channel, of evenly spaced frames."""
    options = settings.encoder
    seen = split.seen(LOOK_EVERY, options.look)
    device = resolve_device(settings.device)
    objective = Reconstruction(networks, device)
    chosen = seen[:: max(len(seen) // LOOK_FRAMES, 1)]
    errors = []
    for part in chosen.split(64):
        with autocast(device, settings.encoder.precision):
            errors.append(objective.error(part) * len(part))
    return float(torch.stack(errors).sum() / len(chosen))
