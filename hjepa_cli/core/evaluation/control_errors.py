"""How wrong a controller's forces are: left alone after one packet, and with every packet."""

import dataclasses

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.force_error import control_error
from hjepa_cli.core.control.loop import last_states, play
from hjepa_cli.core.control.methods import Method
from hjepa_cli.core.evaluation.simulator import Simulator, Tick
from hjepa_cli.core.plants.named import plant


@dataclasses.dataclass(frozen=True)
class Alone:
    """A method left alone after one packet.

    Attributes:
        errors: :func:`control_errors` [R, horizon + 1].
        name, family, uses_link, bits_per_transmission: those of the method.
    """

    errors: Floats
    name: str
    family: str
    uses_link: bool
    bits_per_transmission: int


@dataclasses.dataclass(frozen=True, eq=False)
class LeftAlone:
    """A unit: a method on given rollouts, left alone after one packet.

    Attributes:
        method: its name.
        states, teacher_n: as of :func:`control_errors`.
    """

    method: str
    states: Floats
    teacher_n: Floats

    def compute(self, simulator: Simulator, tick: Tick) -> Alone:
        """Measure it, and describe the method that was built for it."""
        method, settings = simulator.method(self.method), simulator.settings
        limit_n, horizon = plant(settings.plant).force_limit_n, settings.protocol.horizon
        return Alone(
            control_errors(method, self.states, self.teacher_n, limit_n, horizon),
            name=method.name,
            family=method.family,
            uses_link=method.uses_link,
            bits_per_transmission=method.bits_per_transmission,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class WithEveryPacket:
    """A unit: the same rollouts, with a packet at every step. Attributes as of LeftAlone."""

    method: str
    states: Floats
    teacher_n: Floats

    def compute(self, simulator: Simulator, tick: Tick) -> Floats:
        """:func:`errors_at_every_step` [R, horizon + 1]."""
        method, settings = simulator.method(self.method), simulator.settings
        limit_n, horizon = plant(settings.plant).force_limit_n, settings.protocol.horizon
        return errors_at_every_step(method, self.states, self.teacher_n, limit_n, horizon)


def control_errors(
    method: Method, states: Floats, teacher_n: Floats, force_limit_n: float, horizon: int
) -> Floats:
    """Control error of a controller left alone after one packet, on given rollouts.

    Args:
        method: how to drive.
        states: rollouts [R, steps + 1, S]; index 0 is the frame before k = 0.
        teacher_n: the teacher's forces on them [R, steps, *A].
        force_limit_n: half of the force range.
        horizon: last j; the packet at k = 0 is j = 0.

    Returns:
        |ũ - u*| ÷ force range [R, horizon + 1], the mean over a device's forces.
    """
    if not method.uses_link:
        return errors_at_every_step(method, states, teacher_n, force_limit_n, horizon)
    packets, delay_steps = method.sensor(last_states(states, 0)), method.delay_steps
    controller = method.controller(len(states))
    forces_n = play(controller, packets, len(states), horizon + 1, delay_steps=delay_steps)
    return _errors(forces_n, teacher_n, force_limit_n)


def errors_at_every_step(
    method: Method, states: Floats, teacher_n: Floats, force_limit_n: float, horizon: int
) -> Floats:
    """Control error without prediction, with a packet at every step of given rollouts.

    Arguments and result as of :func:`control_errors`.
    """
    controller, every = method.reactive(len(states)), np.ones(len(states), dtype=bool)
    forces_n = []
    for j in range(horizon + 1):
        sent = j - method.delay_steps
        packets = method.sensor(last_states(states, sent)) if sent >= 0 else None
        forces_n.append(controller.act(every if sent >= 0 else ~every, packets))
    return _errors(np.stack(forces_n, axis=1), teacher_n, force_limit_n)


def _errors(forces_n: Floats, teacher_n: Floats, force_limit_n: float) -> Floats:
    """Forces as played and the teacher's [R, ≥ steps, *A] → errors [R, steps]."""
    rollouts, steps = forces_n.shape[:2]
    forces_n = np.clip(forces_n, -force_limit_n, force_limit_n)
    errors = control_error(forces_n, teacher_n[:, :steps], force_limit_n)
    return np.asarray(errors.reshape(rollouts, steps, -1).mean(axis=-1))
