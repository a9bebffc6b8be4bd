"""This list tells what each command takes, which stage does it, and what is particular about it.

What a command does is imported when it runs, so that ``--help`` and refusals answer at once; the
program is made of this list in :mod:`hjepa_cli.cli.builder`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from hjepa_cli.cli.flags import INPUTS, Input, stage_input
from hjepa_cli.config.checks import check_cell, compared_methods
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import origins
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import STAGES
from hjepa_cli.stages.stage import Imported

PIPELINE, TOOLS, WIRE = "Pipeline", "Tools", "Over a wire"
GROUPS = {
    "data": "Import, describe, verify, look at and export datasets.",
    "models": "List, describe and verify trained models.",
    "config": "Show settings.",
}

RESOLVED = ("preset", "config", "plant", "seed")  # what takes these is given settings
COMPUTED = (*RESOLVED, "device")
PARALLEL = ("workers", "cluster")
SHARED = (
    *("dataset", "encoder", "checkpoint", "remeasure", "figure", "verify", "tolerance_steps"),
)  # by stages
LOOP = ("methods", "protocol")
LOOKS = ("title", "labels", "log")  # of figures
LINK = ("protocol.delay_steps", "protocol.jitter_steps", "protocol.downlink_loss")
MEASURED = (
    *(*LOOP, "protocol.process_noise", "protocol.plant_spread", "protocol.payload"),
    *LINK,
    *("conditions.stress", "protocol.false_alarm"),
)

Given = dict[str, Any]  # what was given, by dotted key or argument; None: not given


@dataclasses.dataclass(frozen=True)
class Command:
    """Describes a command.

    Attributes:
        name: as typed, with its group.
        help: what it does.
        run: the stage; it is called with the settings, if the command takes any, the screen, and
            what the command takes besides settings.
        takes: dotted keys of settings and names of :data:`~hjepa_cli.cli.flags.INPUTS`, in the
            order of help.
        plan: what ``--dry-run`` shows; it is called with those arguments of ``run`` that it has.
        product: key of the result that a quiet run prints: the path that it made.
        shared: several processes of torchrun may do it together.
        prepare: changes what was given before settings are made of it.
        check: refuses what does not go with the settings, or adds what follows from both.
        panel: where the program's help lists a command that is in no group.
        own: what it takes that no other command does, by the names in ``takes``.
    """

    name: str
    help: str
    run: Callable[..., Any]
    takes: tuple[str, ...] = ()
    plan: Callable[..., Any] | None = None
    product: str | None = None
    shared: bool = False
    prepare: Callable[[Given], None] | None = None
    check: Callable[[Settings, Given], None] | None = None
    panel: str = PIPELINE
    own: Mapping[str, Input] = dataclasses.field(default_factory=dict)

    @property
    def resolves(self) -> bool:
        """Return whether its stage is given settings."""
        return "preset" in self.takes

    @property
    def all_taken(self) -> tuple[str, ...]:
        """Return what it takes, with what every command takes."""
        dry_run = ("dry_run",) if self.plan else ()
        return (*self.takes, "plugin", "json", "quiet", *dry_run, "debug")


def _one_level(given: Given) -> None:
    """Train a single level where ``--h`` alone is given."""
    h, m, l = (f"hierarchy.{level}" for level in "hml")
    if given[h] is not None and given[m] is None and given[l] is None:
        given[m] = given[l] = given[h]


def _figure_of_all(given: Given) -> None:
    if given["figure"] and given["methods"] is None and given["stress"] is None:
        given["methods"] = compared_methods()


def _one_link(given: Given) -> None:
    """Refuse two kinds of link, and begin the film with the start."""
    gap, delivery = given["gap_steps"], given["delivery"]
    if gap is not None and delivery is not None:
        raise UsageError(
            "--gap-steps is a link without fading, --delivery is of one with; give one of them",
            hint=f"hjepa view --gap-steps {gap:g}, or hjepa view --delivery {delivery:g}",
        )
    given |= {"protocol": "paper", "delivery": 0.05 if delivery is None else delivery}


def _check_cell(settings: Settings, given: Given) -> None:
    from hjepa_cli.core.radio.capacity import parse_snr

    parse_snr(settings.radio.snr_db)
    keys = (name.partition(":")[0] for name in SCALE)
    check_cell(settings.radio, {key: given[key] for key in keys}, settings.nr)


def _check_survival(settings: Settings, given: Given) -> None:
    from hjepa_cli.core.radio.capacity import parse_snr

    parse_snr(settings.radio.snr_db)
    check_cell(settings.radio, nr=settings.nr, command="survive")


def _add_sources(settings: Settings, given: Given) -> None:
    """Tell ``config show`` where its values come from."""
    flags = {key: given[key] for key in (*LOOP, "plant", "seed", "device")}
    given["sources"] = origins(settings.preset, given["config"], flags)


def _one_rule(settings: Settings, given: Given) -> None:
    if given["innovation"] is not None and given["gap_steps"] != INPUTS["gap_steps:wire"].default:
        raise UsageError("--gap-steps and --innovation are two rules to send by; give one of them")
    if given["innovation"] is None and given["longest_steps"] != INPUTS["longest_steps"].default:
        raise UsageError("--longest counts only with --innovation; without it, give --gap-steps")


def _one_schedule(settings: Settings, given: Given) -> None:
    if given["delivery"] is not None and given["gap_steps"] != INPUTS["gap_steps:wire"].default:
        raise UsageError("--gap-steps and --delivery are two kinds of uplink; give one of them")
    if given["lockstep"] and given["period_ms"]:
        raise UsageError("--lockstep counts time in the plant's steps: leave --period-ms out")


_LINK = tuple(
    f"{way}_{name}"
    for way in ("up", "down")
    for name in (
        *("loss", "burst", "delay_ms", "jitter_ms", "reorder", "duplicate", "rate_kbps", "trace"),
    )
)
SCALE = (
    *("radio.snr_db", "radio.law", "radio.schedulers", "radio.uncertainty", "radio.topology"),
    *("radio.bandwidth_hz", "radio.noise", "radio.power_margin_db", "radio.coherence_slots"),
    *("radio.fading", "radio.speed_m_s", "radio.phy", "nr.spacing_khz", "nr.duplex"),
    *("nr.pusch_symbols", "nr.mcs_table", "nr.mcs", "nr.bler_target", "nr.link_adaptation"),
    *("nr.cqi_age_slots", "nr.harq_rounds", "nr.grants", "nr.grants_per_slot", "nr.reports"),
    *("radio.seeds", *MEASURED, "remeasure", "verify", "tolerance_steps", "checkpoint"),
    *("dataset:clean", "out"),
)


def staged(name: str, takes: tuple[str, ...] = (), further: str = "", **more: Any) -> Command:
    """Return the command of a stage, which says itself what it does, and what a plugin's takes."""
    one, own = STAGES[name], {}
    if not takes:
        words = [word for word in one.inputs if word != "further"]
        own = {word: stage_input(word, one.default(word)) for word in words if word not in SHARED}
        takes = (*words, "out", *COMPUTED)
    text = f"{one.help}\n\n{further}".strip()
    return Command(name, text, one.run, takes, one.plan, one.product, one.shared, own=own, **more)


def commands() -> tuple[Command, ...]:
    """Return the commands of the package, and one for each stage that plugins in force add."""
    own = {command.name for command in COMMANDS}
    return (*COMMANDS, *(staged(name) for name in STAGES if name not in own))


COMMANDS = (
    staged(
        "collect",
        takes=(
            *("collect.trajectories", "collect.test_trajectories", "collect.steps"),
            *("collect.frames", "out", *RESOLVED, *PARALLEL),
        ),
    ),
    staged("tune-law", takes=("out", *RESOLVED), panel=TOOLS),
    staged(
        "train-encoder",
        takes=(
            *("encoder.method", "encoder.frames", "encoder.h", "encoder.steps", "encoder.gate"),
            *("dataset", "out", *COMPUTED),
        ),
    ),
    staged(
        "train-hierarchy",
        further="--h without --m and --l trains a single level: TS-JEPA of that depth.",
        takes=("hierarchy.h", "hierarchy.m", "hierarchy.l", "dataset", "encoder", "out", *COMPUTED),
        prepare=_one_level,
    ),
    staged(
        "train-reflex",
        further="Methods hold-decay, hold-decay-linear, chunk and chunk-forces, on a trained "
        "model's encoder.",
        takes=("dataset", "checkpoint", "out", *COMPUTED),
    ),
    staged(
        "train-fusion",
        further="Conditions are those of [conditions] and payload in --config FILE.toml.",
        takes=("protocol.payload", "dataset", "checkpoint", "out", *COMPUTED),
        panel=TOOLS,
    ),
    staged(
        "eval",
        takes=(
            *(*MEASURED, "stress", "remeasure", "figure", *LOOKS, "checkpoint", "dataset:clean"),
            *("out", *COMPUTED, *PARALLEL),
        ),
        prepare=_figure_of_all,
    ),
    staged("scale", takes=(*SCALE, *LOOKS, *COMPUTED, *PARALLEL), check=_check_cell),
    staged(
        "survive",
        takes=(
            *("survival.intervals_steps", "survival.loops", "survival.splitting_paths"),
            *("survival.loss", "survival.burst_transfers", "survival.mean_time_h"),
            *("radio.snr_db", "radio.bandwidth_hz", "radio.phy", "nr.spacing_khz", "nr.duplex"),
            *("nr.pusch_symbols", "nr.bler_target", "nr.harq_rounds"),
            *(*MEASURED, "checkpoint", "out", *COMPUTED, *PARALLEL),
        ),
        check=_check_survival,
    ),
    Command(
        "resume",
        "Take up an interrupted run: same settings, same inputs, same result.",
        Imported("hjepa_cli.stages.resume:run"),
        ("directory", *PARALLEL),
        plan=Imported("hjepa_cli.stages.resume:plan"),
        shared=True,
    ),
    staged("reproduce", takes=(*LOOP, "out", *COMPUTED, *PARALLEL)),
    Command(
        "view",
        "Watch closed loops over a fading link: true pole, believed pole, packets, SNR, age.",
        Imported("hjepa_cli.stages.view:run"),
        (
            *("methods:view", "devices", "snr_db", "delivery", "gap_steps", "every", "fps", "live"),
            *("radio.bandwidth_hz", *LINK, "conditions.stress", "protocol.false_alarm"),
            *("checkpoint", "out:animation", *COMPUTED),
        ),
        plan=Imported("hjepa_cli.stages.view:plan"),
        product="file",
        prepare=_one_link,
        panel=TOOLS,
    ),
    Command(
        "report",
        "Write what runs found as one HTML file: figures, tables, settings, commands.",
        Imported("hjepa_cli.stages.report:run"),
        ("paths:runs", "out:report", "figures", "formats", "film", *LOOKS),
        product="report",
        panel=TOOLS,
    ),
    Command(
        "compare",
        "Average evaluations over training seeds: means, 95 % intervals, paired differences.",
        Imported("hjepa_cli.stages.compare:run"),
        ("paths:evaluations", "methods:compare", "figures:compare", "formats", *LOOKS),
        panel=TOOLS,
    ),
    Command(
        "export",
        "Write a model for serve and device: ONNX networks, a manifest, checked against torch.",
        Imported("hjepa_cli.stages.export:run"),
        ("name_or_path:export", "to", "check", "method", "backend"),
        product="directory",
        plan=Imported("hjepa_cli.stages.export:plan"),
        panel=WIRE,
    ),
    Command(
        "serve",
        "Drive devices over UDP with an exported model.",
        Imported("hjepa_cli.stages.serve:run"),
        (
            *("model", "bind", "key:wire", "max_devices", "timeout_s", "metrics", "websocket"),
            *("backend", "for_s"),
        ),
        plan=Imported("hjepa_cli.stages.serve:plan"),
        panel=WIRE,
    ),
    Command(
        "device",
        "Be a device: look, encode, send, and play the forces that come back.",
        Imported("hjepa_cli.stages.device:run"),
        (
            *("model", "server", "key:wire", "number", "camera:wire", "crop", "actuator"),
            *("period_ms", "gap_steps:wire", "innovation", "longest_steps", "watchdog_ms", "local"),
            *("stop_after_s", "steps:wire", "precision", "backend", *RESOLVED),
        ),
        check=_one_rule,
        plan=Imported("hjepa_cli.stages.device:plan"),
        panel=WIRE,
    ),
    Command(
        "link",
        "Pass datagrams on as a bad network would: losses, delay, jitter, order, rate; seeded.",
        Imported("hjepa_cli.stages.link:run"),
        ("listen", "to:link", *_LINK, "seed:link", "for_s"),
        plan=Imported("hjepa_cli.stages.link:plan"),
        panel=WIRE,
    ),
    staged(
        "bench-link",
        further="Datagrams are delayed (--delay-steps, --jitter-steps, --trace) with --lockstep "
        "only; in real time hjepa link does that.",
        takes=(
            *("model", "devices:bench", "steps:bench", "lockstep", "period_ms", "gap_steps:wire"),
            *("delivery:bench", *LINK, "trace", "harm", "checkpoint:bench", "backend", "out"),
            *RESOLVED,
        ),
        check=_one_schedule,
        panel=WIRE,
    ),
    Command(
        "data import",
        "Make a dataset of recorded pictures and actions, of a plant that hjepa does not know.",
        Imported("hjepa_cli.stages.import_data:run"),
        (
            *("source", "test", "clean", "kind:import", "size", "grey", "limit"),
            *("fps:import", "action_offset", "steps:import", "held_out", "mirror_signs"),
            *("actions", "states", "expert", "camera", "skip_bad", "out"),
        ),
        plan=Imported("hjepa_cli.stages.import_data:plan"),
        product="dataset",
    ),
    Command(
        "data info",
        "Describe a dataset: plant, seed, splits, size, sha256.",
        Imported("hjepa_cli.stages.data:show_info"),
        ("path",),
    ),
    Command(
        "data verify",
        "Read every shard and check it against its sha256; without a name, all of data/.",
        Imported("hjepa_cli.stages.data:verify"),
        ("paths:datasets",),
    ),
    Command(
        "data preview",
        "Draw a contact sheet of camera frames (PNG).",
        Imported("hjepa_cli.stages.data:preview"),
        ("path", "split", "rows", "columns", "out:file"),
        product="picture",
    ),
    Command(
        "data export",
        "Write one split for other programs: HDF5 in stable-worldmodel's layout, or NPZ.",
        Imported("hjepa_cli.stages.data:export"),
        ("path", "split", "kind", "pixels", "out:file"),
        plan=Imported("hjepa_cli.stages.data:plan_export"),
        product="file",
    ),
    Command(
        "models list", "List the models of the zoo.", Imported("hjepa_cli.stages.models:show_list")
    ),
    Command(
        "models info",
        "Describe one model: architecture, training, health, sha256.",
        Imported("hjepa_cli.stages.models:show_info"),
        ("name_or_path",),
    ),
    Command(
        "models verify",
        "Check models against their sha256; without a name, all of the zoo.",
        Imported("hjepa_cli.stages.models:verify"),
        ("names",),
    ),
    Command(
        "config show",
        "Print every setting that a command would use, and where it comes from.",
        Imported("hjepa_cli.stages.show_config:show"),
        ("key", "as_toml", *LOOP, *COMPUTED),
        check=_add_sources,
    ),
)
