"""The zoo's numbers: what the cards say, recomputed where that takes seconds."""

import re

import numpy as np
import pytest
import torch

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.frames import frames_seen
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.statistics import ratio
from hjepa_cli.stages.model_set import under_law_of
from hjepa_cli.storage import files, zoo

DEVICES = 12  # of the 64 on the cards: the same draws
FRESH_SEED = 20_000  # trajectories that no training has seen

pytestmark = pytest.mark.parametrize("name", zoo.list_models())


def settings_of(model, card):
    preset = model.metadata["settings"]["preset"]
    flags = {"protocol.curve_devices": DEVICES, "protocol.bracket_devices": DEVICES}
    if "--protocol paper" in card:
        flags["protocol"] = "paper"
    return under_law_of(model, load_settings(preset, flags=flags))


def load(name):
    return Model.load(zoo.resolve_model(name), "cpu")


def shown_of(model):
    """The methods that the model is about."""
    offered = methods_of(model)
    return ("hjepa", "hold") if "hjepa" in offered else offered[:1]


def card_of(name):
    return (zoo.zoo_directory() / name / "README.md").read_text(encoding="utf-8")


def rows_of(card):
    """The closed-loop table by method: column name → cell."""
    (block,) = re.findall(r"<!-- table: card .*?<!-- end -->", card, re.DOTALL)
    lines = [line for line in block.splitlines() if line.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    header = next(row for row in table if row[0] == "method")
    return {
        row[0].strip("`"): dict(zip(header, row, strict=True))
        for row in table[table.index(header) + 2 :]
        if row[0].startswith("`")
    }


def score_column(row):
    """Its name in a card's table, and the steps between packets that it is about."""
    (name,) = [column for column in row if column.startswith("score at D = ")]
    return name, float(name.removeprefix("score at D = "))


def numbers(cell):
    """``0.871 (0.821–0.917)`` → [0.871, 0.821, 0.917]."""
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", cell.replace(",", ""))]


def agree(cell, *values):
    """Whether a cell shows these values, rounded to its digits."""
    digits = max(len(number.partition(".")[2]) for number in re.findall(r"[\d.]+", cell))
    shown = numbers(cell)
    assert len(shown) == len(values)
    return np.allclose(shown, values, atol=0.51 * 10**-digits)


def test_the_card_says_what_the_curves_say(name):
    entries = files.read_json(zoo.zoo_directory() / name / zoo.CURVES_FILE)["methods"]
    rows = rows_of(card_of(name))
    assert set(shown_of(load(name))) <= rows.keys() <= entries.keys()
    for method, row in rows.items():
        entry = entries[method]
        windows = [key for key in row if key.replace("NMAE ", "").replace("–", "-") in
                   entry["nmae_windows"]]  # fmt: skip
        assert len(windows) == 4
        for key in windows:
            value = entry["nmae_windows"][key.replace("NMAE ", "").replace("–", "-")]
            assert agree(row[key], value), (method, key)
        column, gap_steps = score_column(row)
        (point,) = [point for point in entry["gap_curve"] if point["d"] == gap_steps]
        assert agree(row[column], point["score"], *point["ci95"]), method
        gap = entry["tolerance_gap_steps"], *entry["tolerance_gap_ci95"]
        assert agree(row["gap D* [steps]"], *gap), method
        assert agree(row["delivery p*"], entry["tolerance_p"], *entry["tolerance_p_ci95"]), method


def test_a_few_devices_score_as_on_the_card(name):
    """Their mean lies within three standard errors, those of the card's interval and its n."""
    model, rows = load(name), rows_of(card_of(name))
    settings = settings_of(model, card_of(name))
    simulator = Simulator(settings, model)

    def scores(method, gap):
        block = Block(method, (Point("gap", gap),), 0, DEVICES)
        return block.compute(simulator, lambda steps: None).score

    teacher = scores("optimal", 1.0)
    entries = files.read_json(zoo.zoo_directory() / name / zoo.CURVES_FILE)["methods"]
    for method in shown_of(model):
        column, gap_steps = score_column(rows[method])
        score, low, high = numbers(rows[method][column])
        n = entries[method]["n_curve_devices"]
        standard_error = (high - low) / (2 * 1.96) * np.sqrt(n / DEVICES)
        measured = float(ratio(scores(method, gap_steps), teacher[0])[0])
        assert abs(measured - score) <= 3 * standard_error, (method, measured)
        assert (
            build_driver(method, settings, model).bits_per_transmission
            == (entries[method]["bits_per_transmission"])
        )


def test_fresh_frames_are_read_as_well_as_the_card_says(name):
    """A probe and the shipped actor on trajectories that nobody has seen.

    The card's probe was fitted to ten times the frames, so this one may read a little worse.
    """
    model = load(name)
    kind = plant(model.plant_name)
    flags = {"seed": FRESH_SEED, "collect.trajectories": 80, "collect.test_trajectories": 10}
    settings = under_law_of(model, load_settings(model.metadata["settings"]["preset"], flags=flags))

    def see(split):
        made = generate(settings, split)
        k = np.arange(0, made.steps, 4)
        seen = made.states[:, frames_seen(k, model.look)]
        frames = kind.camera().render(seen.reshape(-1, seen.shape[-1]))
        z = model.encode(frames.reshape(-1, model.frames, *frames.shape[1:]))
        labels_n = made.teacher_n[:, k].reshape(-1, *kind.action_shape)
        return z, torch.from_numpy(seen[:, :, -1].reshape(len(z), -1)), torch.from_numpy(labels_n)

    train_z, train_states, _ = see("train")
    test_z, test_states, labels_n = see("test")
    told = model.metadata["health"]
    r2 = health.probe_r2(train_z, train_states, test_z, test_states, kind.state_names)
    for state, value in told["probe_r2"].items():
        assert r2[state] > value - 0.06, (state, r2)
    with torch.inference_mode():
        played_n = model.actor(test_z)
    assert health.nrmse(played_n, labels_n) == pytest.approx(told["actor_nrmse"], abs=0.05)
    line = next(line for line in card_of(name).splitlines() if line.startswith("| linear probe"))
    assert agree(line.split("|")[2], *(told["probe_r2"][state] for state in kind.state_names))
    line = next(line for line in card_of(name).splitlines() if line.startswith("| actor NRMSE"))
    assert agree(line.split("|")[2], told["actor_nrmse"])
