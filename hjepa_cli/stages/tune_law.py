"""``hjepa tune-law`` searches a control law that is good at sparse packets.

Settings → ``law.toml`` with the law that models learn and the one of method ``ceiling``. The laws
of shipped plants come with the package (``hjepa_cli/config/control_laws.toml``).
"""

import time
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.plants.control_law import instability
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training.law_search import GAPS, LawSearch
from hjepa_cli.errors import NumericalError, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import refuse_recorded
from hjepa_cli.stages.plan import Plan, run_directory, seconds_of
from hjepa_cli.storage.files import write_text
from hjepa_cli.storage.runs import Run

LAW = "law.toml"
WHY = "laws are searched in simulated loops"


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Search both laws and write them; return the document of ``--json``.

    Raises:
        NumericalError: the search found no law that holds the plant; both are written all the same.
    """
    _check(settings)
    kind = plant(settings.plant)
    with Run.create("tune-law", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            _show(record.result, screen)
            return record.result
        began = time.perf_counter()
        search = LawSearch.make(kind, settings.protocol, settings.tune, settings.seed)
        found: dict[str, Floats] = {}
        for name in ("gains_n", "ceiling_gains_n"):
            screen.say(f"searching control.{name} of plant {kind.name} on the true state")
            gains_n = search.gains_n(learnable=name == "gains_n")
            found[name] = np.round(gains_n, 3) + 0.0  # no gain is written as -0.0
        lines = [f"# hjepa tune-law --plant {kind.name} --seed {settings.seed}"]
        lines += [f'plant = "{kind.name}"', "", "[control]"]
        lines += [f"{name} = {gains.ravel().tolist()}" for name, gains in found.items()]
        write_text(record.path(LAW), "\n".join(lines) + "\n")
        for name, gains in found.items():
            if flaw := instability(kind, gains):
                raise NumericalError(
                    f"the control.{name} that was found {flaw}; it is in {record.path(LAW)}",
                    hint=f"more [tune] rounds than {settings.tune.rounds} in --config FILE.toml, "
                    f"or --seed {settings.seed + 1}",
                )
        result = {
            "plant": kind.name,
            "seed": settings.seed,
            "gaps": search.trial.gaps.tolist(),
            "scores": {name: search.drive(one[None])[0][0].tolist() for name, one in found.items()},
            **{name: gains.tolist() for name, gains in found.items()},
            "law": str(record.path(LAW)),
            "seconds": time.perf_counter() - began,
        }
        result = record.finish(result)
    _show(result, screen)
    screen.say(
        f"law {result['law']} in {result['seconds']:.0f} s; "
        f"next: {shell(['hjepa', 'collect', '--config', result['law']])}"
    )
    return result


def plan(settings: Settings, *, out: Path | None = None) -> Plan:
    """Plan both searches."""
    _check(settings)
    options, protocol = settings.tune, settings.protocol
    loops = 2 * options.candidates * options.rounds * options.devices * len(GAPS)
    return Plan(
        command="tune-law",
        reads=[],
        work=[
            f"search 2 laws of plant {settings.plant} in {options.rounds} rounds of "
            f"{options.candidates} candidates, each at {len(GAPS)} gaps on {options.devices} "
            "devices"
        ],
        writes=[f"run {run_directory('tune-law', out)} with {LAW}"],
        writes_bytes=10_000,
        seconds=seconds_of(
            {"device-steps of searches": 3 * loops * (protocol.warmup_steps + options.steps)}
        ),
    )


def _check(settings: Settings) -> None:
    """Refuse what no law is tuned for.

    Raises:
        UsageError: recordings; a link that is late or loses forces: whoever drives moves late
            packets on, the law itself need not know.
    """
    refuse_recorded(settings, WHY)
    if not settings.protocol.ideal_link:
        raise UsageError(
            "a law is tuned for packets and forces that arrive at once; those of this link do not",
            hint="leave delay_steps, jitter_steps and downlink_loss of [protocol] out here: "
            "controllers move late packets on",
        )


def _show(result: dict[str, Any], screen: Screen) -> None:
    rows = [
        [name, *(f"{score:.3f}" for score in scores)] for name, scores in result["scores"].items()
    ]
    screen.table(
        f"{result['plant']}, seed {result['seed']}: score by gap, in the teacher's with a packet "
        "at every step; true state and exact equations",
        ["law", *(f"{gap:.0f}" for gap in result["gaps"])],
        rows,
    )
