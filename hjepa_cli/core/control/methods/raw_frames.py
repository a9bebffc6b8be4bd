"""Methods of this file send camera frames without a codec, act on them and hold the force."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hjepa_cli.core.control.methods.method import Method, training
from hjepa_cli.core.style import Style

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model


def _method(kind: str, frames: int, style: Style, does: str) -> Method:
    """Describe the baseline of an encoder's training method on κ frames."""
    name = f"{kind}-{frames}"

    def build(settings: Settings, model: Model) -> Driver:
        from hjepa_cli.core.control.drivers import Driver, last_force
        from hjepa_cli.core.control.sensors import camera_sensor
        from hjepa_cli.core.plants.conditions import actual_camera
        from hjepa_cli.core.plants.frames import frame_bits

        def act(seen: NDArray[np.uint8]) -> Tensor:
            return model.actor(model.encode(seen).to(model.device))

        bits = frame_bits(settings.camera.frame_shape)
        camera = actual_camera(settings)
        look, drives = camera_sensor(model, camera), last_force(model, act)
        return Driver(name, look, drives, drives, frames * bits, name)

    return Method(
        name,
        "frames",
        build,
        offered=lambda architecture, plant: (
            (architecture["kind"], architecture.get("frames")) == (kind, frames)
        ),
        trained_by=training(f"train-encoder --method {kind} --frames {frames}"),
        compared=True,
        style=style,
        does=f"sends {frames} raw pictures {does}",
    )


_ACTED_ON = "to a network that acts on them"
_RECONSTRUCTED = "that are reconstructed and acted on"
SUPERVISED_2 = _method("supervised", 2, Style("#882255", "P", "--"), _ACTED_ON)
SUPERVISED_4 = _method("supervised", 4, Style("#AA4466", "X", "-."), _ACTED_ON)
AUTOENCODER_2 = _method("autoencoder", 2, Style("#999933", "h", "--"), _RECONSTRUCTED)
