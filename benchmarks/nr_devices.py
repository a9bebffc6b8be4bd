"""What a 5G uplink carries of each payload, beside Shannon's capacity.

    python benchmarks/nr_devices.py [--symbols 14,4] [--snr 10:30] [--folder DIR] [--plant desktop]

The tolerated gap of each payload is measured as ``hjepa scale --payload …`` does (or taken from the
zoo's curves), once, in a folder that keeps it; counts of the law ``duty`` follow for each physical
layer. Prints Markdown tables: devices with 95 % CI by payload and SNR, and what a packet takes.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from hjepa_cli.config.schema import NrSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.duty import DUTY
from hjepa_cli.core.radio.laws.requirement import LinkRequirement

SOURCES = {  # payload and method
    "int8": ("int8", "hjepa"),
    "64 values, pca-64x8": ("pca-64x8", "hjepa"),
    "pca-16x8": ("pca-16x8", "hjepa"),
    "state-48": ("int8", "state-48"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--symbols", default="14,4", help="PUSCH symbols, a list")
    parser.add_argument("--snr", default="10:30")
    parser.add_argument("--folder", type=Path, default=Path("nr-devices"))
    parser.add_argument("--plant", default="desktop")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    settings = load_settings(flags={"plant": options.plant})
    kind, grid_db = plant(settings.plant), parse_snr(options.snr)
    loops = {name: measured(options, *source) for name, source in SOURCES.items()}
    layers = {"Shannon": Cell.of(settings, kind)}
    for symbols in map(int, options.symbols.split(",")):
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


def measured(options: argparse.Namespace, payload: str, method: str) -> LinkRequirement:
    """What a loop tolerates, of ``hjepa scale``."""
    line = [sys.executable, "-m", "hjepa_cli", "scale", "--json", "--quiet", "--snr", "20"]
    line += ["--methods", method, "--payload", payload, "--plant", options.plant]
    done = subprocess.run(line, cwd=options.folder, check=True, stdout=subprocess.PIPE)
    document: dict[str, Any] = json.loads(done.stdout)
    [row] = document["rows"]
    low, high = row["tolerance_ci95"]
    return LinkRequirement(
        method=method,
        tolerance=row["tolerance"],
        interval=(low, high),
        at_least=row["at_least"],
        payload_bits=row["bits_per_transmission"],
        delay_steps=0,
        warmup_steps=document["warmup_steps"],
        scored_steps=document["scored_steps"],
    )


def _ends(row: dict[str, Any]) -> str:
    low, high = row["devices_ci95"]
    return f"{low:,}–{high:,}"


if __name__ == "__main__":
    main()
