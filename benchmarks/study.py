"""Train variations of a recipe with the shipped commands and compare them in one table.

    python benchmarks/study.py ablations --out study             # one seed
    python benchmarks/study.py seeds --seeds 0,1,2,3,4 --out study

A study is a TOML file in ``benchmarks/studies/``: the methods to measure, and rows, each a name and
the settings in which it differs from the preset and from what all rows have in ``common``. A row
with ``strides`` trains these, one with ``flat`` also single levels of these depths on the same
encoder, with the same actor, one with ``reflexes`` also what answers a packet by its age. A row
whose ``encoder.method`` is a baseline on raw frames ends there.

Everything is kept below ``--out`` in directories named after what they depend on, so rows share
what they can (one dataset, one encoder), an interrupted study goes on with the same command, and a
study with more seeds or rows only adds to it. The table goes to the screen and to ``OUT/STUDY.md``,
all numbers to ``OUT/STUDY.json``; a study whose rows are numbers of its ``axis`` is drawn in
``OUT/STUDY.png`` too. With several seeds the intervals are Student's over seeds; with one, the
bootstrap's over devices or rollouts, and they say nothing about another training.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from lists import whole_numbers
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.core.statistics import student_interval
from hjepa_cli.core.style import PALETTE
from hjepa_cli.output import figures, lettering
from hjepa_cli.output.looks import PAGE_IN
from hjepa_cli.stages.compare import differences

STUDIES = Path(__file__).parent / "studies"
PROBES = {"x": "$x$", "x_dot": r"$\dot x$", "theta": r"$\theta$", "theta_dot": r"$\dot\theta$"}
OF_DATA = ("control", "camera", "sensor", "collect")
OF_ENCODER = (*OF_DATA, "encoder", "augment", "actor")
OF_LEVELS = (*OF_ENCODER, "hierarchy")
SECTIONS_OF = {  # a stage's results depend on these settings, its own and those of stages before
    "collect": OF_DATA,
    "train-encoder": OF_ENCODER,
    "train-hierarchy": OF_LEVELS,
    "train-reflex": (*OF_LEVELS, "reflex", "protocol"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=sorted(path.stem for path in STUDIES.glob("*.toml")))
    parser.add_argument("--seeds", type=whole_numbers, default="0", help="comma-separated")
    parser.add_argument("--out", type=Path, default=Path("study"))
    parser.add_argument("--rows", help="only these rows, by name, separated by ;")
    arguments = parser.parse_args()
    study = tomllib.loads((STUDIES / f"{arguments.study}.toml").read_text())
    rows, methods = rows_of(study), study["methods"]
    if arguments.rows:
        wanted = [name.strip() for name in arguments.rows.split(";")]
        unknown = set(wanted) - {row["name"] for row in rows}
        if unknown:
            names = "; ".join(row["name"] for row in rows)
            parser.error(f"no row {', '.join(sorted(unknown))}; choose from {names}")
        rows = [row for row in rows if row["name"] in wanted]
    arguments.out.mkdir(parents=True, exist_ok=True)
    measured: dict[str, dict[int, dict[str, Any]]] = {}
    for seed in arguments.seeds:  # all rows of one before the next: they are compared within it
        for row in rows:
            print(f"{row['name']}, seed {seed}", file=sys.stderr, flush=True)
            result = measure(row, seed, row.get("methods", methods), arguments.out)
            measured.setdefault(row["name"], {})[seed] = result
            write(measured, arguments.out / arguments.study, study.get("axis"))
    print((arguments.out / f"{arguments.study}.md").read_text())


def rows_of(study: dict[str, Any]) -> list[dict[str, Any]]:
    """A study's rows, each with the settings that they have in common where it has no others."""
    common = study.get("common", {})
    return [
        row | {section: values | row.get(section, {}) for section, values in common.items()}
        for row in study["row"]
    ]


def measure(row: dict[str, Any], seed: int, methods: list[str], out: Path) -> dict[str, Any]:
    """Train what the row needs and evaluate it: ``eval``'s methods and the encoder's health."""
    changes = {key: value for key, value in row.items() if isinstance(value, dict)}
    preset = row.get("preset", "default")

    def sections(stage: str) -> dict[str, dict[str, Any]]:
        return {name: changes.get(name, {}) for name in SECTIONS_OF.get(stage, changes)}

    def directory(stage: str, *more: Any) -> Path:
        # A preset other than the default may change any section.
        described = json.dumps([preset, sections(stage), seed, *more], sort_keys=True)
        return out / f"{stage}-{hashlib.sha256(described.encode()).hexdigest()[:12]}"

    def run(stage: str, *words: object) -> dict[str, Any]:
        config = out / f"{directory(stage).name}.toml"
        config.write_text(as_toml(sections(stage)))
        common = ("--preset", preset, "--config", config, "--seed", seed)
        return hjepa(stage, *common, *words)

    def evaluate(checkpoint: Path, methods: list[str], *of: Any) -> dict[str, Any]:
        named = ("--checkpoint", checkpoint, "--methods", ",".join(methods))
        out = directory("eval", *of, methods, LOOP_VERSION)  # measured anew in another loop
        return dict(run("eval", *named, "--out", out)["methods"])

    data, encoder = directory("collect"), directory("train-encoder")
    run("collect", "--out", data)
    trained = run("train-encoder", "--no-gate", "--dataset", data, "--out", encoder)
    if changes.get("encoder", {}).get("method", "jepa") != "jepa":  # on raw frames, no levels
        return {"health": trained["health"], "methods": evaluate(encoder, methods)}

    def levels(strides: list[int] | None, on: Path, *more: str) -> tuple[Path, dict[str, Any]]:
        of = directory("train-hierarchy", strides, *more)
        given = zip("hml", strides or (), strict=False)
        words = [f"--{name}={value}" for name, value in given]
        health = run("train-hierarchy", *words, "--dataset", data, "--encoder", on, "--out", of)
        return of, health["health"]

    strides = row.get("strides")
    hierarchy, health = levels(strides, encoder)
    measured = evaluate(hierarchy, methods, strides)
    for depth in row.get("flat", ()):
        flat, _ = levels([depth], hierarchy, hierarchy.name)  # with that model's actor
        measured |= evaluate(flat, [f"ts-jepa-{depth}"], strides)
    if reflexes := row.get("reflexes"):
        reflex = directory("train-reflex", hierarchy.name)
        run("train-reflex", "--dataset", data, "--checkpoint", hierarchy, "--out", reflex)
        measured |= evaluate(reflex, reflexes, strides)
    return {"health": health, "methods": measured}  # of the actor that drives, not of a probe


def hjepa(*words: object) -> dict[str, Any]:
    """The document of a command; its screen goes to ours. A failing command ends the study."""
    command = [sys.executable, "-m", "hjepa_cli", *map(str, words), "--json"]
    ended = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    if ended.returncode:
        print("failed: hjepa", *words, "\n" + ended.stdout.decode(), file=sys.stderr)
        sys.exit(ended.returncode)
    document: dict[str, Any] = json.loads(ended.stdout)
    return document


def as_toml(sections: dict[str, dict[str, Any]]) -> str:
    """Sections of plain values as TOML; JSON writes those alike."""
    return "".join(
        f"[{section}]\n"
        + "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())
        for section, values in sections.items()
    )


def write(
    measured: dict[str, dict[int, dict[str, Any]]], path: Path, axis: str | None = None
) -> None:
    """``PATH.json`` with everything, ``PATH.md`` with the table, ``PATH.png`` with an axis."""
    path.with_suffix(".json").write_text(json.dumps(measured, indent=1))
    windows = windows_of(measured)
    head = ["row", "method", "n", *(f"R² {name}" for name in PROBES), "actor NRMSE"]
    head += [*(f"NMAE {window}" for window in windows), "gap D* [steps]", "delivery p*"]
    lines = [head, ["---"] * len(head)]
    for name, by_seed in measured.items():
        methods = next(iter(by_seed.values()))["methods"]
        for method in methods:
            health = [result["health"] for result in by_seed.values()]
            entries = [result["methods"][method] for result in by_seed.values()]
            lines.append(
                [
                    *(name, method, str(len(entries))),
                    *(
                        over_seeds([report["probe_r2"][probe] for report in health if report], 3)
                        for probe in PROBES
                    ),
                    over_seeds([report["actor_nrmse"] for report in health if report], 3),
                    *(
                        over_seeds(
                            [entry["nmae_windows"][window] for entry in entries],
                            4,
                            entries[0]["nmae_windows_ci95"][window],
                        )
                        for window in windows
                    ),
                    *(
                        over_seeds(
                            [entry[f"tolerance_{key}"] for entry in entries],
                            decimals,
                            entries[0][f"tolerance_{kind}_ci95"],
                        )
                        for key, kind, decimals in (("gap_steps", "gap", 1), ("p", "p", 4))
                    ),
                ]
            )
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    path.with_suffix(".md").write_text(f"{text}\n\n{compared(measured)}")
    if axis is not None:
        figures.save(size_figure(measured, axis), path.with_suffix(".png"))


def size_figure(measured: dict[str, dict[int, dict[str, Any]]], axis: str) -> Figure:
    """Probes and control error of the rows' first method against what the rows are named by.

    Bands are 95 % intervals: Student's over seeds, of a single one the bootstrap's over rollouts.
    """
    sizes = np.array([int(name) for name in measured], float)
    rows = [list(by_seed.values()) for by_seed in measured.values()]

    def line(
        axes: Axes, label: str, number: int, values: list[list[float]], alone: list[list[float]]
    ) -> lettering.Named:
        middle = np.array([float(np.mean(of)) for of in values])
        colour = PALETTE[number]
        axes.plot(sizes, middle, marker="o^sD"[number], markersize=3, color=colour, label=label)
        several = min(map(len, values)) > 1
        ends = [student_interval(np.array(of)).tolist() for of in values] if several else alone
        if ends:
            axes.fill_between(sizes, *np.array(ends).T, alpha=0.18, linewidth=0, color=colour)
        return lettering.Named(label, colour, sizes, middle)

    with matplotlib.rc_context(figures.RC):
        figure = Figure(figsize=(PAGE_IN, 2.6), layout="constrained")
        probes, errors = figure.subplots(1, 2)
        named: dict[Axes, list[lettering.Named]] = {probes: [], errors: []}
        for number, (probe, symbol) in enumerate(PROBES.items()):
            r2 = [[result["health"]["probe_r2"][probe] for result in row] for row in rows]
            named[probes].append(line(probes, symbol, number, r2, []))
        entries = [[next(iter(result["methods"].values())) for result in row] for row in rows]
        for number, window in enumerate(windows_of(measured)):
            values = [[entry["nmae_windows"][window] for entry in row] for row in entries]
            alone = [row[0].get("nmae_windows_ci95", {}).get(window) for row in entries]
            known = alone if None not in alone else []
            named[errors].append(line(errors, f"{window} steps", number, values, known))
        probes.set_ylabel("Held-out R² of a linear probe")
        errors.set_ylabel("NMAE of the force since a packet")
        errors.set_ylim(bottom=0)
        for axes, lines in named.items():
            axes.set_xscale("log", base=2)
            axes.set_xticks(sizes, labels=[f"{size:g}" for size in sizes])
            axes.set_xlabel(axis)
            axes.grid(visible=True)
            lettering.name_ends(figure, axes, lines, ())
        return figure


def windows_of(measured: dict[str, dict[int, dict[str, Any]]]) -> list[str]:
    """Names of the windows that the NMAE is averaged over."""
    first = next(iter(next(iter(measured.values())).values()))
    return list(next(iter(first["methods"].values()))["nmae_windows"])


def compared(measured: dict[str, dict[int, dict[str, Any]]]) -> str:
    """Within each row, its first method against the others, paired over seeds."""
    lines = []
    for name, by_seed in measured.items():
        if len(by_seed) < 2:
            continue
        methods = next(iter(by_seed.values()))["methods"]
        by_method = {
            method: {seed: result["methods"][method] for seed, result in by_seed.items()}
            for method in methods
        }
        for one in differences(by_method, left_out=()):  # each seed has draws of its own
            ratios = one["tolerance_gap_ratio"], one["tolerance_p_ratio"]
            parts = [
                f"{name} {told(ratio, 3)}" if ratio else f"{name} –"
                for name, ratio in zip(("D* ×", "its p* ×"), ratios, strict=True)
            ]
            parts += [f"NMAE {window} {told(by, 5)}" for window, by in one["nmae_windows"].items()]
            of = f"{one['method']} over {one['over']}, n = {len(by_seed)}"
            lines.append(f"- {name}: {of}: {'; '.join(parts)}")
    return "\n".join(lines) + "\n" * bool(lines)


def told(found: dict[str, Any], decimals: int) -> str:
    """A mean with its interval."""
    low, high = found["ci95"]
    return f"{found['mean']:.{decimals}f} ({low:.{decimals}f} – {high:.{decimals}f})"


def over_seeds(values: list[float], decimals: int, alone: list[float] | None = None) -> str:
    """Mean and Student's 95 % interval over seeds; of one seed the value and ``alone``."""
    if not values:
        return "–"
    mean, n = float(np.mean(values)), len(values)
    interval = alone
    if n > 1:
        interval = list(student_interval(np.array(values)))
    text = f"{mean:.{decimals}f}"
    if interval is not None:
        text += f" ({interval[0]:.{decimals}f} – {interval[1]:.{decimals}f})"
    return text


if __name__ == "__main__":
    main()
