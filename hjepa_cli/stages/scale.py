"""``hjepa scale`` counts the control loops that one radio cell supports, by method and SNR.

What loops tolerate → devices by a law of sharing → a table, ``devices.csv`` and the paper's Fig. 4.
Laws with a formula take tolerances from ``eval``'s curves; under the law ``scheduled`` loops,
radio and scheduler are simulated together.
"""

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import check_cell
from hjepa_cli.config.schema import RECORDED, Settings
from hjepa_cli.core.control import link
from hjepa_cli.core.evaluation.load_search import BLOCK_DEVICES, MAX_BISECTIONS, MAX_WIDENINGS
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.core.radio.doppler import check_speed
from hjepa_cli.core.radio.laws.closed_form import ClosedFormLaw
from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.errors import UsageError
from hjepa_cli.output.looks import Looks
from hjepa_cli.output.screen import Screen, can_draw
from hjepa_cli.output.tables import ALLOCATION, counted_by, described_cell, show_allocations
from hjepa_cli.plugins import LAWS
from hjepa_cli.stages import results
from hjepa_cli.stages.evaluate import reads_of
from hjepa_cli.stages.measuring import plan_curves, seconds_of_loops
from hjepa_cli.stages.plan import Plan, run_directory
from hjepa_cli.stages.scale_by_formula import ByFormula
from hjepa_cli.stages.scale_by_simulation import BySimulation
from hjepa_cli.stages.scale_by_tolerance import ByTolerance, refuse_measuring
from hjepa_cli.stages.verification import enforce
from hjepa_cli.storage.files import write_text
from hjepa_cli.storage.runs import Run

PAPER_GAIN_PERCENT = 42.83  # abstract: "up to 42.83 % more devices", at 20 dB
PAPER_SNR_DB = 20.0


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
    tolerance_steps: float | None = None,
    title: str | None = None,
    labels: Sequence[str] | None = None,
    log: bool | None = None,
) -> dict[str, Any]:
    """Count devices; return the document of ``--json``.

    Args:
        settings: the cell (``radio``), the methods and the protocol.
        screen: shows the result.
        checkpoint: zoo name, run directory or file; default: the newest run that fits, else the
            zoo.
        dataset: clean rollouts for ``eval``, where curves have to be measured.
        out: run directory.
        remeasure: do not use cached curves.
        verify: drive loops a little inside and outside of what was found, now.
        further: models of methods that the first one does not hold; ``None`` looks for them.
        tolerance_steps: count devices whose packets may come so many steps apart, and measure
            nothing: where there is no closed loop.
        title, labels, log: of the figure, as :meth:`hjepa_cli.output.looks.Looks.of`; a finished
            run's is drawn again.

    Raises:
        UsageError: bad SNR grid or method, or what the law or ``tolerance_steps`` does not read.
        MissingInputError: no such checkpoint, or none with any of the methods.
        DataError: a damaged checkpoint, or one of another plant.
        NumericalError: ``verify`` does not confirm what was found.
    """
    radio = settings.radio
    plant_of(settings)  # which refuses settings that do not fit their plant
    grid_db, asked = parse_snr(radio.snr_db), Looks.of(title, labels, log)
    check_cell(radio, {"remeasure": remeasure}, settings.nr)
    inputs = (checkpoint, dataset, further, tolerance_steps)
    count = counting(settings, screen, *inputs, remeasure=remeasure, verify=verify)
    given: dict[str, Any] = {"verify": verify, "tolerance_steps": tolerance_steps}
    if "remeasure" in LAWS[radio.law].uses:
        given["remeasure"] = remeasure
    with Run.create("scale", out, settings.as_dict(), count.models.inputs(**given)) as record:
        result = recorded = record.result
        if result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
        else:
            result = counted(settings, count, record, grid_db, remeasure=remeasure, verify=verify)
            result["csv"] = write_csv(record.path("devices.csv"), result["rows"], count.columns)
            result["figures"] = draw(result, asked, record.directory, screen)
            result = record.finish(result)
        with results.showing("scale", recorded, record.directory):
            if recorded is not None and asked != Looks():
                result["figures"] = draw(result, asked, record.directory, screen)
            count.show(result)
            show_allocations(result["rows"], screen)
            screen.say(f"written: {', '.join(map(str, (result['csv'], *result['figures'])))}")
            enforce(result)
        return result


def counted(
    settings: Settings,
    count: ByFormula | BySimulation,
    record: Run,
    grid_db: Sequence[float],
    *,
    remeasure: bool,
    verify: bool,
) -> dict[str, Any]:
    """Return the document of ``--json`` but for the files that are made of it."""
    radio, kind = settings.radio, plant_of(settings)
    at_db = PAPER_SNR_DB if PAPER_SNR_DB in grid_db else max(grid_db)
    result = {
        "plant": settings.plant,
        "seed": settings.seed,
        "acceptable_score": settings.protocol.acceptable_score,
        "link": link.facts(settings.protocol, len(kind.force_signs)),
        "law": radio.law,
        "phy": radio.phy,
        **({} if radio.phy == "shannon" else {"nr": settings.as_dict()["nr"]}),
        "bandwidth_hz": radio.bandwidth_hz,
        "slot_s": kind.step_s,
        "limit_bits_per_s": kind.data_rate_limit_bits_per_s,
        "paper_gain_percent": PAPER_GAIN_PERCENT,
        "skipped": count.models.skipped(settings.methods),
        **count.counted(record, grid_db, remeasure=remeasure, verify=verify),
    }
    return result | {"gains": count.gains(result["rows"], at_db)}


def plan(
    settings: Settings,
    *,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    verify: bool = False,
    further: Sequence[Path] | None = None,
    tolerance_steps: float | None = None,
    labels: Sequence[str] | None = None,
) -> Plan:
    """Plan a count of devices; arguments as of :func:`run`."""
    Looks.of(labels=labels)
    radio, protocol = settings.radio, settings.protocol
    grid_db = parse_snr(radio.snr_db)
    check_cell(radio, {"remeasure": remeasure}, settings.nr)
    inputs = (checkpoint, dataset, further, tolerance_steps)
    count = counting(settings, Screen(quiet=True), *inputs, remeasure=remeasure, verify=verify)
    if isinstance(count, BySimulation):
        reads = [f"model {count.models.name}"]
        work, seconds = plan_searches(settings, count.methods, verify=verify)
    else:
        at = count.measured_methods(grid_db).values()
        methods = list(dict.fromkeys(name for names in at for name in names))
        reads = reads_of(count.models)
        work, seconds = plan_curves(count.models, methods, remeasure=remeasure)
        work.append(
            f"count devices by law '{radio.law}' at {', '.join(f'{value:g}' for value in grid_db)} "
            f"dB in {radio.bandwidth_hz / 1e6:g} MHz for {len(methods)} methods"
        )
        if verify:
            work.append("simulate one block at 0.9 and 1.1 of each tolerance")
            device_steps = 2 * protocol.bracket_devices * protocol.total_steps
            seconds += seconds_of_loops(methods, device_steps)
    return Plan(
        command="scale",
        reads=reads,
        work=work,
        writes=[f"run {run_directory('scale', out)} with the table (CSV) and the figure"],
        writes_bytes=300_000,
        seconds=5 + seconds,
    )


def plan_searches(
    settings: Settings, methods: Sequence[str], *, verify: bool = False
) -> tuple[list[str], float]:
    """Return what the searches of law ``scheduled`` do, by lines, and about how many seconds."""
    radio, slots = settings.radio, settings.protocol.total_steps
    searches = len(radio.schedulers) * radio.seeds
    if radio.load_depends_on_snr:
        searches *= len(parse_snr(radio.snr_db))
    work = [
        f"simulate up to {MAX_BISECTIONS + 2 * MAX_WIDENINGS} loads of about {BLOCK_DEVICES} "
        f"devices for {slots} slots in each of {searches} searches for {len(methods)} methods "
        f"under {', '.join(radio.schedulers)}"
    ]
    loads = searches * MAX_BISECTIONS  # as a rule
    if verify:
        work.append("simulate each load again, a little lighter and a little heavier")
        loads += 2 * searches
    return work, seconds_of_loops(methods, loads * BLOCK_DEVICES * slots)


def counting(
    settings: Settings,
    screen: Screen,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    further: Sequence[Path] | None = None,
    tolerance_steps: float | None = None,
    *,
    remeasure: bool = False,
    verify: bool = False,
) -> ByFormula | BySimulation:
    """Open what is to be counted under the law of the settings; arguments as of :func:`run`."""
    law, radio = LAWS[settings.radio.law], settings.radio
    if tolerance_steps is not None:
        if not isinstance(law, ClosedFormLaw):
            raise UsageError(
                f"--tolerance-steps is for a law with a formula; {settings.radio.law} simulates",
                hint="hjepa scale --law duty --tolerance-steps STEPS",
            )
        asked = {"--verify": verify, "--remeasure": remeasure, "--dataset": dataset}
        refuse_measuring(settings, asked | {"further": further})
        return ByTolerance(law, settings, screen, tolerance_steps, checkpoint)
    if settings.plant == RECORDED:
        raise UsageError(
            "a recorded plant has no closed loop to measure a tolerance in",
            hint="hjepa scale --tolerance-steps STEPS; eval says how forces err with time",
        )
    if radio.fading != "block":
        check_speed(radio.speed_m_s, radio.carrier_ghz, plant_of(settings).step_s)
    if isinstance(law, ClosedFormLaw):
        return ByFormula(law, settings, screen, checkpoint, dataset, further)
    return BySimulation(settings, screen, checkpoint, further)


def write_csv(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> Path:
    """Write the rows in long format: a line per SNR and method, units in the header."""
    text = io.StringIO()
    if any("mcs" in row for row in rows):
        columns = (*columns, *ALLOCATION)
    table = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    for row in rows:
        low, high = row["devices_ci95"] or (None, None)
        table.writerow(row | {"devices_ci95_low": low, "devices_ci95_high": high})
    write_text(path, text.getvalue())
    return path


def draw(result: Mapping[str, Any], asked: Looks, directory: Path, screen: Screen) -> list[Path]:
    """Write ``devices`` as PNG, SVG and PDF; without matplotlib say how to get them."""
    if not can_draw(screen):
        return []
    from hjepa_cli.output import figures

    usual = f"{described_cell(result)}; {counted_by(result)}"
    figure = figures.scale_figure(result, dataclasses.replace(asked, title=asked.titled(usual)))
    return [figures.save(figure, directory / f"devices.{kind}") for kind in figures.METADATA]
