"""Devices per cell against the delay of packets, by method, and the predictor calls that it takes.

    python benchmarks/delay.py --out delay [--checkpoint MODEL] [--delays 0,10,20,30,40,60,80]

For each delay ``hjepa scale --law duty`` counts the devices of a cell at one SNR. ``--tune 60,75``
first tunes ``hold-decay`` and ``hold-decay-linear`` to each delay and each of these gaps with
``hjepa train-reflex``, so that what predicts nothing is at its best, too; their rows say ``for 60``
and are measured at gaps around it. Settings of loops, and whatever else differs from the preset,
come from ``--config``.

Everything is kept below ``--out``, a directory for each point: an interrupted study goes on with
the same command, and more delays only add to it. All numbers go to ``OUT/delay.json``, the table to
``OUT/delay.csv`` and to the screen, devices against delay to ``OUT/delay.png``.
"""

import argparse
import csv
import hashlib
import json
import shlex
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from lists import whole_numbers
from study import as_toml, hjepa

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.control.link import LINK_VERSION
from hjepa_cli.core.control.loop import LOOP_VERSION, Draws, gap_schedule, simulate
from hjepa_cli.core.networks.model import LEVELS, Model
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.duty import duty_devices
from hjepa_cli.output import figures
from hjepa_cli.plugins import METHODS
from hjepa_cli.storage.files import write_json, write_text
from hjepa_cli.storage.zoo import resolve_model

COMPARED = "hjepa,ts-jepa-1,ts-jepa-4,linear,chunk-forces,hold-decay,hold,oracle"
LABEL = "Delay from a packet's capture to the force (ms)"
TUNED = ("hold-decay", "hold-decay-linear")
AROUND = (0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.4, 2.0)  # × the gap that is tuned to
CALLS_AT = (20, 80)  # steps between packets where calls are counted
CALLS_DEVICES, CALLS_STEPS = 8, 400


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--checkpoint", default="desktop-h4m2l1", help="zoo name, run or file")
    parser.add_argument(
        "--delays", type=whole_numbers, default="0,10,20,30,40,60,80", help="in control steps"
    )
    parser.add_argument("--methods", default=COMPARED)
    parser.add_argument("--snr", default="20", help="dB")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--config", type=Path, help="TOML file of other settings")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--tune",
        type=whole_numbers,
        default=[],
        metavar="GAPS",
        help="hold-decay to these, in steps",
    )
    parser.add_argument("--dataset", type=Path, help="for --tune")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    methods, rows = options.methods.split(","), []
    for delay in options.delays:
        tuned = [name for name in methods if options.tune and name in TUNED]
        others = [name for name in methods if name not in tuned]
        if others:
            rows += counted(options, delay, others, options.checkpoint)
        for gap in options.tune if tuned else ():
            rows += counted(options, delay, tuned, tune(options, delay, gap), gap)
        write(rows, options)
    print((options.out / "delay.csv").read_text())


def counted(
    options: argparse.Namespace, delay: int, methods: list[str], checkpoint: Any, made_for: int = 0
) -> list[dict[str, Any]]:
    """One row a method: devices, tolerated gap, scores, bits and calls at one delay."""
    words = ("--law", "duty", "--snr", options.snr, "--delay-steps", delay)
    words += ("--methods", ",".join(methods), "--checkpoint", checkpoint)
    where = point(options, "scale", *words)
    config = options.config
    if made_for:
        gaps = [1, *sorted({round(share * made_for) for share in AROUND})]
        config = settings_file(options, where, {"protocol": {"gaps": gaps}})
    words += ("--preset", options.preset, "--seed", options.seed, "--out", where)
    result = hjepa("scale", *words, *(("--config", config) if config else ()))
    measured = {
        name: entry
        for path in where.glob("curves*.json")
        for name, entry in json.loads(path.read_text())["methods"].items()
    }
    step_ms = 1e3 * result["slot_s"]
    over: dict[str, dict[str, Any]] = {}
    for gain in result["gains"]:
        over.setdefault(gain["method"], {})[gain["over"]] = [gain["ratio"], *gain["ratio_ci95"]]
    rows = []
    for row in result["rows"]:
        name = row["method"].partition("+")[0]
        entry = measured[row["method"]]
        scores = {f"{at['d']:g}": [at["score"], *at["ci95"]] for at in entry["gap_curve"]}
        longest, ends = longest_gap(entry["gap_curve"] + entry["gap_bracket"])
        rows.append(
            {
                "delay_ms": delay * step_ms,
                "method": row["method"],
                "note": f"for {made_for}" if made_for else "",
                **{key: row[key] for key in ("devices", "devices_ci95", "at_least", "reason")},
                "tolerance_gap_steps": entry["tolerance_gap_steps"],
                "tolerance_gap_ci95": entry["tolerance_gap_ci95"],
                "longest_gap_steps": longest,
                "bits_per_transmission": row["bits_per_transmission"],
                "devices_over": over.get(row["method"], {}),
                "scores": scores,
                "calls_per_step": calls(options, delay, name),
            }
        )
        if made_for:  # devices can keep to it, and shorter gaps do not count
            rows[-1] |= {
                "tolerance_gap_steps": longest,
                "tolerance_gap_ci95": ends,
                "devices": devices(options, row, longest),
                "devices_ci95": [devices(options, row, end) for end in ends],
                "devices_over": {},
                "at_least": longest == entry["gap_curve"][-1]["d"],
                "reason": None if longest else "no gap around it is acceptable",
            }
    return rows


def longest_gap(points: list[dict[str, Any]]) -> tuple[float, list[float]]:
    """Return the longest gap that is acceptable, whatever shorter ones are, and its interval.

    A force that fades after a late packet can fail where packets come often, so that D* is 0, and
    do well where they are rare. The interval is from the scores' own, point by point.
    """
    acceptable = load_settings().protocol.acceptable_score
    in_order = sorted(points, key=lambda at: at["d"])
    gaps = np.array([at["d"] for at in in_order])

    def crossing(scores: list[float]) -> float:
        kept = [at for at, score in enumerate(scores) if score >= acceptable]
        if not kept or kept[-1] == len(gaps) - 1:
            return float(gaps[-1]) if kept else 0.0
        around = slice(kept[-1], kept[-1] + 2)
        return float(np.interp(-acceptable, -np.array(scores[around]), gaps[around]))

    low, high = (crossing([at["ci95"][end] for at in in_order]) for end in (0, 1))
    return crossing([at["score"] for at in in_order]), [low, high]


def devices(options: argparse.Namespace, row: dict[str, Any], gap_steps: float) -> int:
    """How many devices send a packet so often, as ``duty`` counts them; 0 of gap 0."""
    if not gap_steps:
        return 0
    settings = load_settings(options.preset, options.config)
    cell = Cell.of(settings, actual_plant(settings.plant, settings.conditions))
    link = cell.link(row["bits_per_transmission"], row["snr_db"])
    return int(duty_devices(gap_steps, link.packets_per_slot))


def tune(options: argparse.Namespace, delay: int, gap: int) -> Path:
    """Where a model lies whose decaying holds were tuned to delay and gap; its chunks are not."""
    words = ("--checkpoint", options.checkpoint)
    words += ("--dataset", options.dataset) if options.dataset else ()
    where = point(options, "train-reflex", *words, delay, gap)
    reflex = {"steps": 1, "gap_steps": gap}  # the chunks' training is cut short
    given = {"protocol": {"delay_steps": delay}, "reflex": reflex}
    config = settings_file(options, where, given)
    named = ("--preset", options.preset, "--seed", options.seed, "--config", config)
    hjepa("train-reflex", *words, *named, "--out", where)
    return where


def settings_file(
    options: argparse.Namespace, where: Path, more: dict[str, dict[str, Any]]
) -> Path:
    """Where a file lies with the settings of ``--config`` and these."""
    given = tomllib.loads(options.config.read_text()) if options.config else {}
    given |= {section: given.get(section, {}) | values for section, values in more.items()}
    alone = {key: given.pop(key) for key in list(given) if not isinstance(given[key], dict)}
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in alone.items()]
    config = where.with_suffix(".toml")
    write_text(config, "".join(lines) + as_toml(given))
    return config


def calls(options: argparse.Namespace, delay: int, name: str) -> dict[str, dict[str, float]]:
    """Embeddings that each level of the model moves on, per device and control step, by gap."""
    model = Model.load(resolve_model(options.checkpoint), "cpu")
    if not METHODS[name].planner or name not in methods_of(model):
        return {}
    flags = {"seed": options.seed, "protocol": "paper", "protocol.steps": CALLS_STEPS}
    settings = load_settings(
        options.preset, options.config, {**flags, "protocol.delay_steps": delay}
    )
    rows: Counter[str] = Counter()
    for level in LEVELS[model.architecture["kind"]]:
        count = lambda module, given, made, level=level: rows.update({level: len(made)})  # noqa: E731
        model.networks[level].register_forward_hook(count)
    driver, found = build_driver(name, settings, model), {}
    draws = Draws.make(settings.protocol, CALLS_DEVICES, options.seed)
    for gap in CALLS_AT:
        rows.clear()
        schedule = gap_schedule(gap, draws.steps, CALLS_DEVICES)
        kind = actual_plant(settings.plant, settings.conditions)
        controller = driver.controller(CALLS_DEVICES)
        simulate(kind, draws, schedule[None], controller, driver.sensor)
        found[f"{gap}"] = {level: count / schedule.size for level, count in rows.items()}
    return found


def point(options: argparse.Namespace, stage: str, *of: Any) -> Path:
    """The directory of a point, named after all that it depends on."""
    config = options.config.read_text() if options.config else ""
    versions = [LOOP_VERSION, LINK_VERSION]
    described = json.dumps([*versions, options.preset, options.seed, config, *map(str, of)])
    return options.out / f"{stage}-{hashlib.sha256(described.encode()).hexdigest()[:12]}"


def write(rows: list[dict[str, Any]], options: argparse.Namespace) -> None:
    """All rows as JSON, the table as CSV, the devices as a figure."""
    document = {"command": shlex.join(["python", "benchmarks/delay.py", *sys.argv[1:]])}
    document |= {"checkpoint": str(options.checkpoint), "snr_db": float(options.snr), "rows": rows}
    write_json(options.out / "delay.json", document)
    with (options.out / "delay.csv").open("w", newline="") as file:
        table = csv.writer(file)
        head = ("delay_ms", "method", "note", "devices", "low", "high", "gap_steps", "low", "high")
        table.writerow([*head, "score_20", "low", "high", "bits", "calls_20"])
        for row in rows:
            gap = [row["tolerance_gap_steps"], *(row["tolerance_gap_ci95"] or ("", ""))]
            table.writerow(
                [
                    *(row[key] for key in head[:4]),
                    *(row["devices_ci95"] or ("", "")),
                    *gap,
                    *row["scores"].get("20", ("", "", "")),
                    row["bits_per_transmission"],
                    sum(row["calls_per_step"].get("20", {}).values()) or "",
                ]
            )
    drawn = [
        row | {"snr_db": row["delay_ms"], "method": " ".join((row["method"], row["note"])).strip()}
        for row in rows
        if row["devices"] is not None
    ]
    figures.save(figures.devices_figure(drawn, snr_label=LABEL), options.out / "delay.png")


if __name__ == "__main__":
    main()
