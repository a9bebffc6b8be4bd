"""This part of ``hjepa scale`` counts the devices of a gap between packets that somebody states.

Where no closed loop exists, as with recordings, nothing can be measured that the count would follow
from; what a packet costs is known all the same.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from hjepa_cli.config.schema import LONGEST_GAP_STEPS, Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control import link
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.closed_form import ClosedFormLaw
from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.core.radio.laws.requirement import LinkRequirement
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.output.tables import described_gap
from hjepa_cli.plugins import CODECS
from hjepa_cli.stages.model_set import ModelSet, load_first, under_law_of
from hjepa_cli.stages.scale_by_formula import ByFormula
from hjepa_cli.storage.runs import Run


def refuse_measuring(settings: Settings, given: Mapping[str, object]) -> None:
    """Raise UsageError for methods, or what else is ``given`` by its flag, to measure with."""
    own = settings.methods != load_settings(settings.preset).methods
    if asked := [*["--methods"] * own, *(flag for flag, value in given.items() if value)]:
        raise UsageError(
            f"{asked[0]} is of what is measured; with --tolerance-steps nothing is",
            hint=f"leave out {asked[0]}, or --tolerance-steps to measure",
            key="methods" if own else None,
        )


class ByTolerance(ByFormula):
    """Counts devices whose packets come a stated number of steps apart; the model says their bits.

    Raises:
        UsageError: a gap of less than a step, or of more than counts can take.
    """

    def __init__(
        self,
        law: ClosedFormLaw,
        settings: Settings,
        screen: Screen,
        tolerance_steps: float,
        checkpoint: str | None = None,
    ) -> None:
        if not 1 <= tolerance_steps <= LONGEST_GAP_STEPS:
            allowed = f"expected 1 to {LONGEST_GAP_STEPS:g}"
            raise UsageError(f"--tolerance-steps {tolerance_steps:g}; {allowed}")
        path, model = load_first(settings, screen, checkpoint)
        if model:
            settings = under_law_of(model, settings)
        self.models = ModelSet(settings, model, path, None)
        self._law, self._settings, self._screen = law, settings, screen
        self._steps, self._kind = tolerance_steps, plant_of(settings)
        self._cell = Cell.of(settings, self._kind)
        embedding = model.architecture["embedding"] if model else settings.encoder.embedding
        told = link.confirmation_bits(settings.protocol, len(self._kind.force_signs))
        self._bits = CODECS[settings.protocol.payload].bits(embedding) + told
        self._name = described_gap(tolerance_steps)

    def measured_methods(self, grid_db: Sequence[float]) -> dict[float, list[str]]:
        """Return no method: nothing is measured."""
        return {snr_db: [] for snr_db in grid_db}

    def counted(
        self, record: Run, grid_db: Sequence[float], *, remeasure: bool, verify: bool
    ) -> dict[str, Any]:
        """Return this half of the document of ``--json``."""
        gap = self._steps
        loop = LinkRequirement(
            method=self._name,
            tolerance=gap if self._law.axis.larger_is_worse else 1 / gap,
            interval=None,
            at_least=False,
            payload_bits=self._bits,
            delay_steps=0,
            warmup_steps=self._settings.protocol.warmup_steps,
            scored_steps=self._settings.protocol.steps,
        )
        return {
            "checkpoint": self.models.path,
            "checkpoints": {},
            "skipped": {},
            "source": f"{self._name} between packets as stated, not measured",
            "slot_s": self._kind.step_s,
            "tolerance_steps": self._steps,
            "n_devices": 0,
            "warmup_steps": 0,
            "scored_steps": 0,
            "noise": self._settings.radio.noise,
            "rows": [self._law.row(loop, self._cell, snr_db) for snr_db in grid_db],
        }

    def gains(self, rows: Sequence[Row], snr_db: float) -> list[Row]:
        """Return nothing: there is nothing to compare with."""
        return []

    def loop_title(self, result: Mapping[str, Any]) -> str:
        """Return the title of the table of what a loop needs."""
        return f"one {result['plant']} loop, as stated; nothing was driven"
