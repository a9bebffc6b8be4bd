"""Small-scale fading gives power gains |H|² of many links over many slots, and causes losses.

A gain holds for one slot or longer. With a coherence of T slots each link draws a new gain with
probability 1/T at every slot (block fading with geometric block lengths, mean T): T = 1 is the
paper's independent fading per τ_o, and whether a gain lies above a threshold is then exactly a
two-state Markov chain, the Gilbert–Elliott channel. Everything is vectorised over slots and links,
and the first links do not depend on how many there are.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.errors import UsageError

CHUNK_SLOTS = 256  # drawn at a time: memory does not grow with the number of slots
_FADING_KEY = 0xFAD


def rician_power_gains(
    rng: np.random.Generator, shape: tuple[int, ...], k_factor_db: npt.ArrayLike
) -> Floats:
    """Draw |H|² of unit-mean Rician fading: |√(K/(K+1)) + √(1/(K+1)) CN(0, 1)|².

    K, which broadcasts to the shape, is the power of the line of sight over that of the scattered
    paths. −∞ dB is Rayleigh fading, |H|² ~ Exp(1); TR 38.901 Table 7.5-6 has 7 ± 8 dB for InF in
    sight.
    """
    scattered = 1.0 / (10.0 ** (np.asarray(k_factor_db, np.float64) / 10.0) + 1.0)
    real, imaginary = np.moveaxis(rng.standard_normal((*shape, 2)), -1, 0)
    along = np.sqrt(1.0 - scattered) + np.sqrt(scattered / 2) * real
    return np.asarray(along**2 + scattered / 2 * imaginary**2)


def block_fading(
    seed: int, links: int, *, k_factor_db: npt.ArrayLike = -np.inf, coherence_slots: float = 1.0
) -> Iterator[Floats]:
    """Yield the power gains [links] of one slot after the other, forever.

    Two iterators of one seed give the same gains; link i of n is link i of any m > i. The Rician K
    is that of each link [links] or of all; a gain lasts T ≥ 1 slots on average.

    Raises:
        UsageError: a coherence shorter than a slot.
    """
    k_factor_db = np.broadcast_to(np.asarray(k_factor_db, np.float64), links)[:, None]
    if not 1.0 <= coherence_slots < np.inf:
        raise UsageError(f"coherence of {coherence_slots:g} slots; it is 1 slot or longer")
    renewal = 1.0 / coherence_slots
    gains = np.zeros(links)
    chunk = 0
    while True:
        # A stream per chunk and purpose, links first: more links never move the draws of others.
        shape = (links, CHUNK_SLOTS)
        drawn = rician_power_gains(generator(seed, _FADING_KEY, chunk, 0), shape, k_factor_db)
        renewed = generator(seed, _FADING_KEY, chunk, 1).random(shape) < renewal
        for slot in range(CHUNK_SLOTS):
            first = chunk == 0 and slot == 0
            gains = np.where(renewed[:, slot] | first, drawn[:, slot], gains)
            yield gains
        chunk += 1


def gilbert_elliott(uniforms: Floats, delivery: float, burst_slots: float) -> Bools:
    """Return what a two-state channel delivers, whose losses come in bursts: bool [slots, links].

    Good slots deliver, bad ones do not. The chain starts in its stationary state and leaves a bad
    slot with probability 1/B, a good one with (1 − p)/(p B), so that a share p of all slots is good
    and losses come in runs of B slots on average. B = 1/p is independent loss.

    Args:
        uniforms: in 0 … 1 [slots, links]; equal ones give equal channels.
        delivery: p in (0, 1], the long-run share of good slots.
        burst_slots: B, mean length of a run of losses; at least 1 and at least (1 − p)/p, beyond
            which a good state would have to be left before it is entered.

    Raises:
        UsageError: p outside (0, 1], or a B that no such channel has.
    """
    if not 0 < delivery <= 1:
        raise UsageError(f"delivery probability {delivery}; it lies above 0 and at most at 1")
    shortest = max(1.0, (1.0 - delivery) / delivery)
    if not shortest <= burst_slots < np.inf:
        raise UsageError(
            f"bursts of {burst_slots:g} slots; losses with p = {delivery:g} need "
            f"{shortest:g} or more"
        )
    stays_bad = 1.0 - 1.0 / burst_slots
    becomes_bad = (1.0 - delivery) / (delivery * burst_slots)
    good = np.empty(uniforms.shape, dtype=bool)
    state = uniforms[0] < delivery
    for slot, drawn in enumerate(uniforms):
        if slot:
            state = np.where(state, drawn >= becomes_bad, drawn >= stays_bad)
        good[slot] = state
    return good
