"""A law for sparse packets is sought by how well it holds devices between them.

Gains K of u = −K x are factors of the teacher's own gains at rest. A candidate drives devices from
the true state, rolled forward by the plant's exact equations between packets, as method ``oracle``
does. What it learns from a packet is a little wrong, and force has a price: an actor's errors grow
with the forces that it has to learn, and violent motion is hard to predict.
"""

import dataclasses

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ProtocolSettings, TuneSettings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.plants.control_law import LinearLaw
from hjepa_cli.core.plants.linear import gains_at_rest
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.statistics import ratio
from hjepa_cli.core.training.decay_fit import Trial
from hjepa_cli.core.training.search import best

NOISE_KEY = 0x1A3
# Of the gap that the teacher's law tolerates with the true state: where candidates are tried.
GAPS = (0.0, 0.15, 0.6, 1.0, 1.2, 1.4, 1.65)
SPREAD = 0.4  # of the logarithms of the factors in the first round


@dataclasses.dataclass(frozen=True, eq=False)
class LawSearch:
    """Candidates for a law of one plant are compared in these loops.

    Attributes:
        trial: devices and gaps, the same for all candidates.
        rest: standard deviations [S] of the states that the teacher holds, the unit of errors.
        options: how many candidates and rounds, and what errors and forces are.
        seed: of the search.
    """

    trial: Trial
    rest: Floats
    options: TuneSettings
    seed: int

    @classmethod
    def make(
        cls, kind: System, protocol: ProtocolSettings, options: TuneSettings, seed: int
    ) -> "LawSearch":
        """Draw devices, and find the gaps and the spread of states under the teacher."""
        trial = Trial.make(
            kind,
            kind.teacher(),
            protocol,
            devices=options.devices,
            steps=options.steps,
            seed=seed,
            around=GAPS,
        )
        search = cls(trial, np.zeros(len(kind.state_names)), options, seed)
        return dataclasses.replace(search, rest=search._rest())

    def gains_n(self, *, learnable: bool) -> Floats:
        """Search K [F, S]; one with a price on forces if ``learnable``, else without."""
        kind, options = self.trial.kind, self.options
        own_n = gains_at_rest(kind.teacher(), len(kind.state_names))
        price = options.force_price / kind.force_limit_n if learnable else 0.0

        def laws(factors: Floats) -> Floats:
            return np.asarray(own_n * np.exp(factors).reshape(-1, *own_n.shape))

        def worth(factors: Floats) -> Floats:
            scores, forces_n = self.drive(laws(factors))
            return np.asarray((scores - price * forces_n).mean(axis=1))

        found = best(
            worth,
            np.zeros(own_n.size),
            np.full(own_n.size, SPREAD),
            candidates=options.candidates,
            rounds=options.rounds,
            seed=self.seed,
        )
        return np.asarray(laws(found[None])[0])

    def drive(self, gains_n: Floats) -> tuple[Floats, Floats]:
        """Drive devices with laws K [C, F, S] at every gap.

        Returns:
            Scores [C, G] in the teacher's, and root mean square forces [C, G] in newton.
        """
        kind, draws, schedules = self.trial.kind, self.trial.draws, self.trial.schedules
        law = LinearLaw(gains_n[:, None, None], kind.force_limit_n, kind.action_shape)
        shape = len(gains_n), len(self.trial.gaps), draws.devices
        random, error = generator(self.seed, NOISE_KEY), self.options.packet_error * self.rest

        initial = np.broadcast_to(draws.initial, (*shape, draws.initial.shape[1]))
        states = kind.advance(initial, np.zeros((*shape, *kind.action_shape)))
        believed, inside, squares = states, np.zeros(shape), np.zeros(shape)
        for k in range(draws.steps):
            if (heard := schedules[:, k]).any():
                told = states + error * random.standard_normal(states.shape[1:])
                believed = np.where(heard[..., None], told, believed)
            forces_n = law(believed)
            if k >= draws.warmup_steps:
                inside += kind.in_band(states)
                squares += (forces_n**2).reshape(*shape, -1).mean(axis=-1)
            believed = kind.advance(believed, forces_n).clip(-STATE_LIMIT, STATE_LIMIT)
            states = kind.advance(states, forces_n) + draws.noise[k]
            states = states.clip(-STATE_LIMIT, STATE_LIMIT)
        scored = draws.steps - draws.warmup_steps
        scores = ratio(inside / scored, self.trial.teacher)
        return scores, np.sqrt(squares.mean(axis=-1) / scored)

    def _rest(self) -> Floats:
        """Return the spread of each state over scored steps and devices, under the teacher."""
        kind, draws, teacher = self.trial.kind, self.trial.draws, self.trial.kind.teacher()
        states, seen = draws.initial, []
        for k in range(draws.steps):
            states = kind.advance(states, teacher(states)) + draws.noise[k]
            if k >= draws.warmup_steps:
                seen.append(states)
        return np.asarray(np.std(np.concatenate(seen), axis=0))
