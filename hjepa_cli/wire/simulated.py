"""A simulated plant is its own camera and actuator, and moves when its force is played."""

from collections.abc import Iterator

import numpy as np

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.control.loop import ScoredPlants, device_draws, noise_per_step
from hjepa_cli.core.plants.frames import Camera
from hjepa_cli.core.plants.system import System
from hjepa_cli.wire.runtime import Singles


class SimulatedPlant:
    """A device's plant: one control step goes by whenever forces are played.

    Args:
        plant, camera: what it is, and what looks at it.
        protocol: its start and its gusts, those of device ``number`` of ``seed``.
    """

    def __init__(
        self, plant: System, camera: Camera, protocol: ProtocolSettings, seed: int, number: int
    ) -> None:
        initial, mass_scale, _, stream = device_draws(protocol, seed, number)
        scale = noise_per_step(protocol)

        def gusts() -> Iterator[Floats]:
            while True:
                yield stream.standard_normal((1, scale.size)) * scale

        self._camera, self._shape = camera, (1, *plant.action_shape)
        self.plants = ScoredPlants(plant, initial[None], mass_scale[None], gusts())
        self.steps = 0

    def read(self) -> Pixels:
        """Return the picture of now."""
        return np.asarray(self._camera.render(self.plants.states)[0])

    def play(self, forces_n: Singles) -> None:
        """Let a control step go by under forces [m]."""
        self.plants.move(np.asarray(forces_n, np.float64).reshape(self._shape))
        self.steps += 1

    def close(self) -> None:
        """Do nothing."""

    @property
    def score(self) -> float:
        """Return the share of steps in the band so far."""
        return float(self.plants.score[0]) / max(self.steps, 1)
