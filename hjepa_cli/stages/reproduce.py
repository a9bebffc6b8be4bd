"""``hjepa reproduce``: all five stages into one folder, then the report.

Settings → ``runs/reproduce/<nnnn>/`` with the dataset, one run per stage and ``report.html``. Each
stage reads what the one before it left in the folder and nothing else; the same command with
``--out`` and the folder goes on after the last finished stage.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hjepa_cli import plan
from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings
from hjepa_cli.stages import (
    collect,
    evaluate,
    report,
    scale,
    train_encoder,
    train_hierarchy,
)
from hjepa_cli.storage.checkpoints import MODEL_FILE
from hjepa_cli.storage.runs import Run

Result = dict[str, Any]


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> Result:
    """Run the whole pipeline; returns the document of ``--json``.

    Raises:
        As the stages; what is finished stays.
    """
    with Run.create("reproduce", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            return record.result
        folder = record.directory
        if settings.preset == report.SMOKE:
            screen.say(report.NO_RESULT)
        work = stages(settings, screen, folder)
        parts = plan.reproduce_parts(settings)
        expected_s = {name: round(seconds) for name, (_, seconds) in parts.items()}
        results: Result = {}
        with screen.progress("all stages", sum(expected_s.values())) as bar:
            for number, (name, stage) in enumerate(work.items(), start=1):
                screen.say(f"stage {number} of {len(work)}: {name}")
                results[name] = stage()
                record.event("finished", stage=name)
                bar.advance(expected_s[name])
        made = report.run(screen, [folder], out=folder / "report.html", figures=folder / "figures")
        return record.finish({"folder": folder, **results, "report": made["report"]})


def stages(settings: Settings, screen: Screen, folder: Path) -> dict[str, Callable[[], Result]]:
    """The five stages, each bound to what it reads and writes in ``folder``."""
    data, model = folder / "data", str(folder / "train-hierarchy")

    def trained_hierarchy() -> Result:
        return train_hierarchy.run(
            settings,
            screen,
            dataset=data,
            encoder=str(folder / "train-encoder" / MODEL_FILE),
            out=folder / "train-hierarchy",
        )

    return {
        "collect": lambda: collect.run(settings, screen, out=data),
        "train-encoder": lambda: train_encoder.run(
            settings, screen, dataset=data, out=folder / "train-encoder"
        ),
        "train-hierarchy": trained_hierarchy,
        "eval": lambda: evaluate.run(
            settings, screen, checkpoint=model, dataset=data, out=folder / "eval"
        ),
        "scale": lambda: scale.run(
            settings, screen, checkpoint=model, dataset=data, out=folder / "scale"
        ),
    }
