"""Commands beside the pipeline: reports, pictures, datasets and settings.

As in :mod:`hjepa_cli.cli.app`, nothing heavy is imported before a command runs.
"""

from pathlib import Path

import typer

from hjepa_cli.cli import flags as options
from hjepa_cli.cli.execution import Result, execute, print_help
from hjepa_cli.config.resolve import resolve
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import plan
from hjepa_cli.stages.plan import Plan

data_app = typer.Typer(help="Describe, verify, look at and export datasets.")
config_app = typer.Typer(help="Show settings.")


@data_app.callback(invoke_without_command=True)
def data(context: typer.Context) -> None:
    print_help(context)


@data_app.command("info")
def data_info(
    dataset: options.DatasetPath = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Describe a dataset: plant, seed, splits, size, sha256."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.data import show_info

        return show_info(screen, dataset)

    execute(screen, stage)


@data_app.command("verify")
def data_verify(
    datasets: options.DatasetPaths = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Read every shard and check it against its sha256; without a name, all of data/."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.data import verify

        return verify(screen, datasets or [])

    execute(screen, stage)


@data_app.command("preview")
def data_preview(
    dataset: options.DatasetPath = None,
    split: options.Split = "train",
    rows: options.SheetRows = 6,
    columns: options.SheetColumns = 8,
    out: options.FileOut = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Draw a contact sheet of camera frames (PNG)."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.data import preview

        return preview(screen, dataset, out, split, rows, columns)

    execute(screen, stage, product="picture")


@data_app.command("export")
def data_export(
    dataset: options.DatasetPath = None,
    split: options.Split = "train",
    format: options.ExportFormat = None,
    pixels: options.Pixels = True,
    out: options.FileOut = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    dry_run: options.DryRun = False,
    debug: options.Debug = False,
) -> None:
    """Write one split for other programs: HDF5 in stable-worldmodel's layout, or NPZ."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.data import export

        return export(screen, dataset, out, split, format, pixels)

    def planned() -> Plan:
        from hjepa_cli.stages.data import plan_export

        return plan_export(dataset, out, split, format, pixels)

    execute(screen, stage, planned, dry_run=dry_run, product="file")


@config_app.callback(invoke_without_command=True)
def config_group(context: typer.Context) -> None:
    print_help(context)


@config_app.command("show")
def config_show(
    key: options.SettingPrefix = "",
    toml: options.Toml = False,
    methods: options.Methods = None,
    protocol: options.Protocol = None,
    preset: options.Preset = None,
    config: options.Config = None,
    plant: options.PlantName = None,
    seed: options.Seed = None,
    device: options.Device = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Print every setting that a command would use, and where it comes from."""
    flags = {
        "plant": plant,
        "seed": seed,
        "device": device,
        "methods": options.split_names(methods),
        "protocol": protocol,
    }
    settings = resolve(preset, config, flags)
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.show_config import show

        return show(screen, settings, config=config, flags=flags, key=key, as_toml=toml)

    execute(screen, stage)


def view(
    methods: options.ViewMethods = "hjepa,hold",
    devices: options.ViewDevices = 3,
    snr: options.ViewSnr = 20.0,
    delivery: options.Delivery = None,
    gap: options.Gap = None,
    every: options.Every = None,
    fps: options.Fps = 20,
    live: options.Live = False,
    bandwidth_mhz: options.BandwidthMhz = None,
    checkpoint: options.Checkpoint = None,
    out: options.AnimationOut = Path("hjepa-view.gif"),
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
    """Watch closed loops over a fading link: true pole, believed pole, packets, SNR, age."""
    if gap is not None and delivery is not None:
        raise UsageError(
            "--gap is a link without fading, --delivery is of one with; give one of them",
            hint=f"hjepa view --gap {gap:g}, or hjepa view --delivery {delivery:g}",
        )
    settings = resolve(
        preset,
        config,
        {
            "plant": plant,
            "seed": seed,
            "device": device,
            "methods": options.split_names(methods),
            "protocol": "paper",  # a film begins with the start
            "radio.bandwidth_hz": None if bandwidth_mhz is None else bandwidth_mhz * 1e6,
        },
    )
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.view import run

        return run(
            settings,
            screen,
            checkpoint=checkpoint,
            out=out,
            devices=devices,
            snr_db=snr,
            delivery=0.05 if delivery is None else delivery,
            gap_steps=gap,
            every=every,
            fps=fps,
            live=live,
        )

    def planned() -> Plan:
        return plan.plan_view(settings, checkpoint, out, devices, live=live)

    execute(screen, stage, planned, dry_run=dry_run, product=None if live else "file")


def report(
    runs: options.RunPaths = None,
    out: options.ReportOut = Path("report.html"),
    figures: options.FigureDirectory = None,
    format: options.FigureFormats = "pdf",
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write what runs found as one HTML file: figures, tables, settings, commands."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.report import run

        formats = options.split_names(format) or []
        return run(screen, runs or [], out=out, figures=figures, formats=formats)

    execute(screen, stage, product="report")


def compare(
    runs: options.EvaluationPaths = None,
    methods: options.ComparedMethods = None,
    figures: options.ComparisonDirectory = None,
    format: options.FigureFormats = "pdf",
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Average evaluations over training seeds: means, 95 % intervals, paired differences."""
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.compare import run

        return run(
            screen,
            runs or [],
            methods=options.split_names(methods),
            figures=figures,
            formats=options.split_names(format) or [],
        )

    execute(screen, stage)


def reproduce(
    methods: options.Methods = None,
    protocol: options.Protocol = None,
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
    """Run all stages into one folder and write the report."""
    flags = {
        "plant": plant,
        "seed": seed,
        "device": device,
        "methods": options.split_names(methods),
        "protocol": protocol,
    }
    settings = resolve(preset, config, flags)
    screen = Screen(quiet, as_json)

    def stage() -> Result:
        from hjepa_cli.stages.reproduce import run

        return run(settings, screen, out=out)

    execute(
        screen,
        stage,
        lambda: plan.plan_reproduce(settings, out),
        dry_run=dry_run,
        product="report",
        workers=workers,
        cluster=cluster,
    )
