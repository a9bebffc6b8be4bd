"""Closed-loop simulations by description: what to simulate is small, plain data.

So it can be sent to another process: see :mod:`hjepa_cli.core.evaluation.workers`.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from hjepa_cli.config.settings import ProtocolSettings, Settings
from hjepa_cli.core.control.loop import Draws, Outcome, simulate
from hjepa_cli.core.control.methods import Method, build_method
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
    """A tick that nobody watches."""


class Unit(Protocol):
    """What is to be computed, as plain data."""

    def compute(self, simulator: "Simulator", tick: Tick) -> Any:
        """Compute it in the process that has the simulator."""
        ...


@dataclasses.dataclass(frozen=True)
class Block:
    """Some devices of one method at some curve points.

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
        return simulator.simulate(self, tick)


Runner = Callable[[Sequence[Block], Tick], Callable[[], list[Outcome]]]
"""Starts to simulate blocks, in any order; what it returns waits for them and hands out their
outcomes in the order of the blocks."""


class Simulator:
    """Simulates blocks one after the other, in this process: a :data:`Runner`.

    Args:
        settings: plant, protocol and seed, from which the draws follow.
        model: for the methods on embeddings.
    """

    def __init__(self, settings: Settings, model: Model | None) -> None:
        protocol = settings.protocol
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        self.settings, self._model = settings, model
        self._plant = actual_plant(settings)
        self._draws = _draws(protocol, devices, settings.seed)
        self._methods: dict[str, Method] = {}

    def __call__(self, blocks: Iterable[Block], tick: Tick) -> Callable[[], list[Outcome]]:
        outcomes = [self.simulate(block, tick) for block in blocks]
        return lambda: outcomes

    def run(self, unit: Unit, tick: Tick) -> Any:
        """Compute a unit."""
        return unit.compute(self, tick)

    def method(self, name: str) -> Method:
        """A method, built and fitted when it is asked for first."""
        if name not in self._methods:
            self._methods[name] = build_method(name, self.settings, self._model)
        return self._methods[name]

    def simulate(self, block: Block, tick: Tick) -> Outcome:
        """Simulate one block: outcome arrays [points, stop - start]."""
        method = self.method(block.method)
        devices = slice(block.start, block.stop)
        # Phases of the gap schedule go by a device's number, so schedules are made for all.
        schedules = np.stack([point.schedule(self._draws)[:, devices] for point in block.points])
        loops = schedules[:, 0].size
        build = method.reactive if block.reactive else method.controller
        return simulate(
            self._plant,
            self._draws.part(devices),
            schedules,
            build(loops),
            method.sensor,
            delay_steps=method.delay_steps,
            tick=lambda: tick(loops),
        )


@functools.lru_cache(maxsize=1)
def _draws(protocol: ProtocolSettings, devices: int, seed: int) -> Draws:
    """The draws that the simulators of several models share."""
    return Draws.make(protocol, devices, seed)


def run_points(
    runner: Runner,
    method: str,
    points: Sequence[Point],
    devices: int,
    tick: Tick,
    *,
    reactive: bool = False,
) -> Outcome:
    """Simulate the first ``devices`` devices at some points: outcome arrays [P, devices]."""
    return start_points(runner, method, points, devices, tick, reactive=reactive)()


def start_points(
    runner: Runner,
    method: str,
    points: Sequence[Point],
    devices: int,
    tick: Tick,
    *,
    reactive: bool = False,
) -> Pending:
    """Start :func:`run_points`; what is returned waits for its result, and may be asked twice.

    A batch is cut by devices, never by points: so its blocks cost the same, whatever each point
    costs. The cut follows from the batch alone, so that results do not depend on how many
    processes there are.
    """
    count = min(max(len(points) * devices // BLOCK_LOOPS, 1), devices)
    cuts = [devices * number // count for number in range(count + 1)]
    blocks = [
        Block(method, tuple(points), start, stop, reactive)
        for start, stop in itertools.pairwise(cuts)
    ]
    started = runner(blocks, tick)
    return lambda: Outcome.joined(started(), axis=1)
