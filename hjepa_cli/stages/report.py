"""``hjepa report RUN…`` tells what some runs found, in one HTML file that needs nothing else.

Run directories → per run its result with intervals, its figures, its settings, its environment and
the commands that make it again. Figures can also be written as files for a paper.
"""

import base64
import csv
import io
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, UndefinedError

from hjepa_cli import __version__
from hjepa_cli.core.control import link
from hjepa_cli.core.plants.named import plant, plant_in
from hjepa_cli.errors import MissingInputError, UsageError, shell
from hjepa_cli.output.looks import Looks
from hjepa_cli.output.page import explained, gain_rows, headline, methods_of, parts
from hjepa_cli.output.screen import Screen, can_draw, described_steps, in_order, span, tolerance
from hjepa_cli.output.tables import (
    counted_by,
    described_cell,
    offline_columns,
    offline_rows,
    ranked,
    stress_columns,
    stress_rows,
)
from hjepa_cli.stages import results
from hjepa_cli.storage import files, runs

Result = dict[str, Any]
Figures = dict[str, tuple[str, Any]]
"""File name without suffix → caption and figure."""

STAGES = (
    *("train-encoder", "train-hierarchy", "train-reflex", "train-fusion"),
    *("eval", "scale", "survive", "bench-link"),
)
PARTS = ("runs", "sections", "note", "headline", "film", "wants_film")  # of the page
FILM_LIMIT_BYTES = 64 * 2**20
MACHINE = ("system", "machine", "cpus")  # of what a run remembers of its machine
NO_RESULT = "preset smoke shows that all of it runs; too small to learn, its numbers mean nothing"


def run(
    screen: Screen,
    paths: Sequence[Path],
    *,
    out: Path = Path("report.html"),
    figures: Path | None = None,
    formats: Sequence[str] = ("pdf",),
    film: Path | None = None,
    title: str | None = None,
    labels: Sequence[str] | None = None,
    log: bool | None = None,
) -> Result:
    """Write the report; return the document of ``--json``.

    Args:
        screen: says what was written.
        paths: run directories, or directories that hold some; none: the newest of each stage.
        out: the HTML file.
        figures, formats: a directory to write every figure into as well, and how.
        film: a GIF of ``hjepa view`` to show.
        title, labels, log: of the figures, as :meth:`hjepa_cli.output.looks.Looks.of`.

    Raise MissingInputError without a finished run or the film, UsageError for a film that is no
    GIF, and DataError for a damaged run.
    """
    asked, shown = Looks.of(title, labels, log), None if film is None else read_film(film)
    directories = found_runs(paths)
    template = page_template()
    section = template.make_module(dict.fromkeys(PARTS, ())).section
    described, sections, written, names = [], [], [], figure_names(directories)
    for directory in directories:
        one = describe(directory)
        try:
            one["lacking"] = lacking(one, directory)
            drawn = draw(one, directory, screen, asked.wide())
            one["figures"] = [(text, _svg(figure)) for text, figure in drawn.values()]
            sections.append(section(one))
            if figures is not None:  # those in files are as wide as a paper's column
                drawn = draw(one, directory, screen, asked)
        except (UndefinedError, LookupError, TypeError, ValueError, ArithmeticError) as error:
            missing = str(error).rpartition("has no attribute ")[2]
            raise results.damaged(directory, one["stage"], missing) from None
        except UsageError as error:  # of a plant that no plugin in force adds
            raise results.damaged(directory, one["stage"], error) from None
        for text in one["lacking"]:
            screen.say(text)
        described.append(one)
        if figures is not None:
            name = names[directory]
            written += write_figures(drawn, figures, name, formats)
    note = NO_RESULT if any(one["preset"] == runs.SMOKE for one in described) else ""
    text = template.render(
        runs=described,
        sections=sections,
        note=note,
        headline=headline(described),
        film=shown,
        wants_film=any(one["stage"] in ("eval", "scale") for one in described),
    )
    files.write_text(files.target(out), text)
    if figures is not None:
        screen.say(f"{len(written)} figures in {figures}")
    screen.say(f"written: {out}")
    return {"report": out, "runs": directories, "figures": written}


def found_runs(paths: Sequence[Path], made_by: str = "hjepa eval, hjepa scale") -> list[Path]:
    """Return the finished runs among and below ``paths``, in the order of the pipeline.

    Without paths they are the newest of each stage. Raise MissingInputError, suggesting the
    commands ``made_by``, where there is none.
    """
    found: list[Path] = []
    for path in paths:
        below = sorted(file.parent for file in path.glob(f"**/{runs.RESULT}"))
        if not below:
            if (path / runs.CONFIG).is_file():
                raise MissingInputError(
                    f"{path} is an unfinished run", hint=shell(["hjepa", "resume", path])
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
    return sorted(known, key=lambda directory: STAGES.index(stage_of(directory)))


def page_template() -> Template:
    """Return ``report.html.j2``; what a run lacks is an error there, never an empty place."""
    environment = Environment(
        loader=PackageLoader("hjepa_cli", "output"),
        autoescape=True,
        extensions=["jinja2.ext.do"],
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "described_steps": described_steps,
        "devices": lambda row: span(
            row["devices"], row["devices_ci95"], 0, "≥" if row["at_least"] else ""
        ),
        "fixed": lambda value, decimals: None if value is None else f"{value:.{decimals}f}",
        "sprintf": lambda value, text: text % value,
    }
    named = (gates, in_order, ranked, span, tolerance, windows, explained, gain_rows, methods_of)
    tables = (offline_columns, offline_rows, stress_columns, stress_rows)
    cell = (counted_by, described_cell)
    environment.globals |= {one.__name__: one for one in (*named, *tables, *cell, parts)}
    environment.globals |= {"version": __version__, "link_described": link.described}
    return environment.get_template("report.html.j2")


def describe(directory: Path) -> dict[str, Any]:
    """Return what the page says of a run. Raises DataError or MissingInputError."""
    environment, stage = runs.read_environment(directory), stage_of(directory)
    result, settings = runs.read_result(directory), runs.read_config(directory)
    results.check(stage, result, directory)
    results.check_config(stage, settings, directory)
    config = directory / runs.CONFIG
    versions = {f"version of {name}": v for name, v in environment.get("versions", {}).items()}
    return {
        "stage": stage,
        "directory": directory,
        "preset": environment.get("preset"),
        "made_by": runs.version_of(environment),
        "result": result,
        "config": settings,
        "command": shell(["hjepa", *map(str, environment.get("command", [])[1:])]),
        "again": runs.anew(environment, config),
        "environment": versions | {key: environment.get(key) for key in MACHINE},
        "toml": files.read_bytes(config, limit=files.JSON_LIMIT_BYTES).decode(),
    }


def stage_of(directory: Path) -> str:
    """Return the command that made a run. Raises DataError where it does not say."""
    return str(runs.read_environment(directory)["stage"])


def read_film(path: Path) -> str:
    """Return a GIF as the page holds it. Raises MissingInputError, UsageError and DataError."""
    try:
        content = files.read_bytes(path, limit=FILM_LIMIT_BYTES)
    except MissingInputError as error:
        hint = shell(["hjepa", "view", "--out", path])
        raise MissingInputError(error.message, hint=hint) from None
    if not content.startswith((b"GIF87a", b"GIF89a")):
        raise UsageError(f"--film {path}: not a GIF", hint="hjepa view --out film.gif")
    return base64.b64encode(content).decode()


def lacking(described: Mapping[str, Any], directory: Path) -> list[str]:
    """Say which figures a run has not enough for, and which command makes it."""
    stage, result, again = described["stage"], described["result"], described["again"]
    if stage.startswith("train-") and not (directory / runs.METRICS).is_file():
        return [f"No figure of the training, without {runs.METRICS}. To train again: {again}"]
    if stage == "eval" and not has_intervals(result):
        remeasured = "" if result.get("offline") else " --remeasure"
        return [
            "No figure of errors, whose intervals were not measured then. To measure again: "
            f"{again}{remeasured}"
        ]
    return []


def has_intervals(result: Result) -> bool:
    """Return whether errors by windows have intervals, which older versions did not measure."""
    return all("nmae_windows_ci95" in entry for entry in result["methods"].values())


def draw(described: Mapping[str, Any], directory: Path, screen: Screen, asked: Looks) -> Figures:
    """Return the figures of a run, or none without matplotlib."""
    if not can_draw(screen):
        return {}
    stage, result = described["stage"], described["result"]
    return FIGURES[stage](result, described["config"], directory, asked)


def _svg(figure: Any) -> str:
    from hjepa_cli.output.figures import encoded

    return base64.b64encode(encoded(figure, "svg")).decode()


def figure_names(directories: Sequence[Path]) -> dict[Path, str]:
    """Return what the figures of each run begin with: its stage, of several also which run."""
    names: dict[Path, str] = {}
    for directory in directories:
        stage = stage_of(directory)
        alone = sum(stage_of(other) == stage for other in directories) == 1
        name = stage if alone else f"{stage}-{directory.resolve().name}"
        taken = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
        names[directory] = next(one for one in taken if one not in names.values())
    return names


def write_figures(drawn: Figures, directory: Path, run: str, formats: Sequence[str]) -> list[Path]:
    """Write figures as ``<run>-<name>.<format>``."""
    if not drawn:
        return []
    from hjepa_cli.output.figures import save

    files.make_directory(directory)
    return [
        save(figure, directory / f"{run}-{name}.{kind}")
        for name, (_, figure) in drawn.items()
        for kind in formats
    ]


def gates(result: Result, config: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the gates of an encoder by name, those of the states first and in their order."""
    states = [f"probe_r2_{name}" for name in plant_in(config["plant"], config).state_names]
    return list(in_order(result["gates"], states).items())


def windows(errors: Mapping[str, Any]) -> list[str]:
    """Return headings for errors by method and window of steps."""
    first = next(iter(errors.values()))
    return [f"{window} steps" for window in first.get("nmae_windows", first)]


def training_figures(result: Result, config: Mapping[str, Any], run: Path, asked: Looks) -> Figures:
    """Draw losses and health over training."""
    path = run / runs.METRICS
    if not path.is_file():
        return {}
    from hjepa_cli.output import figures

    text = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES).decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    if len({row["step"] for row in rows}) < 2:
        return {}
    return {"training": ("Training", figures.training_figure(rows, asked))}


def eval_figures(result: Result, config: Mapping[str, Any], run: Path, asked: Looks) -> Figures:
    """Draw score against gap and delivery, error against the horizon; none that would be empty."""
    from hjepa_cli.output import figures

    if "stress" in result:
        caption = "Score ÷ nominal score against the severity of each condition, 95 % bands"
        return {"stress": (caption, figures.stress_figure(result["stress"], asked))}
    entries = in_order(result["methods"], config["methods"])
    if result.get("offline"):
        if not has_intervals(result):
            return {}
        text = "Mean error of the predicted force after a single packet, on recordings, 95 % bars"
        return {
            "error": (text, figures.error_figure(entries, step_s=result["step_s"], asked=asked))
        }
    step_s = plant(result["plant"]).step_s
    acceptable = config["protocol"]["acceptable_score"]
    drawn = {
        kind: (
            f"Normalised score against the {against}, 95 % bands",
            figures.score_figure(
                entries, kind, acceptable_score=acceptable, step_s=step_s, asked=asked
            ),
        )
        for kind, against in (("gap", "time between packets"), ("delivery", "delivery probability"))
    }
    text = "Mean error of the predicted force after a single packet, 95 % bars"
    if has_intervals(result):
        drawn["error"] = text, figures.error_figure(entries, step_s=step_s, asked=asked)
    return {name: one for name, one in drawn.items() if figures.has_curves(one[1])}


def scale_figures(result: Result, config: Mapping[str, Any], run: Path, asked: Looks) -> Figures:
    """Draw devices against the SNR."""
    from hjepa_cli.output import figures

    caption = f"Supported devices, law {result['law']}"
    caption += "" if result.get("tolerance_steps") else ", 95 % intervals"
    return {"devices": (caption, figures.scale_figure(result, asked))}


def survival_figures(result: Result, config: Mapping[str, Any], run: Path, asked: Looks) -> Figures:
    """Draw the share of loops that a gap loses."""
    from hjepa_cli.output import figures

    caption = "Loops lost in a single gap between packets, 95 % Clopper-Pearson intervals"
    return {"survival": (caption, figures.survival_figure(result, asked))}


def wire_figures(result: Result, config: Mapping[str, Any], run: Path, asked: Looks) -> Figures:
    """Draw how late answers came and where forces came from."""
    from hjepa_cli.output import figures

    caption = "Control steps from a picture to the first force that answers it; who drove"
    return {"wire": (caption, figures.wire_figure(result, asked))}


FIGURES: dict[str, Callable[..., Figures]] = {
    **{stage: training_figures for stage in STAGES if stage.startswith("train-")},
    "eval": eval_figures,
    "scale": scale_figures,
    "survive": survival_figures,
    "bench-link": wire_figures,
}
