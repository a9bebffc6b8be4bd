"""Methods ``hold`` and ``zero`` act on each packet, then keep that force, or none.

``local`` acts on the device, at every step on what its camera shows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hjepa_cli.core.control.methods.method import Method, of_hierarchy, training
from hjepa_cli.core.style import DASH_DOT_DOT, Style

if TYPE_CHECKING:
    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model


def _method(name: str, *, keep: bool, style: Style, does: str) -> Method:
    def build(settings: Settings, model: Model) -> Driver:
        from hjepa_cli.core.control.drivers import embedding_driver, last_force

        return embedding_driver(name, settings, model, last_force(model, keep=keep))

    return Method(
        name,
        "embedding",
        build,
        offered=of_hierarchy,
        trained_by=training("train-hierarchy"),
        compared=True,
        style=style,
        does=does,
    )


def _local(settings: Settings, model: Model) -> Driver:
    from hjepa_cli.core.control.drivers import Driver, last_force
    from hjepa_cli.core.control.sensors import embedding_sensor
    from hjepa_cli.core.plants.conditions import actual_camera

    camera = actual_camera(settings)
    sensor, drives = embedding_sensor(model, camera=camera), last_force(model)
    return Driver("local", sensor, drives, drives, 0, "local", uses_link=False)


HOLD = _method(
    "hold",
    keep=True,
    style=Style("#CC79A7", "v", ":"),
    does="acts on each packet and keeps that force until the next one",
)
ZERO = _method(
    "zero",
    keep=False,
    style=Style("#E69F00", "D", DASH_DOT_DOT, size=3.5),
    does="acts on each packet, then exerts no force until the next one",
)
LOCAL = Method(
    "local",
    "nothing",
    _local,
    offered=of_hierarchy,
    trained_by=training("train-hierarchy"),
    needs_link=False,
    style=Style("#595959", "s", ":", hollow=True, size=6.5),
    does="acts on the device itself at every step, and needs no radio",
)
