"""A controller's forces err when it is left alone after one packet, and with every packet."""

import dataclasses

import numpy as np

from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.control.drivers import Driver
from hjepa_cli.core.control.force_error import control_error
from hjepa_cli.core.control.loop import last_states
from hjepa_cli.core.evaluation.bench import Facts
from hjepa_cli.core.evaluation.simulator import Simulator, Tick
from hjepa_cli.core.plants.named import plant_of


@dataclasses.dataclass(frozen=True, eq=False)
class ControlErrors:
    """Is a unit: the :func:`control_errors` of a method by its name, and what its driver is."""

    method: str
    states: Floats
    teacher_n: Floats
    every_packet: bool = False

    def compute(self, simulator: Simulator, tick: Tick) -> tuple[Floats, Facts]:
        """Measure the errors [R, horizon + 1], and describe the driver."""
        driver, settings = simulator.driver(self.method), simulator.settings
        errors = control_errors(
            driver,
            self.states,
            self.teacher_n,
            plant_of(settings).force_limit_n,
            settings.protocol.horizon,
            every_packet=self.every_packet,
        )
        bits = driver.bits_per_transmission
        return errors, Facts(driver.name, driver.family, driver.uses_link, bits)


def control_errors(
    driver: Driver,
    states: Floats | Pixels,
    teacher_n: Floats,
    force_limit_n: float,
    horizon: int,
    *,
    every_packet: bool = False,
) -> Floats:
    """Measure the control error of a controller left alone after one packet, on given rollouts.

    Args:
        driver: what drives.
        states: rollouts [R, steps + 1, S]; index 0 is the frame before k = 0. Of recordings it is
            their frames uint8 [R, steps + 1, H, W, C].
        teacher_n: the teacher's forces on them [R, steps, *A].
        force_limit_n: half of the force range.
        horizon: last j; the packet at k = 0 is j = 0.
        every_packet: send one at every step instead, so that nothing is predicted; without a link
            that is always so.

    Returns:
        |ũ - u*| ÷ force range [R, horizon + 1], the mean over a device's forces.
    """
    every_packet = every_packet or not driver.uses_link
    rollouts, steps = len(states), horizon + 1
    controller = (driver.reactive if every_packet else driver.controller)(rollouts)
    played_n = []
    for sent in range(-driver.delay_steps, steps - driver.delay_steps):
        arrives = sent >= 0 if every_packet else sent == 0
        packets = driver.sensor(last_states(states, sent)) if arrives else None
        played_n.append(controller.act(np.full(rollouts, arrives), packets))
    forces_n = np.clip(np.stack(played_n, axis=1), -force_limit_n, force_limit_n)
    errors = control_error(forces_n, teacher_n[:, :steps], force_limit_n)
    return np.asarray(errors.reshape(rollouts, steps, -1).mean(axis=-1))
