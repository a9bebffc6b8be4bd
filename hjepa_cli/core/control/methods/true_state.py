"""Methods of this file get the true state, which no network limits.

They tell what prediction could gain at best (``oracle``), what it has to beat (``hold-true``,
``zero-true``), and what the teacher does at every step (``optimal``). All but ``optimal`` play the
law that models learn; ``oracle-teacher`` plays the plant's own teacher, whatever models learn, and
``ceiling`` the best law that was found without asking whether an actor can learn it.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from hjepa_cli.core.control.methods.method import Method
from hjepa_cli.core.style import DASH_DOT_DOT, Style
from hjepa_cli.plugins import CODECS

if TYPE_CHECKING:
    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.plants.system import System, Teacher


def true_state_driver(
    name: str, kind: System, bits_per_transmission: int, act: Teacher | None = None
) -> Driver:
    """Build one of this file's methods for a nominal plant: a law, and its equations.

    ``act`` is the law, by default the plant's own teacher. Bits are counted as if embeddings were
    sent, so that device counts differ by control alone.
    """
    from hjepa_cli.core.control.controllers import LastForce, Oracle
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.control.sensors import true_state

    family = "state"
    if act is None or act is kind.teacher():
        act = kind.teacher()
    else:
        family = "ceiling" if name == "ceiling" else "law"
    last_force = functools.partial(LastForce, act, action_shape=kind.action_shape)
    reactive = functools.partial(last_force, keep=True)
    drives: Any = reactive
    if name in ("oracle", "oracle-teacher", "ceiling"):
        states, shape = len(kind.state_names), kind.action_shape
        exactly = functools.partial(Oracle, act, kind.advance, kind.force_limit_n)
        drives = functools.partial(exactly, states=states, action_shape=shape)
    elif name == "zero-true":
        drives = functools.partial(last_force, keep=False)
    uses_link = name != "optimal"
    return Driver(name, true_state, drives, reactive, bits_per_transmission, family, uses_link)


def _method(name: str, style: Style, **about: Any) -> Method:
    def build(settings: Settings, model: Model | None) -> Driver:
        from hjepa_cli.core.plants.control_law import ceiling_law, control_law
        from hjepa_cli.core.plants.named import plant

        embedding = model.architecture["embedding"] if model else settings.encoder.embedding
        bits, kind = CODECS[settings.protocol.payload].bits(embedding), plant(settings.plant)
        act = None
        if name not in ("optimal", "oracle-teacher"):
            act = (ceiling_law if name == "ceiling" else control_law)(kind, settings.control)
        return true_state_driver(name, kind, bits, act)

    return Method(name, "true state", build, style=style, **about)


HOLD_TRUE = _method(
    "hold-true",
    Style("#7F7F7F", "v", ":", hollow=True, size=6.5),
    does="as hold, on the true state",
)
ZERO_TRUE = _method(
    "zero-true",
    Style("#A5A5A5", "D", DASH_DOT_DOT, hollow=True, size=6.5),
    does="as zero, on the true state",
)
OPTIMAL = _method(
    "optimal",
    Style("#262626", "x", ":"),
    needs_link=False,
    compared=True,
    does="the teacher on the device, on the true state at every step; no radio",
)
ORACLE = _method(
    "oracle",
    Style("#000000", "o", "-", hollow=True, size=8.5),
    compared=True,
    does="knows the true state of each packet and the exact equations: a perfect model",
)
ORACLE_TEACHER = _method(
    "oracle-teacher",
    Style("#666666", "d", "-.", hollow=True, size=8.5),
    does="as oracle, with the teacher's own law",
)
CEILING = _method(
    "ceiling",
    Style("#404040", "h", "-", hollow=True, size=8.5),
    does="as oracle, with the best law known for sparse packets",
)
