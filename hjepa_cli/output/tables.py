"""Tables show what a training stage or an evaluation found."""

from typing import Any

from hjepa_cli.core.control.force_error import WINDOWS
from hjepa_cli.core.evaluation.protocol import BESIDE
from hjepa_cli.output.screen import Screen, described_steps, span, tolerance


def show_gates(screen: Screen, gates: dict[str, dict[str, Any]], *, enforced: bool) -> None:
    """Print a row per gate."""
    rows = [
        [
            *(name, f"{gate['value']:.3f}"),
            f"{'≤' if name == 'actor_nrmse' else '≥'} {gate['threshold']:g}",
            "passed" if gate["passed"] else "FAILED",
        ]
        for name, gate in gates.items()
    ]
    title = "health, held out" + "; gates are off, nothing stops here" * (not enforced)
    screen.table(title, ["measure", "value", "gate", ""], rows)


def show_hierarchy(result: dict[str, Any], screen: Screen) -> None:
    """Print what the trained model does without packets, before ``eval`` closes the loop."""
    windows = result["nmae_windows"]
    held_out = (result["health"][key] for key in ("actor_nrmse", "action_sensitivity"))
    screen.table(
        f"{result.get('method', 'hjepa')} alone after one packet: NMAE by steps "
        f"({result['n_rollouts']} clean rollouts); actor NRMSE and action sensitivity held out",
        [*windows, "actor NRMSE", "sensitivity"],
        [[f"{value:.3f}" for value in (*windows.values(), *held_out)]],
    )


def show_reflex(result: dict[str, Any], screen: Screen) -> None:
    """Print what each method does after one packet, and how the forces fade."""
    reflex = result["reflex"]
    decays = {"hold-decay": reflex, "hold-decay-linear": reflex["law"]}
    windows, rows = list(next(iter(result["nmae_windows"].values()))), []
    for name, errors in result["nmae_windows"].items():
        decay = decays.get(name)
        fading = (f"{decay['gain']:.2f}", f"{decay['tau_steps']:.1f}") if decay else ("-", "-")
        rows.append([name, *(f"{errors[window]:.3f}" for window in windows), *fading])
    screen.table(
        f"after one packet: NMAE by steps ({result['n_rollouts']} clean rollouts); factor and "
        "time of what fades",
        ["method", *windows, "s", "τ [steps]"],
        rows,
    )


def show_evaluation(result: dict[str, Any], screen: Screen) -> None:
    """Print the tables of an evaluation: what each method does, and its score over the gap."""
    entries = result["methods"]
    if not entries:
        return
    first = next(iter(entries.values()))
    windows = [f"{start}-{end}" for start, end in WINDOWS]
    where = f"{result['plant']}, seed {result['seed']}"
    errors, tolerances, scores = [], [], []
    for name, entry in entries.items():
        nmae = (_number(entry["nmae_windows"].get(window), 3) for window in windows)
        ratios = (_number(entry[key], 3) for key in ("score", "lq_ratio"))
        errors.append([name, *nmae, *ratios, entry["bits_per_transmission"]])
        gap, p = (
            [_number(entry.get(f"tolerance_{kind}_{key}"), 2) for key in BESIDE]
            for kind in ("gap", "p")
        )
        tolerances.append(
            [
                *(name, tolerance(entry, "gap_steps", "gap", 1, "≥"), *gap),
                *(tolerance(entry, "p", "p", 4, "≤"), *p),
                _number(entry["tolerance_gap_lq_steps"], 1),
            ]
        )
        scores.append([name, *(_number(point["score"], 2) for point in entry["gap_curve"])])
    screen.table(
        f"{where}: NMAE by steps since the packet ({first['n_rollouts']} rollouts), score and LQ "
        f"ratio with every packet ({first['n_curve_devices']} devices)",
        ["method", *(f"NMAE {window}" for window in windows), "score", "LQ", "bits"],
        errors,
    )
    beside = ("in band", "LQ", "lost")
    screen.table(
        f"{where}: tolerances at score {result['acceptable_score']:g} and, last, at LQ ratio "
        f"{result['acceptable_lq_ratio']:g} ({first['n_devices']} devices, "
        f"{described_steps(first)}, 95 % CI); "
        "beside each the share of steps in the band, the LQ ratio and the loops lost there",
        ["method", "gap D* [steps]", *beside, "delivery p*", *beside, "D* by LQ"],
        tolerances,
    )
    screen.table(
        f"{where}: score over the gap between packets ({first['n_curve_devices']} devices)",
        ["method", *(f"{point['d']:g}" for point in first["gap_curve"])],
        scores,
    )
    for name, entry in entries.items():
        flagged = [point["flagged"] for point in entry["gap_curve"] if "flagged" in point]
        if flagged:
            shares = ", ".join(f"{share:.1%}" for share in flagged)
            screen.say(f"{name}: packets flagged, by gap: {shares}")
    for name, path in result.get("checkpoints", {}).items():
        if path != result["checkpoint"]:
            screen.say(f"{name} is of model {path}")
    screen.say(result["source"])


def show_stress(result: dict[str, Any], screen: Screen) -> None:
    """Print a table per method: scores under conditions, with their share of the nominal ones."""
    stress = result["stress"]
    for name, entry in stress["methods"].items():
        screen.table(
            f"{result['plant']}, seed {result['seed']}: score of {name} by gap D between packets "
            f"({stress['n_devices']} devices, {described_steps(stress)}, 95 % CI), and ÷ its "
            "nominal score",
            stress_columns(stress, entry),
            stress_rows(entry),
        )


def stress_columns(stress: dict[str, Any], entry: dict[str, Any]) -> list[str]:
    """Return the headings of :func:`stress_rows`."""
    gaps = stress["gaps"]
    flagged = ["flagged"] * ("flagged" in entry["nominal"][0])
    shares = (f"÷ nominal, {gap}" for gap in gaps)
    return ["condition", *(f"D = {gap}" for gap in gaps), *shares, *flagged]


def stress_rows(entry: dict[str, Any]) -> list[list[str | None]]:
    """Return the rows of a method's table, the nominal first, the mean of the others last."""
    rows = [("nominal", entry["nominal"])]
    rows += [(row["condition"], row["points"]) for row in entry["rows"]]
    rows += [("mean of these", entry["means"])] if len(entry["rows"]) > 1 else []
    return [
        [
            name,
            *(span(point["score"], point["ci95"], 2) for point in points),
            *(_number(point["relative"], 2) for point in points),
            *([_number(points[0].get("flagged"), 3)] if "flagged" in entry["nominal"][0] else []),
        ]
        for name, points in rows
    ]


def _number(value: float | None, decimals: int) -> str | None:
    return None if value is None else f"{value:.{decimals}f}"
