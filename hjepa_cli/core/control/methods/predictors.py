"""Methods ``hjepa``, ``ts-jepa-N`` and ``linear`` predict embeddings between packets.

N is any depth; ``linear`` is fitted in closed form.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from hjepa_cli.core.control.methods.method import Method, MethodFamily, of_hierarchy, training
from hjepa_cli.core.style import Style

if TYPE_CHECKING:
    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.controllers import StrideController
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.networks.planning import Planner


def predictor(
    name: str, planner: Callable[[Model], Planner], *, fused: bool = False, **about: Any
) -> Method:
    """Describe a method that plays a model's predictor, a stride at a time.

    Args:
        name: of the method.
        planner: makes the planner from a model that offers the method.
        fused: packets correct what was predicted, by the model's posterior, and do not replace it.
        about: the other fields of :class:`~hjepa_cli.core.control.methods.method.Method`.
    """

    def build(settings: Settings, model: Model) -> Driver:
        from hjepa_cli.core.control.controllers import FusingController
        from hjepa_cli.core.control.disagreement import TwoLevels
        from hjepa_cli.core.control.drivers import check_of, embedding_driver
        from hjepa_cli.core.control.planners import OnePredictor

        made: Any = planner(model)
        drives = _strides(settings, model, made)
        if fused:
            drives = functools.partial(
                FusingController,
                made,
                action_shape=model.action_shape,
                check=check_of(settings, model),
                correct=made.correct,
            )

        def two_levels(devices: int) -> TwoLevels:
            step = OnePredictor(model, model.networks["flat"], 1).step
            return TwoLevels(drives(devices), step, model.actor, model.force_limit_n)

        second = two_levels if planner is _hierarchy else None
        family = name if fused else "embedding"  # a packet is not all that it plays by
        return embedding_driver(name, settings, model, drives, second, family, checks=True)

    return Method(name, "embedding", build, planner=planner, **about)


def _strides(
    settings: Settings, model: Model, planner: Planner
) -> Callable[[int], StrideController]:
    from hjepa_cli.core.control.controllers import StrideController
    from hjepa_cli.core.control.drivers import check_of

    check, shape = check_of(settings, model), model.action_shape
    return functools.partial(StrideController, planner, action_shape=shape, check=check)


def _hierarchy(model: Model) -> Planner:
    from hjepa_cli.core.control.planners import Hierarchy

    return Hierarchy(model)


HJEPA = predictor(
    "hjepa",
    _hierarchy,
    offered=lambda architecture, plant: architecture["kind"] == "hierarchy",
    trained_by=training("train-hierarchy"),
    compared=True,
    style=Style("#0072B2", "o", size=7.0),
    does="predicts the embedding in three strides: a long one, and two that fill it in",
)

HJEPA_FUSED = predictor(
    "hjepa-fused",
    _hierarchy,
    fused=True,
    offered=lambda architecture, plant: (
        architecture["kind"] == "hierarchy" and bool(architecture.get("fusion"))
    ),
    trained_by=training("train-fusion"),
    style=Style("#00366B", "H", ":", size=7.0),
    does="as hjepa, but a packet corrects what was predicted for its time",
)

_STYLES = {  # of the depths that the paper compares
    1: Style("#D55E00", "s", "--", size=2.8),
    2: Style("#56B4E9", "<", "--"),
    3: Style("#6C8EBF", ">", "-."),
    4: Style("#009E73", "^", "-.", size=5.0),
    5: Style("#5F7A8C", "p", ":"),
}


def _ts_jepa(name: str) -> Method | None:
    found = re.fullmatch(r"ts-jepa-([1-9]\d{0,4})", name)
    if not found:
        return None
    depth = int(found[1])

    def planner(model: Model) -> Planner:
        from hjepa_cli.core.control.planners import OnePredictor

        return OnePredictor(model, model.networks["flat" if depth == 1 else "high"], depth)

    return predictor(
        name,
        planner,
        offered=lambda architecture, plant: (
            of_hierarchy(architecture, plant) and depth in (1, architecture["h"])
        ),
        trained_by=training("train-hierarchy", f" --h {depth}" if depth > 1 else ""),
        compared=depth in _STYLES,
        style=_STYLES.get(depth),
        does=f"predicts the embedding with one network, {depth} step{'s' * (depth > 1)} at a time",
    )


TS_JEPA = MethodFamily(
    "ts-jepa-N",
    _ts_jepa,
    lambda architecture: (f"ts-jepa-{architecture.get('h')}", "ts-jepa-1"),
)


def _linear(settings: Settings, model: Model) -> Driver:
    from hjepa_cli.core.control.drivers import embedding_driver
    from hjepa_cli.core.control.linear_latent import LinearPlanner, fit_linear_latent

    planner = LinearPlanner(fit_linear_latent(model, settings), model.actor, model.force_limit_n)
    return embedding_driver(
        "linear", settings, model, _strides(settings, model, planner), checks=True
    )


LINEAR = Method(
    "linear",
    "embedding",
    _linear,
    offered=of_hierarchy,
    trained_by=training("train-hierarchy"),
    fitted=True,
    style=Style("#44AA99", "d", "--"),
    does="predicts the embedding with a linear map, fitted in closed form",
)
