"""Drivers are methods made ready to drive the devices of one plant with one model.

A method (:mod:`hjepa_cli.core.control.methods`) is a description; what it builds is a
:class:`Driver`: the sensor that runs on each device, and controllers for as many devices as there
are. Methods on embeddings send Ψ(its last κ frames), really rendered, encoded,
quantised and dequantised.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any

from hjepa_cli.config.checks import late, split_late
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.answers import GuardedCoder, GuardedController
from hjepa_cli.core.control.codecs.codec import Coder
from hjepa_cli.core.control.controllers import LastForce
from hjepa_cli.core.control.disagreement import TwoLevels
from hjepa_cli.core.control.embedded_split import sampled_embeddings, sampled_states
from hjepa_cli.core.control.familiarity import PacketCheck, fit_familiarity
from hjepa_cli.core.control.link import confirmation_bits
from hjepa_cli.core.control.loop import Controller, Draws, Sensor
from hjepa_cli.core.control.sensors import camera_sensor, checking_sensor, embedding_sensor
from hjepa_cli.core.control.spoilt import most_changed
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.networks.planning import Planner
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.core.plants.control_law import control_of
from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.core.plants.named import camera_in, plant, seen_as_trained
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import DataError, UsageError, choices
from hjepa_cli.plugins import CODECS, METHODS


@dataclasses.dataclass(frozen=True)
class Driver:
    """Drives the devices in one way.

    Attributes:
        name: of the method, on time or late.
        sensor: what a device sends.
        controller: builds a fresh controller for n devices.
        reactive: builds one that only acts on packets, for links that deliver at every step.
        bits_per_transmission: what a transmission costs.
        family: drivers of one family play the same when a packet arrives at every step; over a
            link that is not ideal each is a family of its own.
        uses_link: whether the method needs one.
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

    def draws(self, draws: Draws) -> Draws:
        """Return the draws that its loops meet: one that sits on the device has no link."""
        return draws if self.uses_link else draws.on_device


def build_driver(name: str, settings: Settings, model: Model | None) -> Driver:
    """Build any method by its name, on time or :func:`~hjepa_cli.config.checks.late`.

    Raises:
        UsageError: no such method, no model that holds it, a lateness that is no number, or a
            plugin's method that builds no driver.
        DataError: the model is of another plant.
    """
    name, steps = split_late(name)
    if model and model.plant_name != settings.plant:
        raise DataError(
            f"the model drives plant {model.plant_name}, not {settings.plant}",
            hint=f'add settings={{"plant": "{model.plant_name}"}}, or pass another model',
        )
    if METHODS[name].needs_model and (model is None or name not in methods_of(model)):
        raise UsageError(f"method '{name}' needs a model of it", hint="hjepa models list")
    if model:
        settings = as_trained(settings, model)
    kind = model.plant if model else plant(settings.plant)
    driver: Driver = guarded(METHODS, name, METHODS[name].build)(settings, model)
    if METHODS.source(name):
        driver = _of_plugin(name, driver, kind.action_shape)
    if not driver.uses_link:
        return dataclasses.replace(driver, name=late(name, steps))
    told = confirmation_bits(settings.protocol, len(kind.force_signs))
    bits = driver.bits_per_transmission + told
    driver = dataclasses.replace(
        driver, name=late(name, steps), delay_steps=steps, bits_per_transmission=bits
    )
    if steps or not settings.protocol.ideal_link:  # a packet at every step leaves much to predict
        driver = dataclasses.replace(driver, reactive=driver.controller, family=driver.name)
    return driver


def _of_plugin(name: str, driver: Driver, action_shape: tuple[int, ...]) -> Driver:
    """Return a driver that a plugin built, whose answers are looked at."""
    if not isinstance(driver, Driver):
        raise METHODS.fault(name, f"method '{name}': build(…) made {driver!r}; expected a Driver")
    for member in ("sensor", "controller", "reactive"):
        if not callable(made := getattr(driver, member)):
            says = f"its driver's {member} = {made!r} is no function"
            raise METHODS.fault(name, f"method '{name}': {says}")
    bits = driver.bits_per_transmission
    if not (isinstance(bits, Integral) and bits >= 0):
        says = f"bits_per_transmission = {bits!r}; expected a whole number of at least 0"
        raise METHODS.fault(name, f"method '{name}': {says}")

    def watched(build: Callable[[int], Any] | None) -> Any:
        def made(devices: int) -> GuardedController:
            assert build is not None
            return GuardedController(name, build(devices), (devices, *action_shape))

        return build and guarded(METHODS, name, made)

    return dataclasses.replace(
        driver,
        sensor=guarded(METHODS, name, driver.sensor),
        controller=watched(driver.controller),
        reactive=watched(driver.reactive),
        two_levels=watched(driver.two_levels),
    )


def as_trained(settings: Settings, model: Model) -> Settings:
    """Return settings with the law that a model learned, and its pictures.

    A ceiling is nobody's to learn: that of the settings stays where the model brings none. A sensor
    that they set stays too.

    Raises:
        DataError: the model holds no valid law.
    """
    record = model.metadata["settings"]
    law = control_of(record, model.digest)
    ceiling = law.ceiling_gains_n or settings.control.ceiling_gains_n
    return dataclasses.replace(
        seen_as_trained(settings, record),
        control=dataclasses.replace(law, ceiling_gains_n=ceiling),
        camera=camera_in(model.architecture),
    )


def embedding_driver(
    name: str,
    settings: Settings,
    model: Model,
    controller: Callable[[int], Controller] | None = None,
    two_levels: Callable[[int], TwoLevels] | None = None,
    family: str = "embedding",
    *,
    checks: bool = False,
) -> Driver:
    """Build a driver on embeddings, which the model's actor answers where a packet arrives.

    Without a ``controller`` for what is in between the last force stays. A ``family`` of its own
    has no other controller for links that deliver at every step, nor has one that ``checks``
    packets, whose devices look at their pictures too.
    """
    coder, hold = coder_of(settings, model), last_force(model)
    camera = actual_camera(settings)
    sensor = embedding_sensor(model, coder.send, camera)
    if checks := checks and settings.protocol.false_alarm > 0:
        seen = camera_sensor(model)(sampled_states(model, settings, "train"))
        sensor = checking_sensor(model, coder.send, camera, most_changed(seen))
    drives = controller or hold
    reactive = drives if checks or family != "embedding" else hold
    bits = CODECS[settings.protocol.payload].bits(model.architecture["embedding"])
    return Driver(name, sensor, drives, reactive, bits, family, two_levels=two_levels)


def last_force(
    model: Model, actor: Callable[[Any], Any] | None = None, *, keep: bool = True
) -> Callable[[int], LastForce]:
    """Return what builds :class:`LastForce` for a model's plant, by default with its actor."""
    shape = model.action_shape
    return functools.partial(LastForce, actor or model.actor, keep=keep, action_shape=shape)


def coder_of(settings: Settings, model: Model) -> Coder:
    """Return what the settings' payload sends a model's embeddings through.

    Raises UsageError for no such payload, or one that the model's embeddings do not suit.
    """
    name = settings.protocol.payload
    coder: Coder = guarded(CODECS, name, CODECS[name].fit)(model, settings)
    return GuardedCoder(name, coder) if CODECS.source(name) else coder


@functools.lru_cache(maxsize=2)  # methods of one run share it
def check_of(settings: Settings, model: Model) -> Callable[[int], PacketCheck] | None:
    """Return what makes a check of packets, fitted to a model's; ``None`` where there is none."""
    protocol = settings.protocol
    if not protocol.false_alarm:
        return None
    coder = coder_of(settings, model)
    train, test = (
        coder.send(sampled_embeddings(model, settings, split)) for split in ("train", "test")
    )
    familiarity = fit_familiarity(train, test, protocol.false_alarm)
    return functools.partial(PacketCheck, familiarity, protocol.flagged_in_row)


def methods_of(model: Model) -> tuple[str, ...]:
    """Return what a model can drive its own plant with."""
    return offered_methods(model.architecture, model.plant)


def offered_methods(architecture: Mapping[str, Any], kind: System) -> tuple[str, ...]:
    """Return the methods that a model of this architecture can drive a plant with."""
    offers = (method.offers(architecture, kind) for method in METHODS.values())
    return tuple(name for names in offers for name in names)


def planner_of(model: Model, method: str) -> Planner:
    """Return the planner behind ``method``.

    Raises:
        UsageError: this model does not predict with that method.
    """
    planners = {name: made for name in methods_of(model) if (made := METHODS[name].planner)}
    if method not in planners:
        raise UsageError(f"this model has no planner '{method}'; {choices(method, planners)}")
    planner: Planner = planners[method](model)
    return planner
