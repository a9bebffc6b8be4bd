"""Random streams that depend on nothing but their name.

Every consumer of randomness owns the stream ``(seed, stage, split, index, ...)``, so trajectory
17 is the same whether 20 or 2,000 are made, in whatever order and on however many workers.
"""

import numpy as np


def generator(seed: int, *key: int) -> np.random.Generator:
    """Return the random stream named ``key`` under ``seed``.

    Args:
        seed: the run's seed, a non-negative integer.
        key: non-negative integers that name the stream, for example stage, split, index.
    """
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=key)))
