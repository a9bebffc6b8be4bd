"""What a 5G uplink carries of each payload, beside Shannon's capacity.

    python benchmarks/nr_devices.py [--symbols 14,4] [--snr 10:30] [--plant desktop]

The tolerated gap of each payload comes from the zoo's curves or is searched as ``hjepa eval`` does;
counts of the law ``duty`` follow for each physical layer. Prints Markdown tables: devices with
95 % CI by payload and SNR, and what a packet takes.
"""

import argparse
import dataclasses
import sys
from typing import Any

from lists import whole_numbers

from hjepa_cli.config.schema import NrSettings, Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.evaluation.load_simulator import LoadSimulator, PacketBits
from hjepa_cli.core.evaluation.protocol import Point, Search
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.duty import DUTY
from hjepa_cli.core.radio.laws.requirement import GAP, LinkRequirement
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.measuring import cached
from hjepa_cli.stages.model_set import open_model_set

SOURCES = {  # payload and method
    "int8": ("int8", "hjepa"),
    "64 values, pca-64x8": ("pca-64x8", "hjepa"),
    "pca-16x8": ("pca-16x8", "hjepa"),
    "state-48": ("int8", "state-48"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--symbols", type=whole_numbers, default="14,4", help="PUSCH symbols, a list"
    )
    parser.add_argument("--snr", default="10:30")
    parser.add_argument("--plant", default="desktop")
    options = parser.parse_args()
    settings = load_settings(flags={"plant": options.plant})
    kind, grid_db = plant(settings.plant), parse_snr(options.snr)
    loops = {name: measured(options.plant, *source) for name, source in SOURCES.items()}
    layers = {"Shannon": Cell.of(settings, kind)}
    for symbols in options.symbols:
        radio = dataclasses.replace(settings.radio, phy="nr", snr_db=options.snr)
        cell = dataclasses.replace(settings, radio=radio, nr=NrSettings(pusch_symbols=symbols))
        layers[f"NR, {symbols} symbols"] = Cell.of(cell, kind)
    print(f"\n| payload | D* [steps] | layer | {' | '.join(f'{at:g} dB' for at in grid_db)} |")
    print("|---" * (3 + len(grid_db)) + "|")
    best: dict[tuple[str, float], tuple[int, str]] = {}
    for name, loop in loops.items():
        for layer, cell in layers.items():
            rows = [DUTY.row(loop, cell, at) for at in grid_db]
            for row in rows:
                key = layer, row["snr_db"]
                best[key] = max(best.get(key, (0, "")), (row["devices"], name))
            cells = [f"{row['devices']:,} ({_ends(row)})" for row in rows]
            low, high = sorted(loop.interval)
            gap = f"{loop.tolerance:.1f} ({low:.1f}–{high:.1f})"
            print(f"| {name} | {gap} | {layer} | {' | '.join(cells)} |")
    for layer in layers:
        named = ", ".join(f"{at:g} dB: {best[layer, at][1]}" for at in grid_db)
        print(f"\nmost devices, {layer}: {named}")
    print(
        "\n| payload | layer | SNR [dB] | MCS | PRBs | TBS [bits] | BLER | packets a slot "
        "| of Shannon's |"
    )
    print("|---" * 9 + "|")
    for name, loop in loops.items():
        for layer, cell in layers.items():
            for at in grid_db[:: max(len(grid_db) // 2, 1)]:
                of = cell.phy.carries(loop.payload_bits, at)
                if of.details:
                    full = layers["Shannon"].phy.carries(loop.payload_bits, at).packets_per_slot
                    shown = [of.details[key] for key in ("mcs", "prbs", "tbs_bits")]
                    print(
                        f"| {name} | {layer} | {at:g} | {' | '.join(map(str, shown))} | "
                        f"{of.details['bler']:.4f} | {of.packets_per_slot:.1f} | "
                        f"{of.packets_per_slot / full:.2f} |"
                    )


def measured(plant_name: str, payload: str, method: str) -> LinkRequirement:
    """What a loop tolerates, with 64 devices in steady state."""
    flags = {"plant": plant_name, "protocol.payload": payload, "methods": (method,)}
    settings = load_settings(flags=flags)
    models = open_model_set(settings, Screen(quiet=True), None, None)
    if found := cached(models, [method]):
        return LinkRequirement.measured(GAP, method, found[method][0])
    print(f"measuring {method}, {payload}", file=sys.stderr, flush=True)
    return searched(settings, models, method)


def searched(settings: Settings, models: Any, method: str) -> LinkRequirement:
    """Search the tolerated gap alone."""
    protocol, file = settings.protocol, models.of(method).file
    with open_workers(protocol.total_steps * protocol.bracket_devices) as workers:
        bench = Bench(protocol, settings.seed, workers.runner(settings, file))
        grid = [Point("gap", float(gap)) for gap in protocol.gaps]
        few = bench.measure(method, grid, protocol.curve_devices)
        search = Search(grid, few, bench.reference, protocol)
        while wanted := search.wanted():
            outcome = bench.measure(method, wanted, protocol.bracket_devices)
            for row, point in enumerate(wanted):
                search.add(point, outcome.part(slice(row, row + 1)))
        bits = workers.results([workers.submit(LoadSimulator, settings, file, PacketBits(method))])
    found = search.result()
    return LinkRequirement(
        method=method,
        tolerance=found.gap,
        interval=found.interval,
        at_least=found.censored,
        payload_bits=bits[0],
        delay_steps=0,
        warmup_steps=protocol.warmup_steps,
        scored_steps=protocol.steps,
    )


def _ends(row: dict[str, Any]) -> str:
    low, high = row["devices_ci95"]
    return f"{low:,}–{high:,}"


if __name__ == "__main__":
    main()
