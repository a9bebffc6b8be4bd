"""Random streams depend on nothing but their name.

Every consumer of randomness owns the stream ``(seed, stage, split, index, ...)``, so trajectory
17 is the same whether 20 or 2,000 are made, in whatever order and on however many workers.
"""

import numpy as np


def generator(seed: int, *key: int) -> np.random.Generator:
    """Return the stream of a run's ``seed`` that ``key`` names: say stage, split, index."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=key)))
