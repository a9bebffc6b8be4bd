"""This half of ``hjepa scale`` counts by laws with a formula, from what ``eval`` measures."""

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import late
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.evaluation.device_ratios import best_flat, best_reflex, gain
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.channel import ROUNDING
from hjepa_cli.core.radio.laws.closed_form import ClosedFormLaw
from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.core.radio.laws.requirement import LinkRequirement
from hjepa_cli.output.screen import Screen, described_steps, percent, span
from hjepa_cli.output.tables import counted_by, described_cell, ranked
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.evaluate import open_measurable
from hjepa_cli.stages.measuring import curves_for, measure_points
from hjepa_cli.stages.verification import VERIFY_AT, show_verdicts, verdict
from hjepa_cli.storage.runs import Run


class ByFormula:
    """Counts devices under a law with a formula; arguments as of :func:`~.scale.run`."""

    columns = (
        *("snr_db", "method", "devices", "devices_ci95_low", "devices_ci95_high", "at_least"),
        *("load_per_block", "bits_per_s", "ratio_to_limit", "bits_per_transmission", "reason"),
    )

    def __init__(
        self,
        law: ClosedFormLaw,
        settings: Settings,
        screen: Screen,
        checkpoint: str | None = None,
        dataset: Path | None = None,
        further: Sequence[Path] | None = None,
    ) -> None:
        self.models = open_measurable(settings, screen, checkpoint, dataset, further)
        self._law, self._settings, self._screen = law, settings, screen
        self._cell = Cell.of(settings, plant_of(settings))
        self._frame_bits = functools.cache(self._bits_of)  # the same at every SNR

    def measured_methods(self, grid_db: Sequence[float]) -> dict[float, list[str]]:
        """Return by SNR the methods that can be measured, late where the law makes them so.

        Raw frames alone are driven so late: of the others, whose packets take slots in narrow bands
        only, the law subtracts the delay from the tolerated gap.
        """
        methods = self.models.measurable(self._settings.methods)
        return {snr_db: [self._in_time(name, snr_db) for name in methods] for snr_db in grid_db}

    def counted(
        self, record: Run, grid_db: Sequence[float], *, remeasure: bool, verify: bool
    ) -> dict[str, Any]:
        """Return this half of the document of ``--json``; measures what no curve is cached of."""
        wanted, protocol = self.measured_methods(grid_db), self._settings.protocol
        names = list(dict.fromkeys(name for at in wanted.values() for name in at))
        measured = curves_for(self.models, self._screen, record, remeasure=remeasure, methods=names)
        requirements = {
            name: LinkRequirement.measured(self._law.axis, name, entry)
            for name, entry in measured["methods"].items()
        }
        rows = [
            self._law.row(requirements[name], self._cell, snr_db)
            for snr_db, at in wanted.items()
            for name in at
        ]
        checks = self._verify(requirements.values()) if verify else []
        return {
            **{key: measured[key] for key in ("checkpoint", "checkpoints", "source")},
            "n_devices": protocol.bracket_devices,
            "warmup_steps": protocol.warmup_steps,
            "scored_steps": protocol.steps,
            "noise": self._settings.radio.noise,
            "rows": rows,
            **({"verify": checks} if verify else {}),
        }

    def gains(self, rows: Sequence[Row], snr_db: float) -> list[Row]:
        """Compare ``hjepa`` with ts-jepa-1, the best flat and reflex, hold and the oracle."""
        best = [row["method"] for one in (best_flat, best_reflex) if (row := one(rows, snr_db))]
        rivals = dict.fromkeys(["ts-jepa-1", *best, "hold", "oracle"])
        return [found for rival in rivals if (found := gain(rows, "hjepa", rival, snr_db))]

    def show(self, result: Mapping[str, Any]) -> None:
        """Print what a loop needs, how many fit, the gains beside the paper's."""
        screen, axis = self._screen, self._law.axis
        counts = ranked(result["rows"])
        loops = {
            f"{method}, {delay} steps late" if (delay := row.get("delay_steps", 0)) else method: row
            for method, rows in counts
            for row in reversed(rows)
        }
        screen.table(
            self.loop_title(result),
            ["method", axis.label, "bits", "bit/s", "÷limit"],
            [
                [
                    loop,
                    _span(row, "tolerance", axis.digits, axis.bound),
                    row["bits_per_transmission"],
                    None if row["bits_per_s"] is None else f"{row['bits_per_s']:,.0f}",
                    None if row["ratio_to_limit"] is None else f"{row['ratio_to_limit']:,.0f}",
                ]
                for loop, row in loops.items()
            ],
        )
        screen.table(
            f"devices: {described_cell(result)}; {counted_by(result)}",
            ["method", *(f"{row['snr_db']:g} dB" for row in counts[0][1])],
            [[method, *(_span(row, "devices", 0, "≥") for row in rows)] for method, rows in counts],
        )
        title, at = "driven now, inside and outside each tolerance", (axis.point, axis.point_label)
        show_verdicts(result, screen, title, "method", *at, axis.digits)
        for found in result["gains"]:
            paper = f"; the paper: up to +{result['paper_gain_percent']} %"  # over one-step TS-JEPA
            screen.result(
                f"{found['method']} over {found['over']} at {found['snr_db']:g} dB: "
                f"{percent(found['ratio'])} devices "
                f"(95 % CI {' to '.join(percent(end) for end in found['ratio_ci95'])})"
                + (paper if found["over"] == "ts-jepa-1" else "")
            )
        for method, (row, *_) in counts:
            if row["reason"]:
                screen.say(f"{method} at {row['snr_db']:g} dB: {row['reason']}")
        screen.say(result["source"])

    def loop_title(self, result: Mapping[str, Any]) -> str:
        """Return the title of the table of what a loop needs."""
        return (
            f"one {result['plant']} loop at score {result['acceptable_score']:g}: seed "
            f"{result['seed']}, {result['n_devices']} devices, {described_steps(result)}, 95 % CI; "
            f"limit λ/ln 2 = {result['limit_bits_per_s']:.1f} bit/s"
        )

    def _in_time(self, method: str, snr_db: float) -> str:
        if METHODS[method].sends != "frames":
            return method
        cell = self._cell.link(self._frame_bits(method), snr_db)
        delay_slots = self._law.asked("delay_slots", cell)
        return late(method, math.ceil(delay_slots * (1 - ROUNDING)))

    def _bits_of(self, method: str) -> int:
        """Return what a packet takes: of the pictures that the method's own model sees."""
        holder = self.models.of(method)
        return build_driver(method, holder.settings, holder.model).bits_per_transmission

    def _verify(self, loops: Iterable[LinkRequirement]) -> list[Row]:
        """Drive a block of loops a little inside and a little outside each tolerance."""
        sides = {late(loop.method, loop.delay_steps): self._sides(loop) for loop in loops}
        sides = {name: of for name, of in sides.items() if of}
        if not sides:
            return []
        kind, acceptable = self._law.axis.kind, self._settings.protocol.acceptable_score
        asked = {
            name: [Point(kind, value if kind == "gap" else 1 / value) for _, value, _ in of]
            for name, of in sides.items()
        }
        driven = measure_points(self.models, self._screen, asked)
        return [
            verdict(name, share, point, acceptable, inside=inside)
            for name, of in sides.items()
            for (share, _, inside), point in zip(of, driven[name], strict=True)
        ]

    def _sides(self, loop: LinkRequirement) -> list[tuple[float, float, bool]]:
        """Return where to drive a loop: share of its tolerance, value, and whether that is inside.

        A side is left out where it would be more than a packet in every slot, and the outside where
        the tolerance is only known as a bound.
        """
        axis = self._law.axis
        if not loop.tolerance or loop.tolerance == 1 or not loop.payload_bits:
            return []
        sides = []
        for share in VERIFY_AT:
            value, inside = share * loop.tolerance, (share < 1) == axis.larger_is_worse
            possible = value >= 1 if axis.larger_is_worse else value <= 1
            if possible and (inside or not loop.at_least):
                sides.append((share, value, inside))
        return sides


def _span(row: Row, key: str, digits: int, bound: str) -> str | None:
    return span(row[key], row[f"{key}_ci95"], digits, bound if row["at_least"] else "")
