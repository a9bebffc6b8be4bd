"""A decoded state is filtered between packets, and the teacher answers it.

A linear decoder reads the plant's state from embeddings, at the controller or on the device. The
dynamics of decoded states under known forces are identified by least squares, and a Kalman filter
carries the estimate from one packet to the next. No network predicts anything.
"""

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.control.controllers import told_ahead
from hjepa_cli.core.control.embedded_split import embed_split
from hjepa_cli.core.control.link import MOST_LEAD_STEPS, REMEMBERED_STEPS
from hjepa_cli.core.control.loop import noise_per_step
from hjepa_cli.core.networks.health import fit_probe, read_probe
from hjepa_cli.core.plants.system import Teacher

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

STATE_BITS = 12  # of each state that ``state-48`` sends
RANGE_MARGIN = 1.05  # of the largest decoded state; beyond, a state is clipped


@dataclasses.dataclass(frozen=True, eq=False)
class LinearGaussian:
    """Moves x' = A x + B u + c + w, y = x + v; w ~ N(0, Q), v ~ N(0, R), x ~ N(0, P_0) at first.

    Attributes:
        a, b, c: [S, S], [S, F] for actions in units of the force limit, [S].
        process, noise, start: Q, R and P_0 [S, S].
    """

    a: Floats
    b: Floats
    c: Floats
    process: Floats
    noise: Floats
    start: Floats

    def predict(self, mean: Floats, spread: Floats, actions: Floats) -> tuple[Floats, Floats]:
        """Go a step on with means [n, S] and covariances [n, S, S] under actions [n, F]."""
        return self.moved(mean, actions), self.a @ spread @ self.a.T + self.process

    def moved(self, mean: Floats, actions: Floats) -> Floats:
        """Return the means [n, S] of :meth:`predict`."""
        return mean @ self.a.T + actions @ self.b.T + self.c

    def correct(self, mean: Floats, spread: Floats, seen: Floats) -> tuple[Floats, Floats]:
        """Take in measurements y [n, S]."""
        gain = spread @ np.linalg.inv(spread + self.noise)
        rest = np.eye(len(self.a)) - gain
        mean = mean + np.einsum("nij,nj->ni", gain, seen - mean)
        # Joseph's form: it stays symmetric and positive whatever rounding does.
        transposed = np.swapaxes(rest, 1, 2), np.swapaxes(gain, 1, 2)
        return mean, rest @ spread @ transposed[0] + gain @ self.noise @ transposed[1]


class KalmanController:
    """Filters what arrives at n devices, and plays the teacher's force at its estimate.

    Args:
        filter_: the identified plant.
        read: packets → measured states [m, S].
        teacher: states [n, S] → forces_n [n, *A].
        force_limit_n: the actuator clips here, and the filter knows.
    """

    def __init__(
        self,
        filter_: LinearGaussian,
        read: Callable[[Any], Floats],
        teacher: Teacher,
        force_limit_n: float,
        devices: int,
    ) -> None:
        self._filter, self._read, self._teacher = filter_, read, teacher
        self._limit_n = force_limit_n
        self._mean = np.zeros((devices, len(filter_.c)))
        self._played_n = np.zeros(devices)
        self._spread = np.tile(filter_.start, (devices, 1, 1))
        # What it believed in its last steps, and did: a late packet corrects the past.
        self._past: deque[tuple[Floats, Floats, Floats]] = deque(
            maxlen=REMEMBERED_STEPS + MOST_LEAD_STEPS
        )

    def act(self, delivered: Bools, packets: Any, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are those of ``read``."""
        if ages is not None and not self._past:  # a packet of step 0 may have to be moved on
            still = np.zeros((len(self._mean), self._filter.b.shape[1]))
            for _ in range(MOST_LEAD_STEPS):
                self._past.append((self._mean.copy(), self._spread.copy(), still))
        if packets is not None:
            seen = self._read(packets)
            if ages is None or not ages.any():
                self._correct(self._mean, self._spread, delivered, seen)
            else:
                self._correct_past(np.flatnonzero(delivered), seen, ages)
        self._played_n = forces_n = self.planned_n()
        actions = self._actions(forces_n)
        if ages is not None:
            self._past.append((self._mean, self._spread, actions))
        self._mean, self._spread = self._predict(self._mean, self._spread, actions)
        return forces_n

    def _correct(self, mean: Floats, spread: Floats, devices: Any, seen: Floats) -> None:
        """Take in what was seen of some devices, in place."""
        mean[devices], spread[devices] = self._filter.correct(mean[devices], spread[devices], seen)

    def _correct_past(self, devices: Integers, seen: Floats, ages: Integers) -> None:
        """Take in what was seen so many steps ago, and live through the time since once more."""
        ages = np.minimum(ages, len(self._past))  # of the first steps there is no past
        for back in range(int(ages.max()), -1, -1):
            then = (self._mean, self._spread) if back == 0 else self._past[-back][:2]
            if (now := ages == back).any():
                self._correct(*then, devices[now], seen[now])
            if back and len(since := devices[ages >= back]):
                after = (self._mean, self._spread) if back == 1 else self._past[1 - back][:2]
                moved = self._predict(then[0][since], then[1][since], self._past[-back][2][since])
                after[0][since], after[1][since] = moved

    def _predict(self, mean: Floats, spread: Floats, actions: Floats) -> tuple[Floats, Floats]:
        mean, spread = self._filter.predict(mean, spread, actions)
        # Seconds without a packet: beyond the loop's own limits a covariance means nothing more,
        # and in the end no number holds it.
        deviation = np.sqrt(np.einsum("nii->ni", spread))
        within = np.minimum(1.0, STATE_LIMIT / deviation)
        spread = within[:, :, None] * spread * within[:, None, :]
        return np.clip(mean, -STATE_LIMIT, STATE_LIMIT), spread

    def planned_n(self) -> Floats:
        """Return the forces [n, *A] of the coming step if no packet comes."""
        return self._answer(self._mean)

    def ahead_n(self) -> Floats:
        """Return the forces [n, L, *A] of the last step and of the next ones if no packet comes."""

        def moved(mean: Floats, forces_n: Floats) -> Floats:
            mean = self._filter.moved(mean, self._actions(forces_n))
            return np.clip(mean, -STATE_LIMIT, STATE_LIMIT)

        return told_ahead(self._played_n, self._mean, self._answer, moved)

    def _answer(self, mean: Floats) -> Floats:
        return np.clip(self._teacher(mean), -self._limit_n, self._limit_n)

    def _actions(self, forces_n: Floats) -> Floats:
        return np.asarray(forces_n.reshape(len(forces_n), -1) / self._limit_n)


@dataclasses.dataclass(frozen=True, eq=False)
class StateCodec:
    """Sends states as :data:`STATE_BITS` bits each, uniformly over ± the reach of each [S]."""

    reach: Floats

    @property
    def bits(self) -> int:
        """Return the bits of one transmission."""
        return STATE_BITS * len(self.reach)

    @property
    def step(self) -> Floats:
        """Return the width of a quantisation step in each state [S]."""
        return np.asarray(2 * self.reach / 2**STATE_BITS)

    def send(self, states: Floats) -> Floats:
        """Send states [n, S]: the controller receives the middles of their steps [n, S]."""
        levels = 2**STATE_BITS
        codes = np.clip(np.floor((states / self.reach + 1) / 2 * levels), 0, levels - 1)
        return np.asarray(((codes + 0.5) / levels * 2 - 1) * self.reach)


@dataclasses.dataclass(frozen=True, eq=False)
class StateReader:
    """Decodes the state linearly from embeddings, and holds what was identified through that.

    The weights [D + 1, S] are those of :func:`~hjepa_cli.core.networks.health.read_probe`, the
    filter is for decoded states as they are; the codec can send these.
    """

    weights: Tensor
    filter: LinearGaussian
    codec: StateCodec

    def read(self, z: Tensor) -> Floats:
        """Decode states [n, S] from embeddings [n, D]."""
        return np.asarray(read_probe(self.weights, z.cpu()).numpy())

    @property
    def quantised(self) -> LinearGaussian:
        """Return the filter for states through the codec, whose rounding adds its variance to R."""
        rounding = np.diag(self.codec.step**2 / 12)
        return dataclasses.replace(self.filter, noise=self.filter.noise + rounding)


def fit_state_reader(
    model: "Model", settings: Settings, send: Callable[[Tensor], Tensor] = lambda z: z
) -> StateReader:
    """Fit decoder and filter to the training trajectories of the settings.

    The measurement noise is the decoder's error on the held-out trajectories, whose embeddings
    [n, D] it gets as ``send`` makes them arrive. The process noise is what the identified dynamics
    leave unexplained and, since trajectories for training have none, the noise of the protocol,
    which no other method knows.
    """
    train, test = (embed_split(model, settings, split) for split in ("train", "test"))
    weights = fit_probe(train.z.flatten(0, 1), torch.from_numpy(train.states).flatten(0, 1))
    decoded = np.asarray(read_probe(weights, train.z.flatten(0, 1)).numpy())
    decoded = decoded.reshape(train.states.shape)
    held_out = np.asarray(read_probe(weights, send(test.z.flatten(0, 1))).numpy())
    error = held_out - test.states.reshape(held_out.shape)
    a, b, c, unexplained = identify(decoded, train.actions)
    gusts = np.diag(noise_per_step(settings.protocol) ** 2)
    start = np.cov(train.states.reshape(-1, train.states.shape[2]).T)
    noise = error.T @ error / len(error)
    filter_ = LinearGaussian(a, b, c, unexplained + gusts, noise, start)
    reach = RANGE_MARGIN * np.abs(decoded).max(axis=(0, 1))
    return StateReader(weights, filter_, StateCodec(reach))


def identify(states: Floats, actions: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit x' = A x + B u + c by least squares to states [N, T, S] under actions [N, T, F].

    Returns:
        A [S, S], B [S, F], c [S] and the covariance [S, S] of what remains.
    """
    count, forces = states.shape[2], actions.shape[2]
    before, after = (part.reshape(-1, count) for part in (states[:, :-1], states[:, 1:]))
    played = actions[:, :-1].reshape(-1, forces)
    inputs = np.concatenate([before, played, np.ones((len(before), 1))], axis=1)
    weights = np.linalg.lstsq(inputs, after, rcond=None)[0]
    rest = after - inputs @ weights
    a, b, c = np.split(weights.T, [count, count + forces], axis=1)
    return a, b, c[:, 0], rest.T @ rest / len(rest)
