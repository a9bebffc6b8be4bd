"""An episode's actions are put beside the pictures that they lead from, scaled and checked."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.datasets.importing.episode import Episode, Recording
from hjepa_cli.errors import DataError, UsageError

ROUNDING = 1e-6  # of a limit
UNEVEN = 0.1  # of the usual time between pictures
LEAST_ROWS = 4  # for two steps, and the rows around them
TIMES = "its column of times"


@dataclasses.dataclass(frozen=True, eq=False)
class Aligned:
    """Rows 0 … R − 1 of an episode have a picture, and the action that leads on from it.

    Attributes:
        episode: where the pictures come from.
        first: the picture of row 0.
        actions, expert: ÷ limits [R, A].
        states: [R, S], S = 0 where there are none.
    """

    episode: Episode
    first: int
    actions: Floats
    expert: Floats
    states: Floats

    @property
    def rows(self) -> int:
        """Return R."""
        return len(self.actions)

    def part(self, start: int, stop: int) -> "Aligned":
        """Return rows ``start`` … ``stop`` − 1."""
        cut = (values[start:stop] for values in (self.actions, self.expert, self.states))
        return Aligned(self.episode, self.first + start, *cut)


def limits_of(recording: Recording, limits: Sequence[float] | None) -> tuple[float, ...]:
    """Return the limit of each action: the one given, for all, or those given, or the source's.

    Raises:
        UsageError: nobody says what they are, or there are not as many as actions.
        DataError: no episode is sound.
    """
    most = largest(recording)
    if limits is None:
        if recording.limits is not None and len(recording.limits) == len(most):
            return recording.limits
        shown = ",".join(f"{value:.4g}" for value in most)
        enough = ",".join(f"{_limit_above(value):.4g}" for value in most)
        raise UsageError(
            f"nobody says what limits the {len(most)} actions have; the largest recorded ones "
            f"are {shown}",
            hint=f"--limit {enough}, or a limit above: actions are stored divided by it",
        )
    if len(limits) == 1:
        limits = [*limits] * len(most)
    if len(limits) != len(most):
        raise UsageError(
            f"--limit has {len(limits)} values; there are {len(most)} actions",
            hint="give one for all, or one for each",
        )
    return tuple(limits)


def step_of(recording: Recording, step_s: float | None) -> tuple[float, str]:
    """Return the time between pictures, and who says so: ``--fps``, the source or its times.

    Raises:
        UsageError: nobody says.
        DataError: times do not rise.
    """
    if step_s is not None:
        return step_s, "--fps"
    if recording.step_s is not None:
        return recording.step_s, "the recording"
    for _, read in recording.episodes:
        try:
            times_s = read().times_s
        except DataError:
            continue
        if times_s is not None and len(times_s) > 1:
            found_s = float(np.median(np.diff(times_s)))
            if not found_s > 0:
                raise DataError(f"{TIMES} does not rise: {1e3 * found_s:g} ms between pictures")
            return found_s, TIMES
        break
    raise UsageError(
        "nobody says how many pictures a second there are", hint="--fps RATE, as --fps 50"
    )


def align(
    episode: Episode, limits: Sequence[float], step_s: float, offset: int, states: int
) -> Aligned:
    """Align an episode whose action row j + ``offset`` leads from picture j to picture j + 1.

    ``states`` is how many there should be.

    Raises:
        DataError: what it holds is unsound; the message says in which row.
    """
    name, actions, pictures = episode.name, episode.actions, episode.pictures
    if len(actions) and np.isnan(actions[-1]).all():  # some leave the last one empty
        actions = actions[:-1]
    if len(actions) > pictures:
        raise DataError(f"{name}: {len(actions)} actions, and {pictures} pictures")
    if len(actions) < pictures - 1:
        raise DataError(
            f"{name}, row {len(actions)}: {pictures} pictures, and {len(actions)} actions"
        )
    if actions.shape[1] != len(limits):
        raise DataError(f"{name}: {actions.shape[1]} actions a row; expected {len(limits)}")
    expert = actions if episode.expert is None else episode.expert[: len(actions)]
    if expert.shape != actions.shape:
        raise DataError(f"{name}: expert actions {expert.shape}, actions {actions.shape}")
    for what, values in (("action", actions), ("expert action", expert)):
        _check_finite(name, what, values)
        scaled = np.abs(values) / limits
        if (scaled > 1 + ROUNDING).any():
            row, at = np.argwhere(scaled > 1 + ROUNDING)[0]
            raise DataError(
                f"{name}, row {row}: {what} {at} is {values[row, at]:g}, and its limit "
                f"{limits[at]:g}",
                hint="a larger --limit, or --skip-bad",
            )
    recorded = np.zeros((pictures, 0)) if episode.states is None else episode.states
    if recorded.shape[1] != states or len(recorded) < len(actions):
        raise DataError(
            f"{name}: states {recorded.shape}; expected {states} a row for {pictures} pictures"
        )
    _check_finite(name, "state", recorded)
    if episode.times_s is not None:
        _check_even(name, np.asarray(episode.times_s), step_s)
    first = max(0, -offset)
    stop = min(pictures, len(actions) - offset)
    if stop - first < LEAST_ROWS:
        raise DataError(
            f"{name}: {max(stop - first, 0)} pictures with an action; expected {LEAST_ROWS} or more"
        )
    led = slice(first + offset, stop + offset)
    scaled = (actions[led] / limits).clip(-1, 1)
    return Aligned(episode, first, scaled, (expert[led] / limits).clip(-1, 1), recorded[first:stop])


def largest(recording: Recording) -> Floats:
    """Return the largest of each action over all sound episodes; rows that say none do not count.

    Raises:
        DataError: there is none.
    """
    found: Floats | None = None
    for _, read in recording.episodes:
        try:
            episode = read()
        except DataError:
            continue
        rows = np.abs(episode.actions[np.isfinite(episode.actions).all(axis=1)])
        if not len(rows):
            continue
        most = rows.max(axis=0)
        if found is None:
            found = most
        elif found.shape == most.shape:
            found = np.maximum(found, most)
    if found is None:
        if recording.episodes:
            recording.episodes[0][1]()  # which says what is wrong with it
        raise DataError("no episode has any action")
    return found


def _limit_above(value: float) -> float:
    """Return a limit of four digits that holds a value; 1 where an action never moved."""
    if not value:
        return 1.0
    digit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / digit - ROUNDING) * digit


def _check_finite(name: str, what: str, values: Floats) -> None:
    if not np.isfinite(values).all():
        row, at = np.argwhere(~np.isfinite(values))[0]
        raise DataError(
            f"{name}, row {row}: {what} {at} is {values[row, at]}; expected finite numbers",
            hint="--skip-bad leaves such episodes out",
        )


def _check_even(name: str, times_s: Floats, step_s: float) -> None:
    """Refuse a variable frame rate, or another one."""
    apart_s = np.diff(times_s)
    uneven = np.abs(apart_s - step_s) > UNEVEN * step_s
    if uneven.any():
        row = int(np.argmax(uneven))
        usual = "elsewhere" if not uneven.all() else "--fps or the source says"
        raise DataError(
            f"{name}, row {row + 1}: {1e3 * apart_s[row]:.4g} ms after the picture before it, "
            f"{usual} {1e3 * step_s:.4g} ms; the frame rate must be constant",
            hint="--skip-bad leaves such episodes out, --fps RATE states another rate",
        )
