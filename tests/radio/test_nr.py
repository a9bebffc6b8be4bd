"""The 5G uplink: carriers, allocations, error rates, repetition, reports, what it refuses."""

import dataclasses
import math

import numpy as np
import pytest

from hjepa_cli.config.checks import check_cell
from hjepa_cli.config.schema import NrSettings, RadioSettings
from hjepa_cli.core.radio.cell import Cell, physical_layer
from hjepa_cli.core.radio.coding import normal_approximation_error
from hjepa_cli.core.radio.laws.duty import DUTY
from hjepa_cli.core.radio.laws.equal import EQUAL
from hjepa_cli.core.radio.laws.requirement import LinkRequirement
from hjepa_cli.core.radio.phy import nr as nr_module
from hjepa_cli.core.radio.phy.numerology import CARRIER_PRBS, Carrier
from hjepa_cli.errors import UsageError

RADIO = RadioSettings(phy="nr")
INT8, VALUES_64, PCA_16X8, STATE_48 = 2064, 528, 128, 48


def layer(radio=RADIO, slot_s=1e-3, **changes):
    pytest.importorskip("sionna")
    return physical_layer(radio, NrSettings(**changes), slot_s)


def shannon(bits, snr_db):
    return physical_layer(RadioSettings(), NrSettings(), 1e-3).carries(bits, snr_db)


# What the author estimated from the same tables at 20 dB, ± 15 %: 51 PRBs at 30 kHz.
@pytest.mark.parametrize("bits, share", [(INT8, 0.53), (VALUES_64, 0.40), (PCA_16X8, 0.10)])
def test_shares_of_shannons_packets_at_20_db(bits, share):
    ratio = layer().carries(bits, 20.0).packets_per_slot / shannon(bits, 20.0).packets_per_slot
    assert ratio == pytest.approx(share, rel=0.15)


def test_the_allocation_is_the_best_of_all_by_brute_force():
    """Every MCS and width one by one: no other brings more packets through."""
    uplink = layer(pusch_symbols=7, dmrs_additional=0)
    errors = uplink._errors
    for bits, snr_db in ((INT8, 7.3), (VALUES_64, 13.0), (PCA_16X8, 18.0), (STATE_48, -1.0)):
        best = 0.0
        for row, (order, rate) in enumerate(
            zip(errors.modulation_order, errors.code_rate, strict=True)
        ):
            for prbs in range(1, 52):
                if prbs not in (*range(1, 7), 8, 9, 10, 12, 15, 16, 18, 20, 24, 25, 27, 30, 32, 36,
                                40, 45, 48, 50):  # fmt: skip
                    continue
                block = nr_module.transport_block(prbs, 72, order, rate)
                lost = errors.rate(row, block.code_block_bits, snr_db)
                if block.code_blocks == 1 and block.bits >= bits + 40 and lost <= 0.1:
                    best = max(best, 2 * 2 * (51 // prbs) * (1 - lost))
        found = uplink.carries(bits, snr_db)
        assert found.packets_per_slot == pytest.approx(best, rel=1e-12)
        assert found.details["tbs_bits"] >= bits + 40 and found.details["bler"] <= 0.1


def test_dmrs_positions_are_those_of_sionnas_pusch():
    pytest.importorskip("sionna")
    from sionna.phy.nr import PUSCHConfig

    for symbols in range(4, 15):
        for additional in range(4):
            config = PUSCHConfig()
            config.mapping_type = "B"
            config.symbol_allocation = [0, symbols]
            config.dmrs.additional_position = additional
            config.dmrs.num_cdm_groups_without_data = 2
            expected = 12 * len(config.dmrs_symbol_indices)
            try:
                config.check_config()
            except (ValueError, AssertionError):  # too many for so few symbols: fewer here
                continue
            assert nr_module.dmrs_elements(symbols, additional) == expected, (symbols, additional)


def test_widths_that_transform_precoding_allows():
    assert nr_module.allowed_prbs(20).tolist() == [
        *range(1, 7), 8, 9, 10, 12, 15, 16, 18, 20,
    ]  # fmt: skip


def test_carriers_leave_the_guard_bands_of_the_standard():
    """A carrier fills 0.79 to 0.99 of its channel, and more PRBs need more bandwidth."""
    for spacing, listed in CARRIER_PRBS.items():
        filled = {mhz: prbs * 12 * spacing / 1e3 / mhz for mhz, prbs in listed.items()}
        assert min(filled.values()) > 0.78 and max(filled.values()) < 0.99, spacing
        assert list(listed.values()) == sorted(listed.values())
    assert Carrier(30, 20e6).prbs == 51 and Carrier(15, 20e6).prbs == 106


def test_error_rates_are_sionnas_own():
    """Looked up as its abstraction does, of the same MCS, sizes and SNRs."""
    pytest.importorskip("sionna")
    from hjepa_cli.core.radio.phy import block_errors

    abstraction, _ = block_errors._sionna()
    random = np.random.default_rng(1)
    for table in (1, 2):
        ours = block_errors.block_errors(table)
        row = random.integers(len(ours.mcs), size=300)
        size, snr_db = random.integers(24, 4000, 300), random.uniform(-5, 30, 300)
        import torch

        theirs = abstraction.get_bler(
            torch.from_numpy(ours.mcs[row]), table, 0, torch.from_numpy(size),
            torch.from_numpy(10 ** (snr_db / 10)),
        ).numpy()  # fmt: skip
        # Single precision decides some ties of its grid of 0.1 dB otherwise.
        assert (np.abs(ours.rate(row, size, snr_db) - theirs) < 1e-6).mean() > 0.98
        assert ours.rate(0, 500, -5.01) == 1.0


def test_no_table_is_better_than_the_best_code():
    """A tenth of the blocks is lost 0.15 to 2.6 dB above the normal approximation, QPSK nearest.

    It is also what tells that the tables are those of transform precoding: read as 256QAM,
    table 2 would lie dB below it.
    """
    pytest.importorskip("sionna")
    from hjepa_cli.core.radio.phy.block_errors import block_errors

    snr_db = np.arange(-5, 20, 0.1)
    for table in (1, 2):
        ours = block_errors(table)
        for row, order in enumerate(ours.modulation_order):
            lost = ours.rate(row, 1024, snr_db)
            if lost[-1] > 0.1 or lost[0] < 0.1:
                continue
            uses = 1024 / ours.code_rate[row] / order
            best = normal_approximation_error(1024, uses, snr_db[:, None])[:, 0]
            apart_db = snr_db[np.argmax(lost < 0.1)] - snr_db[np.argmax(best < 0.1)]
            assert 0.15 < apart_db < {2: 1.2, 4: 1.6, 6: 2.6}[int(order)], ours.mcs[row]


@pytest.mark.slow
@pytest.mark.parametrize("table, mcs", [(1, 5), (1, 22), (2, 27)])
def test_error_rates_within_a_decibel_of_sionnas_link_simulation(table, mcs):
    pytest.importorskip("sionna")
    from sionna.phy import config
    from sionna.phy.nr.utils import CodedAWGNChannelNR

    from hjepa_cli.core.radio.phy.block_errors import block_errors

    ours, config.seed = block_errors(table), 7
    row = int(np.flatnonzero(ours.mcs == mcs)[0])
    order, rate = int(ours.modulation_order[row]), float(ours.code_rate[row])
    channel = CodedAWGNChannelNR(order, 524, rate, device="cpu")
    snr_db = np.arange(-5, 20, 0.1)
    tenth_db = snr_db[np.argmax(ours.rate(row, 524, snr_db) < 0.1)]
    # 40 blocks: fewer than 5 % or more than 25 % lost are well away from a tenth.
    lost = []
    for at_db in (tenth_db - 1, tenth_db + 1):
        sent, heard = channel(40, at_db - 10 * math.log10(order * rate))
        lost.append(float((sent != heard).any(dim=1).float().mean()))
    assert lost[0] > 0.25 and lost[1] < 0.05, (tenth_db, lost)


def test_a_packet_larger_than_a_slot_is_cut_and_late():
    found = layer().carries(393_216, 20.0)
    segments, bits = found.details["segments"], found.details["tbs_bits"]
    assert segments * (bits - 40) >= 393_216 > (segments - 1) * (bits - 40)
    assert found.late_slots == pytest.approx(found.latency_s / 1e-3) and found.late_slots > 5
    assert found.packets_per_slot < 0.2 and "slots" in found.described


def test_tdd_has_the_share_of_its_pattern():
    """One slot of five is uplink, and a repetition waits for the next."""
    fdd, tdd = layer().carries(INT8, 20.0), layer(duplex="DDDSU").carries(INT8, 20.0)
    assert tdd.packets_per_slot == pytest.approx(fdd.packets_per_slot / 5, rel=1e-9)
    assert layer(duplex="DDDSU")._round_trip_slots == 5.0
    assert layer(duplex="DSUUU", harq_rtt_slots=2)._round_trip_slots == pytest.approx(
        (2 + 4 + 3) / 3
    )


def test_numerologies_and_mapping():
    """Four symbols bring three packets into a slot, where a packet fits a PRB so short."""
    assert layer(pusch_symbols=4).carries(PCA_16X8, 20.0).transmissions_per_slot == 2 * 3 * 51
    assert layer().carries(STATE_48, 20.0).transmissions_per_slot == 2 * 51
    assert layer(spacing_khz=15).carries(STATE_48, 20.0).transmissions_per_slot == 106
    assert layer(slot_s=20e-3).carries(STATE_48, 20.0).transmissions_per_slot == 40 * 51
    wide = dataclasses.replace(RADIO, bandwidth_hz=100e6)
    assert layer(wide).carries(STATE_48, 20.0).transmissions_per_slot == 2 * 273


def test_dynamic_grants_are_limited():
    uplink = layer(grants_per_slot=16)
    assert uplink.carries(STATE_48, 20.0, dynamic=True).transmissions_per_slot == 32
    assert uplink.carries(STATE_48, 20.0).transmissions_per_slot == 102
    assert layer(grants="dynamic").carries(INT8, 20.0).transmissions_per_slot == 32


def test_repetition_costs_what_it_sends_and_waits():
    """At a fixed MCS near its limit: expected transmissions, deliveries and waiting, by hand."""
    at_db = 9.4
    once = layer(mcs=17).carries(INT8, at_db)
    error = once.details["bler"]
    assert 0.05 < error < 0.95 and once.round_errors == (pytest.approx(error),)
    assert once.packets_per_slot == pytest.approx(once.transmissions_per_slot * (1 - error))
    assert once.late_slots == pytest.approx(error / (1 - error) * 4 * 0.5)  # 4 slots of 0.5 ms
    twice = layer(mcs=17, harq_rounds=2).carries(INT8, at_db)
    uplink = layer(mcs=17)
    width = np.flatnonzero(uplink._prbs == twice.details["prbs"])[0]
    row = int(np.flatnonzero(uplink._errors.mcs == 17)[0])
    combined = uplink._block_errors(at_db + 10 * math.log10(2), np.zeros(1))[row, width]
    assert twice.round_errors == (pytest.approx(error), pytest.approx(combined / error))
    expected = twice.transmissions_per_slot * (1 - combined) / (1 + error)
    assert twice.packets_per_slot == pytest.approx(expected)
    assert twice.round_trip_slots == 2


def test_a_fixed_mcs_may_need_copies_to_get_through_at_all():
    """At 15 dB MCS 27 is lost once sent; two, three, four copies have 18.0, 19.8, 21.0 dB."""
    sent = layer(mcs=27, harq_rounds=4).carries(INT8, 15.0)
    errors = layer()._errors
    block = nr_module.transport_block(3, 144, 6, 948 / 1024)
    lost = errors.rate(27 - 3, block.code_block_bits, 15.0 + 10 * np.log10([1, 2, 3, 4]))
    assert lost[0] == 1.0 and lost[-1] < 0.01
    per_packet = 1 + lost[:-1].sum()  # transmissions, as left after 1, 2, 3 copies
    assert sent.packets_per_slot == pytest.approx(2 * 17 * (1 - lost[-1]) / per_packet)
    once = layer(mcs=27).carries(INT8, 15.0)
    assert once.described == "at 15 dB every block of MCS 27 is lost"


def test_an_outer_loop_keeps_the_target_that_aged_knowledge_misses():
    """Against a Monte Carlo of two correlated fades, and against Sionna's own outer loop's rule."""
    radio = dataclasses.replace(RADIO, fading="jakes", speed_m_s=3.0)
    inner = layer(radio, cqi_age_slots=16.0).carries(VALUES_64, 20.0)
    outer = layer(radio, cqi_age_slots=16.0, link_adaptation="outer").carries(VALUES_64, 20.0)
    assert outer.details["bler"] <= 0.1 < inner.details["bler"]
    assert outer.details["mcs"] < inner.details["mcs"]
    random = np.random.default_rng(0)
    correlation = nr_module.power_correlation(nr_module.doppler_hz(3.0, 3.75), 8e-3)
    then = random.standard_normal((2, 200_000)) / math.sqrt(2)
    fresh = random.standard_normal((2, 200_000)) / math.sqrt(2)
    now = math.sqrt(correlation) * then + math.sqrt(1 - correlation) * fresh
    off_db = 10 * np.log10((now**2).sum(0) / (then**2).sum(0))
    uplink = layer(radio)
    row = int(np.flatnonzero(uplink._errors.mcs == inner.details["mcs"])[0])
    size = inner.details["tbs_bits"] + 16
    drawn = uplink._errors.rate(row, size, 20.0 + off_db).mean()
    assert inner.details["bler"] == pytest.approx(drawn, abs=0.01)


def test_equal_shares_by_brute_force():
    """N devices in PRBs of equal number: the largest N that still gets through, one by one."""
    uplink = layer()
    for bits, snr_db, p in ((INT8, 15.0, 0.5), (VALUES_64, 20.0, 0.8), (PCA_16X8, 10.0, 0.02)):
        found = uplink.shared_by(p, bits, snr_db, "fixed")
        works = [
            uplink._delivery(51 // math.ceil(n / 2), bits, snr_db, "fixed") >= p
            for n in range(1, 103)
        ]
        assert found == sum(works) and works == sorted(works, reverse=True)
        assert uplink.shared_by(p, bits, snr_db, "scaled") >= found


def test_delivery_is_rayleigh_outage_where_the_code_is_a_step():
    """With the rate of one MCS the loss is that of falling below its threshold."""
    uplink = layer(mcs=16)
    lost = 1 - uplink._delivery(6, INT8, 20.0, "fixed")
    threshold_db = 8.15  # where MCS 16 loses a tenth of 2,000 bits
    assert lost == pytest.approx(1 - math.exp(-(10 ** ((threshold_db - 20) / 10))), rel=0.1)


def test_laws_count_on_it():
    pytest.importorskip("sionna")
    cell = Cell(20e6, 1e-3, 13.2, phy=layer())
    loop = LinkRequirement("hjepa", 100.0, (90.0, 110.0), False, INT8, 0, 1000, 3000)
    row = DUTY.row(loop, cell, 20.0)
    assert row["devices"] == 3400 and row["devices_ci95"] == [3060, 3740]
    assert {
        "mcs", "modulation_order", "code_rate", "prbs", "data_symbols", "dmrs_re_per_prb",
        "tbs_bits", "bler", "packets_per_slot", "latency_s",
    } <= row.keys()  # fmt: skip
    one = dataclasses.replace(loop, tolerance=0.02, interval=(0.03, 0.02))
    assert EQUAL.row(one, cell, 20.0)["devices"] == layer().shared_by(0.02, INT8, 20.0, "fixed")


def test_links_that_fade_have_no_allocation_and_need_no_target_met():
    """At −5 dB no MCS keeps a target; fades above that still let a device in fifty through."""
    uplink = layer()
    cell = Cell(20e6, 1e-3, 13.2, phy=uplink)
    loop = LinkRequirement("hjepa", 0.02, (0.03, 0.02), False, INT8, 0, 1000, 3000)
    row = EQUAL.row(loop, cell, -5.0)
    # Alone in one of 2 n parts, on 51 // n PRBs: who falls below no MCS' threshold, one by one.
    works = [uplink._delivery(51 // n, INT8, -5.0, "fixed") >= 0.02 for n in range(1, 52)]
    assert row["devices"] == 2 * sum(works) > 0
    assert row["bits_per_s"] == pytest.approx(0.02 * INT8 / 1e-3)
    assert row["reason"] is None and "mcs" not in row
    stuck = Cell(20e6, 1e-3, 13.2, phy=layer(mcs=27))
    reason = EQUAL.row(dataclasses.replace(loop, tolerance=0.9), stuck, 5.0)["reason"]
    assert reason.startswith("one device alone delivers with p = ")


def test_nothing_fits_below_the_lowest_mcs_and_it_says_why():
    cell = Cell(20e6, 1e-3, 13.2, phy=layer())
    loop = LinkRequirement("hjepa", 100.0, (90.0, 110.0), False, INT8, 0, 1000, 3000)
    row = DUTY.row(loop, cell, -5.0)
    assert row["devices"] == 0
    assert row["reason"].startswith("at -5 dB not even MCS 3 of table 1 keeps a block error rate")


def test_reports_cost_what_their_channel_takes():
    """One symbol pair of a PRB is shared by 6 devices, every 8 slots; the slot has 2 · 14 · 51."""
    one = layer(reports="sr").reports(4800, 20.0)
    assert one.share_reserved == pytest.approx(4800 / 8 / 6 * 2 / (2 * 14 * 51))
    assert (one.levels, one.share_each, one.delay_slots) == (1, 0.0, 1)
    two = layer(reports="pucch").reports(4800, 20.0)
    assert two.share_reserved == pytest.approx(4 * one.share_reserved) and two.levels == 4
    grant = layer(reports="grant").reports(4800, 20.0)
    assert grant.share_each == pytest.approx(math.e / (2 * 3 * 51)) and not grant.share_reserved
    free = layer(reports="free").reports(4800, 20.0)
    assert (free.share_each, free.share_reserved, free.delay_slots) == (0.0, 0.0, 0)


@pytest.mark.parametrize(
    ("radio", "changes", "match"),
    [
        ({"bandwidth_hz": 22e6}, {}, "22: at 30 kHz TS 38.101-1 lists 5, 10, 15, 20"),
        ({"bandwidth_hz": 100e6}, {"spacing_khz": 15}, "100: at 15 kHz .* 45, 50$"),
        ({}, {"spacing_khz": 45}, "choose a spacing of 15, 30, 60 kHz"),
        ({}, {"duplex": "DDDS"}, "a pattern without uplink"),
        ({}, {"duplex": "DXU"}, "choose FDD, or a TDD pattern"),
        ({}, {"duplex": ""}, "choose FDD, or a TDD pattern"),
        ({}, {"mcs": 2}, "MCS 3 to 27"),
        ({}, {"mcs_table": 2, "mcs": 8}, "MCS 9 to 27"),
        ({"snr_db": "10:35"}, {}, "--snr 35: .* from -5 to 30 dB"),
        ({}, {"cqi_age_slots": 4.0}, "a fade of --fading block has no age"),
    ],
)
def test_what_the_standard_does_not_have_is_refused(radio, changes, match):
    with pytest.raises(UsageError, match=match):
        check_cell(dataclasses.replace(RADIO, **radio), {}, NrSettings(**changes))


@pytest.mark.parametrize(
    ("radio", "given", "nr", "match"),
    [
        ({}, {"nr.mcs": 5}, {"mcs": 5}, "--mcs is for the physical layer nr, this is shannon"),
        ({"phy": "nr", "overhead_bits": 24, "law": "scheduled"}, {}, {}, "physical layer shannon"),
        ({"speed_m_s": 3.0, "law": "scheduled"}, {}, {}, "for --fading jakes, tdl"),
        ({"fading": "jakes"}, {}, {}, "for the law scheduled"),
        ({"phy": "nr"}, {}, {"mcs": 10, "bler_target": 0.01}, "0.01 is for an MCS that"),
        ({"phy": "nr"}, {}, {"link_adaptation": "outer"}, "is for --cqi-age-slots and"),
        ({"phy": "nr"}, {}, {"grants_per_slot": 4}, "is for --grants dynamic"),
        (
            {"phy": "nr", "law": "scheduled", "schedulers": ("max-aoi",)}, {}, {"reports": "free"},
            "is for a scheduler as innovation",
        ),
        (
            {"phy": "nr", "fading": "jakes", "delay_spread_s": 1e-7}, {}, {"cqi_age_slots": 4.0},
            "delay_spread_s = 1e-07 is for the law scheduled",
        ),
        (
            {"phy": "nr", "fading": "tdl-d"}, {}, {"cqi_age_slots": 4.0},
            "fading = 'tdl-d' is for the law scheduled",
        ),
        ({"phy": "nr", "law": "equal"}, {}, {"harq_rounds": 4}, "for the law duty or scheduled"),
        ({"phy": "nr", "law": "equal"}, {"nr.grants": 1}, {}, "--grants is for the law duty"),
        (
            {"fading": "jakes", "law": "scheduled", "coherence_slots": 4.0}, {}, {},
            "for --fading block",
        ),
        (
            {"fading": "tdl-a", "law": "scheduled", "topology": "hall"}, {}, {},
            "has a line of sight of its own",
        ),
    ],
)  # fmt: skip
def test_what_is_not_read_is_refused(radio, given, nr, match):
    with pytest.raises(UsageError, match=match):
        check_cell(RadioSettings(**radio), given, NrSettings(**nr))


@pytest.mark.parametrize(
    ("radio", "nr"),
    [
        ({"fading": "jakes", "speed_m_s": 3.0, "carrier_ghz": 2.0}, {"cqi_age_slots": 4.0}),
        ({"law": "scheduled", "schedulers": ("round-robin", "max-aoi")}, {"grants_per_slot": 4}),
        ({"law": "scheduled"}, {"reports": "grant", "mcs": 10, "bler_target": 0.01}),
        ({}, {"grants": "dynamic", "grants_per_slot": 4, "harq_rtt_slots": 8}),
    ],
)
def test_what_is_read_is_taken(radio, nr):
    check_cell(dataclasses.replace(RADIO, **radio), {}, NrSettings(**nr))


def test_without_sionna_one_line_says_so(monkeypatch):
    from hjepa_cli.core.radio.phy import block_errors

    monkeypatch.setattr(block_errors, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="needs sionna") as refused:
        check_cell(RADIO)
    assert refused.value.hint == 'pip install "hjepa[nr]"'
