"""What each method name means: what its devices send, and what its controller does with it.

Methods on embeddings send Ψ(previous frame, current frame), really rendered, encoded, quantised
and dequantised. Methods on the true state are anchors: what prediction could gain at best
(``oracle``), what it has to beat (``hold-true``, ``zero-true``), and the teacher (``optimal``).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.checks import TRUE_STATE
from hjepa_cli.core.codecs import Codec, bits_of, build_codec
from hjepa_cli.core.controllers import LastForce, Oracle, StrideController
from hjepa_cli.core.disagreement import TwoLevels
from hjepa_cli.core.loop import Controller, Sensor
from hjepa_cli.core.plant import plant
from hjepa_cli.core.system import Floats, System
from hjepa_cli.errors import UsageError
from hjepa_cli.settings import Settings

if TYPE_CHECKING:
    from hjepa_cli.core.model import Model

SENSOR_BATCH = 256  # frame pairs rendered and encoded at a time: 12 MiB


@dataclasses.dataclass(frozen=True)
class Method:
    """One way to drive the devices.

    Attributes:
        name: as on the command line.
        sensor: what a device sends.
        controller: builds a fresh controller for n devices.
        reactive: builds one that only acts on packets, for links that deliver at every step.
        bits_per_transmission: what a transmission costs.
        family: methods of one family play the same when a packet arrives at every step.
        uses_link: ``False`` for ``optimal``, which sees every state whatever the link does.
        two_levels: builds the controller with a second level beside it, where the method has two.
    """

    name: str
    sensor: Sensor
    controller: Callable[[int], Controller]
    reactive: Callable[[int], Controller]
    bits_per_transmission: int
    family: str
    uses_link: bool = True
    two_levels: Callable[[int], TwoLevels] | None = None


def build_method(name: str, settings: Settings, model: "Model | None") -> Method:
    """Any method by its name, as the settings want it.

    Raises:
        UsageError: there is no model that holds it.
    """
    payload = settings.protocol.payload
    if name in TRUE_STATE:
        sent = bits_of(payload, settings.encoder.embedding)
        return true_state_method(name, plant(settings.plant), sent)
    if model is None:
        raise UsageError(f"method '{name}' needs a model", hint="hjepa train-hierarchy")
    return embedding_method(name, model, build_codec(payload, model, settings))


def true_state_method(name: str, kind: System, bits_per_transmission: int) -> Method:
    """One of :data:`~hjepa_cli.checks.TRUE_STATE`.

    Args:
        name: the method.
        kind: the nominal plant: its teacher and, for the oracle, its equations.
        bits_per_transmission: counted as if embeddings were sent, so that device counts differ by
            control alone.
    """
    act = kind.teacher()
    last_force = functools.partial(LastForce, act, action_shape=kind.action_shape)
    reactive = functools.partial(last_force, keep=True)
    build: Callable[[int], Controller] = reactive
    if name == "oracle":
        states = len(kind.state_names)
        build = functools.partial(Oracle, act, kind.advance, kind.force_limit_n, states=states)
    elif name == "zero-true":
        build = functools.partial(last_force, keep=False)
    uses_link = name != "optimal"
    return Method(name, true_state, build, reactive, bits_per_transmission, "state", uses_link)


def embedding_method(name: str, model: "Model", codec: Codec) -> Method:
    """A method that lives on a trained model's embeddings.

    Raises:
        UsageError: the model does not hold this method.
    """
    last_force = functools.partial(LastForce, model.actor, action_shape=model.action_shape)
    reactive = functools.partial(last_force, keep=True)
    build: Callable[[int], Controller] = reactive
    if name == "zero":
        build = functools.partial(last_force, keep=False)
    elif name != "hold":
        planner, shape = model.planner(name), model.action_shape
        build = functools.partial(StrideController, planner, action_shape=shape)
    sensor = embedding_sensor(model, codec)
    two_levels = functools.partial(_two_levels, model) if name == "hjepa" else None
    return Method(name, sensor, build, reactive, codec.bits, "embedding", two_levels=two_levels)


def true_state(previous: Floats, states: Floats) -> Floats:
    """Sensor: the state itself, exact."""
    return states


def embedding_sensor(model: "Model", codec: Codec) -> Callable[[Floats, Floats], Tensor]:
    """Sensor: render the last two frames, encode, send through the codec."""
    camera = plant(model.plant_name).camera()

    def sense(previous: Floats, states: Floats) -> Tensor:
        """States [m, S] one step before and now → received embeddings [m, D]."""
        pairs = np.stack([previous, states], axis=1)
        received = []
        for start in range(0, len(pairs), SENSOR_BATCH):
            frames = camera.render(pairs[start : start + SENSOR_BATCH].reshape(-1, states.shape[1]))
            z = model.encode(frames.reshape(-1, 2, *frames.shape[1:]))
            received.append(codec.send(z))
        return torch.cat(received).to(model.device)

    return sense


def _two_levels(model: "Model", devices: int) -> TwoLevels:
    planner, shape = model.planner("hjepa"), model.action_shape
    hierarchical = StrideController(planner, devices, action_shape=shape)
    return TwoLevels(hierarchical, model.single_step, model.actor, model.force_limit_n)
