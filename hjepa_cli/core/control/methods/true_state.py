"""Methods of this file get the true state, which no network limits.

They tell what prediction could gain at best (``oracle``), what it has to beat (``hold-true``,
``zero-true``), and what the teacher does at every step (``optimal``).
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
    from hjepa_cli.core.plants.system import System


def true_state_driver(name: str, kind: System, bits_per_transmission: int) -> Driver:
    """Build one of this file's methods for a nominal plant: its teacher, and its equations.

    Bits are counted as if embeddings were sent, so that device counts differ by control alone.
    """
    from hjepa_cli.core.control.controllers import LastForce, Oracle
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.control.sensors import true_state

    teacher = kind.teacher()
    last_force = functools.partial(LastForce, teacher, action_shape=kind.action_shape)
    reactive = functools.partial(last_force, keep=True)
    drives: Any = reactive
    if name == "oracle":
        states, shape = len(kind.state_names), kind.action_shape
        exactly = functools.partial(Oracle, teacher, kind.advance, kind.force_limit_n)
        drives = functools.partial(exactly, states=states, action_shape=shape)
    elif name == "zero-true":
        drives = functools.partial(last_force, keep=False)
    uses_link = name != "optimal"
    return Driver(name, true_state, drives, reactive, bits_per_transmission, "state", uses_link)


def _method(name: str, style: Style, **about: Any) -> Method:
    def build(settings: Settings, model: Model | None) -> Driver:
        from hjepa_cli.core.plants.named import plant

        embedding = model.architecture["embedding"] if model else settings.encoder.embedding
        bits = CODECS[settings.protocol.payload].bits(embedding)
        return true_state_driver(name, plant(settings.plant), bits)

    return Method(name, "true state", build, style=style, **about)


HOLD_TRUE = _method("hold-true", Style("#7F7F7F", "v", ":", hollow=True, size=6.5))
ZERO_TRUE = _method("zero-true", Style("#7F7F7F", "D", DASH_DOT_DOT, hollow=True, size=6.5))
OPTIMAL = _method("optimal", Style("#000000", "x", ":"), needs_link=False, compared=True)
ORACLE = _method("oracle", Style("#000000", "o", "-", hollow=True, size=8.5), compared=True)
