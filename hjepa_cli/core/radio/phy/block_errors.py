"""Block error rates of PUSCH code blocks come from Sionna SYS's tables, read once.

``sionna-no-rt`` takes seconds to import and brings h5py and matplotlib, so this module does it when
the first table is asked for and nobody else does.
"""

import contextlib
import dataclasses
import functools
import io
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.errors import UsageError

SNR_DB = (-5.0, 30.0)  # where Sionna interpolates its tables
SIMULATED_TO_DB = 20.0  # above, and above 2,000 bits, a table stands for its edge
SIMULATED_TO_BITS = 2000
LOWEST_MCS = {1: 3, 2: 9}  # by MCS table: below, nothing was simulated
TABLES = tuple(LOWEST_MCS)


@dataclasses.dataclass(frozen=True)
class BlockErrors:
    """Holds one MCS table of TS 38.214, clause 6.1.4.1, with its simulated error rates.

    Sionna's PUSCH tables are those of transform precoding (6.1.4.1-1 and -2), whatever its own
    default is: as the 256QAM that table 2 else stands for they would lie beyond capacity.

    Attributes:
        mcs: indices that error rates are there of [M].
        modulation_order, code_rate: of each [M].
        snr_db, code_block_bits: grids [S], [C].
        rates: block error rates [M, C, S].
    """

    mcs: Integers
    modulation_order: Integers
    code_rate: Floats
    snr_db: Floats
    code_block_bits: Floats
    rates: Floats

    def rate(
        self, row: npt.ArrayLike, code_block_bits: npt.ArrayLike, snr_db: npt.ArrayLike
    ) -> Floats:
        """Return block error rates; arguments broadcast.

        The nearest place of the grid counts, as in Sionna. Below −5 dB every block is lost; above
        20 dB and 2,000 bits the rate is that of the edge, a bound.

        Args:
            row: of the MCS, 0 … M − 1.
            code_block_bits: with its CRC.
            snr_db: of resource elements.
        """
        snr = np.asarray(snr_db, np.float64)
        places = _nearest(self.code_block_bits, code_block_bits), _nearest(self.snr_db, snr)
        found = self.rates[(np.asarray(row), *places)]
        return np.asarray(np.where(snr < SNR_DB[0], 1.0, found))[()]

    def transport_rate(
        self,
        row: npt.ArrayLike,
        code_block_bits: npt.ArrayLike,
        code_blocks: npt.ArrayLike,
        snr_db: npt.ArrayLike,
    ) -> Floats:
        """Return the rate at which transport blocks are lost: any of their code blocks is."""
        one = self.rate(row, code_block_bits, snr_db)
        return np.asarray(1.0 - (1.0 - one) ** np.asarray(code_blocks, np.float64))[()]

    def is_bound(self, code_block_bits: npt.ArrayLike, snr_db: npt.ArrayLike) -> Bools:
        """Tell where a rate is that of the tables' edge."""
        large = np.asarray(code_block_bits, np.float64) > SIMULATED_TO_BITS
        return np.asarray(large | (np.asarray(snr_db, np.float64) > SIMULATED_TO_DB))


def check_installed() -> None:
    """Raise UsageError where the extra ``nr`` is not installed."""
    if find_spec("sionna") is None:
        raise UsageError(
            "--phy nr needs sionna, which is not installed; without it there is --phy shannon",
            hint='pip install "hjepa[nr]"',
        )


@functools.cache
def block_errors(table: int) -> BlockErrors:
    """Return MCS table 1 or 2 (low rates), read from Sionna's files at the first call.

    Raises:
        UsageError: Sionna is not installed.
    """
    abstraction, decode = _sionna()
    mcs = np.arange(LOWEST_MCS[table], 28)
    orders, rates = decode(mcs, table)
    low, high, step = abstraction.snr_db_interp_min_max_delta
    few, many, apart = abstraction.cbs_interp_min_max_delta
    errors = abstraction.bler_table_interp[0, table - 1].double().numpy()[mcs]
    return BlockErrors(
        mcs,
        orders,
        rates,
        np.arange(low, high, step),
        np.arange(few, many, apart, dtype=np.float64),
        errors,
    )


@functools.cache
def _sionna() -> tuple[Any, Any]:
    """Return Sionna's abstraction of PUSCH, and what tells order and rate of an MCS."""
    check_installed()
    with contextlib.redirect_stdout(io.StringIO()):
        import sionna.sys
        import torch
        from sionna.phy.nr.utils import decode_mcs_index

    folder = Path(sionna.sys.__file__).parent / "bler_tables"
    files = [str(folder / f"PUSCH_table{table}.json") for table in TABLES]
    abstraction = sionna.sys.PHYAbstraction(load_bler_tables_from=files, device="cpu")

    def decode(mcs: Integers, table: int) -> tuple[Integers, Floats]:
        orders, rates = decode_mcs_index(
            torch.from_numpy(mcs), table, transform_precoding=True, device="cpu"
        )
        return orders.numpy().astype(np.int64), rates.numpy().astype(np.float64)

    return abstraction, decode


def _nearest(grid: Floats, values: npt.ArrayLike) -> Integers:
    step = grid[1] - grid[0]
    place = np.rint((np.asarray(values, np.float64) - grid[0]) / step).astype(np.int64)
    return np.asarray(np.clip(place, 0, len(grid) - 1))
