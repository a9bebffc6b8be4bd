"""The anchors ``state-kf`` and ``state-48``: decode the state, filter it, and ask the teacher.

A linear decoder reads the plant's state from embeddings, at the controller or on the device. The
dynamics of decoded states under known forces are identified by least squares, and a Kalman filter
carries the estimate from one packet to the next. No network predicts anything.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.control.embedded_trajectories import typical
from hjepa_cli.core.control.loop import STATE_LIMIT, noise_per_step
from hjepa_cli.core.networks.health import fit_probe, read_probe
from hjepa_cli.core.plants.system import Teacher

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

STATE_BITS = 12  # of each state that ``state-48`` sends
RANGE_MARGIN = 1.05  # of the largest decoded state; beyond, a state is clipped


@dataclasses.dataclass(frozen=True, eq=False)
class LinearGaussian:
    """x' = A x + B u + c + w, y = x + v with w ~ N(0, Q), v ~ N(0, R), and x ~ N(0, P_0) at first.

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
        """One step: means [n, S], covariances [n, S, S], actions [n, F] → the same a step on."""
        moved = mean @ self.a.T + actions @ self.b.T + self.c
        return moved, self.a @ spread @ self.a.T + self.process

    def correct(self, mean: Floats, spread: Floats, seen: Floats) -> tuple[Floats, Floats]:
        """Take in measurements y [n, S]."""
        gain = spread @ np.linalg.inv(spread + self.noise)
        rest = np.eye(len(self.a)) - gain
        mean = mean + np.einsum("nij,nj->ni", gain, seen - mean)
        # Joseph's form: it stays symmetric and positive whatever rounding does.
        transposed = np.swapaxes(rest, 1, 2), np.swapaxes(gain, 1, 2)
        return mean, rest @ spread @ transposed[0] + gain @ self.noise @ transposed[1]


class KalmanController:
    """Filters what arrives, and plays the teacher's force at its estimate.

    Args:
        filter_: the identified plant.
        read: packets → measured states [m, S].
        teacher: states [n, S] → forces_n [n, *A].
        force_limit_n: the actuator clips here, and the filter knows.
        devices: n.
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
        self._spread = np.tile(filter_.start, (devices, 1, 1))

    def act(self, delivered: Bools, packets: Any) -> Floats:
        """Forces of one step [n, *A]."""
        if packets is not None:
            self._mean[delivered], self._spread[delivered] = self._filter.correct(
                self._mean[delivered], self._spread[delivered], self._read(packets)
            )
        forces_n = self.outlook()
        actions = forces_n.reshape(len(forces_n), -1) / self._limit_n
        mean, spread = self._filter.predict(self._mean, self._spread, actions)
        self._mean = np.clip(mean, -STATE_LIMIT, STATE_LIMIT)
        # Seconds without a packet: beyond the loop's own limits a covariance means nothing more,
        # and in the end no number holds it.
        deviation = np.sqrt(np.einsum("nii->ni", spread))
        within = np.minimum(1.0, STATE_LIMIT / deviation)
        self._spread = within[:, :, None] * spread * within[:, None, :]
        return forces_n

    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes."""
        return np.clip(self._teacher(self._mean), -self._limit_n, self._limit_n)


@dataclasses.dataclass(frozen=True, eq=False)
class StateCodec:
    """States as integers of :data:`STATE_BITS` bits, uniformly over each state's own range.

    Attributes:
        reach: largest magnitude of each state [S]; states are clipped there.
    """

    reach: Floats

    @property
    def bits(self) -> int:
        """Bits of one transmission."""
        return STATE_BITS * len(self.reach)

    @property
    def step(self) -> Floats:
        """Width of a level [S]."""
        return np.asarray(2 * self.reach / 2**STATE_BITS)

    def send(self, states: Floats) -> Floats:
        """States [n, S] → what the controller receives [n, S]: the middles of their levels."""
        levels = 2**STATE_BITS
        codes = np.clip(np.floor((states / self.reach + 1) / 2 * levels), 0, levels - 1)
        return np.asarray(((codes + 0.5) / levels * 2 - 1) * self.reach)


@dataclasses.dataclass(frozen=True, eq=False)
class StateReader:
    """A linear decoder of the state from embeddings, and what was identified through it.

    Attributes:
        weights: of :func:`~hjepa_cli.core.networks.health.read_probe` [D + 1, S].
        filter: for decoded states, sent as they are.
        codec: for sending decoded states.
    """

    weights: Tensor
    filter: LinearGaussian
    codec: StateCodec

    def read(self, z: Tensor) -> Floats:
        """Embeddings [n, D] → decoded states [n, S]."""
        return np.asarray(read_probe(self.weights, z.cpu()).numpy())

    @property
    def quantised(self) -> LinearGaussian:
        """The filter for states that went through the codec: rounding adds its variance to R."""
        rounding = np.diag(self.codec.step**2 / 12)
        return dataclasses.replace(self.filter, noise=self.filter.noise + rounding)


@functools.lru_cache(maxsize=1)  # both anchors of a model share it
def fit_state_reader(
    model: "Model", settings: Settings, send: Callable[[Tensor], Tensor] = lambda z: z
) -> StateReader:
    """Fit decoder and filter to the training trajectories of the settings.

    The measurement noise is the decoder's error on the held-out trajectories, whose embeddings
    [n, D] it gets as ``send`` makes them arrive. The process noise is
    what the identified dynamics leave unexplained and, since trajectories for training have none,
    the noise of the protocol, which no other method is told.
    """
    train, test = (typical(model, settings, split) for split in ("train", "test"))
    weights = fit_probe(train.z.flatten(0, 1), torch.from_numpy(train.states).flatten(0, 1))
    decoded, held_out = _decode(weights, train.z), _decode(weights, _sent(test.z, send))
    error = (held_out - test.states).reshape(-1, test.states.shape[2])
    a, b, c, unexplained = identify(decoded, train.actions)
    gusts = np.diag(noise_per_step(settings.protocol) ** 2)
    start = np.cov(train.states.reshape(-1, train.states.shape[2]).T)
    noise = error.T @ error / len(error)
    filter_ = LinearGaussian(a, b, c, unexplained + gusts, noise, start)
    reach = RANGE_MARGIN * np.abs(decoded).max(axis=(0, 1))
    return StateReader(weights, filter_, StateCodec(reach))


def identify(states: Floats, actions: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Least squares of x' = A x + B u + c over trajectories.

    Args:
        states: [N, T, S].
        actions: from each step to the next [N, T, F].

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


def _sent(z: Tensor, send: Callable[[Tensor], Tensor]) -> Tensor:
    """Embeddings [N, T, D] as they arrive."""
    return send(z.flatten(0, 1)).reshape(z.shape)


def _decode(weights: Tensor, z: Tensor) -> Floats:
    """Decoded states [N, T, S]."""
    read = read_probe(weights, z.flatten(0, 1))
    return np.asarray(read.reshape(*z.shape[:2], -1).numpy())
