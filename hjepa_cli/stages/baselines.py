"""``hjepa train-encoder --method supervised|autoencoder``: the baselines on raw frames.

They see the windows that the JEPA sees, in the same steps of the same optimiser: the supervised
network in one loop, the auto-encoder in two, first to reconstruct, then to act on what it
reconstructed.
"""

import functools
from typing import Any

import torch
from torch import nn

from hjepa_cli.compute.device import autocast, resolve_device
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.decoder import Decoder
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.read_frames import read_frames
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training.frame_policies import Imitation, Reconstruction
from hjepa_cli.stages.frame_training import Training, standardisation_sample
from hjepa_cli.stages.inputs import RenderedSplit, embed

LOOK_EVERY = 4  # steps between the held-out frames that watch training
LOOK_FRAMES = 500  # of them, for the reconstruction error


def describe_architecture(settings: Settings) -> dict[str, Any]:
    """What :func:`~hjepa_cli.core.networks.model.build_modules` needs, as it goes into the checkpoint."""
    encoder, actor = settings.encoder, settings.actor
    return {
        "kind": encoder.method,
        "frames": encoder.frames,
        "embedding": encoder.embedding,
        "frame_input": encoder.frame_input,
        "centre": encoder.centre,
        "mirror": encoder.mirror,
        "actor_hidden": actor.hidden,
        "actor_dropout": actor.dropout,
    }


def train(networks: nn.ModuleDict, training: Training) -> dict[str, Any]:
    """Train a baseline in place; returns its held-out health."""
    device = resolve_device(training.settings.device)
    frames = training.settings.encoder.frames
    _standardise(networks, standardisation_sample(training.train.frames, frames_each=frames))
    trained: tuple[str, ...] = ("encoder", "actor")
    if "decoder" in networks:
        reconstruction = Reconstruction(networks, device)
        training.fit("autoencoder", reconstruction, functools.partial(_look, networks, training))
        trained = ("reader", "actor")
    imitation = Imitation(networks, trained, device)
    training.fit("actor", imitation, functools.partial(_look, networks, training))
    networks.eval()
    training.screen.say("measuring health on all frames")
    return examine(networks, training.train, training.test, training.settings)


def examine(
    networks: nn.ModuleDict, train: RenderedSplit, test: RenderedSplit, settings: Settings
) -> dict[str, Any]:
    """Health of what the actor listens to, and of the actor; there is no predictor to examine."""
    train_z, test_z = (_read(networks, split, settings, every=1) for split in (train, test))
    names = plant(settings.plant).state_names
    probe = (train_z, train.states_at(1), test_z, test.states_at(1), names)
    report = {
        "probe_r2": health.probe_r2(*probe),
        "effective_rank": health.effective_rank(test_z),
        "std": float(test_z.std(0).mean()),
        "action_sensitivity": None,
        "actor_nrmse": _actor_error(networks, test_z, test, every=1),
    }
    if "decoder" in networks:
        report["reconstruction_mse"] = _reconstruction_error(networks, test, settings)
    return report


def _look(networks: nn.ModuleDict, training: Training, terms: dict[str, float]) -> dict[str, Any]:
    """A row of ``metrics.csv``: the loss, and the held-out error of what the phase trains."""
    networks.eval()
    test, settings = training.test, training.settings
    [(phase, loss)] = terms.items()
    error = nrmse = None
    if phase == "reconstruction":
        error = _reconstruction_error(networks, test, settings)
    else:
        z = _read(networks, test, settings, every=LOOK_EVERY)
        nrmse = _actor_error(networks, z, test, every=LOOK_EVERY)
    return {"term": phase, "loss": loss, "reconstruction_mse": error, "actor_nrmse": nrmse}


def _standardise(networks: nn.ModuleDict, sample: torch.Tensor) -> None:
    """Measure what all networks take for mean and scale of a picture."""
    encoder = networks["encoder"]
    assert isinstance(encoder, Encoder)
    encoder.fit_standardisation(sample)
    for network in networks.values():
        if isinstance(network, Encoder | Decoder):
            network.input_mean.copy_(encoder.input_mean)
            network.input_std.copy_(encoder.input_std)


def _read(
    networks: nn.ModuleDict, split: RenderedSplit, settings: Settings, *, every: int
) -> torch.Tensor:
    """What the actor listens to in every ``every``-th step: embeddings [N · K, D]."""
    read, frames = functools.partial(read_frames, networks), settings.encoder.frames
    return embed(read, split, settings, every=every, frames=frames).flatten(0, 1)


@torch.inference_mode()
def _actor_error(
    networks: nn.ModuleDict, z: torch.Tensor, split: RenderedSplit, *, every: int
) -> float:
    """NRMSE of the actor on embeddings [N · K, D]."""
    actor = networks["actor"]
    assert isinstance(actor, Actor)
    forces = actor.act(z.to(next(actor.parameters()).device)).cpu()
    return health.nrmse(forces, split.labels_at(every))


@torch.inference_mode()
def _reconstruction_error(
    networks: nn.ModuleDict, split: RenderedSplit, settings: Settings
) -> float:
    """Of evenly spaced frames: mean squared error ÷ variance of a channel."""
    seen = split.seen(LOOK_EVERY, frames=settings.encoder.frames)
    device = resolve_device(settings.device)
    objective = Reconstruction(networks, device)
    chosen = seen[:: max(len(seen) // LOOK_FRAMES, 1)]
    errors = []
    for part in chosen.split(64):
        with autocast(device, settings.encoder.precision):
            errors.append(objective.error(part) * len(part))
    return float(torch.stack(errors).sum() / len(chosen))
