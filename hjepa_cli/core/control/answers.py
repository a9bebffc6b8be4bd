"""Controllers and coders of plugins are looked at when they answer.

Later nobody could say any more whose a force is that is NaN, or that is one for all devices. The
package's own are used as they are: tests know them, and a loop asks at every step.
"""

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Floats, check_answer, finite
from hjepa_cli.core.control.codecs.codec import Coder
from hjepa_cli.core.control.link import AHEAD_STEPS
from hjepa_cli.core.control.loop import Controller
from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.errors import ArrayError
from hjepa_cli.plugins import CODECS, METHODS


class GuardedController:
    """A plugin's controller, whose forces are one of each device and axis, and finite.

    Args:
        method: of the plugin.
        controller: that it built.
        shape: of the forces of one step, [n, *A].
    """

    def __init__(self, method: str, controller: Controller, shape: tuple[int, ...]) -> None:
        self._controller, self._shape = controller, shape
        self._guard = functools.partial(guarded, METHODS, method)
        self.act = functools.wraps(controller.act)(self._guard(self._act))

    def __getattr__(self, name: str) -> Any:
        """Return what else the controller tells, as the forces that it has planned."""
        found = getattr(self._controller, name)
        if name not in ("planned_n", "ahead_n"):
            return found
        return self._guard(lambda: self._forces(found(), f"{name}()", ahead=name == "ahead_n"))

    def _act(self, delivered: Bools, packets: Any, *ages: Any) -> Floats:
        act: Any = self._controller.act
        return self._forces(act(delivered, packets, *ages), "act(…)")

    def _forces(self, answer: Any, name: str, *, ahead: bool = False) -> Floats:
        """Return forces [n, *A], or those of steps ``ahead`` [n, L, *A], of any L."""
        forces_n, (devices, *action) = np.asarray(answer), self._shape
        steps = forces_n.shape[1:2] or (AHEAD_STEPS,)
        check_answer(forces_n, (devices, *(steps if ahead else ()), *action), name)
        finite(forces_n, name)
        return forces_n


class GuardedCoder:
    """A plugin's coder, whose embeddings arrive as they were sent: of one shape, and finite."""

    def __init__(self, codec: str, coder: Coder) -> None:
        self._coder, self._guarded = coder, guarded(CODECS, codec, self._send)

    def send(self, z: Tensor) -> Tensor:
        """Send embeddings [n, D]; the controller receives [n, D], float32."""
        return self._guarded(z)

    def _send(self, z: Tensor) -> Tensor:
        received: Tensor = self._coder.send(z)
        check_answer(received, z.shape, "send(…)", Tensor)
        if received.dtype != torch.float32:
            raise ArrayError(f"send(…) is {received.dtype}; expected torch.float32")
        if not torch.isfinite(received).all():
            finite(received.cpu().numpy(), "send(…)")  # says which is not
        return received
