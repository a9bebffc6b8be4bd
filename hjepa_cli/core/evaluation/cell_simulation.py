"""Many closed loops compete for one uplink: plants, scheduler and one shared controller.

Step by step as in :mod:`hjepa_cli.core.control.loop`, but who gets through is decided while it
runs. Cameras and encoders run only for devices that send, and for those that a reporting scheduler
has look. A device that has fallen gets no force and scores nothing, as there, but goes on sending:
nobody tells the base station. Memory does not grow with the number of slots.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.control.disagreement import LevelDisagreement, calibrate_levels
from hjepa_cli.core.control.drivers import Driver
from hjepa_cli.core.control.error_growth import ErrorGrowthTable, conformal_growth
from hjepa_cli.core.control.force_error import control_error
from hjepa_cli.core.control.loop import (
    Link,
    LinkDraws,
    ScoredPlants,
    device_draws,
    noise_per_step,
)
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.radio.uplink import Access, Uplink

CHUNK_STEPS = 256
CALIBRATION_DEVICES = 39  # (39 + 1) · 0.9 is whole: the conformal quantile is exact
LONGEST = 320  # steps without a packet that growth is calibrated over


@dataclasses.dataclass(frozen=True)
class CellOutcome:
    """Holds the measurements of a simulated cell.

    Attributes:
        score, cost: means over the scored steps of each device [N].
        packets, reports: delivered to each device's controller [N], and the innovation reports of
            all devices, both in the counted slots.
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
    method: Driver,
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
        tick: called with the device-steps done.

    Raises:
        NumericalError: the controller returned a force that is not finite.
    """
    warmup_steps, uplink = protocol.warmup_steps, Uplink(access, devices)
    plants = ScoredPlants(plant, *streamed_draws(protocol, devices, seed), warmup_steps)
    controller: Any = method.controller(devices)
    link = Link(LinkDraws.make(protocol, devices, seed), controller)
    outbox, packets, early_reports = Outbox(), np.zeros(devices, dtype=np.int64), 0
    first_counted = max(warmup_steps, 1)
    for k in range(protocol.total_steps):
        if k == first_counted:
            early_reports = uplink.reports
        uplink.begin()
        if access.levels and k:
            uplink.weigh(controller.apart)
        if uplink.listens and (checking := uplink.checking()).any():
            planned_n = link.planned_n()
            uplink.hear(checking, _innovation(plants, method, checking, planned_n))
        arrived = uplink.grant()
        packets += arrived if k >= first_counted else 0
        fresh = plants.sense(method.sensor, uplink.sampled)
        plants.move(link.forces_n(arrived, outbox.deliver(fresh, uplink.sampled, arrived)))
        tick(devices)
    score, cost, _ = plants.means(protocol.steps)
    reports, counted_slots = uplink.reports - early_reports, protocol.total_steps - first_counted
    return CellOutcome(score, cost, packets, reports, counted_slots)


class Outbox:
    """Keeps the samples that have not reached the controller yet: copies of them may follow."""

    def __init__(self) -> None:
        self._kept: Any = None

    def deliver(self, fresh: Any, sampled: Bools, arrived: Bools) -> Any:
        """Take new samples, and hand out the packets that arrive; ``None`` where none does.

        ``fresh`` are those [sampled.sum(), ...] of the devices that sample in this slot [N].
        """
        if self._kept is None:  # of everybody: all are heard in the first slot
            self._kept = fresh[np.arange(len(fresh))]  # a copy: those may still be under way
        if np.array_equal(sampled, arrived):
            return fresh
        if fresh is not None:
            self._kept[np.flatnonzero(sampled)] = fresh
        return self._kept[np.flatnonzero(arrived)] if arrived.any() else None


def measure_growth(
    plant: System, protocol: ProtocolSettings, seed: int, method: Driver, *, longest: int = LONGEST
) -> ErrorGrowthTable:
    """Calibrate a method's growth table: one packet, then the loop runs on predicted forces alone.

    Args:
        plant, protocol, seed, method: as for :func:`simulate_cell`; use another seed than there.
        longest: A_max in steps; fewer where the protocol is shorter.
    """
    devices = CALIBRATION_DEVICES
    ages, errors, _ = _without_packets(plant, protocol, seed, method, devices, longest)
    return conformal_growth(ages, errors)


def measure_levels(
    plant: System, protocol: ProtocolSettings, seed: int, method: Driver
) -> LevelDisagreement:
    """Calibrate the disagreement of a method's two levels; arguments as above."""
    devices = 2 * CALIBRATION_DEVICES
    return calibrate_levels(*_without_packets(plant, protocol, seed, method, devices, LONGEST))


def _without_packets(
    plant: System, protocol: ProtocolSettings, seed: int, method: Driver, devices: int, longest: int
) -> tuple[list[int], Floats, Floats]:
    """Return ages [G]; of each device then its force's error and its levels' distance [n, G]."""
    longest = min(longest, protocol.total_steps - 1)
    wanted = sorted({1, 2, longest, *np.geomspace(4, longest, 20).astype(int).tolist()})
    ages = [age for age in wanted if age <= longest]
    # Forces err on after a fall, too, and what is calibrated is how far.
    plants = ScoredPlants(plant, *streamed_draws(protocol, devices, seed), ends=False)
    controller: Any = method.controller(devices)
    everybody, nobody = np.ones(devices, dtype=bool), np.zeros(devices, dtype=bool)
    plants.move(controller.act(everybody, plants.sense(method.sensor, everybody)))
    errors, apart = [], []
    for age in range(1, longest + 1):
        if age in ages:
            errors.append(_innovation(plants, method, everybody, controller.planned_n()))
            apart.append(np.array(getattr(controller, "apart", np.zeros(devices))))
        plants.move(controller.act(nobody, None))
    return ages, np.stack(errors, axis=1), np.stack(apart, axis=1)


def streamed_draws(
    protocol: ProtocolSettings, devices: int, seed: int
) -> tuple[Floats, Floats, Iterator[Floats]]:
    """Make the draws of :class:`~hjepa_cli.core.control.loop.Draws` without keeping them.

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


def _innovation(plants: ScoredPlants, method: Driver, devices: Bools, planned_n: Floats) -> Floats:
    """Return |C(z) − ũ| ÷ the force range: what devices' own packets would change in the force."""
    packets = plants.sense(method.sensor, devices)
    count = int(devices.sum())
    wanted_n = method.reactive(count).act(np.ones(count, dtype=bool), packets)
    error = control_error(planned_n[devices], wanted_n, plants.plant.force_limit_n)
    return np.asarray(error.reshape(count, -1).mean(axis=1))  # over the forces of a device
