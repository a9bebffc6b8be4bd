"""Many closed loops that compete for one uplink: plants, scheduler and one shared controller.

As :mod:`hjepa_cli.core.control.loop`, step by step, but who gets through is decided while it runs. Cameras
and encoders run only for devices that send, and for those that a reporting scheduler has look.
Memory does not grow with the number of slots.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.config.settings import ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.control.disagreement import Levels, calibrate_levels
from hjepa_cli.core.control.error_growth import Growth, conformal_growth
from hjepa_cli.core.control.force_error import control_error
from hjepa_cli.core.control.loop import (
    World,
    device_draws,
    noise_per_step,
)
from hjepa_cli.core.control.methods import Method
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.radio.uplink import Access, Uplink

CHUNK_STEPS = 256
CALIBRATION_DEVICES = 39  # (39 + 1) · 0.9 is whole: the conformal quantile is exact


@dataclasses.dataclass(frozen=True)
class CellOutcome:
    """What a simulated cell measured.

    Attributes:
        score, cost: means over the scored steps of each device [N].
        packets: delivered to each device's controller in the counted slots [N].
        reports: innovation reports of all devices in the counted slots.
        counted_slots: the scored steps, but for the first slot of all, in which everybody is heard
            without asking.
    """

    score: Floats
    cost: Floats
    packets: NDArray[np.int64]
    reports: int
    counted_slots: int


def simulate_cell(
    plant: System,
    protocol: ProtocolSettings,
    seed: int,
    devices: int,
    access: Access,
    method: Method,
    *,
    tick: Callable[[int], None] = lambda steps: None,
) -> CellOutcome:
    """Run N closed loops on J resource blocks.

    Args:
        plant: of all devices; masses vary with ``protocol.plant_spread``.
        protocol: initial states, noise, steps.
        seed: of the draws, which are those of :class:`~hjepa_cli.core.control.loop.Draws`.
        devices: N.
        access: the uplink and its scheduler.
        method: what devices send and what the controller does.
        tick: told the device-steps done.

    Raises:
        NumericalError: the controller returned a force that is not finite.
    """
    warmup_steps, uplink = protocol.warmup_steps, Uplink(access, devices)
    world = World(plant, *streamed_draws(protocol, devices, seed), warmup_steps)
    controller: Any = method.controller(devices)
    outbox, packets, early_reports = Outbox(), np.zeros(devices, dtype=np.int64), 0
    first_counted = max(warmup_steps, 1)
    for k in range(protocol.total_steps):
        if k == first_counted:
            early_reports = uplink.reports
        uplink.begin()
        if access.levels and k:
            uplink.weigh(controller.apart)
        if uplink.listens:
            _report(uplink, world, controller, method, plant.force_limit_n)
        arrived = uplink.grant()
        packets += arrived if k >= first_counted else 0
        fresh = world.sense(method.sensor, uplink.sampled)
        world.move(controller.act(arrived, outbox.deliver(fresh, uplink.sampled, arrived)))
        tick(devices)
    score, cost, _ = world.means(protocol.steps)
    reports, counted_slots = uplink.reports - early_reports, protocol.total_steps - first_counted
    return CellOutcome(score, cost, packets, reports, counted_slots)


class Outbox:
    """What devices have sampled and not yet brought to the controller: copies of it may follow."""

    def __init__(self) -> None:
        self._kept: Any = None

    def deliver(self, fresh: Any, sampled: Bools, arrived: Bools) -> Any:
        """Take the new samples, and hand out the packets that arrive; ``None`` where none does.

        Args:
            fresh: packets [sampled.sum(), ...] of the devices that sample in this slot [N].
            sampled, arrived: devices [N].
        """
        if self._kept is None:  # of everybody: all are heard in the first slot
            self._kept = fresh
        if np.array_equal(sampled, arrived):
            return fresh
        if fresh is not None:
            self._kept[np.flatnonzero(sampled)] = fresh
        return self._kept[np.flatnonzero(arrived)] if arrived.any() else None


def measure_growth(
    plant: System,
    protocol: ProtocolSettings,
    seed: int,
    method: Method,
    *,
    devices: int = CALIBRATION_DEVICES,
    longest: int = 320,
) -> Growth:
    """Calibrate a method's growth table: one packet, then the loop runs on predicted forces alone.

    Args:
        plant, protocol, seed, method: as for :func:`simulate_cell`; use another seed than there.
        devices: calibration loops.
        longest: A_max in steps; fewer where the protocol is shorter.
    """
    ages, errors, _ = _without_packets(plant, protocol, seed, method, devices, longest)
    return conformal_growth(ages, errors)


def measure_levels(
    plant: System,
    protocol: ProtocolSettings,
    seed: int,
    method: Method,
    *,
    devices: int = 2 * CALIBRATION_DEVICES,
    longest: int = 320,
) -> Levels:
    """Calibrate the disagreement of a method's levels, as :func:`measure_growth` does the age.

    Args:
        method: its controller has two levels.
    """
    return calibrate_levels(*_without_packets(plant, protocol, seed, method, devices, longest))


def _without_packets(
    plant: System, protocol: ProtocolSettings, seed: int, method: Method, devices: int, longest: int
) -> tuple[list[int], Floats, Floats]:
    """Ages [G], and of each device then: the force's error and its levels' distance [n, G]."""
    longest = min(longest, protocol.total_steps - 1)
    wanted = sorted({1, 2, longest, *np.geomspace(4, longest, 20).astype(int).tolist()})
    ages = [age for age in wanted if age <= longest]
    world = World(plant, *streamed_draws(protocol, devices, seed))
    controller: Any = method.controller(devices)
    everybody, nobody = np.ones(devices, dtype=bool), np.zeros(devices, dtype=bool)
    world.move(controller.act(everybody, world.sense(method.sensor, everybody)))
    errors, apart = [], []
    for age in range(1, longest + 1):
        if age in ages:
            planned = controller.outlook()
            errors.append(_innovation(world, method, everybody, planned, plant.force_limit_n))
            apart.append(np.array(getattr(controller, "apart", np.zeros(devices))))
        world.move(controller.act(nobody, None))
    return ages, np.stack(errors, axis=1), np.stack(apart, axis=1)


def streamed_draws(
    protocol: ProtocolSettings, devices: int, seed: int
) -> tuple[Floats, Floats, Iterator[Floats]]:
    """The draws of :class:`~hjepa_cli.core.control.loop.Draws` without keeping them.

    Returns:
        Initial states [N, S], mass factors [N, 2] and the noise of one step after the other [N, S].
    """
    drawn = [device_draws(protocol, seed, device) for device in range(devices)]
    initial = np.stack([draw[0] for draw in drawn])
    mass_scale = np.stack([draw[1] for draw in drawn])

    def noise() -> Iterator[Floats]:
        streams, scale = [draw[3] for draw in drawn], noise_per_step(protocol)
        while True:
            chunk = [stream.standard_normal((CHUNK_STEPS, scale.size)) for stream in streams]
            yield from np.stack(chunk, axis=1) * scale

    return initial, mass_scale, noise()


def _report(
    uplink: Uplink, world: World, controller: Any, method: Method, force_limit_n: float
) -> None:
    """Let devices compare the controller's force with their own, and report."""
    checking = uplink.checking()
    if checking.any():
        error = _innovation(world, method, checking, controller.outlook(), force_limit_n)
        uplink.hear(checking, error)


def _innovation(
    world: World, method: Method, devices: Bools, planned_n: Floats, force_limit_n: float
) -> Floats:
    """|C(z) − ũ| ÷ 40 N of some devices: what their own packet would change in the force."""
    packets = world.sense(method.sensor, devices)
    count = int(devices.sum())
    wanted_n = method.reactive(count).act(np.ones(count, dtype=bool), packets)
    error = control_error(planned_n[devices], wanted_n, force_limit_n)
    return np.asarray(error.reshape(count, -1).mean(axis=1))  # over the forces of a device
