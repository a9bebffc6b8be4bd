"""This half of ``hjepa scale`` counts by the law ``scheduled``, from loads that are simulated.

One resource block is simulated with its devices, radio and scheduler in one loop; the largest load
that keeps the score acceptable, times the transmissions that fit into a slot, are the devices.
"""

import operator
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import check_schedulable, check_warmup
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control import link
from hjepa_cli.core.control.loop import check_memory
from hjepa_cli.core.evaluation.device_ratios import best_flat, comparable, ratio_of
from hjepa_cli.core.evaluation.load_search import BLOCK_DEVICES
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.errors import MissingInputError
from hjepa_cli.output.screen import Screen, span
from hjepa_cli.output.tables import described_cell
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.block_loads import BlockLoads
from hjepa_cli.stages.model_set import open_model_set
from hjepa_cli.stages.verification import show_verdicts
from hjepa_cli.storage.runs import Run

_most = operator.itemgetter("devices")


class BySimulation:
    """Counts devices under each scheduler; arguments as of :func:`~.scale.run`.

    Attributes:
        methods: those of the settings' methods that share a band.

    Raises:
        UsageError: a method whose packets do not fit into slots, or too few slots.
        MissingInputError: no such checkpoint, or none with any of the methods.
    """

    columns = (
        *("snr_db", "method", "scheduler", "devices", "devices_ci95_low", "devices_ci95_high"),
        *("at_least", "load_per_block", "bits_per_s", "ratio_to_limit", "bits_per_transmission"),
        *("packets_per_block_slot", "reports_per_block_slot", "reports_share", "reason"),
    )

    def __init__(
        self,
        settings: Settings,
        screen: Screen,
        checkpoint: str | None = None,
        further: Sequence[Path] | None = None,
    ) -> None:
        linked = [name for name in settings.methods if METHODS[name].needs_link]
        check_schedulable(linked, settings.protocol.total_steps)
        check_warmup(settings.protocol)
        check_memory(settings.protocol, BLOCK_DEVICES)
        self._settings, self._screen = settings, screen
        self.models = open_model_set(settings, screen, checkpoint, None, further)
        self.methods = self.models.measurable(linked)
        skipped = self.models.skipped(settings.methods)
        if not self.methods:
            hint = next(iter(skipped.values()), "choose a method that has a link")
            names = ", ".join(settings.methods)
            raise MissingInputError(f"nothing to schedule for {names}", hint=hint)
        self.models.say_skipped(settings.methods, screen)

    def counted(
        self, record: Run, grid_db: Sequence[float], *, remeasure: bool, verify: bool
    ) -> dict[str, Any]:
        """Return this half of the document of ``--json``; simulates every load anew."""
        radio, protocol = self._settings.radio, self._settings.protocol
        with open_workers(BLOCK_DEVICES * protocol.total_steps) as workers:
            loads = BlockLoads(self.models, self._screen, workers)
            with closing(loads.find(self.methods, grid_db)) as found:
                for name, scheduler in found:
                    record.event("measured", method=name, scheduler=scheduler)
            checked_db = grid_db if radio.load_depends_on_snr else grid_db[:1]
            checks = loads.verify(self.methods, checked_db) if verify else []
        return {
            "checkpoint": self.models.path,
            "seeds": radio.seeds,
            "n_devices": BLOCK_DEVICES,
            "uncertainty": radio.uncertainty,
            "topology": radio.topology,
            "power_margin_db": radio.power_margin_db if radio.topology == "target" else None,
            "coherence_slots": radio.coherence_slots,
            "fading": radio.fading,
            "speed_m_s": None if radio.fading == "block" else radio.speed_m_s,
            "overhead_bits": radio.overhead_bits,
            "block_error": radio.block_error,
            "harq_rounds": radio.harq_rounds,
            "payload": protocol.payload,
            "rows": [
                loads.row(name, scheduler, snr_db)
                for snr_db in sorted(grid_db)
                for name in self.methods
                for scheduler in radio.schedulers
            ],
            **({"verify": checks} if verify else {}),
        }

    def gains(self, rows: Sequence[Row], snr_db: float) -> list[Row]:
        """Compare schedulers with round robin, methods being equal, and ``hjepa`` with its rivals.

        The rivals are the best flat predictor and the oracle; all three with their best scheduler.
        Counts that are bounds are not compared.
        """
        at = [row for row in rows if row["snr_db"] == snr_db and row["devices"]]
        pairs = [
            (row, turns)
            for turns in at
            for row in at
            if turns["scheduler"] == "round-robin" != row["scheduler"]
            and turns["method"] == row["method"]
        ]
        ours, oracle = (
            max((row for row in at if row["method"] == name), key=_most, default=None)
            for name in ("hjepa", "oracle")
        )
        if ours:
            pairs += [(ours, rival) for rival in (best_flat(at, snr_db), oracle) if rival]
        return [
            {"snr_db": snr_db, "method": _label(row), "over": _label(rival), **ratio_of(row, rival)}
            for row, rival in pairs
            if comparable(row, rival)
        ]

    def show(self, result: Mapping[str, Any]) -> None:
        """Print what a block carries and how many devices the cell has."""
        screen, grid_db = self._screen, list(dict.fromkeys(row["snr_db"] for row in result["rows"]))
        lines = [row for row in result["rows"] if row["snr_db"] == grid_db[0]]
        sample = f"{result['seeds']} seeds" if result["seeds"] > 1 else f"seed {result['seed']}"
        sample += link.described(result.get("link", {}))
        screen.table(
            f"one resource block of {result['plant']} loops at score "
            f"{result['acceptable_score']:g}, {grid_db[0]:g} dB: {sample}, 95 % CI; "
            f"limit λ/ln 2 = {result['limit_bits_per_s']:.1f} bit/s",
            ["method, scheduler", "devices/block", "reports/slot", "bits", "bit/s", "÷limit"],
            [
                [
                    _label(row),
                    _span(row, "load_per_block", "load_ci95", 1),
                    _number(row.get("reports_per_block_slot"), 2),
                    row["bits_per_transmission"],
                    _number(row["bits_per_s"], 0),
                    _number(row["ratio_to_limit"], 0),
                ]
                for row in lines
            ],
        )
        count = {(_label(row), row["snr_db"]): row for row in result["rows"]}
        links = (
            f"power margin {result['power_margin_db']:g} dB"
            if result["topology"] == "target"
            else "devices in a hall"
        )
        fades = f"coherence {result['coherence_slots']:g} slots"
        if result["fading"] != "block":
            fades = f"{result['fading']} at {result['speed_m_s']:g} m/s"
        screen.table(
            f"devices: {described_cell(result)}, payload {result['payload']}, {links}, {fades}",
            ["method, scheduler", *(f"{snr_db:g} dB" for snr_db in grid_db)],
            [
                [label, *(_span(count[label, at], "devices", "devices_ci95", 0) for at in grid_db)]
                for label in map(_label, lines)
            ],
        )
        covered: dict[float, list[float]] = {}  # by the width of packets, if these differ
        for row in result["rows"]:
            if "coverage" in row:
                covered.setdefault(row["snr_db"], []).append(row["coverage"])
        if covered:
            ends = {
                at: dict.fromkeys(f"{end(of):.0%}" for end in (min, max))
                for at, of in covered.items()
            }
            shares = ", ".join(f"{' to '.join(of)} at {at:g} dB" for at, of in ends.items())
            screen.result(f"devices of the hall whose power suffices at mean fading: {shares}")
        title, at = "simulated again, inside and outside each load", ("load", "devices/block")
        show_verdicts(result, screen, title, "method, scheduler", *at, digits=1)
        for found in result["gains"]:
            low, high = found["ratio_ci95"]
            bound = "unbounded" if high is None else f"{high:.2f}"
            screen.result(
                f"{found['method']} over {found['over']} at {found['snr_db']:g} dB: "
                f"{found['ratio']:.2f} x devices (95 % CI {low:.2f} to {bound})"
            )
        for row in lines:
            if row["reason"]:
                screen.say(f"{_label(row)} at {grid_db[0]:g} dB: {row['reason']}")


def _label(row: Row) -> str:
    return f"{row['method']}, {row['scheduler']}"


def _span(row: Row, value: str, interval: str, digits: int) -> str | None:
    if row.get(value) is None:
        return None
    return span(row[value], row[interval], digits, "≥" if row["at_least"] else "")


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:,.{digits}f}"
