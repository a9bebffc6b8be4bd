"""The command line: flags to settings, stages to results, errors to one line and an exit code.

Nothing heavy is imported here: a command imports its stage when it runs, so that ``--help`` answers
at once. Defaults live in ``presets/default.toml``, not in the signatures below: a flag that is not
given is ``None`` and changes nothing.
"""

import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.main import get_command

from hjepa_cli import __version__, options, plan
from hjepa_cli.checks import check_settings
from hjepa_cli.errors import DataError, HjepaError, StorageError, UsageError
from hjepa_cli.screen import Screen, one_line
from hjepa_cli.settings import Settings, load_settings

Result = dict[str, Any]

PIPELINE = "Pipeline"
STAGES = ("collect", "train-encoder", "train-hierarchy", "eval", "scale")

app = typer.Typer(
    help="How many cart-poles does one radio cell support when a hierarchical JEPA drives them? "
    f"The stages, in order: {', '.join(STAGES)}. The last two also work alone, on a zoo model.",
    pretty_exceptions_enable=False,
)
models_app = typer.Typer(help="List, describe and verify trained models.")
app.add_typer(models_app, name="models", rich_help_panel="Models")


class Interrupted(HjepaError):
    """Ctrl-C."""

    exit_code = 130


class PipeClosed(HjepaError):
    """Whoever read our output has gone, as in ``hjepa scale | head -1``: end without a word."""

    exit_code = StorageError.exit_code


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit: the only place where an error becomes a line and a code.

    Args:
        arguments: command line without the program's name; by default that of the process.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII-only terminal gets "?", not a crash
            stream.reconfigure(errors="replace")
    sys.exit(_run_command(argv))


def _run_command(argv: list[str]) -> int:
    """Run one command; return the exit code after reporting any error."""
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
    screen = Screen(json="--json" in argv)
    screen.error(failure.message, failure.hint)
    if screen.json:
        message, hint = one_line(failure.message), failure.hint
        screen.emit({"error": {"code": failure.exit_code, "message": message, "hint": hint}})
    return failure.exit_code


def _expected(error: Exception, argv: list[str]) -> HjepaError:
    """Every exception as one of ours: a message, a hint and an exit code."""
    command = next((word for word in argv if word in (*STAGES, "models")), None)
    usage = f"hjepa {command} --help" if command else f"commands: {', '.join(STAGES)}, models"
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


def _settings(preset: str | None, config: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Merge preset, file and flags; refuse values that make no sense before anything is touched.

    A plant has its own ranges and noise, so ``--plant gym`` alone means its preset.
    """
    plant = flags["plant"]
    if preset is None and plant == "gym":
        preset = "gym"
    settings = load_settings(preset, config, flags)
    if plant is not None and (preset == "gym") != (plant == "gym"):
        raise UsageError(
            f"preset '{settings.preset}' holds the ranges and noise of the other plant, "
            f"not of '{plant}'",
            hint="--preset gym for plant gym, and --config FILE.toml for other values of it",
        )
    check_settings(settings)
    return settings


def _execute(
    screen: Screen,
    stage: Callable[[], Result],
    planned: Callable[[], plan.Plan] | None = None,
    *,
    dry_run: bool = False,
    product: str | None = None,
) -> None:
    """Run a stage, or show its plan, and print what it returns.

    Args:
        stage: the work.
        planned: its plan.
        dry_run: show the plan only.
        product: key of the result that a quiet run prints: the path that it made.
    """
    with _guard():
        if dry_run and planned is not None:
            planned().show(screen)
            return
        result = stage()
        if screen.json:
            screen.emit(result)
        elif screen.quiet and product is not None:  # otherwise the stage has said where it is
            screen.result(str(result[product]))


@contextmanager
def _guard() -> Iterator[None]:
    """Catch what Typer would turn into exit codes of its own."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted",
            hint="the same command with --out and its run directory takes it up; "
            "a training stage starts over",
        ) from None
    except BrokenPipeError:
        raise PipeClosed("output closed") from None


def _print_help(context: typer.Context) -> None:
    """A command group on its own shows its help."""
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit()


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
    _print_help(context)


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
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Simulate cart-poles under an exploring teacher and store them as a dataset."""
    settings = _settings(
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

    _execute(
        screen, stage, lambda: plan.plan_collect(settings, out), dry_run=dry_run, product="dataset"
    )


@app.command("train-encoder", rich_help_panel=PIPELINE)
def train_encoder(
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
    """Learn an encoder of camera frames with a joint-embedding predictive objective."""
    settings = _settings(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "encoder.h": h,
            "encoder.steps": steps,
            "encoder.gate": gate,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.train_encoder import run

        return run(settings, screen, dataset=dataset, out=out)

    _execute(
        screen,
        stage,
        lambda: plan.plan_train_encoder(settings, dataset, out),
        dry_run=dry_run,
        product="checkpoint",
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
    """Train the three predictors of the hierarchy, the flat baseline and the semantic actor."""
    settings = _settings(
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

    _execute(
        screen,
        stage,
        lambda: plan.plan_train_hierarchy(settings, dataset, encoder, out),
        dry_run=dry_run,
        product="checkpoint",
    )


@app.command("eval", rich_help_panel=PIPELINE)
def evaluate(
    methods: options.Methods = None,
    process_noise: options.ProcessNoise = None,
    plant_spread: options.PlantSpread = None,
    payload: options.Payload = None,
    remeasure: options.Remeasure = False,
    checkpoint: options.Checkpoint = None,
    dataset: options.CleanDataset = None,
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
    """Measure prediction error, control score and tolerated losses of each method."""
    settings = _settings(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "methods": options.split_names(methods),
            "protocol.process_noise": process_noise,
            "protocol.plant_spread": plant_spread,
            "protocol.payload": payload,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.evaluate import run

        return run(
            settings, screen, checkpoint=checkpoint, dataset=dataset, out=out, remeasure=remeasure
        )

    _execute(
        screen,
        stage,
        lambda: plan.plan_eval(settings, checkpoint, dataset, out, remeasure=remeasure),
        dry_run=dry_run,
    )


@app.command(rich_help_panel=PIPELINE)
def scale(
    snr: options.Snr = None,
    law: options.Law = None,
    scheduler: options.Schedulers = None,
    topology: options.Topology = None,
    bandwidth_mhz: options.BandwidthMhz = None,
    noise: options.Noise = None,
    power_margin_db: options.PowerMarginDb = None,
    coherence_slots: options.CoherenceSlots = None,
    seeds: options.Seeds = None,
    methods: options.Methods = None,
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
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Count the devices that one radio cell supports, by method and signal-to-noise ratio."""
    settings = _settings(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "methods": options.split_names(methods),
            "protocol.process_noise": process_noise,
            "protocol.plant_spread": plant_spread,
            "protocol.payload": payload,
            "radio.snr_db": snr,
            "radio.law": law,
            "radio.bandwidth_hz": None if bandwidth_mhz is None else bandwidth_mhz * 1e6,
            "radio.noise": noise,
            "radio.schedulers": options.split_names(scheduler),
            "radio.topology": topology,
            "radio.power_margin_db": power_margin_db,
            "radio.coherence_slots": coherence_slots,
            "radio.seeds": seeds,
        },
    )
    screen = Screen(quiet, as_json)
    with _guard():
        from hjepa_cli.core.capacity import parse_snr

        snr_db = parse_snr(settings.radio.snr_db)

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

    _execute(
        screen,
        stage,
        lambda: plan.plan_scale(
            settings, checkpoint, dataset, out, snr_db, remeasure=remeasure, verify=verify
        ),
        dry_run=dry_run,
    )


@models_app.callback(invoke_without_command=True)
def models(context: typer.Context) -> None:
    _print_help(context)


@models_app.command("list")
def list_models(
    as_json: options.Json = False, quiet: options.Quiet = False, debug: options.Debug = False
) -> None:
    """List the models of the zoo."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.models import show_list

        return show_list(screen)

    _execute(screen, stage)


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
        from hjepa_cli.models import show_info

        return show_info(screen, name)

    _execute(screen, stage)


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
        from hjepa_cli.models import verify

        return verify(screen, names or [])

    _execute(screen, stage)
