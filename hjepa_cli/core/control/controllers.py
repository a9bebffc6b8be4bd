"""Controllers sit in the cloud and turn packets into forces.

Nothing here can reach a plant: a controller is built from functions of what it received (a
planner, an actor, the equations of motion), never from the simulator that it drives.

Where packets come late, ``act`` is told their ages. A controller that predicts then moves a packet
on to the present under the forces that it sent meanwhile, and not under those that it would have
sent had the packet been there.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Floats, Integers, check_answer
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.control.familiarity import PacketCheck
from hjepa_cli.core.control.link import (
    AHEAD_STEPS,
    MOST_LEAD_STEPS,
    REMEMBERED_STEPS,
    SentForces,
)
from hjepa_cli.core.networks.planning import Planner, Reaction
from hjepa_cli.errors import UsageError


class _Strides:
    """Plays some steps of forces at a time; a packet starts a device anew at once.

    Where forces can be lost, devices are told those of the next steps, too (:meth:`ahead_n`). Then
    strides are planned before their time, and played when it comes: planning costs no more, but
    for the strides that a packet makes void.
    """

    def __init__(self, stride: int, devices: int, action_shape: tuple[int, ...]) -> None:
        self._stride = stride
        self._z = torch.zeros(devices, 0)  # takes its width from the first packets
        self._forces_n = torch.zeros(devices, stride, *action_shape)
        self._phase = np.full(devices, stride)
        self._heard, self._given_up = np.zeros(devices, dtype=bool), np.zeros(devices, dtype=bool)
        longest = REMEMBERED_STEPS + MOST_LEAD_STEPS + stride
        self._sent = SentForces(devices, longest, action_shape)
        self._later_n = torch.zeros(devices, 0, stride, *action_shape)  # strides planned already
        self._ready = np.zeros(devices, dtype=np.int64)  # how many of them there are

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Tensor | None, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are embeddings [delivered.sum(), D].

        A device that has not been heard yet gets 0 N.
        """
        self._ready[delivered] = 0
        if packets is not None:
            packets = self._take(delivered, packets, ages)
            if not self._z.shape[1]:
                self._z = packets.new_zeros(len(delivered), packets.shape[1])
            self._z[torch.from_numpy(delivered)] = packets
            self._heard |= delivered & ~self._given_up
        played = self._play(delivered | self._over)
        self._phase[self._heard] += 1
        if ages is not None:
            self._sent.note(played)
        return played

    @torch.inference_mode()
    def ahead_n(self) -> Floats:
        """Return the forces [n, L, *A] of the last step and of the next ones if no packet comes."""
        further = -(-(AHEAD_STEPS - 1) // self._stride)
        if not self._later_n.shape[1]:
            self._later_n = self._forces_n.new_zeros(
                len(self._phase), further, *self._forces_n.shape[1:]
            )
        for number in range(further):
            rows = np.flatnonzero(self._heard & (self._ready == number))
            if len(rows):
                planned_n = self._fitting(self._plan_later(rows, number), len(rows))
                self._later_n[torch.from_numpy(rows), number] = planned_n
                self._ready[rows] += 1
        strides_n = torch.cat([self._forces_n[:, None], self._later_n], 1).flatten(1, 2).numpy()
        steps = np.maximum(self._phase - 1, 0)[:, None] + np.arange(AHEAD_STEPS)
        return np.asarray(strides_n[np.arange(len(steps))[:, None], steps], dtype=np.float64)

    def give_up(self, devices: Bools) -> None:
        """Plan nothing more for these devices [n]: their forces count for nothing."""
        self._given_up |= devices
        self._heard &= ~devices

    @torch.inference_mode()
    def planned_n(self) -> Floats:
        """Return the forces [n, *A] of the coming step if no packet comes.

        ``act`` then plans only for those who do get a packet.
        """
        return self._play(self._over)

    def _take(self, delivered: Bools, packets: Tensor, ages: Integers | None) -> Tensor:
        """Return the embeddings to plan from [delivered.sum(), D]."""
        raise NotImplementedError

    def _plan(self, due: Bools) -> Tensor:
        """Return forces_n [due.sum(), stride, *A] from the embeddings of those who are due."""
        raise NotImplementedError

    def _plan_later(self, rows: Integers, number: int) -> Tensor:
        """Return forces_n [m, stride, *A] of the stride ``number`` + 1 after the present one."""
        raise NotImplementedError

    def _go_on(self, rows: Tensor) -> None:
        """Let the stride that comes next, and was planned already, be the present one."""

    def _fitting(self, planned_n: Tensor, devices: int) -> Tensor:
        """Return planned forces as they are kept; raise ArrayError for another shape."""
        check_answer(planned_n, (devices, *self._forces_n.shape[1:]), "plan(…)", Tensor)
        return planned_n.float().cpu()

    @property
    def _over(self) -> Bools:
        return np.asarray(self._heard & (self._phase == self._stride))

    def _play(self, due: Bools) -> Floats:
        """Plan for those who are due, and return everybody's force of this step."""
        if due.any():
            planned = due & (self._ready > 0)
            if planned.any():
                rows = torch.from_numpy(np.flatnonzero(planned))
                self._forces_n[rows] = self._later_n[rows, 0]
                self._later_n[rows, :-1] = self._later_n[rows, 1:]
                self._ready[planned] -= 1
                self._go_on(rows)
            if (new := due & ~planned).any():
                planned_n = self._fitting(self._plan(new), int(new.sum()))
                self._forces_n[torch.from_numpy(new)] = planned_n
            self._phase[due] = 0
        at = np.minimum(self._phase, self._stride - 1)  # 0 N of those not heard yet
        return np.asarray(self._forces_n.numpy()[np.arange(len(due)), at], dtype=np.float64)


class StrideController(_Strides):
    """Plays a planner for n devices: a stride starts where the last one led to, or at a packet.

    Attributes:
        taken: whose stride started anew at a packet in the last step [n].
        stride_steps: what a stride takes; late packets are best taken whole strides old.
        moves_on: whether the planner can move late packets on: a plugin's may not.
    """

    def __init__(
        self,
        planner: Planner,
        devices: int,
        *,
        action_shape: tuple[int, ...] = (),
        check: Callable[[int], PacketCheck] | None = None,
    ) -> None:
        super().__init__(planner.stride, devices, action_shape)
        self._planner, self._starts = planner, self._z
        self.stride_steps, self.moves_on = planner.stride, hasattr(planner, "follow")
        self._later_z = torch.zeros(devices, 0, 0)  # where the strides planned already lead to
        self.check = check(devices) if check else None
        self.taken = np.zeros(devices, dtype=bool)

    def act(self, delivered: Bools, packets: Tensor | None, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are embeddings [delivered.sum(), D].

        Those that its check keeps back change nothing: it goes on predicting.
        """
        if self.check is not None:
            delivered, packets, ages = self.check.pass_on(delivered, packets, ages)
        self.taken = delivered
        return super().act(delivered, packets, ages)

    def _take(self, delivered: Bools, packets: Tensor, ages: Integers | None) -> Tensor:
        """Move late packets on to the present."""
        if ages is None or not ages.any():
            return packets
        if not self.moves_on:
            raise UsageError(
                f"packets come late, and {type(self._planner).__name__} cannot move an embedding "
                "on under given forces: it has no follow(z, forces_n, ages)",
                hint="write one (docs/how-to/plugins.md), "
                "or leave out --delay-steps and --jitter-steps",
            )
        forces_n = self._sent.since(np.flatnonzero(delivered), ages)
        return self._follow(packets, torch.from_numpy(forces_n).float(), ages)

    def _plan(self, due: Bools) -> Tensor:
        if not self._starts.shape[1]:
            self._starts = torch.zeros_like(self._z)
        rows = torch.from_numpy(np.flatnonzero(due))
        self._starts[rows] = self._z[rows]
        forces_n, self._z[rows] = self._ahead(self._z[rows])
        return forces_n

    def _plan_later(self, rows: Integers, number: int) -> Tensor:
        if not self._later_z.shape[1]:
            self._later_z = self._z.new_zeros(
                len(self._z), self._later_n.shape[1], self._z.shape[1]
            )
        at = torch.from_numpy(rows)
        before = self._later_z[at, number - 1] if number else self._z[at]
        forces_n, self._later_z[at, number] = self._ahead(before)
        return forces_n

    def _ahead(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forces_n of a stride and the embeddings after it; ArrayError for no such."""
        forces_n, reached = self._planner.plan(z)
        check_answer(reached, z.shape, "the embeddings of plan(…)", Tensor)
        return forces_n, reached

    def _follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        """Return embeddings moved on by the planner; raise ArrayError for another shape."""
        moved = self._planner.follow(z, forces_n, ages)
        check_answer(moved, z.shape, "follow(…)", Tensor)
        return moved

    def _go_on(self, rows: Tensor) -> None:
        self._starts[rows], self._z[rows] = self._z[rows], self._later_z[rows, 0]
        self._later_z[rows, :-1] = self._later_z[rows, 1:]

    @property
    def reached(self) -> tuple[Bools, Tensor]:
        """Return whose stride is over [n], and the embeddings [n, D] that strides lead to."""
        return self._over, self._z

    @property
    def belief(self) -> tuple[Tensor, Tensor, Floats]:
        """Return the embeddings that the controller takes its devices to be at, at its last step.

        Returns:
            The embeddings [n, D] that the current strides started from, those [n, D] that they
            lead to, and the share of each stride that is over [n], 0 where one has just started.
        """
        return self._starts, self._z, (self._phase - 1) / self._stride


class FusingController(StrideController):
    """Plays a planner from what packets make of its own predictions: a filter in latent space.

    Args:
        planner: what it predicts and plays with.
        devices: n.
        correct: maps predicted embeddings and those of packets [m, D] to what is taken for true.
        action_shape: A, of the plant.
        check: keeps packets back that are not to be corrected by, either.
    """

    def __init__(
        self,
        planner: Planner,
        devices: int,
        *,
        correct: Callable[[Tensor, Tensor], Tensor],
        action_shape: tuple[int, ...] = (),
        check: Callable[[int], PacketCheck] | None = None,
    ) -> None:
        super().__init__(planner, devices, action_shape=action_shape, check=check)
        self._correct, self._anchors = correct, self._z
        self._anchor_ages = np.zeros(devices, dtype=np.int64)

    def act(self, delivered: Bools, packets: Tensor | None, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are embeddings [delivered.sum(), D]."""
        if ages is None:  # the forces that were sent are remembered for packets on time, too
            ages = np.zeros(int(delivered.sum()), dtype=np.int64)
        played = super().act(delivered, packets, ages)
        self._anchor_ages += 1
        return played

    def _take(self, delivered: Bools, packets: Tensor, ages: Integers | None) -> Tensor:
        """Correct what was predicted for the moment of each packet, then move on to the present."""
        assert ages is not None
        if not self._anchors.shape[1]:
            self._anchors = packets.new_zeros(len(delivered), packets.shape[1])
        rows, predicted = np.flatnonzero(delivered), packets.clone()
        known = self._heard[rows] & (self._anchor_ages[rows] <= REMEMBERED_STEPS)
        if known.any():
            old, at = rows[known], torch.from_numpy(rows[known])
            if ages.any():
                since = self._anchor_ages[old]
                forces_n = torch.from_numpy(self._sent.since(old, since)).float()
                moved = self._follow(self._anchors[at], forces_n, since - ages[known])
            else:  # the stride that is being played leads there
                moved = self._follow(self._starts[at], self._forces_n[at], self._phase[old])
            predicted[torch.from_numpy(known)] = moved
        corrected = self._correct(predicted, packets)
        self._anchors[torch.from_numpy(rows)], self._anchor_ages[rows] = corrected, ages
        return super()._take(delivered, corrected, ages)


class ReflexController(_Strides):
    """Plays a reaction for n devices, to the last packet, its age and the forces since."""

    def __init__(
        self, reaction: Reaction, devices: int, *, action_shape: tuple[int, ...] = ()
    ) -> None:
        super().__init__(reaction.stride, devices, action_shape)
        self._reaction = reaction
        self._sent_n = torch.zeros(devices, reaction.remembers, *action_shape)
        self._ages = np.zeros(devices, dtype=np.int64)

    def act(self, delivered: Bools, packets: Tensor | None, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are embeddings [delivered.sum(), D]."""
        played = super().act(delivered, packets, ages)
        remembered = np.flatnonzero(self._heard & (self._ages < self._sent_n.shape[1]))
        at = torch.from_numpy(remembered), torch.from_numpy(self._ages[remembered])
        self._sent_n[at] = torch.from_numpy(played[remembered]).to(self._sent_n.dtype)
        self._ages += 1
        return played

    def _take(self, delivered: Bools, packets: Tensor, ages: Integers | None) -> Tensor:
        """Start anew at the age of each packet, with the forces that were sent since."""
        self._sent_n[torch.from_numpy(delivered)] = 0.0
        self._ages[delivered] = 0
        if ages is not None:
            self._ages[delivered] = ages
            since_n = self._sent.since(np.flatnonzero(delivered), ages)
            kept = min(since_n.shape[1], self._sent_n.shape[1])
            fresh_n = torch.zeros(len(since_n), *self._sent_n.shape[1:])
            fresh_n[:, :kept] = torch.from_numpy(since_n[:, :kept]).to(fresh_n.dtype)
            self._sent_n[torch.from_numpy(delivered)] = fresh_n
        return packets

    def _plan(self, due: Bools) -> Tensor:
        rows, ages = torch.from_numpy(due), torch.from_numpy(self._ages[due])
        return self._reaction.plan(self._z[rows], ages, self._sent_n[rows])

    def _plan_later(self, rows: Integers, number: int) -> Tensor:
        """Plan as if all that is planned before had been sent."""
        at, first = torch.from_numpy(rows), self._ages[rows] - self._phase[rows]
        sent_n, before_n = (
            self._sent_n[at],
            [self._forces_n[at], *self._later_n[at, :number].unbind(1)],
        )
        steps = torch.from_numpy(first)[:, None] + torch.arange((number + 1) * self._stride)
        known = steps < sent_n.shape[1]
        of, _ = torch.where(known)
        sent_n[of, steps[known]] = torch.cat(before_n, 1)[known].to(sent_n.dtype)
        ages = torch.from_numpy(first + (number + 1) * self._stride)
        return self._reaction.plan(self._z[at], ages, sent_n)


class LastForce:
    """Acts on each packet, then keeps that force, lets it fade, or applies none.

    At age j it plays clip(s · C(packet) · e^(−j/τ)). With the teacher as actor and a packet at
    every step this is the optimal controller. A late packet is taken for fresh: who predicts
    nothing knows nothing better.

    Args:
        actor: packets [m, ...] → forces_n [m, *A].
        devices: n.
        keep: play a force between packets at all; ``False`` applies 0 N.
        gain: s, of all devices or of each [n].
        tau_steps: τ > 0, likewise; ∞ holds the force.
        force_limit_n: the actuator clips here.
        action_shape: A, of the plant.
    """

    def __init__(
        self,
        actor: Callable[[Any], Any],
        devices: int,
        *,
        keep: bool = True,
        gain: float | Floats = 1.0,
        tau_steps: float | Floats = np.inf,
        force_limit_n: float = np.inf,
        action_shape: tuple[int, ...] = (),
    ) -> None:
        self._actor, self._limit_n = actor, force_limit_n
        column = (devices, *[1] * len(action_shape))
        self._gain, self._kept = (
            np.broadcast_to(value, devices).reshape(column)
            for value in (gain, keep * np.exp(-1.0 / np.asarray(tau_steps)))
        )
        self._played_n = self._forces_n = np.zeros((devices, *action_shape))

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Any) -> Floats:
        """Return the forces of one step [n, *A]; 0 N before a device's first packet."""
        if packets is not None:
            forces_n, gain = self._actor(packets), self._gain[delivered]
            torchs = isinstance(forces_n, Tensor)
            fresh_n = forces_n.float().cpu().numpy() if torchs else np.asarray(forces_n)
            check_answer(fresh_n, (len(gain), *self._forces_n.shape[1:]), "act(…)")
            self._forces_n[delivered] = fresh_n * gain
        self._played_n = self._forces_n
        played = self.planned_n()
        self._forces_n = self._forces_n * self._kept + 0.0  # which makes 0 of −0
        return played

    def planned_n(self) -> Floats:
        """Return the forces [n, *A] of the coming step if no packet comes."""
        return np.clip(self._forces_n, -self._limit_n, self._limit_n)

    def ahead_n(self) -> Floats:
        """Return the forces [n, L, *A] of the last step and of the next ones without a packet."""
        kept = self._kept[:, None] ** np.arange(AHEAD_STEPS).reshape(
            -1, *[1] * (self._kept.ndim - 1)
        )
        return np.clip(self._played_n[:, None] * kept, -self._limit_n, self._limit_n)


def told_ahead(
    played_n: Floats,
    states: Floats,
    answer: Callable[[Floats], Floats],
    moved: Callable[[Floats, Floats], Floats],
) -> Floats:
    """Return the forces [n, L, *A] of a step and of the next ones, from the states [n, S] after it.

    Args:
        played_n: forces of the step [n, *A].
        states: where devices are believed to be then.
        answer: states → forces_n.
        moved: states and the forces of a step → states after it.
    """
    forces_n = [played_n]
    for _ in range(AHEAD_STEPS - 1):
        forces_n.append(answer(states))
        states = moved(states, forces_n[-1])
    return np.stack(forces_n, axis=1)


class Oracle:
    """Plays the true state at each packet and exact equations in between: a predictor's ceiling.

    It knows the noise-free equations of the nominal plant, not the noise and not a device's own
    masses.

    Args:
        actor: states [m, S] → forces_n [m, *A], the teacher.
        advance: one control step, states [n, S] and applied forces_n [n, *A] → states [n, S].
        force_limit_n: the actuator clips here, and the oracle knows.
        devices: n.
        states: S.
        action_shape: A, of the plant.
    """

    def __init__(
        self,
        actor: Callable[[Floats], Floats],
        advance: Callable[[Floats, Floats], Floats],
        force_limit_n: float,
        devices: int,
        *,
        states: int = 4,
        action_shape: tuple[int, ...] = (),
    ) -> None:
        self._actor, self._advance, self._limit_n = actor, advance, force_limit_n
        self._states = np.zeros((devices, states))
        self._played_n = np.zeros((devices, *action_shape))
        self._sent = SentForces(devices, REMEMBERED_STEPS + MOST_LEAD_STEPS, action_shape)

    def act(self, delivered: Bools, packets: Floats | None, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]; packets are true states [delivered.sum(), S]."""
        if packets is not None:
            if ages is not None:
                packets = self._follow(packets, np.flatnonzero(delivered), ages)
            self._states[delivered] = packets
        self._played_n = self.planned_n()
        self._states = self._moved(self._states, self._played_n)
        if ages is not None:
            self._sent.note(self._played_n)
        return self._played_n

    def planned_n(self) -> Floats:
        """Return the forces [n, *A] of the coming step if no packet comes."""
        return self._answer(self._states)

    def ahead_n(self) -> Floats:
        """Return the forces [n, L, *A] of the last step and of the next ones if no packet comes."""
        return told_ahead(self._played_n, self._states, self._answer, self._moved)

    def _answer(self, states: Floats) -> Floats:
        return np.clip(self._actor(states), -self._limit_n, self._limit_n)

    def _follow(self, states: Floats, devices: Integers, ages: Integers) -> Floats:
        """Move late packets on to the present under the forces that were sent meanwhile."""
        forces_n, states = self._sent.since(devices, ages), states.copy()
        for step in range(forces_n.shape[1]):
            on = ages > step
            states[on] = self._moved(states[on], forces_n[on, step])
        return states

    def _moved(self, states: Floats, forces_n: Floats) -> Floats:
        # The loop clips true states there, too: a lost pole must not overflow.
        return np.clip(self._advance(states, forces_n), -STATE_LIMIT, STATE_LIMIT)
