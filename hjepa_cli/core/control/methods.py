"""What each method name means: what its devices send, and what its controller does with it.

Methods on embeddings send Ψ(previous frame, current frame), really rendered, encoded, quantised
and dequantised. Methods on raw frames send the pictures. Methods on the true state are anchors:
what prediction could gain at best (``oracle``), what it has to beat (``hold-true``,
``zero-true``), and the teacher (``optimal``).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.config.checks import RAW_FRAMES, REFLEXES, TRUE_STATE, late, split_late
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.control.codecs import Codec, bits_of, build_codec
from hjepa_cli.core.control.controllers import LastForce, Oracle, StrideController
from hjepa_cli.core.control.disagreement import TwoLevels
from hjepa_cli.core.control.kalman import KalmanController, fit_state_reader
from hjepa_cli.core.control.linear_latent import LinearPlanner, fit_linear_latent
from hjepa_cli.core.control.loop import Controller, Sensor
from hjepa_cli.core.control.reflex_controllers import DecayingHold, ReflexController
from hjepa_cli.core.control.sensors import camera_sensor, embedding_sensor, true_state
from hjepa_cli.core.networks.planning import Planner
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.core.plants.frames import CHANNELS, HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import Camera, System
from hjepa_cli.errors import DataError, UsageError

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

FRAME_BITS = HEIGHT_PX * WIDTH_PX * CHANNELS * 8


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
        uses_link: ``False`` for ``optimal`` and ``local``, which need none.
        two_levels: builds the controller with a second level beside it, where the method has two.
        delay_steps: how long its packets are under way.
    """

    name: str
    sensor: Sensor
    controller: Callable[[int], Controller]
    reactive: Callable[[int], Controller]
    bits_per_transmission: int
    family: str
    uses_link: bool = True
    two_levels: Callable[[int], TwoLevels] | None = None
    delay_steps: int = 0


def build_method(name: str, settings: Settings, model: "Model | None") -> Method:
    """Any method by its name, on time or :func:`~hjepa_cli.config.checks.late`, as the settings want it.

    Raises:
        UsageError: there is no model that holds it, or a lateness that is no number.
        DataError: the model is of another plant.
    """
    name, steps = split_late(name)
    if model and model.plant_name != settings.plant:
        raise DataError(
            f"the model drives plant {model.plant_name}, not {settings.plant}",
            hint=f'add settings={{"plant": "{model.plant_name}"}}, or pass another model',
        )
    method = _build_method(name, settings, model)
    return dataclasses.replace(
        method, name=late(name, steps), family=late(method.family, steps), delay_steps=steps
    )


def _build_method(name: str, settings: Settings, model: "Model | None") -> Method:
    payload = settings.protocol.payload
    if name in TRUE_STATE:
        trained = model.architecture if model else settings.as_dict()["encoder"]
        sent = bits_of(payload, trained["embedding"])
        return true_state_method(name, plant(settings.plant), sent)
    if model is None or name not in model.methods:
        raise UsageError(f"method '{name}' needs a model of it", hint="hjepa models list")
    camera = actual_camera(settings)
    if name in RAW_FRAMES:
        return frames_method(name, model, camera)
    if name == "local":
        return local_method(model, camera)
    if name in ("state-kf", "state-48"):
        return filtered_method(name, model, settings)
    codec = build_codec(payload, model, settings)
    if name in REFLEXES:
        return reflex_method(name, model, codec, camera)
    if name == "linear":
        latent = fit_linear_latent(model, settings)
        planner = LinearPlanner(latent, model.actor, model.force_limit_n)
        return embedding_method(name, model, codec, planner, camera)
    return embedding_method(name, model, codec, camera=camera)


def true_state_method(name: str, kind: System, bits_per_transmission: int) -> Method:
    """One of :data:`~hjepa_cli.config.checks.TRUE_STATE`.

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


def embedding_method(
    name: str,
    model: "Model",
    codec: Codec,
    planner: Planner | None = None,
    camera: Camera | None = None,
) -> Method:
    """A method that lives on a trained model's embeddings.

    Args:
        name: the method.
        model: encoder, actor and, unless given, planner.
        codec: what embeddings are sent through.
        planner: one that is not the model's.
        camera: as for :func:`~hjepa_cli.core.control.sensors.camera_sensor`.

    Raises:
        UsageError: the model does not hold this method.
    """
    last_force = functools.partial(LastForce, model.actor, action_shape=model.action_shape)
    reactive = functools.partial(last_force, keep=True)
    build: Callable[[int], Controller] = reactive
    if name == "zero":
        build = functools.partial(last_force, keep=False)
    elif name != "hold":
        planner, shape = planner or model.planner(name), model.action_shape
        build = functools.partial(StrideController, planner, action_shape=shape)
    sensor = embedding_sensor(model, codec, camera)
    two_levels = functools.partial(_two_levels, model) if name == "hjepa" else None
    return Method(name, sensor, build, reactive, codec.bits, "embedding", two_levels=two_levels)


def reflex_method(name: str, model: "Model", codec: Codec, camera: Camera | None = None) -> Method:
    """One of :data:`~hjepa_cli.config.checks.REFLEXES`; arguments as of :func:`embedding_method`."""
    shape = model.action_shape
    build: Callable[[int], Controller]
    if name in model.decays:
        decay = model.decays[name]
        actor = model.law if name == "hold-decay-linear" else model.actor
        values = actor, decay.gain, decay.tau_steps, model.force_limit_n
        build = functools.partial(DecayingHold, *values, action_shape=shape)
    else:
        build = functools.partial(ReflexController, model.reaction(name), action_shape=shape)
    sensor = embedding_sensor(model, codec, camera)
    return Method(name, sensor, build, build, codec.bits, name)


def frames_method(name: str, model: "Model", camera: Camera | None = None) -> Method:
    """A baseline whose controller receives camera frames, acts on them and holds the force."""

    def act(frames: NDArray[np.uint8]) -> Tensor:
        return model.actor(model.encode(frames).to(model.device))

    build = functools.partial(LastForce, act, keep=True, action_shape=model.action_shape)
    look, bits = camera_sensor(model, camera), model.frames * FRAME_BITS
    return Method(name, look, build, build, bits, name)


def local_method(model: "Model", camera: Camera | None = None) -> Method:
    """The actor on the device, at every step on what the camera shows: nothing is sent."""
    shape, sensor = model.action_shape, embedding_sensor(model, None, camera)
    build = functools.partial(LastForce, model.actor, keep=True, action_shape=shape)
    return Method("local", sensor, build, build, 0, "local", uses_link=False)


def filtered_method(name: str, model: "Model", settings: Settings) -> Method:
    """``state-kf`` decodes states at the controller, ``state-48`` on the device."""
    kind = plant(model.plant_name)
    controls = kind.teacher(), kind.force_limit_n
    if name == "state-kf":
        codec = build_codec(settings.protocol.payload, model, settings)
        reader = fit_state_reader(model, settings, codec.send)
        build = functools.partial(KalmanController, reader.filter, reader.read, *controls)
        received = embedding_sensor(model, codec, actual_camera(settings))
        return Method(name, received, build, build, codec.bits, name)
    reader = fit_state_reader(model, settings)
    fresh = embedding_sensor(model, None, actual_camera(settings))
    build = functools.partial(KalmanController, reader.quantised, np.asarray, *controls)
    sensor: Sensor = lambda seen: reader.codec.send(reader.read(fresh(seen)))  # noqa: E731
    return Method(name, sensor, build, build, reader.codec.bits, name)


def _two_levels(model: "Model", devices: int) -> TwoLevels:
    planner, shape = model.planner("hjepa"), model.action_shape
    hierarchical = StrideController(planner, devices, action_shape=shape)
    return TwoLevels(hierarchical, model.single_step, model.actor, model.force_limit_n)
