"""``hjepa report RUN…``: what some runs found, in one HTML file that needs nothing else.

Run directories → per run its result with intervals, its figures, its settings, its environment and
the commands that make it again. Figures can also be written as files for a paper.
"""

import csv
import io
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hjepa_cli import __version__
from hjepa_cli.core.evaluation.protocol import BESIDE
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output import html
from hjepa_cli.output.screen import Screen, described_steps, in_order, percent, span, tolerance
from hjepa_cli.storage import files, runs

Result = dict[str, Any]
Figures = dict[str, tuple[str, Any]]
"""File name without suffix → caption and figure."""

STAGES = ("train-encoder", "train-hierarchy", "train-reflex", "eval", "scale")
FIGURE_FORMATS = ("pdf", "svg", "png")
SMOKE = "smoke"
NO_RESULT = "preset smoke shows that all of it runs; too small to learn, its numbers mean nothing"


def run(
    screen: Screen,
    paths: Sequence[Path],
    *,
    out: Path = Path("report.html"),
    figures: Path | None = None,
    formats: Sequence[str] = ("pdf",),
) -> Result:
    """Write the report; returns the document of ``--json``.

    Args:
        screen: where to say so.
        paths: run directories, or directories that hold some; none: the newest of each stage.
        out: the HTML file.
        figures: also write every figure into this directory.
        formats: of these figures.

    Raises:
        MissingInputError: no run there, or an unfinished one.
        DataError: a damaged run.
    """
    directories = found_runs(paths)
    parts = [html.heading(1, "hjepa report"), html.paragraph(f"Written by hjepa {__version__}.")]
    parts.append(contents(directories))
    if any(runs.read_environment(directory)["preset"] == SMOKE for directory in directories):
        parts.append(html.paragraph(f"{NO_RESULT}.", note=True))
    written: list[Path] = []
    for directory in directories:
        section, drawn = describe(directory, screen)
        parts += section
        if figures is not None:
            written += write_figures(drawn, figures, stage_of(directory), formats)
    files.make_directory(out.parent)
    files.write_text(out, html.page("hjepa report", parts))
    if figures is not None:
        screen.say(f"{len(written)} figures in {figures}")
    screen.say(f"written: {out}")
    return {"report": out, "runs": directories, "figures": written}


def found_runs(paths: Sequence[Path], made_by: str = "hjepa eval, hjepa scale") -> list[Path]:
    """The finished runs among and below ``paths``, in the order of the pipeline.

    Args:
        paths: of runs or of directories that hold some; none: the newest run of each stage.
        made_by: the commands to suggest where there is none.

    Raises:
        MissingInputError: none there.
    """
    found: list[Path] = []
    for path in paths:
        below = sorted(file.parent for file in path.glob(f"**/{runs.RESULT}"))
        if not below:
            if (path / runs.CONFIG).is_file():
                raise MissingInputError(
                    f"{path} is an unfinished run", hint=f"hjepa resume {shlex.quote(str(path))}"
                )
            raise MissingInputError(f"no finished run in {path}", hint=made_by)
        found += below
    if not paths:
        newest = [runs.newest_run(stage) for stage in STAGES]
        found = [directory for directory in newest if directory is not None]
        if not found:
            raise MissingInputError("no finished run in runs/", hint="hjepa scale")
    known = [directory for directory in dict.fromkeys(found) if stage_of(directory) in STAGES]
    if not known:
        raise MissingInputError(
            f"{', '.join(map(str, found))}: no run of {', '.join(STAGES)}", hint="hjepa eval"
        )
    return sorted(known, key=lambda directory: -STAGES.index(stage_of(directory)))


def contents(directories: Sequence[Path]) -> str:
    """What the report holds."""
    rows = []
    for directory in directories:
        config = runs.read_config(directory)
        rows.append([stage_of(directory), str(directory), config["plant"], config["seed"]])
    return html.table(["stage", "run", "plant", "seed"], rows)


def describe(directory: Path, screen: Screen) -> tuple[list[str], Figures]:
    """One run as a section of HTML, and its figures."""
    stage = stage_of(directory)
    result, config = runs.read_result(directory), runs.read_config(directory)
    environment = runs.read_environment(directory)
    parts = [html.heading(2, f"{stage}: {directory}")]
    made_by = runs.version_of(environment)
    if made_by != __version__:
        again = f"hjepa {stage} --config {directory / runs.CONFIG}"
        parts.append(
            html.paragraph(
                f"made by hjepa {made_by}, this is {__version__}; numbers may differ. "
                f"To measure it again: {again}",
                note=True,
            )
        )
    section, figures_of = SECTIONS[stage]
    try:
        parts += section(result, config)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise DataError(
            f"{directory / runs.RESULT} lacks what a {stage} run has: {error}",
            hint=f"hjepa {stage} --config {directory / runs.CONFIG}",
        ) from None
    drawn = draw(lambda: figures_of(result, config, directory), screen)
    parts += [html.picture(svg(figure), "svg+xml", caption) for caption, figure in drawn.values()]
    parts.append(html.heading(3, "Made by"))
    command = ["hjepa", *map(str, environment.get("command", [])[1:])]
    again = ["hjepa", stage, "--config", str(directory / runs.CONFIG), *inputs_of(environment)]
    text = "# as it was typed\n" + shlex.join(command)
    text += "\n# this stage again, with the same settings and inputs\n" + shlex.join(again)
    parts.append(html.code(text))
    versions = {f"version of {name}": v for name, v in environment.get("versions", {}).items()}
    machine = {key: environment.get(key) for key in ("system", "machine", "cpus")}
    parts.append(html.details("Environment", html.pairs(versions | machine)))
    toml = files.read_bytes(directory / runs.CONFIG, limit=files.JSON_LIMIT_BYTES).decode()
    parts.append(html.details("Settings", html.code(toml)))
    return parts, drawn


def inputs_of(environment: Mapping[str, Any]) -> list[str]:
    """What a run was given, as flags; paths below this directory without it.

    Further models (``checkpoint 2``) have no flag: the command finds them again.
    """
    flags = []
    for name, given in environment["inputs"].items():
        if " " not in name and isinstance(given, dict) and isinstance(given.get("path"), str):
            path = Path(given["path"])
            here = path.is_relative_to(Path.cwd())
            flags += [f"--{name}", str(path.relative_to(Path.cwd()) if here else path)]
    return flags


def stage_of(directory: Path) -> str:
    """Which command made a run. Raises DataError where it does not say."""
    return str(runs.read_environment(directory)["stage"])


def draw(figures_of: Callable[[], Figures], screen: Screen) -> Figures:
    """The figures, or none without matplotlib."""
    try:
        return figures_of()
    except ModuleNotFoundError as missing:
        if not (missing.name or "").startswith("matplotlib"):
            raise
        screen.say('no figures without matplotlib: pip install "hjepa[plot]"')
        return {}


def svg(figure: Any) -> bytes:
    """A figure as SVG, equal bytes for equal figures."""
    from hjepa_cli.output.figures import encoded

    return encoded(figure, "svg")


def write_figures(
    drawn: Figures, directory: Path, stage: str, formats: Sequence[str]
) -> list[Path]:
    """Write figures as ``<stage>-<name>.<format>``."""
    if not drawn:
        return []
    from hjepa_cli.output.figures import save

    files.make_directory(directory)
    return [
        save(figure, directory / f"{stage}-{name}.{kind}")
        for name, (_, figure) in drawn.items()
        for kind in formats
    ]


# --- one section per stage


def encoder_section(result: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Health and gates."""
    states = [f"probe_r2_{name}" for name in plant(config["plant"]).state_names]
    rows = [
        [
            name,
            gate["value"],
            f"{'≤' if name == 'actor_nrmse' else '≥'} {gate['threshold']:g}",
            "passed" if gate["passed"] else "FAILED",
        ]
        for name, gate in in_order(result["gates"], states).items()
    ]
    return [
        html.paragraph(f"Encoder {result['checkpoint']}, trained in {result['seconds']:.0f} s."),
        html.table(["health, held out", "value", "gate", ""], rows),
    ]


def hierarchy_section(result: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Strides and prediction error."""
    strides = "/".join(str(result["strides"][level]) for level in "hml")
    return [
        html.paragraph(
            f"Hierarchy of strides {strides}, {result['checkpoint']}, trained in "
            f"{result['seconds']:.0f} s."
        ),
        html.table(
            ["steps since the packet", f"NMAE of {result.get('method', 'hjepa')}"],
            [[window, float(error)] for window, error in result["nmae_windows"].items()],
        ),
    ]


def reflex_section(result: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """How the forces of decaying holds fade, and what all reflexes do after one packet."""
    decays = {"hold-decay": result["reflex"], "hold-decay-linear": result["reflex"]["law"]}
    windows = list(next(iter(result["nmae_windows"].values())))
    return [
        html.paragraph(
            f"Reflexes, {result['checkpoint']}, trained in {result['seconds']:.0f} s: error of the "
            f"force (NMAE) by steps since a single packet, {result['n_rollouts']} rollouts; factor "
            "s and time τ of the forces that fade."
        ),
        html.table(
            ["method", *(f"{window} steps" for window in windows), "s", "τ [steps]"],
            [
                [
                    name,
                    *(f"{errors[window]:.4f}" for window in windows),
                    _two_decimals(decays.get(name, {}).get("gain")),
                    _two_decimals(decays.get(name, {}).get("tau_steps")),
                ]
                for name, errors in result["nmae_windows"].items()
            ],
        ),
    ]


def _two_decimals(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def eval_section(result: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Scores and tolerances with their intervals."""
    entries = in_order(result["methods"], config["methods"])
    if not entries:
        return [html.paragraph("No method was measured.")]
    first = next(iter(entries.values()))
    tolerances = [
        [
            name,
            span(entry["score"], entry["score_ci95"], 3),
            f"{entry['lq_ratio']:.3f}",
            entry["bits_per_transmission"],
            tolerance(entry, "gap_steps", "gap", 1, "≥"),
            *(_two_decimals(entry.get(f"tolerance_gap_{key}")) for key in BESIDE),
            tolerance(entry, "p", "p", 4, "≤"),
        ]
        for name, entry in entries.items()
    ]
    errors = [
        [name, *(f"{error:.4f}" for error in entry["nmae_windows"].values())]
        for name, entry in entries.items()
    ]
    windows = [f"{window} steps" for window in first["nmae_windows"]]
    return [
        html.paragraph(
            f"Plant {result['plant']}, seed {result['seed']}, model {result['checkpoint']}. Score "
            f"and LQ ratio with a packet at every step, {first['n_curve_devices']} devices; "
            f"tolerances from {first['n_devices']} devices, {described_steps(first)}; beside D* "
            "the share of steps in the band there, the LQ ratio, and the share of loops lost. In "
            "brackets: 95 % bootstrap intervals."
        ),
        *_models(result),
        html.table(
            [
                *("method", "score", "LQ ratio", "bits"),
                *("gap D* [steps]", "in band", "LQ ratio", "lost", "delivery p*"),
            ],
            tolerances,
        ),
        html.paragraph(
            f"Error of the force (NMAE) by steps since a single packet, {first['n_rollouts']} "
            "rollouts."
        ),
        html.table(["method", *windows], errors),
    ]


def _models(result: Mapping[str, Any]) -> list[str]:
    """Where methods come from that the first model does not hold."""
    paths = result.get("checkpoints", {}).items()
    others = [f"{name}: {path}" for name, path in paths if path != result["checkpoint"]]
    return [html.paragraph(f"Of other models: {'; '.join(others)}.")] if others else []


def scale_section(result: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    """Device counts with their intervals, and the gains."""
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for row in result["rows"]:
        names = (row["method"], row.get("scheduler"))
        by_method.setdefault(", ".join(filter(None, names)), []).append(row)
    grid_db = sorted({row["snr_db"] for row in result["rows"]})
    ranked = sorted(by_method.items(), key=lambda item: -(item[1][-1]["devices"] or 0))
    rows = [
        [
            method,
            *(
                span(row["devices"], row["devices_ci95"], 0, "≥" if row["at_least"] else "")
                for row in found
            ),
            None if found[0]["bits_per_s"] is None else f"{found[0]['bits_per_s']:,.0f}",
        ]
        for method, found in ranked
    ]
    parts = [
        html.paragraph(
            f"Devices per cell under law {result['law']}: {result['bandwidth_hz'] / 1e6:g} MHz, "
            f"slots of {1e3 * result['slot_s']:g} ms, normalised score of at least "
            f"{result['acceptable_score']:g}; tolerances from {result['n_devices']} simulated "
            f"devices, seed {result['seed']}. In brackets: 95 % intervals. Least rate that any "
            f"controller needs: {result['limit_bits_per_s']:.1f} bit/s per device."
        ),
        html.table(["method", *(f"{snr:g} dB" for snr in grid_db), "bit/s per device"], rows),
    ]
    parts += [html.paragraph(gained(found)) for found in result["gains"] if found["ratio"]]
    paper = f"The paper: up to +{result['paper_gain_percent']} % over its one-step predictor."
    parts.append(html.paragraph(paper))
    return parts


def gained(found: Mapping[str, Any]) -> str:
    """How many more devices a method carries than another."""
    low, high = found["ratio_ci95"]
    return (
        f"{found['method']} over {found['over']} at {found['snr_db']:g} dB: "
        f"{percent(found['ratio'])} ({percent(low)} to {percent(high)}) devices."
    )


def training_figures(result: Mapping[str, Any], config: Mapping[str, Any], run: Path) -> Figures:
    """Losses and health over training."""
    path = run / runs.METRICS
    if not path.is_file():
        return {}
    from hjepa_cli.output import figures

    text = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES).decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    if len({row["step"] for row in rows}) < 2:
        return {}
    return {"training": ("Training", figures.training_figure(rows))}


def eval_figures(result: Mapping[str, Any], config: Mapping[str, Any], run: Path) -> Figures:
    """Score against gap and delivery, error against the horizon; none that would be empty."""
    from hjepa_cli.output import figures

    entries = in_order(result["methods"], config["methods"])
    step_s = plant(result["plant"]).step_s
    level = config["protocol"]["acceptable_score"]
    drawn = {
        "gap": (
            "Normalised score against the time between packets, 95 % bands",
            figures.score_figure(entries, "gap", acceptable_score=level, step_s=step_s),
        ),
        "delivery": (
            "Normalised score against the delivery probability, 95 % bands",
            figures.score_figure(entries, "delivery", acceptable_score=level, step_s=step_s),
        ),
        "error": (
            "Error of the predicted force after a single packet, 95 % bands",
            figures.error_figure(entries, step_s=step_s),
        ),
    }
    return {
        name: (text, figure) for name, (text, figure) in drawn.items() if figures.has_curves(figure)
    }


def scale_figures(result: Mapping[str, Any], config: Mapping[str, Any], run: Path) -> Figures:
    """Devices against the SNR."""
    from hjepa_cli.output import figures

    caption = f"Supported devices, law {result['law']}, 95 % intervals"
    return {"devices": (caption, figures.scale_figure(result))}


SECTIONS: dict[str, tuple[Callable[..., list[str]], Callable[..., Figures]]] = {
    "train-encoder": (encoder_section, training_figures),
    "train-hierarchy": (hierarchy_section, training_figures),
    "train-reflex": (reflex_section, training_figures),
    "eval": (eval_section, eval_figures),
    "scale": (scale_section, scale_figures),
}
