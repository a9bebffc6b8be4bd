"""``hjepa train-encoder`` learns Ψ and its companion P^H from rendered frames, or a baseline.

Dataset → checkpoint. The story: render the trajectories once, train on whole sub-sampled
trajectories, look at the representation's health every epoch, and let the stage gates decide
whether the result is worth handing on. The baselines are in :mod:`hjepa_cli.stages.baselines`.
"""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.config.schema import RECORDED, Settings, dotted
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.datasets.trajectories import driven_by_teacher
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import tensors_of
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.optimiser import fit_actor
from hjepa_cli.core.training.ranks import joined
from hjepa_cli.core.training.rendered import RenderedSplit, standardisation_sample
from hjepa_cli.core.training.shared_norm import share_statistics
from hjepa_cli.errors import NumericalError, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.output.tables import measured, show_gates
from hjepa_cli.stages import baselines
from hjepa_cli.stages.frame_training import (
    fit,
    frames_of_step,
    recorded,
    steps_of_epoch,
    steps_shown,
)
from hjepa_cli.stages.inputs import (
    count_frames,
    embed,
    pictures,
    sizes_of,
)
from hjepa_cli.stages.plan import Plan
from hjepa_cli.stages.training import (
    SPLITS,
    TrainingRun,
    open_training_data,
    plan_training,
    planned_data,
    run_training,
    untrained,
)
from hjepa_cli.storage.checkpoints import MODEL_FILE, save_checkpoint

REJECTED_FILE = "rejected.safetensors"  # what did not pass the gates: nothing trained is lost
PROBE_EPOCHS = 20  # of the quick probe actor that watches training …
LEAST_ACTION_R2 = 0.1  # of a recorded plant: below, frames hardly show what actions do
WATCHED = 80  # … on so many training trajectories: a look must not cost more than it tells
ARCHITECTURE = (  # the settings of an encoder that its architecture records
    *("embedding", "hidden", "frame_input", "centre", "stride_actions", "residual"),
    "mirror",
)
LOOPS = {  # of each method: how many there are, and what they train
    "jepa": (1, "the encoder"),
    "supervised": (1, "frames to force"),
    "autoencoder": (2, "reconstruction, then reconstructed frames to force,"),
}


def run(
    settings: Settings, screen: Screen, *, dataset: Path | None = None, out: Path | None = None
) -> dict[str, Any]:
    """Train, gate and save an encoder or a baseline; return the document of ``--json``.

    Under ``torchrun`` several processes share the steps; the first does all the rest.

    Raises:
        UsageError: no such device, too many processes, or several of them for a baseline.
        MissingInputError: no dataset.
        NumericalError: training diverged, or a gate failed (see ``settings.encoder.gate``).
    """
    options, device = settings.encoder, resolve_device(settings.device)
    with joined(device, options.batch_trajectories) as ranks:
        if ranks.size > 1 and options.method != "jepa":
            raise UsageError(f"torchrun trains the jepa alone, not {options.method}")
        with ranks.together():
            data = open_training_data(dataset, settings, h=options.h)
        return run_training(
            *("train-encoder", out, data, settings, screen),
            train=train_and_gate,
            show=lambda result, screen: show_gates(screen, result["gates"], enforced=options.gate),
            ranks=ranks,
        )


def plan(settings: Settings, *, dataset: Path | None = None, out: Path | None = None) -> Plan:
    """Plan the loops of the settings' method on the dataset's frames."""
    data, dataset_line, settings = planned_data(dataset, settings)
    options, frames = settings.encoder, count_frames(data, settings, *SPLITS)
    trajectories, recorded_steps = sizes_of(data, settings)["train"]
    if options.method == "jepa":
        trajectories = len(range(trajectories)[driven_by_teacher(settings)])
    loops, what = LOOPS[options.method]
    batch, steps = frames_of_step(settings, recorded_steps), loops * options.steps
    shown = steps_shown(settings, recorded_steps)
    epochs = steps * batch / (trajectories * shown)
    looks = loops * (options.steps // steps_of_epoch(settings, trajectories, recorded_steps))
    look, examination = frames_looked_at(data, settings)
    return plan_training(
        "train-encoder",
        settings,
        out,
        describe_architecture(settings),
        reads=[dataset_line],
        work=[
            f"render about {frames} frames",
            f"train {what} for {steps} steps of {batch} frames "
            f"({epochs:.0f} passes over {shown} steps of {trajectories} trajectories), "
            f"h = {options.h}",
            f"examine its health {'and stop at a missed gate' if options.gate else '(no gate)'}",
        ],
        amounts={
            "rendered frames": frames,
            "encoder training frames": steps * batch,
            "encoded frames": looks * look + examination,
        },
    )


def frames_looked_at(data: Dataset | None, settings: Settings) -> tuple[float, int]:
    """Return the frames that an epoch's look at training encodes, and the examination after it."""
    options, frames = settings.encoder, count_frames(data, settings, *SPLITS)
    trajectories, steps = sizes_of(data, settings)["train"]
    held_out = count_frames(data, settings, "test")
    if options.method != "jepa":
        return held_out / baselines.LOOK_EVERY, frames
    look = (min(trajectories, WATCHED) * steps + held_out) / math.gcd(4, options.h)
    mirrored = options.mirror == "augment"  # the probe actor is fitted to mirror images too
    return look, frames + mirrored * (frames - held_out)


def train_and_gate(run: TrainingRun) -> dict[str, Any]:
    """Train, examine, gate and save; return the result, of the process that leads.

    Raises NumericalError, so that the pipeline stops, at what cannot carry control.
    """
    settings, screen, options = run.settings, run.screen, run.settings.encoder
    torch.manual_seed(settings.seed)
    screen.say(f"dataset {run.dataset.path} ({settings.plant}), run {run.record.directory}")
    splits = run.render()
    architecture = describe_architecture(settings)
    modules = untrained(architecture, settings)
    method = train_jepa if options.method == "jepa" else baselines.train
    report = method(modules, run, *splits)
    if not run.ranks.leads:
        return {}
    gates = judge(report, settings)
    accepted = all(gate["passed"] for gate in gates.values()) or not options.gate
    path = run.record.path(MODEL_FILE if accepted else REJECTED_FILE)
    save_checkpoint(path, tensors_of(modules), run.metadata(architecture, health=report))
    show_gates(screen, gates, enforced=options.gate)
    is_jepa = options.method == "jepa"
    following, flag = ("train-hierarchy", "--encoder") if is_jepa else ("eval", "--checkpoint")
    if not accepted:
        failed = [
            f"{name} {measured(gate['value'])} (gate {gate['threshold']:g})"
            for name, gate in gates.items()
            if not gate["passed"]
        ]
        raise NumericalError(
            f"the encoder failed its gate: {', '.join(failed)}",
            hint="collect more trajectories or train for more steps; --no-gate skips the gate, and "
            f"{shell(['hjepa', following, flag, path])} goes on with this one",
        )
    result = run.finish(health=report, gates=gates)
    screen.say(f"{path} in {result['seconds']:.0f} s; next: hjepa {following}")
    return result


def describe_architecture(settings: Settings) -> dict[str, Any]:
    """Return the architecture of what is trained, as it goes into the checkpoint."""
    encoder = settings.encoder
    if encoder.method != "jepa":
        return baselines.describe_architecture(settings)
    of_encoder = recorded(encoder, *ARCHITECTURE)
    # One level: the companion.
    of_encoder |= {"h": encoder.h, "m": encoder.h, "l": encoder.h}
    return {"kind": "encoder", **of_encoder, **pictures(settings)}


def train_jepa(
    modules: nn.ModuleDict, run: TrainingRun, train: RenderedSplit, test: RenderedSplit
) -> dict[str, Any]:
    """Train Ψ and P^H in place; return their health, of the process that leads."""
    settings, ranks, options = run.settings, run.ranks, run.settings.encoder
    kind = plant_of(settings)
    encoder, companion = modules["encoder"], modules["high"]
    assert isinstance(encoder, Encoder) and isinstance(companion, Predictor)
    # Laws and wrong beliefs throw a device about; from what the teacher does, embeddings become
    # smoother in the states, and are as good in all of the others (docs/LOG.md).
    calm = train[driven_by_teacher(settings)]
    encoder.fit_standardisation(standardisation_sample(calm.frames, options.look))
    if ranks.size > 1:
        if options.regulariser != "none":
            raise UsageError(
                f"encoder.regulariser = {options.regulariser!r} looks at a whole batch, and "
                f"{ranks.size} processes share one",
                hint="train with it in one process, without torchrun",
            )
        share_statistics(encoder)
    jepa = Jepa(
        encoder,
        companion,
        ema_decay=options.ema_decay,
        inverse_dynamics=options.inverse_dynamics,
        rollout_strides=max(options.rollout_steps // options.h, 1),
        device=resolve_device(settings.device),
        forces=math.prod(kind.action_shape),
        mirror=kind.force_signs if options.mirror == "exact" else None,
        regulariser=options.regulariser,
        regulariser_weight=options.regulariser_weight,
        seed=settings.seed,
    )

    def watch(terms: dict[str, float]) -> dict[str, Any]:
        few, every = train[:WATCHED], math.gcd(4, options.h)
        report = examine(encoder, companion, few, test, settings, every=every)
        return {f"loss_{name}": value for name, value in terms.items()} | dotted(report, "_")

    fit(run, calm, "jepa", jepa, watch, augmented=False)
    encoder.eval()
    if not ranks.leads:
        return {}
    run.screen.say("measuring health on all frames and fitting the probe actor")
    return examine(encoder, companion, train, test, settings, every=1, epochs=None)


def examine(
    encoder: Encoder,
    companion: Predictor,
    train: RenderedSplit,
    test: RenderedSplit,
    settings: Settings,
    *,
    every: int,
    epochs: int | None = PROBE_EPOCHS,
) -> dict[str, Any]:
    """Return the health of frozen embeddings, from every ``every``-th frame of both splits.

    ``every`` divides h, so that the embeddings a stride apart are among them.
    ``epochs`` limits the probe actor's fit; ``None`` fits it in full, on mirrored frames too when
    training flips them.
    """
    options, kind = settings.encoder, plant_of(settings)
    mirror = kind.force_signs if options.mirror == "exact" else None
    encoder.eval()
    train_z, test_z = (embed(encoder, split, settings, every=every) for split in (train, test))
    of_actions = know_actions(train_z, test_z, train, test, settings, h=options.h, every=every)
    per_trajectory, train_z, test_z = test_z, train_z.flatten(0, 1), test_z.flatten(0, 1)
    train_states, test_states = train.states_at(every), test.states_at(every)
    fit_z, fit_labels = train_z, train.labels_at(every)
    if epochs is None and options.mirror == "augment":
        mirrored = embed(encoder, train, settings, every=every, mirrored=True)
        fit_z = torch.cat([fit_z, mirrored.flatten(0, 1)])
        fit_labels = torch.cat([fit_labels, torch.tensor(kind.mirror) * fit_labels])
    actor = fit_actor(
        fit_z, fit_labels, settings.actor, seed=settings.seed, epochs=epochs, mirror=mirror
    )
    ahead = options.h // every
    start, end = per_trajectory[:, :-ahead].flatten(0, 1), per_trajectory[:, ahead:].flatten(0, 1)
    with torch.no_grad():
        sensitivity = health.action_sensitivity(
            companion.cpu().eval(), start, end, options.h, kind.action_shape
        )
        error = health.nrmse(actor.act(test_z), test.labels_at(every))
    companion.to(resolve_device(settings.device)).train()
    return {
        **health.of_embeddings(train_z, train_states, test_z, test_states, kind.state_names),
        "action_sensitivity": sensitivity,
        "actor_nrmse": error,
        **of_actions,
    }


def know_actions(
    train_z: Tensor,
    test_z: Tensor,
    train: RenderedSplit,
    test: RenderedSplit,
    settings: Settings,
    *,
    h: int,
    every: int = 1,
) -> dict[str, float | None]:
    """Return what embeddings [N, K, D] of every ``every``-th frame know of a stride's actions.

    It is for recorded plants, whose states may be unknown; of others there is nothing to tell.
    """
    if settings.plant != RECORDED:
        return {}
    of_train, of_test = (split.actions[:, ::every] for split in (train, test))
    return {"action_r2": health.action_r2(train_z, of_train, test_z, of_test, h // every)}


def judge(report: dict[str, Any], settings: Settings) -> dict[str, dict[str, Any]]:
    """Compare the health report with the stage's gates; return value and verdict by gate."""
    options, states = settings.encoder, plant_of(settings).state_names
    bounds, of_recorded = {}, settings.plant == RECORDED
    if options.method == "jepa":  # a baseline is there to act, and nothing else
        # Of recordings nobody can say beforehand how well which state should be seen.
        least_r2 = options.gate_r2 if of_recorded else options.least_r2
        least = zip(states, least_r2, strict=False)
        bounds = {f"probe_r2_{name}": bound for name, bound in least} | {
            "effective_rank": options.gate_rank,
            "action_sensitivity": options.gate_sensitivity,
        }
        if of_recorded:
            bounds["action_r2"] = LEAST_ACTION_R2
    values = dotted(report, "_")
    bounds["actor_nrmse"] = options.gate_actor_nrmse

    def passed(name: str, bound: float) -> bool:
        value = values[name]  # None: undefined, as of a state that is the same everywhere
        return value is not None and (value <= bound if name == "actor_nrmse" else value >= bound)

    return {
        name: {"value": values[name], "threshold": bound, "passed": passed(name, bound)}
        for name, bound in bounds.items()
        if values[name] is not None or not of_recorded
    }
