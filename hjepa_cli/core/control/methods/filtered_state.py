"""Methods ``state-kf`` and ``state-48`` have a decoded state, a Kalman filter and the teacher.

``state-kf`` decodes states at the controller, ``state-48`` on the device, which sends them.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from hjepa_cli.core.control.methods.method import Architecture, Method, of_hierarchy, training
from hjepa_cli.core.style import Style
from hjepa_cli.plugins import PLANTS

if TYPE_CHECKING:
    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.plants.system import System


def _decoded_at_the_controller(settings: Settings, model: Model) -> Driver:
    from hjepa_cli.core.control.drivers import coder_of, embedding_driver
    from hjepa_cli.core.control.kalman import KalmanController, fit_state_reader
    from hjepa_cli.core.plants.control_law import control_law

    kind = PLANTS[model.plant_name]
    reader = fit_state_reader(model, settings, coder_of(settings, model).send)
    controls = reader.filter, reader.read, control_law(kind, settings.control), kind.force_limit_n
    drives = functools.partial(KalmanController, *controls)
    return embedding_driver("state-kf", settings, model, drives, family="state-kf")


def _decoded_on_the_device(settings: Settings, model: Model) -> Driver:
    import numpy as np

    from hjepa_cli.core.arrays import Floats
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.control.kalman import KalmanController, fit_state_reader
    from hjepa_cli.core.control.sensors import embedding_sensor
    from hjepa_cli.core.plants.conditions import actual_camera
    from hjepa_cli.core.plants.control_law import control_law

    kind, reader = PLANTS[model.plant_name], fit_state_reader(model, settings)
    act = control_law(kind, settings.control)
    controls = reader.quantised, np.asarray, act, kind.force_limit_n
    drives = functools.partial(KalmanController, *controls)
    camera = actual_camera(settings)
    embed = embedding_sensor(model, camera=camera)

    def sense(seen: Floats) -> Floats:
        return reader.codec.send(reader.read(embed(seen)))

    return Driver("state-48", sense, drives, drives, reader.codec.bits, "state-48")


def _offered_to_four_states(architecture: Architecture, plant: System) -> bool:
    return of_hierarchy(architecture, plant) and len(plant.state_names) == 4


def _training_of_four_states(settings: Settings) -> str:
    if len(PLANTS[settings.plant].state_names) != 4:
        return "state-48 is for plants of four states"
    return training("train-hierarchy")(settings)


STATE_KF = Method(
    "state-kf",
    "embedding",
    _decoded_at_the_controller,
    offered=of_hierarchy,
    trained_by=training("train-hierarchy"),
    fitted=True,
    style=Style("#332288", "*", "--", size=5.5),
    does="reads the state off the embedding and tracks it with a Kalman filter",
)
STATE_48 = Method(
    "state-48",
    "decoded state",
    _decoded_on_the_device,
    offered=_offered_to_four_states,
    trained_by=_training_of_four_states,
    fitted=True,
    style=Style("#8A7FD1", "8", "-."),
    does="as state-kf, but a device sends four states of 12 bits",
)
