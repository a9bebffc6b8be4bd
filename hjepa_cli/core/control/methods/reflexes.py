"""Methods of ``train-reflex`` answer the last packet by its age, without a predictor."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

from hjepa_cli.core.control.methods.method import Method, training
from hjepa_cli.core.style import Style

if TYPE_CHECKING:
    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.control.loop import Controller
    from hjepa_cli.core.networks.model import Model


def _decaying(name: str, model: Model) -> Callable[[int], Controller]:
    from hjepa_cli.core.control.controllers import LastForce

    decay = model.decays[name]
    return functools.partial(
        LastForce,
        model.law if name == "hold-decay-linear" else model.actor,
        gain=decay.gain,
        tau_steps=decay.tau_steps,
        force_limit_n=model.force_limit_n,
        action_shape=model.action_shape,
    )


def _chunked(name: str, model: Model) -> Callable[[int], Controller]:
    from hjepa_cli.core.control.controllers import ReflexController
    from hjepa_cli.core.control.planners import ReflexReaction

    reaction = ReflexReaction(model, model.networks[name.replace("-", "_")])
    return functools.partial(ReflexController, reaction, action_shape=model.action_shape)


def _method(
    name: str,
    controller: Callable[[str, Model], Callable[[int], Controller]],
    style: Style,
    does: str,
) -> Method:
    def build(settings: Settings, model: Model) -> Driver:
        from hjepa_cli.core.control.drivers import embedding_driver

        return embedding_driver(name, settings, model, controller(name, model), family=name)

    return Method(
        name,
        "embedding",
        build,
        offered=lambda architecture, plant: architecture["kind"] == "reflex",
        trained_by=training("train-reflex"),
        reflex=True,
        style=style,
        does=does,
    )


HOLD_DECAY = _method(
    "hold-decay",
    _decaying,
    Style("#9467BD", "^", "-.", hollow=True, size=5.0),
    "acts on each packet, and its force fades with the packet's age; no prediction",
)
HOLD_DECAY_LINEAR = _method(
    "hold-decay-linear",
    _decaying,
    Style("#6A3D9A", ">", "--", hollow=True, size=5.0),
    "as hold-decay, with a linear law that was made to fade",
)
CHUNK = _method(
    "chunk",
    _chunked,
    Style("#117733", "X", "--", hollow=True, size=5.0),
    "a network answers a packet and its age with the next forces; no prediction",
)
CHUNK_FORCES = _method(
    "chunk-forces",
    _chunked,
    Style("#66A61E", "P", "-.", hollow=True, size=5.0),
    "as chunk, and it is told the forces that were sent meanwhile",
)
