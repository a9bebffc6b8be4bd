"""Closed-loop simulations by description: what to simulate is small, plain data.

So it can be sent to another process: see :mod:`hjepa_cli.core.workers`.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from hjepa_cli.core.conditions import actual_plant
from hjepa_cli.core.loop import Draws, Outcome, simulate
from hjepa_cli.core.methods import Method, build_method
from hjepa_cli.core.model import Model
from hjepa_cli.core.protocol import Point
from hjepa_cli.settings import Settings

BLOCK_DEVICES = 128
SMALL_DEVICES = 32  # not worth a second process


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


Tick = Callable[[int], None]
"""Told how many device-steps (one control step of one device) are done since the last call."""

Runner = Callable[[Sequence[Block], Tick], list[Outcome]]
"""Simulates blocks, in any order, and returns their outcomes in the order of the blocks."""


class Simulator:
    """Simulates blocks one after the other, in this process.

    Args:
        settings: plant, protocol and seed, from which the draws follow.
        model: for the methods on embeddings.
    """

    def __init__(self, settings: Settings, model: Model | None) -> None:
        protocol = settings.protocol
        devices = max(protocol.curve_devices, protocol.bracket_devices)
        self._settings, self._model = settings, model
        self._plant = actual_plant(settings)
        self._draws = Draws.make(protocol, devices, settings.seed)
        self._methods: dict[str, Method] = {}

    def __call__(self, blocks: Iterable[Block], tick: Tick) -> list[Outcome]:
        return [self.run(block, tick) for block in blocks]

    def run(self, block: Block, tick: Tick) -> Outcome:
        """Simulate one block: outcome arrays [points, stop - start]."""
        if block.method not in self._methods:
            method = build_method(block.method, self._settings, self._model)
            self._methods[block.method] = method
        method = self._methods[block.method]
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


def run_points(
    runner: Runner,
    method: str,
    points: Sequence[Point],
    devices: int,
    tick: Tick,
    *,
    reactive: bool = False,
) -> Outcome:
    """Simulate the first ``devices`` devices at some points: outcome arrays [P, devices].

    The devices are cut into blocks, two at least unless they are few, and always the same ones, so
    that results do not depend on how many processes there are.
    """
    size = min(BLOCK_DEVICES, max(-(-devices // 2), SMALL_DEVICES))
    blocks = [
        Block(method, tuple(points), start, min(start + size, devices), reactive)
        for start in range(0, devices, size)
    ]
    outcomes = runner(blocks, tick)
    return Outcome.joined(outcomes, axis=1)
