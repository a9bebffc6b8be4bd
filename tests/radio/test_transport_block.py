"""Sizes of transport blocks against an independent reading of TS 38.214, and against Sionna's."""

import math
from fractions import Fraction

import numpy as np
import pytest

from hjepa_cli.core.radio.phy.transport_block import (
    SMALL_SIZES,
    data_elements_per_prb,
    transport_block,
)
from hjepa_cli.errors import UsageError

# Modulation orders and R · 1024 of TS 38.214, Tables 5.1.3.1-1 and -2.
TABLES = {
    1: [
        *[(2, r) for r in (120, 157, 193, 251, 308, 379, 449, 526, 602, 679)],
        *[(4, r) for r in (340, 378, 434, 490, 553, 616, 658)],
        *[(6, r) for r in (438, 466, 517, 567, 616, 666, 719, 772, 822, 873, 910, 948)],
    ],
    2: [
        *[(2, r) for r in (120, 193, 308, 449, 602)],
        *[(4, r) for r in (378, 434, 490, 553, 616, 658)],
        *[(6, r) for r in (466, 517, 567, 616, 666, 719, 772, 822, 873)],
        *[(8, r) for r in (682.5, 711, 754, 797, 841, 885, 916.5, 948)],
    ],
}
CASES = 2000


def drawn():
    """PRBs, symbols, elements of reference signals, and the place in a table, of each case."""
    random = np.random.default_rng(38214)
    for _ in range(CASES):
        table = int(random.integers(1, 3))
        mcs = int(random.integers(len(TABLES[table])))
        symbols = int(random.integers(4, 15))
        dmrs = 12 * int(random.integers(1, min(4, symbols // 2) + 1))
        # Few PRBs are what packets get: as many cases there as everywhere else.
        prbs = int(random.integers(1, 20 if random.random() < 0.5 else 276))
        yield prbs, symbols, dmrs, table, mcs


def by_fractions(prbs, symbols, dmrs, order, rate_1024):
    """The clause, step by step, in whole numbers and fractions."""
    elements = min(156, 12 * symbols - dmrs) * prbs
    rate = Fraction(rate_1024) / 1024
    wanted = elements * order * rate
    if wanted <= 3824:
        power = max(3, len(bin(math.floor(wanted))) - 3 - 6) if wanted >= 1 else 3
        quantised = max(24, 2**power * (math.floor(wanted) // 2**power))
        return min(size for size in SMALL_SIZES.tolist() if size >= quantised), 1
    power = len(bin(math.floor(wanted - 24))) - 3 - 5
    steps, rest = divmod(wanted - 24, 2**power)
    quantised = max(3840, 2**power * (steps + (2 * rest >= 2**power)))
    blocks = 1
    if rate <= Fraction(1, 4):
        blocks = -(-(quantised + 24) // 3816)
    elif quantised > 8424:
        blocks = -(-(quantised + 24) // 8424)
    return 8 * blocks * -(-(quantised + 24) // (8 * blocks)) - 24, blocks


def test_two_thousand_sizes_are_those_of_the_clause_in_fractions():
    for prbs, symbols, dmrs, table, mcs in drawn():
        order, rate = TABLES[table][mcs]
        elements = data_elements_per_prb(symbols, dmrs)
        ours = transport_block(prbs, elements, order, rate / 1024)
        assert (ours.bits, ours.code_blocks) == by_fractions(prbs, symbols, dmrs, order, rate)


def test_two_thousand_sizes_are_those_of_sionna():
    pytest.importorskip("sionna")
    import torch
    from sionna.phy.nr.utils import calculate_tb_size, decode_mcs_index

    cases = np.array(list(drawn()))
    prbs, symbols, dmrs, tables, mcs = cases.T
    order, rate = decode_mcs_index(
        torch.tensor(mcs), table_index=torch.tensor(tables), is_pusch=True, device="cpu"
    )
    theirs = calculate_tb_size(
        order,
        rate,
        num_prbs=torch.tensor(prbs),
        num_ofdm_symbols=torch.tensor(symbols),
        num_dmrs_per_prb=torch.tensor(dmrs),
        return_cw_length=False,
        device="cpu",
    )
    elements = [data_elements_per_prb(int(s), int(d)) for s, d in zip(symbols, dmrs, strict=True)]
    ours = transport_block(prbs, elements, order.numpy(), rate.numpy())
    for place, name in ((0, "bits"), (1, "code_block_bits"), (2, "code_blocks")):
        assert np.array_equal(getattr(ours, name), theirs[place].numpy()), name
    known = np.array([TABLES[t][m] for t, m in zip(tables, mcs, strict=True)])
    assert np.array_equal(np.stack([order.numpy(), 1024 * rate.numpy()], axis=1), known)


def test_one_size_worked_out_by_hand():
    """1 PRB, 14 symbols less 12 elements, 64QAM at 948/1024: N_info = 866.5 → 864 → 888 bits."""
    found = transport_block(1, data_elements_per_prb(14, 12), 6, 948 / 1024)
    assert found == (888, 904, 1)


@pytest.mark.parametrize("symbols, dmrs", [(0, 0), (15, 12), (4, 48), (4, -1)])
def test_no_allocation_without_data(symbols, dmrs):
    with pytest.raises(UsageError):
        data_elements_per_prb(symbols, dmrs)


def test_a_carrier_has_275_prbs():
    with pytest.raises(UsageError, match="1 to 275"):
        transport_block([1, 276], 156, 2, 0.5)
