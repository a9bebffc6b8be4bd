"""The size of a transport block follows from its resource elements and its modulation and coding.

TS 38.214, clause 6.1.4.2, which is clause 5.1.3.2 for the uplink. All is exact: sizes are found in
double precision, where products and powers of two of these lengths have no rounding.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hjepa_cli.core.arrays import Integers
from hjepa_cli.errors import UsageError

SUBCARRIERS = 12  # of a physical resource block (PRB)
MOST_PRBS = 275
MOST_ELEMENTS = 156  # of a PRB, that count for the size of a transport block
SLOT_SYMBOLS = 14
SMALL_BITS = 3824  # up to here sizes are those of Table 5.1.3.2-1, and a CRC has 16 bits
CODE_BLOCK_BITS, LOW_RATE_CODE_BLOCK_BITS = 8424, 3816  # most of them, without CRC
LOW_RATE = 0.25

# TS 38.214, Table 5.1.3.2-1.
SMALL_SIZES = np.array([
    24, 32, 40, 48, 56, 64, 72, 80, 88, 96, 104, 112, 120, 128, 136, 144, 152, 160, 168, 176, 184,
    192, 208, 224, 240, 256, 272, 288, 304, 320, 336, 352, 368, 384, 408, 432, 456, 480, 504, 528,
    552, 576, 608, 640, 672, 704, 736, 768, 808, 848, 888, 928, 984, 1032, 1064, 1128, 1160, 1192,
    1224, 1256, 1288, 1320, 1352, 1416, 1480, 1544, 1608, 1672, 1736, 1800, 1864, 1928, 2024, 2088,
    2152, 2216, 2280, 2408, 2472, 2536, 2600, 2664, 2728, 2792, 2856, 2976, 3104, 3240, 3368, 3496,
    3624, 3752, 3824,
])  # fmt: skip


class TransportBlock(NamedTuple):
    """Holds sizes in bits; arrays of one shape.

    ``bits`` are those of the payload with its headers, ``code_block_bits`` those of one of the
    ``code_blocks``, with its CRC.
    """

    bits: Integers
    code_block_bits: Integers
    code_blocks: Integers


def data_elements_per_prb(symbols: int, dmrs_elements: int) -> int:
    """Return the resource elements of a PRB that a transport block's size is counted by.

    Raises:
        UsageError: symbols outside of a slot, or no element left by the reference signals.
    """
    if not 1 <= symbols <= SLOT_SYMBOLS:
        raise UsageError(f"{symbols} symbols; a PUSCH has 1 to {SLOT_SYMBOLS}")
    left = SUBCARRIERS * symbols - dmrs_elements
    if dmrs_elements < 0 or left <= 0:
        raise UsageError(
            f"{dmrs_elements} elements of reference signals in {symbols} symbols leave none for "
            "data"
        )
    return min(left, MOST_ELEMENTS)


def transport_block(
    prbs: npt.ArrayLike,
    elements_per_prb: npt.ArrayLike,
    modulation_order: npt.ArrayLike,
    code_rate: npt.ArrayLike,
) -> TransportBlock:
    """Return what an allocation of one layer carries; arguments broadcast.

    Args:
        prbs: 1 … 275 of them.
        elements_per_prb: from :func:`data_elements_per_prb`.
        modulation_order: bits of a symbol.
        code_rate: R, as the table says, up to rounding: a multiple of 1/2048.

    Raises:
        UsageError: more PRBs than a carrier has, or none.
    """
    prbs = np.asarray(prbs, np.int64)
    if np.any((prbs < 1) | (prbs > MOST_PRBS)):
        raise UsageError(f"an allocation has 1 to {MOST_PRBS} PRBs")
    rate = np.rint(np.asarray(code_rate, np.float64) * 2048) / 2048
    elements = prbs * np.asarray(elements_per_prb, np.int64)
    wanted = elements * np.asarray(modulation_order, np.int64) * rate

    unit = 2.0 ** np.maximum(3, _floor_log2(wanted) - 6)
    small = np.maximum(24, unit * np.floor(wanted / unit))
    fitting = np.minimum(np.searchsorted(SMALL_SIZES, small), len(SMALL_SIZES) - 1)

    body = np.maximum(wanted - 24, 1.0)
    step = 2.0 ** (_floor_log2(body) - 5)
    large = np.maximum(3840, step * np.floor(body / step + 0.5))  # ties go up
    most = np.where(rate <= LOW_RATE, LOW_RATE_CODE_BLOCK_BITS, CODE_BLOCK_BITS)
    several = (rate <= LOW_RATE) | (large > CODE_BLOCK_BITS)
    blocks = np.where(several, np.ceil((large + 24) / most), 1.0)
    large = 8 * blocks * np.ceil((large + 24) / (8 * blocks)) - 24

    is_small = wanted <= SMALL_BITS
    bits = np.where(is_small, SMALL_SIZES[fitting], large).astype(np.int64)
    blocks = np.where(is_small, 1, blocks).astype(np.int64)
    code_block = (bits + np.where(bits > SMALL_BITS, 24, 16)) // blocks + 24 * (blocks > 1)
    return TransportBlock(bits, code_block, blocks)


def _floor_log2(values: npt.ArrayLike) -> Integers:
    """Return ⌊log2 v⌋ of v ≥ 1 exactly; 0 below."""
    return np.maximum(np.frexp(np.asarray(values, np.float64))[1].astype(np.int64) - 1, 0)
