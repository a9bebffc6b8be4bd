"""``hjepa scale``: how many control loops one radio cell supports, by method and SNR.

Closed-loop tolerances (from ``eval``'s curves) → what one loop asks of the link → devices by the
law ``duty`` or ``equal`` (spec §5) → a table, ``devices.csv`` and the paper's Fig. 4.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hjepa_cli.core import capacity
from hjepa_cli.core.plant import plant
from hjepa_cli.errors import NumericalError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import RadioSettings, Settings
from hjepa_cli.stages.evaluate import curves_for, measure_points, open_subject
from hjepa_cli.storage.files import write_text
from hjepa_cli.storage.runs import Run

PAPER_GAIN_PERCENT = 42.83  # abstract: "up to 42.83 % more devices", at 20 dB
PAPER_SNR_DB = 20.0
SUBJECT, RIVALS = "hjepa", ("ts-jepa-1", "hold")
VERIFY_AT = (0.9, 1.1)  # times the tolerance

Row = dict[str, Any]


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    verify: bool = False,
) -> dict[str, Any]:
    """Count devices; returns the document of spec §8 ``scale``.

    Args:
        settings: the cell (``radio``) and the methods.
        screen: where to say so.
        checkpoint: zoo name, run directory or file; default: the newest run that fits, else the
            zoo.
        dataset: passed on to ``eval`` where curves have to be measured.
        out: run directory.
        remeasure: do not use cached curves.
        verify: drive a block of loops at 0.9 and 1.1 times each tolerance.

    Raises:
        UsageError: bad ``--snr`` or method.
        MissingInputError, DataError: no such checkpoint, or a damaged one, or of another plant.
        NumericalError: ``verify`` contradicts a tolerance.
    """
    snr_db = capacity.parse_snr(settings.radio.snr_db)
    subject = open_subject(settings, screen, checkpoint, dataset)  # refuses before writing anything
    model = None if subject.path is None else str(subject.path)
    with Run.create("scale", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            show(record.result, screen)
            return record.result
        _, entries, source = curves_for(
            settings,
            screen,
            methods=settings.methods,
            checkpoint=model,
            dataset=dataset,
            remeasure=remeasure,
        )
        radio, chosen = settings.radio, plant(settings.plant)
        limit_bits_per_s = chosen.data_rate_limit_bits_per_s
        needs = [Need.of(name, entry, radio.law) for name, entry in entries.items()]
        rows = [
            count(need, radio, chosen.step_s, value, limit_bits_per_s)
            for value in snr_db
            for need in needs
        ]
        result: dict[str, Any] = {
            "checkpoint": model,
            "source": source,
            "plant": settings.plant,
            "law": radio.law,
            "noise": radio.noise,
            "bandwidth_hz": radio.bandwidth_hz,
            "slot_s": chosen.step_s,
            "acceptable_score": settings.protocol.acceptable_score,
            "rows": rows,
            "limit_bits_per_s": limit_bits_per_s,
            "gains": gains(rows),
            "paper_gain_percent": PAPER_GAIN_PERCENT,
            "csv": str(write_csv(record.path("devices.csv"), rows)),
        }
        result["figures"] = draw(result, record.directory, screen)
        if verify:
            result["verify"] = [
                check for need in needs for check in check_need(need, settings, screen, model)
            ]
        show(result, screen)
        if verify:
            enforce(result["verify"], settings.protocol.acceptable_score)
        return record.finish(result)


@dataclass(frozen=True)
class Need:
    """What one loop of a method asks of the link, at the acceptable score.

    Attributes:
        tolerance: D* in steps (``duty``) or p* (``equal``); ``None`` for a method without a link.
        interval: its 95 % interval, ordered so that device counts ascend.
        at_least: still acceptable at the end of the measured range: the true tolerance is wider.
    """

    method: str
    law: str
    tolerance: float | None
    interval: tuple[float, float] | None
    at_least: bool
    payload_bits: int | None

    @classmethod
    def of(cls, method: str, entry: Mapping[str, Any], law: str) -> "Need":
        """Read a method entry of ``eval --json``."""
        key, kind = ("tolerance_gap_steps", "gap") if law == "duty" else ("tolerance_p", "p")
        interval = entry[f"tolerance_{kind}_ci95"]
        if interval is not None:
            low, high = interval
            interval = (low, high) if law == "duty" else (high, low)
        censored = bool(entry[f"tolerance_{kind}_censored"])
        bits = entry["bits_per_transmission"]
        return cls(method, law, entry[key], interval, censored, bits)

    def bits_per_s(self, slot_s: float) -> float | None:
        """Bits per second that reach the controller of a loop at its tolerance."""
        if not self.tolerance or self.payload_bits is None:
            return None
        packets_per_slot = 1 / self.tolerance if self.law == "duty" else self.tolerance
        return self.payload_bits * packets_per_slot / slot_s


def count(
    need: Need, radio: RadioSettings, slot_s: float, snr_db: float, limit_bits_per_s: float
) -> Row:
    """One row of ``scale --json``: the devices that a method supports at one SNR."""
    devices, interval, reason = None, None, "sees every state, whatever the link does"
    if need.tolerance is not None and need.payload_bits is not None:
        ends = need.interval or (need.tolerance, need.tolerance)
        devices, *interval = (
            _devices(tolerance, need.payload_bits, radio, slot_s, snr_db)
            for tolerance in (need.tolerance, *ends)
        )
        reason = None if devices else _why_nobody(need, radio, slot_s, snr_db)
    rate = need.bits_per_s(slot_s)
    return {
        "snr_db": snr_db,
        "method": need.method,
        "devices": devices,
        "devices_ci95": interval,
        "at_least": need.at_least,
        "bits_per_s": rate,
        "ratio_to_limit": None if rate is None else rate / limit_bits_per_s,
        "tolerance_gap_steps" if need.law == "duty" else "tolerance_p": need.tolerance,
        "tolerance_ci95": sorted(need.interval) if need.interval else None,
        "bits_per_transmission": need.payload_bits,
        "reason": reason,
    }


def _devices(
    tolerance: float, payload_bits: int, radio: RadioSettings, slot_s: float, snr_db: float
) -> int:
    if radio.law == "equal":
        cell = (payload_bits, radio.bandwidth_hz, slot_s, snr_db)
        return int(capacity.equal_devices(tolerance, *cell, noise=radio.noise))
    c = capacity.slot_capacity(payload_bits, radio.bandwidth_hz, slot_s, snr_db)
    # A packet that is late on arrival has used up that much of the gap it could have bridged.
    return int(capacity.duty_devices(max(tolerance - capacity.late_slots(c), 0.0), c))


def _why_nobody(need: Need, radio: RadioSettings, slot_s: float, snr_db: float) -> str:
    if need.tolerance == (0.0 if need.law == "duty" else 1.0):
        return "below the acceptable score even with a packet in every slot"
    cell = (need.payload_bits or 1, radio.bandwidth_hz, slot_s, snr_db)
    c = float(capacity.slot_capacity(*cell))
    if need.law == "duty":
        return f"a packet takes {1 / c:.3g} slots and serves for {need.tolerance:.3g}"
    p = float(capacity.equal_delivery_probability(1, *cell, noise=radio.noise))
    return f"a single device delivers with p = {p:.3g} and needs {need.tolerance:.3g}"


def gains(rows: Sequence[Row]) -> list[Row]:
    """Return ``hjepa``'s devices over those of its rivals, at 20 dB or else the highest SNR."""
    at = {row["snr_db"] for row in rows}
    snr_db = PAPER_SNR_DB if PAPER_SNR_DB in at else max(at, default=None)
    counted = {row["method"]: row for row in rows if row["snr_db"] == snr_db and row["devices"]}
    if SUBJECT not in counted:
        return []
    ours = counted[SUBJECT]
    found = []
    for rival in RIVALS:
        if rival in counted:
            theirs = counted[rival]
            found.append(
                {
                    "snr_db": snr_db,
                    "method": SUBJECT,
                    "over": rival,
                    "ratio": ours["devices"] / theirs["devices"],
                    "ratio_ci95": ratio_interval(
                        (ours["devices"], *ours["devices_ci95"]),
                        (theirs["devices"], *theirs["devices_ci95"]),
                    ),
                }
            )
    return found


def ratio_interval(
    above: tuple[float, float, float], below: tuple[float, float, float]
) -> list[float | None]:
    """95 % interval of a ratio from (value, low, high) of its two parts, taken as independent.

    The method of variance estimates recovery (Zou and Donner, Statistics in Medicine 27, 2008) on
    the logarithm, so that lopsided intervals stay so. Methods share their draws, which makes their
    tolerances move together: this interval is then wider than it needs to be. ``None``: unbounded.
    """
    a, a_low, a_high = (math.log(value) if value else -math.inf for value in above)
    b, b_low, b_high = (math.log(value) if value else -math.inf for value in below)
    low = a - b - math.hypot(a - a_low, b_high - b)
    high = a - b + math.hypot(a_high - a, b - b_low)
    return [math.exp(low), None if high == math.inf else math.exp(high)]


def check_need(need: Need, settings: Settings, screen: Screen, model: str | None) -> list[Row]:
    """Drive a block of loops a little inside and a little outside a tolerance, now.

    The interval of the score must lie above the acceptable score inside and below it outside. Only
    the inside exists where the tolerance is as wide as was looked for, or where the other side
    would be a packet in every slot or more.
    """
    if not need.tolerance or need.tolerance == 1.0:
        return []
    level = settings.protocol.acceptable_score
    duty = need.law == "duty"
    points = [
        (share * need.tolerance, "above" if duty == (share < 1) else "below") for share in VERIFY_AT
    ]
    points = [
        (value, side)
        for value, side in points
        if (value >= 1 if duty else value <= 1) and not (need.at_least and side == "below")
    ]
    measured = measure_points(
        settings,
        screen,
        method=need.method,
        gaps=[value for value, _ in points] if duty else (),
        probabilities=() if duty else [value for value, _ in points],
        checkpoint=model,
    )
    checks = []
    for (value, side), point in zip(points, measured, strict=True):
        low, high = point["ci95"]
        checks.append(
            {
                "method": need.method,
                "gap_steps" if duty else "p": value,
                "share_of_tolerance": value / need.tolerance,
                "score": point["score"],
                "score_ci95": [low, high],
                "lq_ratio": point["lq_ratio"],
                "n_devices": point["n_devices"],
                "expected": side,
                "passed": low > level if side == "above" else high < level,
            }
        )
    return checks


def enforce(checks: Sequence[Row], level: float) -> None:
    """Stop where a block of loops contradicts, or cannot confirm, a tolerance."""
    failed = [
        f"{check['method']} at {check['share_of_tolerance']:.1f} x its tolerance scores "
        f"{check['score']:.3f} ({check['score_ci95'][0]:.3f} – {check['score_ci95'][1]:.3f}), "
        f"not clearly {check['expected']} {level:g}"
        for check in checks
        if not check["passed"]
    ]
    if failed:
        raise NumericalError(
            f"not verified: {'; '.join(failed)}",
            hint="hjepa scale --remeasure --verify, with more protocol.bracket_devices in --config",
        )


def write_csv(path: Path, rows: Sequence[Row]) -> Path:
    """Write the rows in long format: one line per SNR and method, units in the header."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(
        ["snr_db", "method", "devices", "devices_ci95_low", "devices_ci95_high", "at_least"]
        + ["bits_per_s", "ratio_to_limit", "bits_per_transmission", "reason"]
    )
    for row in rows:
        low, high = row["devices_ci95"] or (None, None)
        writer.writerow(
            [row["snr_db"], row["method"], row["devices"], low, high, int(row["at_least"])]
            + [row["bits_per_s"], row["ratio_to_limit"], row["bits_per_transmission"]]
            + [row["reason"]]
        )
    write_text(path, table.getvalue())
    return path


def draw(result: Mapping[str, Any], directory: Path, screen: Screen) -> list[str]:
    """Write ``devices.png`` and ``devices.svg``; without matplotlib say how to get it."""
    try:
        from hjepa_cli import figures
    except ModuleNotFoundError as missing:
        if not (missing.name or "").startswith("matplotlib"):
            raise
        screen.say('no figure without matplotlib: pip install "hjepa[plot]"')
        return []
    figure = figures.devices_figure(
        result["rows"],
        title=f"{_cell(result)}; score ≥ {result['acceptable_score']:g}, 95 % CI",
        snr_label="Target SNR (dB)" if result["law"] == "duty" else "Mean SNR (dB)",
    )
    return [
        str(figures.save(figure, directory / f"devices.{kind}")) for kind in ("png", "svg")
    ]


def show(result: Mapping[str, Any], screen: Screen) -> None:
    """Print what a loop needs, how many fit, the gain beside the paper's, and where it all is."""
    rows, duty = result["rows"], result["law"] == "duty"
    first = {row["method"]: row for row in reversed(rows)}  # what does not depend on the SNR
    key, digits = ("tolerance_gap_steps", 1) if duty else ("tolerance_p", 4)
    methods = sorted(first, key=lambda name: -(_last(rows, name)["devices"] or 0))
    screen.table(
        f"what one {result['plant']} loop needs for a score of {result['acceptable_score']:g} "
        f"({result['limit_bits_per_s']:.1f} bit/s would do in theory)",
        ["method", "gap D* [steps]" if duty else "delivery p*", "bits", "bit/s", "÷ theory"],
        [
            [
                name,
                _with_interval(row[key], row["tolerance_ci95"], row["at_least"], digits, duty),
                row["bits_per_transmission"],
                _rounded(row["bits_per_s"]),
                _rounded(row["ratio_to_limit"]),
            ]
            for name in methods
            for row in [first[name]]
        ],
    )
    screen.table(
        f"devices in one cell: {_cell(result)}; 95 % CI",
        ["method", *(f"{value:g} dB" for value in dict.fromkeys(row["snr_db"] for row in rows))],
        [
            [
                name,
                *(
                    _with_interval(row["devices"], row["devices_ci95"], row["at_least"], 0)
                    for row in rows
                    if row["method"] == name
                ),
            ]
            for name in methods
        ],
    )
    if "verify" in result:
        screen.table(
            "driven now, at 0.9 and 1.1 of each tolerance",
            ["method", "gap [steps]" if duty else "p", "score (95 % CI)", "expected", "verdict"],
            [
                [
                    check["method"],
                    f"{check['gap_steps' if duty else 'p']:.{digits}f}",
                    _with_interval(check["score"], check["score_ci95"], False, 3),
                    f"{check['expected']} {result['acceptable_score']:g}",
                    "verified" if check["passed"] else "NOT VERIFIED",
                ]
                for check in result["verify"]
            ],
        )
    for gain in result["gains"]:
        low, high = ((value and 100 * (value - 1)) for value in gain["ratio_ci95"])
        screen.result(
            f"{gain['method']} over {gain['over']} at {gain['snr_db']:g} dB: "
            f"{100 * (gain['ratio'] - 1):+.1f} % devices (95 % CI {low:+.1f} to "
            f"{'unbounded' if high is None else f'{high:+.1f}'} %); "
            f"the paper: up to +{result['paper_gain_percent']} %"
        )
    for name in methods:
        if not first[name]["devices"] and first[name]["reason"]:
            screen.say(f"{name}: {first[name]['reason']}")
    screen.say(result["source"])
    screen.say(f"written: {', '.join([result['csv'], *result['figures']])}")


def _cell(result: Mapping[str, Any]) -> str:
    noise = ", noise scaled with bandwidth" if result["noise"] == "scaled" else ""
    law = result["law"] + (noise if result["law"] == "equal" else "")
    return f"{law}, {result['bandwidth_hz'] / 1e6:g} MHz, {result['slot_s'] * 1e3:g} ms slots"


def _last(rows: Sequence[Row], method: str) -> Row:
    return next(row for row in reversed(rows) if row["method"] == method)


def _with_interval(
    value: float | None,
    interval: Sequence[float] | None,
    at_least: bool,
    digits: int,
    rises: bool = True,
) -> str | None:
    """``112.5 (104.1 – 118.0)``; ``320 (at least)`` where the measured range ended first."""
    if value is None:
        return None
    if at_least:
        return f"{value:.{digits}f} ({'at least' if rises else 'at most'})"
    if interval is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} ({interval[0]:.{digits}f} – {interval[1]:.{digits}f})"


def _rounded(value: float | None) -> str | None:
    return None if value is None else f"{value:,.0f}"
