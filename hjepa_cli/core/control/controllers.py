"""What sits in the cloud: controllers that turn packets into forces.

Nothing here can reach a plant: a controller is built from functions of what it received (a
planner, an actor, the equations of motion), never from the simulator that it drives.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.networks.planning import Planner


class StrideController:
    """Plays a planner: one stride at a time, a packet starts a new stride at once.

    Args:
        planner: see :class:`Planner`.
        devices: n.
        action_shape: A, of the plant.
    """

    def __init__(
        self, planner: Planner, devices: int, *, action_shape: tuple[int, ...] = ()
    ) -> None:
        self._planner = planner
        self._forces_n = torch.zeros(devices, planner.stride, *action_shape)
        self._anchors = torch.zeros(devices, 0)  # takes its width from the first packets
        self._starts = self._anchors
        self._phase = np.full(devices, planner.stride)

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Tensor | None) -> Floats:
        """Forces of one step [n, *A]; packets are embeddings [delivered.sum(), D].

        The first packets must be of every device; until they come, no force is played.
        """
        if packets is None and not self._anchors.shape[1]:
            return np.zeros((len(delivered), *self._forces_n.shape[2:]))
        if packets is not None:
            if not self._anchors.shape[1]:
                self._anchors = packets.new_zeros(len(delivered), packets.shape[1])
                self._starts = self._anchors.clone()
            self._anchors[torch.from_numpy(delivered)] = packets
        played = self._plan(delivered | (self._phase == self._planner.stride))
        self._phase += 1
        return played

    @torch.inference_mode()
    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes; from the second step on.

        ``act`` then plans only for those who do get a packet.
        """
        return self._plan(self._phase == self._planner.stride)

    def _plan(self, due: Bools) -> Floats:
        """Plan a stride for those who are due, and return everybody's force of this step."""
        if due.any():
            rows = torch.from_numpy(np.flatnonzero(due))
            self._starts[rows] = self._anchors[rows]
            forces_n, self._anchors[rows] = self._planner.plan(self._anchors[rows])
            self._forces_n[rows] = forces_n.float().cpu()
            self._phase[due] = 0
        played = self._forces_n.numpy()[np.arange(len(due)), self._phase]
        return np.asarray(played, dtype=np.float64)

    @property
    def reached(self) -> tuple[Bools, Tensor]:
        """Whose stride is over [n], and the embeddings [n, D] that the strides lead to."""
        return self._phase == self._planner.stride, self._anchors

    @property
    def belief(self) -> tuple[Tensor, Tensor, Floats]:
        """Where the controller takes its devices to be, at the step it acted on last.

        Returns:
            The embeddings [n, D] that the current strides started from, those [n, D] that they
            lead to, and the share of each stride that is over [n], 0 where one has just started.
        """
        return self._starts, self._anchors, (self._phase - 1) / self._planner.stride


class LastForce:
    """No prediction: act on each packet, then keep that force (hold) or none (zero).

    With the teacher as actor and a packet at every step this is the optimal controller.

    Args:
        actor: packets [m, ...] → forces_n [m, *A].
        devices: n.
        keep: hold the last force between packets; ``False`` applies 0 N.
        action_shape: A, of the plant.
    """

    def __init__(
        self,
        actor: Callable[[Any], Any],
        devices: int,
        *,
        keep: bool,
        action_shape: tuple[int, ...] = (),
    ) -> None:
        self._actor, self._keep = actor, keep
        self._forces_n = np.zeros((devices, *action_shape))

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Any) -> Floats:
        """Forces of one step [n, *A]."""
        if not self._keep:
            self._forces_n[:] = 0.0
        if packets is not None:
            forces_n = self._actor(packets)
            is_tensor = isinstance(forces_n, Tensor)
            self._forces_n[delivered] = forces_n.float().cpu().numpy() if is_tensor else forces_n
        return self._forces_n.copy()

    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes."""
        return self._forces_n.copy() if self._keep else np.zeros_like(self._forces_n)


class Oracle:
    """The ceiling for any predictor: the true state at each packet, exact equations in between.

    It knows the noise-free equations of the nominal plant, not the noise and not a device's own
    masses.

    Args:
        actor: states [m, S] → forces_n [m, *A], the teacher.
        advance: one control step, states [n, S] and applied forces_n [n, *A] → states [n, S].
        force_limit_n: the actuator clips here, and the oracle knows.
        devices: n.
        states: S.
    """

    def __init__(
        self,
        actor: Callable[[Floats], Floats],
        advance: Callable[[Floats, Floats], Floats],
        force_limit_n: float,
        devices: int,
        *,
        states: int = 4,
    ) -> None:
        self._actor, self._advance, self._limit_n = actor, advance, force_limit_n
        self._states = np.zeros((devices, states))

    def act(self, delivered: Bools, packets: Floats | None) -> Floats:
        """Forces of one step [n, *A]; packets are true states [delivered.sum(), S]."""
        if packets is not None:
            self._states[delivered] = packets
        forces_n = np.clip(self._actor(self._states), -self._limit_n, self._limit_n)
        # ±50 is where the loop clips true states too: a lost pole must not overflow.
        self._states = np.clip(self._advance(self._states, forces_n), -50.0, 50.0)
        return forces_n

    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes."""
        return np.clip(self._actor(self._states), -self._limit_n, self._limit_n)
