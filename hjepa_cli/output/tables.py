"""Tables show what a training stage or an evaluation found."""

from collections.abc import Mapping, Sequence
from typing import Any

from hjepa_cli.core.control.force_error import WINDOWS
from hjepa_cli.core.control.link import described
from hjepa_cli.core.evaluation.protocol import BESIDE
from hjepa_cli.output.screen import Screen, described_steps, span, tolerance
from hjepa_cli.plugins import LAWS, PHYS


def measured(value: float | None) -> str:
    """Set a number with three decimals, or say that there is none."""
    return "undefined" if value is None else f"{value:.3f}"


def ranked(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[Mapping[str, Any]]]]:
    """Return device counts by method, with its scheduler where it has one, the most first.

    Those of a method ascend with the SNR, in whatever order it was asked for.
    """
    by_method: dict[str, list[Mapping[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["snr_db"]):
        names = (row["method"], row.get("scheduler"))
        by_method.setdefault(", ".join(filter(None, names)), []).append(row)
    return sorted(by_method.items(), key=lambda item: -(item[1][-1]["devices"] or 0))


def described_cell(result: Mapping[str, Any]) -> str:
    """Return the cell of a result of ``scale`` in a few words."""
    law = f"{result['law']} law{described(result.get('link', {}))}"
    if result.get("noise") == "scaled" and "radio.noise" in LAWS[result["law"]].uses:
        law += ", scaled noise"
    if (phy := result.get("phy", "shannon")) != "shannon":
        law += f", {PHYS[phy].help}" if phy in PHYS else f", {phy}"
    return f"{law}, {result['bandwidth_hz'] / 1e6:g} MHz, {result['slot_s'] * 1e3:g} ms slots"


def counted_by(result: Mapping[str, Any]) -> str:
    """Return what the devices of a result of ``scale`` were counted by."""
    if steps := result.get("tolerance_steps"):
        return f"a packet every {described_gap(steps)}, as stated"
    return f"score ≥ {result['acceptable_score']:g}, 95 % CI"


def described_gap(steps: float) -> str:
    """Return a gap in words: ``1 step``, ``2.5 steps``."""
    return f"{steps:g} step" + "s" * (steps != 1)


def show_gates(screen: Screen, gates: dict[str, dict[str, Any]], *, enforced: bool) -> None:
    """Print a row per gate."""
    rows = [
        [
            *(name, measured(gate["value"])),
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
        [[measured(value) for value in (*windows.values(), *held_out)]],
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


def show_fusion(result: dict[str, Any], screen: Screen) -> None:
    """Print how far predictions, packets and what is made of both are from the truth."""
    distances = result["distances"]
    screen.table(
        f"distance 1 − cos from clean embeddings, over {result['packets']} packets of loops that "
        "training did not see",
        [*distances],
        [[f"{value:.5f}" for value in distances.values()]],
    )


def show_evaluation(result: dict[str, Any], screen: Screen) -> None:
    """Print the tables of an evaluation: what each method does, and its score over the gap."""
    entries = result["methods"]
    if not entries:
        return
    first = next(iter(entries.values()))
    windows = [f"{start}-{end}" for start, end in WINDOWS]
    where = f"{result['plant']}, seed {result['seed']}{described(result.get('link', {}))}"
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


def show_offline(result: dict[str, Any], screen: Screen) -> None:
    """Print what recordings say of each method: its error, and how long that is small."""
    entries = result["methods"]
    first = next(iter(entries.values()))
    windows = list(first["nmae_windows"])
    within = list(first["steps_within"])
    where = f"split {result['split']} of {result['dataset']}"
    screen.table(
        f"{where}: NMAE by steps since the packet, with every packet, and steps until it exceeds a "
        f"share of the range ({first['n_rollouts']} trajectories)",
        ["method", *windows, "every", *(f"≤ {most}" for most in within), "bits"],
        [
            [
                name,
                *(_number(entry["nmae_windows"][window], 4) for window in windows),
                _number(entry["nmae_every_step"], 4),
                *(str(entry["steps_within"][most]) for most in within),
                entry["bits_per_transmission"],
            ]
            for name, entry in entries.items()
        ],
    )
    for name in entries if result.get("conditions") else ():
        screen.table(
            f"{where}: NMAE of {name} under conditions, and with every packet ÷ without any",
            offline_columns(entries),
            offline_rows(result, name),
        )
    rows = []
    for name, of in result["latent"].items():
        last = len(of["steps"]) - 1
        for at in sorted({0, last // 2, last} - {-1}):
            rows.append(
                [
                    *(name, str(of["steps"][at]), _number(of["error"][at], 4)),
                    _number(of["still"][at], 4),
                ]
            )
    if rows:
        screen.table(
            f"{where}: 1 − cos of predicted and seen embeddings under the recorded actions",
            ["method", "steps", "predicted", "nothing changes"],
            rows,
        )
    if result["probe_r2"]:
        probes = result["probe_r2"]
        screen.table(
            "states read off embeddings, held out",
            [*probes],
            [[_number(value, 3) for value in probes.values()]],
        )
    else:
        screen.say("no states were recorded: probes are absent")
    screen.say(
        "recordings say nothing of closed loops; hjepa scale --tolerance-steps STEPS counts the "
        "devices of a gap that you take to be safe"
    )


def offline_columns(entries: Mapping[str, Any]) -> list[str]:
    """Return the headings of :func:`offline_rows`."""
    first = next(iter(entries.values()))
    within = (f"≤ {most}" for most in first["steps_within"])
    return ["condition", *first["nmae_windows"], "every", "÷ nominal", *within]


def offline_rows(result: Mapping[str, Any], name: str) -> list[list[str | None]]:
    """Return what recordings say of a method under conditions, by rows, the nominal first."""
    nominal = result["methods"][name]
    rows = [(row["condition"], row["methods"][name]) for row in result["conditions"]]
    usual = nominal["nmae_every_step"]
    return [
        [
            condition,
            *(_number(value, 4) for value in entry["nmae_windows"].values()),
            _number(entry["nmae_every_step"], 4),
            _number(entry["nmae_every_step"] / usual if usual else None, 2),
            *(str(steps) for steps in entry["steps_within"].values()),
        ]
        for condition, entry in (("nominal", nominal), *rows)
    ]


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


ALLOCATION = (  # of rows of ``scale --json`` under a physical layer with transport blocks
    *("mcs", "modulation_order", "code_rate", "prbs", "data_symbols", "dmrs_re_per_prb"),
    *("tbs_bits", "segments", "bler", "grants", "packets_per_slot", "latency_s"),
)


def show_allocations(rows: Sequence[Mapping[str, Any]], screen: Screen) -> None:
    """Print what a packet is sent on, once for each size, SNR and kind of grant."""
    found = {
        (row["bits_per_transmission"], row["snr_db"], row["grants"]): row
        for row in rows
        if "mcs" in row
    }
    if not found:
        return
    screen.table(
        "what a packet takes; packets get through per slot of the loop",
        [
            *("bits", "SNR [dB]", "grants", "MCS", "Qm", "R", "PRBs", "symbols", "TBS [bits]"),
            *("blocks", "BLER", "packets", "latency [ms]"),
        ],
        [
            [
                *(bits, f"{snr_db:g}", grants, row["mcs"], row["modulation_order"]),
                *(f"{row['code_rate']:.3f}", row["prbs"], row["data_symbols"], row["tbs_bits"]),
                row["segments"],
                f"{'≤ ' if row['bler_is_bound'] else ''}{row['bler']:.4f}",
                *(f"{row['packets_per_slot']:.1f}", f"{row['latency_s'] * 1e3:.2f}"),
            ]
            for (bits, snr_db, grants), row in sorted(found.items())
        ],
    )
