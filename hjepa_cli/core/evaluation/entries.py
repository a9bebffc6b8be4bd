"""``eval --json`` says of a method how it errs when left alone, and how its closed loop does."""

import threading
from concurrent.futures import Future
from typing import Any

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.evaluation.bench import Bench, control_entry
from hjepa_cli.core.evaluation.control_errors import ControlErrors
from hjepa_cli.core.evaluation.curves import Entry
from hjepa_cli.core.evaluation.simulator import Simulator
from hjepa_cli.core.evaluation.workers import ModelFile, Workers


class MethodEntries:
    """Measures the methods of one model beside a bench's teacher; several threads may ask for some.

    ``rollouts`` are clean ones: states [R, steps + 1, S] and the teacher's forces [R, steps, *A].
    """

    def __init__(
        self,
        bench: Bench,
        workers: Workers,
        settings: Settings,
        model: ModelFile | None,
        rollouts: tuple[Floats, Floats],
    ) -> None:
        self._workers, self._settings, self._model = workers, settings, model
        self._bench = bench.sharing(workers.runner(settings, model))
        self._rollouts, self._lock = rollouts, threading.Lock()
        self._every_packet: dict[str, Future[Any]] = {}

    def entry(self, name: str) -> Entry:
        """Return the entry of a method in ``eval --json``."""
        alone = self._submit(ControlErrors(name, *self._rollouts))
        [(errors, driver)] = self._workers.results([alone], self._bench.tick)
        with self._lock:  # with every packet a family plays the same
            if driver.family not in self._every_packet:
                unit = ControlErrors(name, *self._rollouts, every_packet=True)
                self._every_packet[driver.family] = self._submit(unit)
        curves_of = self._bench.entry(driver)
        every_packet = self._every_packet[driver.family]
        [(every, _)] = self._workers.results([every_packet], self._bench.tick)
        seed, replicates = self._settings.seed, self._settings.protocol.bootstrap
        return {
            **control_entry(errors, every, replicates, seed),
            **curves_of,
            "teacher_score": self._bench.teacher_score,
            "seed": seed,
        }

    def _submit(self, unit: ControlErrors) -> "Future[Any]":
        return self._workers.submit(Simulator, self._settings, self._model, unit)
