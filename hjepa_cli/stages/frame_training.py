"""All methods of ``train-encoder`` share the loop that trains on camera frames."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import RECORDED, EncoderSettings, Look, Settings
from hjepa_cli.core.networks.model import UNSAID
from hjepa_cli.core.plants.control_law import control_law
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training.augmentation import Augmentation
from hjepa_cli.core.training.batches import FrameWindows, frames_that_fit
from hjepa_cli.core.training.frame_policies import Imitation, Reconstruction
from hjepa_cli.core.training.hardening import Hardening
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.rendered import RenderedSplit, labels_of
from hjepa_cli.stages.training import Drawn, TrainingRun

STREAM = 2  # this stage's branch of the seed tree
MOTION_STEPS = 100  # of a simulated trajectory, from its beginning, hold its widest motion


def recorded(encoder: EncoderSettings, *names: str) -> dict[str, Any]:
    """Return the settings that an architecture records: those named, and others unless usual."""
    values = UNSAID | vars(encoder)
    kept = {name: value for name, value in UNSAID.items() if values[name] == value}
    return {name: values[name] for name in (*names, *UNSAID) if name in names or name not in kept}


def steps_shown(settings: Settings, steps: int) -> int:
    """Return how many of a trajectory's steps windows are cut from, from its beginning on.

    Simulated motion is widest there; windows from anywhere would hardly show it.
    """
    if settings.plant == RECORDED:
        return steps
    options = settings.encoder
    return min(steps, max(MOTION_STEPS, options.batch_frames * options.h))


def frames_of_step(settings: Settings, steps: int) -> int:
    """Return the frames that a step of training takes from trajectories of so many steps."""
    options = settings.encoder
    shown = steps_shown(settings, steps)
    return options.batch_trajectories * frames_that_fit(shown, options.batch_frames, options.h)


def steps_of_epoch(settings: Settings, trajectories: int, steps: int) -> int:
    """Return how many steps of training take as many frames as windows are cut from."""
    frames = trajectories * steps_shown(settings, steps)
    return max(frames // frames_of_step(settings, steps), 1)


def fit(
    run: TrainingRun,
    train: RenderedSplit,
    phase: str,
    objective: Jepa | Hardening | Imitation | Reconstruction,
    look: Callable[[dict[str, float]], dict[str, Any]],
    *,
    augmented: bool = True,
    looks: tuple[Look, Look] | None = None,
    steps: int | None = None,
    learning_rate: float | None = None,
) -> None:
    """Train on windows of frames, for ``encoder.steps`` steps unless ``steps`` says otherwise.

    Every batch is ``batch_trajectories`` windows of ``batch_frames`` frames, h steps apart. Every
    epoch ``look`` is called with the loss terms and returns a row of ``metrics.csv``.

    Args:
        augmented: whether networks see the windows as ``[augment]`` makes them.
        looks: how many steps back the frames lie that networks see, and those of targets.
        steps, learning_rate: others than those of ``[encoder]``.

    Raises:
        NumericalError: training diverged.
        Interrupted: the state is saved.
    """
    options, ranks, kind = run.settings.encoder, run.ranks, plant_of(run.settings)
    optimiser = Optimiser(
        objective.parameters(),
        name=options.optimizer,
        schedule=options.schedule,
        steps=options.steps if steps is None else steps,
        learning_rate=options.learning_rate if learning_rate is None else learning_rate,
        weight_decay=options.weight_decay,
        gradient_clip=options.gradient_clip,
        ranks=ranks,
    )
    seen, aimed_at = looks or (options.look, options.look)
    longest = steps_shown(run.settings, train.actions.shape[1])
    if options.shift_px:  # refuse a plant whose pictures cannot be moved before any step
        kind.sideways(train.states[:1, 0].numpy().astype(float), options.shift_px)
    labels = None
    if isinstance(objective, Imitation):  # asking the teacher takes time, and nothing else needs it
        labels = labels_of(train, kind, control_law(kind, run.settings.control))
    windows = FrameWindows(
        train.frames[:, : longest + 1],
        train.actions[:, :longest],
        window_frames=options.batch_frames,
        stride=options.h,
        mirror=options.mirror == "augment",
        shift_px=options.shift_px,
        mirrored_actions=kind.mirror,
        labels=labels,
        look=seen,
        target_look=aimed_at,
    )
    stream, count = generator(run.settings.seed, STREAM), options.batch_trajectories
    share, device = ranks.share(count), resolve_device(run.settings.device)
    augment = Augmentation(run.settings.augment)
    part = (share.stop - share.start) / count  # 1 on a single process
    epoch_steps = steps_of_epoch(run.settings, *train.actions.shape[:2])
    terms: dict[str, Tensor] = {}

    def draw() -> Drawn:
        objective.train()
        batch = windows.draw(count, stream, share)
        if augmented and (seeds := augment.draw(count, stream)):
            batch = batch.shown(augment(batch.frames.to(device), seeds[share]))
        losses = objective.losses(batch)
        terms.update({name: part * term for name, term in losses.items()})
        return objective.total(terms), lambda: batch.drawn

    def after(step: int, loss: float) -> None:
        objective.after_step()
        if step % epoch_steps == 0:
            ranks.add_up(list(terms.values()))
            if ranks.leads:
                row = look({name: term.item() for name, term in terms.items()})
                run.record.metric({"step": step, **row})

    run.fit(phase, optimiser, objective.parts(), stream, draw, after)
