"""``hjepa scale``: how many control loops one radio cell supports, by method and SNR.

Closed-loop tolerances (``eval``'s curves) → devices by the law ``duty`` or ``equal`` → a
table, ``devices.csv`` and the paper's Fig. 4.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import RAW_FRAMES, late
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.control.methods import FRAME_BITS
from hjepa_cli.core.evaluation.cell import Cell, Need, Row, best_flat, best_reflex, gain
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import late_slots, parse_snr, slot_capacity
from hjepa_cli.errors import NumericalError
from hjepa_cli.output.screen import Screen, described_steps, percent, span
from hjepa_cli.stages.evaluate import curves_for, measure_points, open_measurable
from hjepa_cli.stages.model_set import Subject
from hjepa_cli.storage.files import write_text
from hjepa_cli.storage.runs import Run

PAPER_GAIN_PERCENT = 42.83  # abstract: "up to 42.83 % more devices", at 20 dB
PAPER_SNR_DB = 20.0
VERIFY_AT = (0.9, 1.1)  # times the tolerance

CSV_COLUMNS = (
    *("snr_db", "method", "devices", "devices_ci95_low", "devices_ci95_high", "at_least"),
    *("load_per_block", "bits_per_s", "ratio_to_limit", "bits_per_transmission", "reason"),
)


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    verify: bool = False,
    further: Sequence[Path] | None = None,
) -> dict[str, Any]:
    """Count devices; returns the document of ``--json``.

    Args:
        settings: the cell (``radio``), the methods and the protocol.
        screen: where to say so.
        checkpoint: zoo name, run directory or file; default: the newest run that fits, else the
            zoo.
        dataset: clean rollouts for ``eval``, where curves have to be measured.
        out: run directory.
        remeasure: do not use cached curves.
        verify: drive a block of loops at 0.9 and 1.1 times each tolerance, now.
        further: models of methods that the first one does not hold; ``None`` looks for them.

    Raises:
        UsageError: bad SNR grid or method.
        MissingInputError: no such checkpoint, or none with any of the methods.
        DataError: a damaged checkpoint, or one of another plant.
        NumericalError: ``verify`` does not confirm a tolerance.
    """
    if settings.radio.law == "scheduled":
        return run_scheduled(settings, screen, checkpoint, out, verify, further)
    grid_db = parse_snr(settings.radio.snr_db)
    subject = open_measurable(settings, screen, checkpoint, dataset, further)
    level = settings.protocol.acceptable_score
    inputs = subject.inputs(remeasure=remeasure, verify=verify)
    with Run.create("scale", out, settings.as_dict(), inputs) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            show(record.result, screen)
            enforce(record.result.get("verify", []), level)
            return record.result
        cell, wanted = cell_of(settings), all_timed(subject, grid_db)
        names = list(dict.fromkeys(name for at in wanted.values() for name in at))
        measured = curves_for(subject, screen, record, remeasure=remeasure, methods=names)
        needs = {
            name: Need.under(cell.law, name, entry) for name, entry in measured["methods"].items()
        }
        rows = [cell.row(needs[name], snr_db) for snr_db, at in wanted.items() for name in at]
        at_db = PAPER_SNR_DB if PAPER_SNR_DB in grid_db else max(grid_db)
        result: dict[str, Any] = {
            "checkpoint": measured["checkpoint"],
            "checkpoints": measured["checkpoints"],
            "source": measured["source"],
            "plant": settings.plant,
            "seed": settings.seed,
            "n_devices": settings.protocol.bracket_devices,
            "warmup_steps": settings.protocol.warmup_steps,
            "scored_steps": settings.protocol.steps,
            "acceptable_score": level,
            "law": cell.law,
            "noise": cell.noise,
            "bandwidth_hz": cell.bandwidth_hz,
            "slot_s": cell.slot_s,
            "limit_bits_per_s": cell.limit_bits_per_s,
            "rows": rows,
            "gains": gains(rows, at_db),
            "paper_gain_percent": PAPER_GAIN_PERCENT,
            "skipped": subject.skipped(settings.methods),
        }
        result["csv"] = write_csv(record.path("devices.csv"), rows)
        result["figures"] = draw(result, record.directory, screen)
        if verify:
            result["verify"] = [
                check for need in needs.values() for check in verify_need(need, subject, screen)
            ]
        result = record.finish(result)
        show(result, screen)
        enforce(result.get("verify", []), level)
        return result


def run_scheduled(
    settings: Settings,
    screen: Screen,
    checkpoint: str | None,
    out: Path | None,
    verify: bool,
    further: Sequence[Path] | None,
) -> dict[str, Any]:
    """Hand over to the law that is simulated, not computed from curves."""
    from hjepa_cli.stages import scheduled

    return scheduled.run(
        settings, screen, checkpoint=checkpoint, out=out, verify=verify, further=further
    )


def cell_of(settings: Settings) -> Cell:
    """The cell of the settings: its slot is one control step of the plant."""
    radio, chosen = settings.radio, plant(settings.plant)
    limit_bits_per_s = chosen.data_rate_limit_bits_per_s
    return Cell(radio.law, radio.noise, radio.bandwidth_hz, chosen.step_s, limit_bits_per_s)


def all_timed(subject: Subject, grid_db: Sequence[float]) -> dict[float, list[str]]:
    """By SNR the methods that can be measured, each :func:`timed`."""
    cell, methods = cell_of(subject.settings), subject.measurable(subject.settings.methods)
    return {snr_db: [timed(name, cell, snr_db) for name in methods] for snr_db in grid_db}


def timed(method: str, cell: Cell, snr_db: float) -> str:
    """A method as it is under the law ``duty`` at an SNR: late, where its packet takes slots.

    Raw frames alone are driven so late: of the others, whose packets take slots in narrow bands
    only, the law subtracts the delay from the tolerated gap.
    """
    if cell.law != "duty" or method not in RAW_FRAMES:
        return method
    bits = int(method.rpartition("-")[2]) * FRAME_BITS
    c = slot_capacity(bits, cell.bandwidth_hz, cell.slot_s, snr_db)
    return late(method, math.ceil(late_slots(c)))


def gains(rows: Sequence[Row], snr_db: float) -> list[Row]:
    """``hjepa`` over one-step TS-JEPA, the best flat predictor and reflex, hold and the oracle."""
    best = [row["method"] for row in (best_flat(rows, snr_db), best_reflex(rows, snr_db)) if row]
    rivals = dict.fromkeys(["ts-jepa-1", *best, "hold", "oracle"])
    return [found for rival in rivals if (found := gain(rows, "hjepa", rival, snr_db))]


def verify_need(need: Need, subject: Subject, screen: Screen) -> list[Row]:
    """Drive a block of loops a little inside and a little outside a tolerance.

    The score's interval must lie above the acceptable score inside and below it outside. A side
    is left out where it would be more than a packet in every slot, and the outside where the
    tolerance is only known as a bound.
    """
    settings = subject.settings
    duty, level = settings.radio.law == "duty", settings.protocol.acceptable_score
    if not need.tolerance or need.tolerance == 1 or not need.payload_bits:
        return []
    points = []
    for share in VERIFY_AT:
        value, inside = share * need.tolerance, (share < 1) == duty
        if (value >= 1 if duty else value <= 1) and (inside or not need.at_least):
            points.append((share, value, inside))
    values = [value for _, value, _ in points]
    measured = measure_points(
        subject,
        screen,
        method=late(need.method, need.delay_steps),
        gaps=values if duty else (),
        probabilities=() if duty else values,
    )
    return [
        {
            "method": late(need.method, need.delay_steps),
            "share_of_tolerance": share,
            **point,
            "expected": "above" if inside else "below",
            "passed": point["ci95"][0] > level if inside else point["ci95"][1] < level,
        }
        for (share, _, inside), point in zip(points, measured, strict=True)
    ]


def enforce(checks: Sequence[Row], level: float) -> None:
    """Stop where a block of loops does not confirm a tolerance."""
    failed = [
        f"{check['method']} at {check['share_of_tolerance']} x its tolerance scores "
        f"{span(check['score'], check['ci95'], 3)}, not clearly {check['expected']} {level:g}"
        for check in checks
        if not check["passed"]
    ]
    if failed:
        raise NumericalError(
            f"not verified: {'; '.join(failed)}",
            hint="measure with more devices: protocol.bracket_devices in --config FILE.toml",
        )


def write_csv(path: Path, rows: Sequence[Row], columns: Sequence[str] = CSV_COLUMNS) -> Path:
    """Write the rows in long format: a line per SNR and method, units in the header."""
    text = io.StringIO()
    table = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    for row in rows:
        low, high = row["devices_ci95"] or (None, None)
        table.writerow(row | {"devices_ci95_low": low, "devices_ci95_high": high})
    write_text(path, text.getvalue())
    return path


def draw(result: Mapping[str, Any], directory: Path, screen: Screen) -> list[Path]:
    """Write ``devices.png`` and ``devices.svg``; without matplotlib say how to get them."""
    try:
        from hjepa_cli.output import figures
    except ModuleNotFoundError as missing:
        if not (missing.name or "").startswith("matplotlib"):
            raise
        screen.say('no figure without matplotlib: pip install "hjepa[plot]"')
        return []
    title = f"{_described(result)}; score ≥ {result['acceptable_score']:g}, 95 % CI"
    figure = figures.scale_figure(result, title=title)
    return [figures.save(figure, directory / f"devices.{kind}") for kind in ("png", "svg")]


def show(result: Mapping[str, Any], screen: Screen) -> None:
    """Print what a loop needs, how many fit, the gains beside the paper's, and where it all is."""
    by_method: dict[str, list[Row]] = {}
    for row in result["rows"]:
        by_method.setdefault(row["method"], []).append(row)
    ranked = sorted(by_method.items(), key=lambda item: -(item[1][-1]["devices"] or 0))
    loops = {_loop(row): row for _, rows in ranked for row in reversed(rows)}
    duty, level = result["law"] == "duty", result["acceptable_score"]
    digits, bound = (1, "≥") if duty else (4, "≤")

    screen.table(
        f"one {result['plant']} loop at score {level:g}: seed {result['seed']}, "
        f"{result['n_devices']} devices, {described_steps(result)}, 95 % CI; "
        f"limit λ/ln 2 = {result['limit_bits_per_s']:.1f} bit/s",
        ["method", "gap D* [steps]" if duty else "delivery p*", "bits", "bit/s", "÷limit"],
        [
            [
                loop,
                span(
                    row["tolerance"],
                    row["tolerance_ci95"],
                    digits,
                    bound if row["at_least"] else "",
                ),
                row["bits_per_transmission"],
                None if row["bits_per_s"] is None else f"{row['bits_per_s']:,.0f}",
                None if row["ratio_to_limit"] is None else f"{row['ratio_to_limit']:,.0f}",
            ]
            for loop, row in loops.items()
        ],
    )
    screen.table(
        f"devices: {_described(result)}; 95 % CI",
        ["method", *(f"{row['snr_db']:g} dB" for row in ranked[0][1])],
        [
            [
                method,
                *(
                    span(row["devices"], row["devices_ci95"], 0, "≥" if row["at_least"] else "")
                    for row in rows
                ),
            ]
            for method, rows in ranked
        ],
    )
    if "verify" in result:
        screen.table(
            "driven now, inside and outside each tolerance",
            ["method", "gap [steps]" if duty else "p", "score (95 % CI)", "expected", "verdict"],
            [
                [
                    check["method"],
                    f"{check['d' if duty else 'p']:.{digits}f}",
                    span(check["score"], check["ci95"], 3),
                    f"{check['expected']} {level:g}",
                    "verified" if check["passed"] else "NOT VERIFIED",
                ]
                for check in result["verify"]
            ],
        )
    for found in result["gains"]:
        paper = f"; the paper: up to +{result['paper_gain_percent']} %"  # over one-step TS-JEPA
        screen.result(
            f"{found['method']} over {found['over']} at {found['snr_db']:g} dB: "
            f"{percent(found['ratio'])} devices "
            f"(95 % CI {' to '.join(percent(end) for end in found['ratio_ci95'])})"
            + (paper if found["over"] == "ts-jepa-1" else "")
        )
    for method, (row, *_) in ranked:
        if row["reason"]:
            screen.say(f"{method} at {row['snr_db']:g} dB: {row['reason']}")
    screen.say(result["source"])
    screen.say(f"written: {', '.join(str(path) for path in (result['csv'], *result['figures']))}")


def _loop(row: Row) -> str:
    """A method, and how late its packets are."""
    delay = row.get("delay_steps", 0)
    return f"{row['method']}, {delay} steps late" if delay else row["method"]


def _described(result: Mapping[str, Any]) -> str:
    scaled = result["law"] == "equal" and result["noise"] == "scaled"
    law = f"{result['law']} law{', scaled noise' if scaled else ''}"
    return f"{law}, {result['bandwidth_hz'] / 1e6:g} MHz, {result['slot_s'] * 1e3:g} ms slots"
