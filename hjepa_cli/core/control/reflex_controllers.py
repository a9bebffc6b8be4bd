"""Controllers that predict nothing: what they play depends on the last packet and its age alone."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.networks.planning import Reaction


class DecayingHold:
    """Acts on each packet, then lets the force fade: clip(s · C(packet) · e^(−j/τ)) at age j.

    Args:
        actor: packets [m, ...] → forces_n [m, *A].
        gain: s, of all devices or of each [n].
        tau_steps: τ > 0, likewise.
        force_limit_n: the actuator clips here.
        devices: n.
        action_shape: A, of the plant.
    """

    def __init__(
        self,
        actor: Callable[[Any], Any],
        gain: float | Floats,
        tau_steps: float | Floats,
        force_limit_n: float,
        devices: int,
        *,
        action_shape: tuple[int, ...] = (),
    ) -> None:
        self._actor, self._limit_n = actor, force_limit_n
        column = (devices, *[1] * len(action_shape))
        self._gain, self._kept = (
            np.broadcast_to(value, devices).reshape(column)
            for value in (gain, np.exp(-1.0 / np.asarray(tau_steps)))
        )
        self._forces_n = np.zeros((devices, *action_shape))

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Any) -> Floats:
        """Forces of one step [n, *A]; 0 N before a device's first packet."""
        if packets is not None:
            forces_n = self._actor(packets)
            fresh_n = forces_n.float().cpu().numpy() if isinstance(forces_n, Tensor) else forces_n
            self._forces_n[delivered] = fresh_n * self._gain[delivered]
        played = self.outlook()
        self._forces_n *= self._kept
        return played

    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes."""
        return np.clip(self._forces_n, -self._limit_n, self._limit_n)


class ReflexController:
    """Plays a reaction: some steps at a time, a packet starts anew at once.

    Args:
        reaction: see :class:`Reaction`.
        devices: n.
        action_shape: A, of the plant.
    """

    def __init__(
        self, reaction: Reaction, devices: int, *, action_shape: tuple[int, ...] = ()
    ) -> None:
        self._reaction = reaction
        self._packets = torch.zeros(devices, 0)  # takes its width from the first packets
        self._sent_n = torch.zeros(devices, reaction.remembers, *action_shape)
        self._forces_n = torch.zeros(devices, reaction.stride, *action_shape)
        self._phase = np.full(devices, reaction.stride)
        self._ages = np.zeros(devices, dtype=np.int64)
        self._heard = np.zeros(devices, dtype=bool)

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Tensor | None) -> Floats:
        """Forces of one step [n, *A]; packets are embeddings [delivered.sum(), D].

        A device that has not been heard yet gets 0 N.
        """
        if packets is not None:
            if not self._packets.shape[1]:
                self._packets = packets.new_zeros(len(delivered), packets.shape[1])
            rows = torch.from_numpy(delivered)
            self._packets[rows], self._sent_n[rows] = packets, 0.0
            self._ages[delivered] = 0
            self._heard |= delivered
        played = self._plan(delivered | (self._heard & (self._phase == self._reaction.stride)))
        remembered = np.flatnonzero(self._heard & (self._ages < self._sent_n.shape[1]))
        at = torch.from_numpy(remembered), torch.from_numpy(self._ages[remembered])
        self._sent_n[at] = torch.from_numpy(played[remembered]).to(self._sent_n.dtype)
        self._ages += 1
        self._phase[self._heard] += 1
        return played

    @torch.inference_mode()
    def outlook(self) -> Floats:
        """Forces [n, *A] of the coming step if no packet comes.

        ``act`` then plans only for those who do get a packet.
        """
        return self._plan(self._heard & (self._phase == self._reaction.stride))

    def _plan(self, due: Bools) -> Floats:
        """Plan for those who are due, and return everybody's force of this step."""
        if due.any():
            rows = torch.from_numpy(np.flatnonzero(due))
            ages = torch.from_numpy(self._ages[due])
            forces_n = self._reaction.plan(self._packets[rows], ages, self._sent_n[rows])
            self._forces_n[rows] = forces_n.float().cpu()
            self._phase[due] = 0
        at = np.minimum(self._phase, self._reaction.stride - 1)  # 0 N of those not heard yet
        played = self._forces_n.numpy()[np.arange(len(due)), at]
        return np.asarray(played, dtype=np.float64)
