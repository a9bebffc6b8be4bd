"""Decide what becomes of a recording before a picture of it is read."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from hjepa_cli.config.schema import CameraSettings, RecordedSettings
from hjepa_cli.core.datasets.importing import alignment, assembly
from hjepa_cli.core.datasets.importing.aligned import Aligned, align, limits_of, step_of
from hjepa_cli.core.datasets.importing.assembly import Assembly
from hjepa_cli.core.datasets.importing.episode import Recording
from hjepa_cli.core.plants.recorded import Recorded
from hjepa_cli.errors import DataError, UsageError

TESTED_ROWS = 4000  # of the test of alignment, at most
CAMERA = CameraSettings()


@dataclasses.dataclass(frozen=True)
class Options:
    """A person may say so much of a recording.

    Attributes:
        camera: size of the frames.
        limits: of each action, or one for all; ``None`` leaves it to the source.
        step_s: between pictures; ``None`` leaves it to the source.
        offset: action row j + ``offset`` leads from picture j to picture j + 1.
        steps: of a trajectory; ``None``: as many as the shortest episode has.
        held_out: share of the episodes for the split ``test``.
        mirror: what a mirror does to each action, 1 or −1; empty: nobody says.
        skip_bad: leave unsound episodes out.
    """

    camera: CameraSettings = CAMERA
    limits: tuple[float, ...] | None = None
    step_s: float | None = None
    offset: int = 0
    steps: int | None = None
    held_out: float = 0.2
    mirror: tuple[float, ...] = ()
    skip_bad: bool = False


@dataclasses.dataclass(frozen=True)
class Prepared:
    """It is what a dataset will be: how it is made, what is known of its plant, its origin.

    ``step_from`` says who states the time between pictures; ``largest`` are the actions recorded.
    """

    assembly: Assembly
    known: RecordedSettings
    step_from: str
    largest: tuple[float, ...]
    episodes: int
    format: str
    lossy: bool

    def judge(self) -> alignment.Verdict | None:
        """Test on some trajectories whether actions lead from where they should.

        Raises:
            DataError: a picture cannot be read.
        """
        made, pieces = self.assembly, list(self.assembly.splits["train"])
        few = max(TESTED_ROWS // (pieces[0].steps + 1), 1)
        chosen = pieces[:: max(-(-len(pieces) // few), 1)]
        frames, actions = [], []
        for piece in chosen:
            try:
                seen = assembly.frames_of_pieces([piece], made.frame_shape, set())
                frames.append(next(seen))
            except DataError:
                if not made.skip_bad:
                    raise
                continue
            actions.append(piece.of.actions[piece.rows])
        return alignment.judge(frames, actions) if frames else None


def prepare(recordings: Mapping[str, Recording], options: Options) -> Prepared:
    """Check all episodes and cut them into trajectories.

    Args:
        recordings: by split; without one for ``test`` some episodes of ``train`` are held out.
        options: see there.

    Raises:
        UsageError: limits or frame rate are missing, or wrong; a mirror that is none; no split.
        DataError: an episode is unsound and ``skip_bad`` is off, or none is left.
    """
    train = recordings["train"]
    limits, (step_s, step_from) = limits_of(train, options.limits), step_of(train, options.step_s)
    names = train.state_names or _numbered(train)
    known = RecordedSettings(step_s, limits, names, options.mirror)
    kind = Recorded.of(known)
    if kind.symmetric and options.camera.width_px % 2:
        raise UsageError(
            f"pictures {options.camera.width_px} px wide have no middle; a mirror needs an even "
            "number",
            hint="another --size H W, or leave out --mirror-signs",
        )
    if not 0 < options.held_out < 1:
        raise UsageError(f"--held-out {options.held_out:g}; expected a share between 0 and 1")
    bad: list[str] = []
    sound = {
        split: _sound(one, known, options.offset, bad, skip_bad=options.skip_bad)
        for split, one in recordings.items()
    }
    every = [one for some in sound.values() for one in some]
    scaled = np.max([np.abs(one.actions).max(axis=0) for one in every], axis=0)
    if "test" not in sound:
        train_on, test_on = assembly.held_out(sound["train"], options.held_out)
        sound = {"train": train_on, "test": test_on, **{k: sound[k] for k in sound if k != "train"}}
    cut_alike = ("train", "test") if "test" not in recordings else ("train",)
    alike = [one for split in cut_alike for one in sound[split]]
    splits = {}
    for split, some in sound.items():
        steps = assembly.shared_steps(alike if split in cut_alike else some, options.steps)
        for one in some:
            if one.rows <= steps:
                short = f"{one.episode.name}: {one.rows - 1} steps; trajectories have {steps}"
                if not options.skip_bad:
                    raise DataError(short, hint=f"--steps {one.rows - 1}, or --skip-bad")
                bad.append(short)
        splits[split] = assembly.pieces_of(some, steps)
        if not splits[split]:
            raise DataError(f"no episode of split {split} is left")
    shapes = options.camera.frame_shape, kind.action_shape
    made = Assembly(splits, *shapes, options.skip_bad, bad=bad)
    lossy = any(one.lossy for one in recordings.values())
    largest = tuple((scaled * limits).tolist())
    return Prepared(made, known, step_from, largest, len(every), train.format, lossy)


def _sound(
    recording: Recording, known: RecordedSettings, offset: int, bad: list[str], *, skip_bad: bool
) -> Sequence[Aligned]:
    """Return the sound episodes; ``bad`` gets what is wrong with the others."""
    found, flaws = [], []
    for _, read in recording.episodes:
        try:
            episode = read()
            found.append(align(episode, known.limits, known.step_s, offset, len(known.states)))
        except DataError as error:
            flaws.append(error)
    if flaws and not skip_bad:
        first, *others = flaws
        more = f"; {len(others)} more episodes are unsound" if others else ""
        hint = first.hint or "--skip-bad leaves such episodes out"
        raise DataError(f"{first.message}{more}", hint=hint)
    if not found:
        raise DataError(f"no sound episode: {flaws[0].message}" if flaws else "no episode")
    bad += [flaw.message for flaw in flaws]
    return found


def _numbered(recording: Recording) -> tuple[str, ...]:
    """Return a name for each state of the first sound episode."""
    for _, read in recording.episodes:
        try:
            states = read().states
        except DataError:
            continue
        return tuple(f"state_{i}" for i in range(0 if states is None else states.shape[1]))
    return ()
