"""``hjepa train-encoder``: learn Ψ and its companion P^H from rendered frames.

Dataset → encoder checkpoint. The story: render the trajectories once, train the JEPA on whole
sub-sampled trajectories, look at the representation's health every epoch, and let the stage gates
decide whether the result is worth handing on.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core import health
from hjepa_cli.core.batches import FrameWindows
from hjepa_cli.core.encoder import Encoder
from hjepa_cli.core.jepa import Jepa
from hjepa_cli.core.model import build_modules, tensors_of
from hjepa_cli.core.plant import plant
from hjepa_cli.core.predictors import Predictor
from hjepa_cli.core.ranks import ALONE, Ranks, joined
from hjepa_cli.core.seeding import generator
from hjepa_cli.core.shared_norm import share_statistics
from hjepa_cli.core.training import Optimiser, autocast, fit_actor, resolve_device
from hjepa_cli.errors import NumericalError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings, dotted
from hjepa_cli.stages.inputs import (
    RenderedSplit,
    check_stride,
    embed,
    open_dataset,
    render,
    training_run,
    versions,
)
from hjepa_cli.stages.progress import Progress
from hjepa_cli.storage.checkpoints import MODEL_FILE, save_checkpoint
from hjepa_cli.storage.runs import Run, describe_input

STREAM = 2  # this stage's branch of the seed tree
REJECTED_FILE = "rejected.safetensors"  # what did not pass the gates: nothing trained is lost
PROBE_EPOCHS = 20  # of the quick probe actor that watches training …
WATCHED = 80  # … on so many training trajectories: a look must not cost more than it tells


def run(
    settings: Settings, screen: Screen, *, dataset: Path | None = None, out: Path | None = None
) -> dict[str, Any]:
    """Train, gate and save an encoder; returns the document of ``--json``.

    Under ``torchrun`` several processes share the steps; the first does all the rest.

    Raises:
        UsageError: no such device, or too many processes.
        MissingInputError: no dataset.
        NumericalError: training diverged, or a gate failed (see ``settings.encoder.gate``).
    """
    device = resolve_device(settings.device)  # refused before anything is read
    with joined(device, settings.encoder.batch_trajectories) as ranks:
        return _run(settings, screen, dataset, out, ranks)


def _run(
    settings: Settings, screen: Screen, dataset: Path | None, out: Path | None, ranks: Ranks
) -> dict[str, Any]:
    with ranks.together():
        data = open_dataset(dataset, settings)
        recorded = {split: data.split(split) for split in ("train", "test")}
        check_stride(settings.encoder.h, recorded["train"].steps)
    inputs = {"dataset": describe_input(data.path, data.digest)}
    with training_run("train-encoder", out, settings, inputs, screen, ranks) as (record, progress):
        if record.result is not None:
            show_gates(screen, record.result["gates"])
            return record.result
        torch.manual_seed(settings.seed)
        screen.say(f"dataset {data.path} ({settings.plant}), run {record.directory}")
        train, test = (render(split, settings.plant, screen) for split in recorded.values())
        architecture = describe_architecture(settings)
        kind = plant(settings.plant)
        modules = build_modules(architecture, kind.action_shape, kind.force_signs)
        encoder, companion = modules["encoder"], modules["high"]
        assert isinstance(encoder, Encoder) and isinstance(companion, Predictor)
        train_jepa(encoder, companion, train, test, settings, record, progress, screen, ranks)
        if not ranks.leads:
            return {}

        screen.say("measuring health on all frames and fitting the probe actor")
        report = examine(encoder, companion, train, test, settings, every=1, epochs=None)
        gates = judge(report, settings)
        accepted = all(gate["passed"] for gate in gates.values()) or not settings.encoder.gate
        path = record.path(MODEL_FILE if accepted else REJECTED_FILE)
        metadata = {
            "stage": "train-encoder",
            "plant": settings.plant,
            "architecture": architecture,
            "settings": settings.as_dict(),
            "dataset": data.digest,
            "camera": data.camera,
            "seed": settings.seed,
            "versions": versions(),
            "health": report,
        }
        save_checkpoint(path, tensors_of(modules), metadata)
        show_gates(screen, gates)
        if not accepted:
            refuse(gates, path)
        result = {
            "checkpoint": str(path),
            "seconds": round(progress.seconds, 2),
            "health": report,
            "gates": gates,
        }
        result = record.finish(result)
        progress.remove()
        screen.say(f"encoder {path} in {result['seconds']:.0f} s; next: hjepa train-hierarchy")
        return result


def describe_architecture(settings: Settings) -> dict[str, Any]:
    """What :func:`build_modules` needs, as it goes into the checkpoint."""
    encoder = settings.encoder
    return {
        "kind": "encoder",
        "embedding": encoder.embedding,
        "hidden": encoder.hidden,
        "frame_input": encoder.frame_input,
        "centre": encoder.centre,
        "stride_actions": encoder.stride_actions,
        "residual": encoder.residual,
        "mirror": encoder.mirror,
        "h": encoder.h,
        "m": encoder.h,  # one level: the companion
        "l": encoder.h,
    }


def train_jepa(
    encoder: Encoder,
    companion: Predictor,
    train: RenderedSplit,
    test: RenderedSplit,
    settings: Settings,
    record: Run,
    progress: Progress,
    screen: Screen,
    ranks: Ranks = ALONE,
) -> None:
    """The training loop; modules are trained in place and left in evaluation mode."""
    options, kind = settings.encoder, plant(settings.plant)
    device = resolve_device(settings.device)
    encoder.fit_standardisation(standardisation_sample(train.frames))
    if ranks.size > 1:
        share_statistics(encoder)
    jepa = Jepa(
        encoder,
        companion,
        ema_decay=options.ema_decay,
        inverse_dynamics=options.inverse_dynamics,
        rollout_strides=max(options.rollout_steps // options.h, 1),
        device=device,
        forces=math.prod(kind.action_shape),
        mirror=kind.force_signs if options.mirror == "exact" else None,
    )
    optimiser = Optimiser(
        jepa.parameters(),
        name=options.optimizer,
        schedule=options.schedule,
        steps=options.steps,
        learning_rate=options.learning_rate,
        weight_decay=options.weight_decay,
        gradient_clip=options.gradient_clip,
        ranks=ranks,
    )
    windows = FrameWindows(
        train.frames,
        train.actions,
        window_frames=options.batch_frames,
        stride=options.h,
        mirror=options.mirror == "augment",
        shift_px=options.shift_px,
        mirrored_actions=kind.mirror,
    )
    stream = generator(settings.seed, STREAM)
    share = ranks.share(options.batch_trajectories)
    part = (share.stop - share.start) / options.batch_trajectories  # 1 on a single process
    frames_per_epoch = train.actions.numel()
    epoch_steps = max(frames_per_epoch // (options.batch_trajectories * windows.window_frames), 1)
    parts = jepa.parts() | {"optimiser": optimiser}
    done = progress.reached("jepa")
    with screen.progress("train-encoder", options.steps, "steps", done=done) as bar:
        for step in progress.steps("jepa", options.steps, parts, stream):
            encoder.train()
            batch = windows.draw(options.batch_trajectories, stream, share)
            with autocast(device, options.precision):
                terms = {name: part * term for name, term in jepa.losses(batch).items()}
            loss = optimiser.step(jepa.total(terms), step, lambda batch=batch: batch.drawn)
            jepa.update_target()
            bar.advance(1, loss=loss)
            if (step + 1) % epoch_steps == 0:
                ranks.add_up(list(terms.values()))
                if not ranks.leads:
                    continue
                report = examine(
                    encoder,
                    companion,
                    train.slice(0, WATCHED),
                    test,
                    settings,
                    every=math.gcd(4, options.h),
                )
                losses = {f"loss_{name}": term.item() for name, term in terms.items()}
                record.metric({"step": step + 1, **losses, **dotted(report, "_")})
    encoder.eval()


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
    """Health of frozen embeddings, from every ``every``-th frame of both splits.

    ``every`` divides h, so that the embeddings a stride apart are among them.
    ``epochs`` limits the probe actor's fit; ``None`` fits it in full, on mirrored frames too when
    training flips them.
    """
    options, device = settings.encoder, resolve_device(settings.device)
    kind = plant(settings.plant)
    encoder.eval()

    train_z, test_z = (embed(encoder, split, settings, every=every) for split in (train, test))
    per_trajectory, train_z, test_z = test_z, train_z.flatten(0, 1), test_z.flatten(0, 1)
    train_states, test_states = train.states_at(every), test.states_at(every)
    fit_z, fit_labels = train_z, train.labels_at(every)
    if epochs is None and options.mirror == "augment":
        mirrored = embed(encoder, train, settings, every=every, mirrored=True)
        fit_z = torch.cat([fit_z, mirrored.flatten(0, 1)])
        fit_labels = torch.cat([fit_labels, torch.tensor(kind.mirror) * fit_labels])
    actor = fit_actor(
        fit_z,
        fit_labels,
        settings.actor,
        seed=settings.seed,
        epochs=epochs,
        mirror=kind.force_signs if options.mirror == "exact" else None,
    )
    ahead = options.h // every
    start, end = per_trajectory[:, :-ahead].flatten(0, 1), per_trajectory[:, ahead:].flatten(0, 1)
    with torch.no_grad():
        sensitivity = health.action_sensitivity(
            companion.cpu().eval(), start, end, options.h, kind.action_shape
        )
        error = health.nrmse(actor.act(test_z), test.labels_at(every))
    companion.to(device).train()
    return {
        "probe_r2": health.probe_r2(train_z, train_states, test_z, test_states, kind.state_names),
        "effective_rank": health.effective_rank(test_z),
        "std": float(test_z.std(0).mean()),
        "action_sensitivity": sensitivity,
        "actor_nrmse": error,
    }


def judge(report: dict[str, Any], settings: Settings) -> dict[str, dict[str, Any]]:
    """Compare the health report with the stage gates."""
    options, states = settings.encoder, plant(settings.plant).state_names
    lower_bounds = {
        f"probe_r2_{name}": bound for name, bound in zip(states, options.least_r2, strict=True)
    }
    lower_bounds |= {
        "effective_rank": options.gate_rank,
        "action_sensitivity": options.gate_sensitivity,
    }
    values = dotted(report, "_")
    gates = {
        name: {"value": values[name], "threshold": bound, "passed": values[name] >= bound}
        for name, bound in lower_bounds.items()
    }
    error, limit = values["actor_nrmse"], options.gate_actor_nrmse
    gates["actor_nrmse"] = {"value": error, "threshold": limit, "passed": error <= limit}
    return gates


def show_gates(screen: Screen, gates: dict[str, dict[str, Any]]) -> None:
    """One row per gate."""
    rows = [
        [
            name,
            f"{gate['value']:.3f}",
            f"{'≤' if name == 'actor_nrmse' else '≥'} {gate['threshold']:g}",
            "passed" if gate["passed"] else "FAILED",
        ]
        for name, gate in gates.items()
    ]
    screen.table("health, held out", ["measure", "value", "gate", ""], rows)


def refuse(gates: dict[str, dict[str, Any]], path: Path) -> None:
    """Stop the pipeline at a representation that cannot carry control."""
    failed = [
        f"{name} {gate['value']:.3f} (gate {gate['threshold']:g})"
        for name, gate in gates.items()
        if not gate["passed"]
    ]
    raise NumericalError(
        f"the encoder failed its gate: {', '.join(failed)}",
        hint="collect more trajectories or train for more steps; --no-gate skips the gate, and "
        f"hjepa train-hierarchy --encoder {path} goes on with this one",
    )


def standardisation_sample(frames: Tensor, pairs: int = 512) -> Tensor:
    """Evenly spaced (previous, current) pairs [≤ ``pairs``, 2, H, W, 3] of the training split."""
    flat = frames.flatten(0, 1)
    current = np.linspace(1, len(flat) - 1, min(pairs, len(flat) - 1)).astype(int)
    current = current[current % frames.shape[1] != 0]  # the first frame has no predecessor
    return torch.stack([flat[current - 1], flat[current]], dim=1)
