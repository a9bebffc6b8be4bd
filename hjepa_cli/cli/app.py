"""The command line: flags to settings, stages to results, errors to one line and an exit code.

Nothing heavy is imported here: a command imports its stage when it runs, so that ``--help`` answers
at once. Defaults live in ``presets/default.toml``, not in the signatures below: a flag that is not
given is ``None`` and changes nothing.
"""

import contextlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, NoReturn, TextIO

import typer
from typer.main import get_command

from hjepa_cli import __version__
from hjepa_cli.cli import flags as options
from hjepa_cli.cli.execution import PipeClosed, Result, execute, guard, print_help
from hjepa_cli.cli.tools import compare, config_app, data_app, report, reproduce, view
from hjepa_cli.compute import torchrun
from hjepa_cli.config.checks import COMPARED, check_flags_of_law
from hjepa_cli.config.resolve import resolve
from hjepa_cli.errors import DataError, HjepaError, StorageError, UsageError
from hjepa_cli.output.screen import Screen, one_line
from hjepa_cli.stages import plan
from hjepa_cli.stages.plan import Plan

PIPELINE, TOOLS = "Pipeline", "Tools"
STAGES = ("collect", "train-encoder", "train-hierarchy", "eval", "scale")

app = typer.Typer(
    help="How many cart-poles does one radio cell support when a hierarchical JEPA drives them? "
    f"The stages, in order: {', '.join(STAGES)}. The last two also work alone, on a zoo model.",
    pretty_exceptions_enable=False,
)
models_app = typer.Typer(help="List, describe and verify trained models.")
app.add_typer(data_app, name="data", rich_help_panel=TOOLS)
app.add_typer(models_app, name="models", rich_help_panel=TOOLS)
app.add_typer(config_app, name="config", rich_help_panel=TOOLS)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit: the only place where an error becomes a line and a code.

    Args:
        arguments: command line without the program's name; by default that of the process.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII-only terminal gets "?", not a crash
            stream.reconfigure(errors="replace")
    if not torchrun.follows():
        sys.exit(_run_command(argv, sys.stderr))
    errors = sys.stderr
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        code = _run_command(argv, errors)
    sys.exit(code)


def _run_command(argv: list[str], errors: TextIO) -> int:
    """Run one command; return the exit code after reporting any error to ``errors``."""
    try:
        returned = get_command(app).main(argv, prog_name="hjepa", standalone_mode=False)
        return returned if isinstance(returned, int) else 0
    except Exception as error:  # the last resort of a command line
        if "--debug" in argv or os.environ.get("HJEPA_DEBUG", "0") not in ("", "0"):
            traceback.print_exc()
        failure = _expected(error, argv)
    if isinstance(failure, PipeClosed):  # keep Python from complaining about its last flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return failure.exit_code
    if torchrun.follows() and not isinstance(failure, torchrun.OneOfSeveral):
        return failure.exit_code  # the process that leads says the same
    screen = Screen(json="--json" in argv, stderr=errors)
    screen.error(failure.message, failure.hint)
    if screen.json:
        message, hint = one_line(failure.message), failure.hint
        screen.emit({"error": {"code": failure.exit_code, "message": message, "hint": hint}})
    return failure.exit_code


def _expected(error: Exception, argv: list[str]) -> HjepaError:
    """Every exception as one of ours: a message, a hint and an exit code."""
    named, group = [], get_command(app)
    for word in argv:
        if word in (inside := getattr(group, "commands", {})):
            named.append(word)
            group = inside[word]
    usage = f"commands: {', '.join(getattr(group, 'commands', {}))}"
    if named:
        usage = f"hjepa {' '.join(named)} --help"
    if isinstance(error, HjepaError):
        if error.hint is None:
            again = "restore the file or make it again; what this command reads: "
            error.hint = again + usage if isinstance(error, DataError) else usage
        return error
    if hasattr(error, "format_message"):  # Typer's usage errors; it has no public base class
        return UsageError(" ".join(error.format_message().split()), hint=usage)
    if isinstance(error, OSError):
        where = f": {error.filename}" if error.filename else ""
        return StorageError(
            f"{error.strerror or error}{where}", hint="check the path, its permissions and the disk"
        )
    first_line = next(iter(str(error).splitlines()), "")
    return HjepaError(
        f"unexpected {type(error).__name__}: {first_line}",
        hint="run it again with --debug (or HJEPA_DEBUG=1) to see the traceback, and report it",
    )


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"hjepa {__version__}")
        raise typer.Exit()


# --- commands -------------------------------------------------------------------------------------


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            help="Print the version.",
            rich_help_panel=options.SCREEN,
            callback=_print_version,
            is_eager=True,
            show_default=False,
        ),
    ] = False,
) -> None:
    print_help(context)


@app.command(rich_help_panel=PIPELINE)
def collect(
    trajectories: options.TrajectoryCount = None,
    test_trajectories: options.TestTrajectoryCount = None,
    steps: options.TrajectorySteps = None,
    frames: options.Frames = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Simulate cart-poles under an exploring teacher and store them as a dataset."""
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "collect.trajectories": trajectories,
            "collect.test_trajectories": test_trajectories,
            "collect.steps": steps,
            "collect.frames": frames,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.collect import run

        return run(settings, screen, out=out)

    execute(
        screen,
        stage,
        lambda: plan.plan_collect(settings, out),
        dry_run=dry_run,
        product="dataset",
        workers=workers,
        cluster=cluster,
    )


@app.command("train-encoder", rich_help_panel=PIPELINE)
def train_encoder(
    method: options.EncoderMethod = None,
    frames: options.InputFrames = None,
    h: options.StrideH = None,
    steps: options.TrainingSteps = None,
    gate: options.Gate = None,
    dataset: options.Dataset = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Learn an encoder of camera frames by joint-embedding prediction, or train a baseline."""
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "encoder.method": method,
            "encoder.frames": frames,
            "encoder.h": h,
            "encoder.steps": steps,
            "encoder.gate": gate,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.train_encoder import run

        return run(settings, screen, dataset=dataset, out=out)

    execute(
        screen,
        stage,
        lambda: plan.plan_train_encoder(settings, dataset, out),
        dry_run=dry_run,
        product="checkpoint",
        shared=True,
    )


@app.command("train-hierarchy", rich_help_panel=PIPELINE)
def train_hierarchy(
    h: options.StrideH = None,
    m: options.StrideM = None,
    l: options.StrideL = None,
    dataset: options.Dataset = None,
    encoder: options.Encoder = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Train the predictors of the hierarchy, the flat baseline and the semantic actor.

    --h without --m and --l trains a single level: TS-JEPA of that depth.
    """
    if h is not None and m is None and l is None:
        m = l = h
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "hierarchy.h": h,
            "hierarchy.m": m,
            "hierarchy.l": l,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.train_hierarchy import run

        return run(settings, screen, dataset=dataset, encoder=encoder, out=out)

    execute(
        screen,
        stage,
        lambda: plan.plan_train_hierarchy(settings, dataset, encoder, out),
        dry_run=dry_run,
        product="checkpoint",
    )


@app.command("train-reflex", rich_help_panel=PIPELINE)
def train_reflex(
    dataset: options.Dataset = None,
    checkpoint: options.Checkpoint = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Train rivals of the predictors: what a packet and its age say, without predicting anything.

    Methods hold-decay, hold-decay-linear, chunk and chunk-forces, on a trained model's encoder.
    """
    settings = resolve(preset, config, {"plant": plant, "seed": seed, "device": device})
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.train_reflex import run

        return run(settings, screen, dataset=dataset, checkpoint=checkpoint, out=out)

    execute(
        screen,
        stage,
        lambda: plan.plan_train_reflex(settings, dataset, checkpoint, out),
        dry_run=dry_run,
        product="checkpoint",
    )


@app.command("eval", rich_help_panel=PIPELINE)
def evaluate(
    methods: options.Methods = None,
    protocol: options.Protocol = None,
    process_noise: options.ProcessNoise = None,
    plant_spread: options.PlantSpread = None,
    payload: options.Payload = None,
    remeasure: options.Remeasure = False,
    figure: options.Figure = False,
    checkpoint: options.Checkpoint = None,
    dataset: options.CleanDataset = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Measure prediction error, control score and tolerated losses of each method."""
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "methods": COMPARED if figure and methods is None else options.split_names(methods),
            "protocol": protocol,
            "protocol.process_noise": process_noise,
            "protocol.plant_spread": plant_spread,
            "protocol.payload": payload,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.evaluate import run

        return run(
            settings,
            screen,
            checkpoint=checkpoint,
            dataset=dataset,
            out=out,
            remeasure=remeasure,
            figure=figure,
        )

    execute(
        screen,
        stage,
        lambda: plan.plan_eval(
            settings, checkpoint, dataset, out, remeasure=remeasure, figure=figure
        ),
        dry_run=dry_run,
        workers=workers,
        cluster=cluster,
    )


@app.command(rich_help_panel=PIPELINE)
def scale(
    snr: options.Snr = None,
    law: options.Law = None,
    scheduler: options.Schedulers = None,
    uncertainty: options.Uncertainty = None,
    topology: options.Topology = None,
    bandwidth_mhz: options.BandwidthMhz = None,
    noise: options.Noise = None,
    power_margin_db: options.PowerMarginDb = None,
    coherence_slots: options.CoherenceSlots = None,
    seeds: options.Seeds = None,
    methods: options.Methods = None,
    protocol: options.Protocol = None,
    process_noise: options.ProcessNoise = None,
    plant_spread: options.PlantSpread = None,
    payload: options.Payload = None,
    remeasure: options.Remeasure = False,
    verify: options.Verify = False,
    checkpoint: options.Checkpoint = None,
    dataset: options.CleanDataset = None,
    out: options.Out = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Count the devices that one radio cell supports, by method and signal-to-noise ratio."""
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "methods": options.split_names(methods),
            "protocol": protocol,
            "protocol.process_noise": process_noise,
            "protocol.plant_spread": plant_spread,
            "protocol.payload": payload,
            "radio.snr_db": snr,
            "radio.law": law,
            "radio.bandwidth_hz": None if bandwidth_mhz is None else bandwidth_mhz * 1e6,
            "radio.noise": noise,
            "radio.schedulers": options.split_names(scheduler),
            "radio.uncertainty": uncertainty,
            "radio.topology": topology,
            "radio.power_margin_db": power_margin_db,
            "radio.coherence_slots": coherence_slots,
            "radio.seeds": seeds,
        },
    )
    screen = Screen(quiet, as_json)
    with guard():
        from hjepa_cli.core.radio.capacity import parse_snr

        snr_db = parse_snr(settings.radio.snr_db)
        given = {
            "--scheduler": scheduler is not None,
            "--uncertainty": uncertainty is not None,
            "--topology": topology is not None,
            "--power-margin-db": power_margin_db is not None,
            "--coherence-slots": coherence_slots is not None,
            "--seeds": seeds is not None,
            "--noise": noise is not None,
            "--remeasure": remeasure,
            "--dataset": dataset is not None,
        }
        check_flags_of_law(settings.radio.law, given)

    def stage() -> Result:
        from hjepa_cli.stages.scale import run

        return run(
            settings,
            screen,
            checkpoint=checkpoint,
            dataset=dataset,
            out=out,
            remeasure=remeasure,
            verify=verify,
        )

    execute(
        screen,
        stage,
        lambda: plan.plan_scale(
            settings, checkpoint, dataset, out, snr_db, remeasure=remeasure, verify=verify
        ),
        dry_run=dry_run,
        workers=workers,
        cluster=cluster,
    )


@app.command(rich_help_panel=PIPELINE)
def resume(
    directory: options.RunDirectory,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Take up an interrupted run: same settings, same inputs, same result."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.resume import run

        return run(directory, screen)

    def planned() -> Plan:
        from hjepa_cli.stages.resume import planned

        return planned(directory)

    execute(screen, stage, planned, dry_run=dry_run, workers=workers, cluster=cluster, shared=True)


app.command(rich_help_panel=PIPELINE)(reproduce)
app.command(rich_help_panel=TOOLS)(view)
app.command(rich_help_panel=TOOLS)(report)
app.command(rich_help_panel=TOOLS)(compare)


@models_app.callback(invoke_without_command=True)
def models(context: typer.Context) -> None:
    print_help(context)


@models_app.command("list")
def list_models(
    as_json: options.Json = False, quiet: options.Quiet = False, debug: options.Debug = False
) -> None:
    """List the models of the zoo."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.models import show_list

        return show_list(screen)

    execute(screen, stage)


@models_app.command()
def info(
    name: options.ModelName,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Describe one model: architecture, training, health, sha256."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.models import show_info

        return show_info(screen, name)

    execute(screen, stage)


@models_app.command()
def verify(
    names: options.ModelNames = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Check models against their sha256; without a name, all of the zoo."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.models import verify

        return verify(screen, names or [])

    execute(screen, stage)
