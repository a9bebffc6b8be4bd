"""Closed loops are simulated by description: what to simulate is small, plain data.

So it can be sent to another process: see :mod:`hjepa_cli.core.evaluation.workers`.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from hjepa_cli.config.schema import ProtocolSettings, Settings
from hjepa_cli.core.control.drivers import Driver, build_driver
from hjepa_cli.core.control.loop import Draws, Outcome, simulate
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.conditions import actual_plant

# A loop of `hjepa` costs 1.2 times as much in blocks of 640 as in those of 1,280, and 2 times as
# much in blocks of 260: there the networks' weights are read for few rows (benchmarks/workers.py).
BLOCK_LOOPS = 512

Tick = Callable[[int], None]
"""Told how many device-steps (one control step of one device) are done since the last call."""

Pending = Callable[[], Outcome]
"""Waits for the outcome of what was started."""


def silent(steps: int) -> None:
    """Tell nobody."""


@dataclasses.dataclass(frozen=True)
class Block:
    """Describes some devices of one method at some curve points.

    Attributes:
        method: its name.
        points: the link at each curve point.
        start, stop: devices ``start`` … ``stop`` - 1 of the protocol's.
        reactive: act on packets only, for points that deliver at every step.
    """

    method: str
    points: tuple[Point, ...]
    start: int
    stop: int
    reactive: bool = False

    def compute(self, simulator: "Simulator", tick: Tick) -> Outcome:
        """Simulate the block: outcome arrays [points, stop - start]."""
        driver, draws = simulator.driver(self.method), simulator.draws
        devices = slice(self.start, self.stop)
        # Phases of the gap schedule go by a device's number, so schedules are made for all.
        schedules = np.stack([point.schedule(draws)[:, devices] for point in self.points])
        loops = schedules[:, 0].size
        build = driver.reactive if self.reactive else driver.controller
        return simulate(
            simulator.plant,
            driver.draws(draws.part(devices)),
            schedules,
            build(loops),
            driver.sensor,
            delay_steps=driver.delay_steps,
            tick=lambda: tick(loops),
        )


Runner = Callable[[Sequence[Block], Tick], Callable[[], list[Outcome]]]
"""Starts to simulate blocks, in any order; what it returns waits for them and hands out their
outcomes in the order of the blocks."""


class Simulator:
    """Holds what the units of one model share, and runs blocks in this process: a :data:`Runner`.

    Args:
        settings: plant, protocol and seed, from which the draws follow.
        model: for the methods on embeddings.
    """

    def __init__(self, settings: Settings, model: Model | None) -> None:
        self.settings, self._model = settings, model
        self.plant = actual_plant(settings.plant, settings.conditions)
        self._drivers: dict[str, Driver] = {}

    def __call__(self, blocks: Iterable[Block], tick: Tick) -> Callable[[], list[Outcome]]:
        outcomes = [block.compute(self, tick) for block in blocks]
        return lambda: outcomes

    @property
    def draws(self) -> Draws:
        """Return the draws of all of the protocol's devices."""
        protocol = self.settings.protocol
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        return _draws(protocol, devices, self.settings.seed)

    def driver(self, name: str) -> Driver:
        """Return a method's driver, built and fitted when it is asked for first."""
        if name not in self._drivers:
            self._drivers[name] = build_driver(name, self.settings, self._model)
        return self._drivers[name]


@functools.lru_cache(maxsize=1)
def _draws(protocol: ProtocolSettings, devices: int, seed: int) -> Draws:
    """Draw once for the simulators of several models."""
    return Draws.make(protocol, devices, seed)


def start_points(
    runner: Runner,
    method: str,
    points: Sequence[Point],
    devices: int,
    tick: Tick,
    *,
    reactive: bool = False,
) -> Pending:
    """Start to simulate the first ``devices`` devices at some points; return what waits for it.

    That may be asked twice, and returns outcome arrays [P, devices]. A batch is cut by devices,
    never by points: so its blocks cost the same, whatever each point costs. The cut follows from
    the batch alone, so that results do not depend on how many processes there are.
    """
    count = min(max(len(points) * devices // BLOCK_LOOPS, 1), devices)
    cuts = [devices * number // count for number in range(count + 1)]
    blocks = [
        Block(method, tuple(points), start, stop, reactive)
        for start, stop in itertools.pairwise(cuts)
    ]
    started = runner(blocks, tick)
    return lambda: Outcome.joined(started(), axis=1)
