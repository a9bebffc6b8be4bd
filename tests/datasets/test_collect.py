"""Datasets: what is drawn, what is applied, what is labelled, and when."""

import dataclasses
import io
import json
from unittest.mock import Mock

import numpy as np
import pytest

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.datasets.trajectories import driven_by_teacher, generate, split_sizes
from hjepa_cli.core.plants.named import Camera, plant, teacher
from hjepa_cli.errors import DataError, StorageError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect
from hjepa_cli.stages.inputs import brought_along

PRESETS = ("default", "gym")


def settings_of(preset="default", seed=0, law=(), **changes):
    """Settings of a few trajectories, all by the plant's own teacher, unless a law is given."""
    settings = load_settings(preset, flags={"seed": seed, "control.gains_n": law})
    small = {"trajectories": 6, "test_trajectories": 2, "clean_trajectories": 2, "steps": 100}
    small |= changes
    return dataclasses.replace(settings, collect=dataclasses.replace(settings.collect, **small))


@pytest.fixture
def screen():
    return Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())


@pytest.mark.parametrize("preset", PRESETS)
def test_each_state_follows_from_the_one_before_and_the_force_applied_there(preset):
    """The force of step k acts between states[k + 1] and states[k + 2]; none before k = 0."""
    settings = settings_of(preset)
    kind, data = plant(settings.plant), generate(settings, "train")
    states = data.states.astype(float)
    forces_n = np.concatenate([np.zeros((6, 1)), data.applied_n[:, :-1]], axis=1)
    exact, quarter = states[:, :-1], dataclasses.replace(kind, step_s=kind.step_s / 4)
    for _ in range(4):
        exact = quarter.advance(exact, forces_n)
    assert np.abs(exact - states[:, 1:]).max() < 1e-4
    assert states.shape == (6, 101, 4) and data.applied_n.shape == (6, 100)


@pytest.mark.parametrize("preset", PRESETS)
def test_labels_are_the_teachers_and_applied_forces_add_held_exploration(preset):
    settings = settings_of(preset, trajectories=300)
    data = generate(settings, "train")
    expected = teacher(settings.plant)(data.states[:, 1:])
    np.testing.assert_allclose(data.teacher_n, expected, rtol=0, atol=2e-4)  # states are float32
    assert np.abs(data.applied_n).max() <= 20.0
    free = (np.abs(data.applied_n) < 20.0).reshape(300, 10, 10)  # [.., holds, steps of a hold]
    pushes_n = (data.applied_n - data.teacher_n).reshape(300, 10, 10)
    highest_n = pushes_n.max(axis=2, where=free, initial=-np.inf)
    lowest_n = pushes_n.min(axis=2, where=free, initial=np.inf)
    assert (highest_n - lowest_n).max() < 1e-5
    unclipped = free.all(axis=2) & (np.abs(data.teacher_n[:, ::10]) < 5)
    held_n = pushes_n[:, :, 0]
    deviation_n = {"desktop": 4.0, "gym": 2.0}[settings.plant]
    assert held_n[unclipped].std() == pytest.approx(deviation_n, rel=0.1)
    assert held_n[unclipped].mean() == pytest.approx(0, abs=0.1 * deviation_n)


def test_clean_rollouts_are_the_teacher_alone():
    clean = generate(settings_of(), "clean")
    np.testing.assert_array_equal(clean.applied_n, clean.teacher_n)
    assert clean.states.shape == (2, 121, 4)


@pytest.mark.parametrize("preset", PRESETS)
def test_initial_states_fill_their_range(preset):
    settings = settings_of(preset, trajectories=300, steps=1)
    options = settings.collect
    half_widths = [options.x_m, options.x_dot_m_s, options.theta_rad, options.theta_dot_rad_s]
    share = generate(settings, "train").states[:, 0] / half_widths
    assert (np.abs(share) <= 1 + 1e-6).all()
    assert (share.min(axis=0) < -0.97).all() and (share.max(axis=0) > 0.97).all()
    assert np.abs(share.mean(axis=0)).max() < 0.15  # 4.5 standard errors
    np.testing.assert_allclose(share.var(axis=0), 1 / 3, rtol=0.2)


def test_a_trajectory_depends_on_its_seed_split_and_index_only():
    few, many = (generate(settings_of(trajectories=n), "train") for n in (2, 5))
    for name, values in few.tensors().items():
        np.testing.assert_array_equal(values, many.tensors()[name][:2])
    short = generate(settings_of(trajectories=2, steps=30), "train")
    np.testing.assert_array_equal(short.states, few.states[:, :31])
    streams = ((0, "train", 0), (0, "train", 1), (0, "test", 0), (1, "train", 0))
    starts = [
        generate(settings_of(seed=seed), split).states[index, 0, 0]
        for seed, split, index in streams
    ]
    assert len(set(starts)) == 4


@pytest.mark.parametrize("preset", PRESETS)
def test_a_tuned_law_drives_as_many_in_training_as_the_teacher(preset):
    """Every second trajectory is the teacher's, and what the teacher does does not depend on it."""
    law = load_settings(preset).control.gains_n
    assert law, "the plant's, by default"
    both, alone = settings_of(preset, law=law), settings_of(preset)
    assert split_sizes(both) == {"train": (12, 100), "test": (2, 100), "clean": (2, 120)}
    assert split_sizes(alone) == {"train": (6, 100), "test": (2, 100), "clean": (2, 120)}
    assert split_sizes(load_settings("paper"))["train"] == (200, 100)
    assert split_sizes(load_settings(preset))["train"] == (400, load_settings(preset).collect.steps)
    data, of_teacher = generate(both, "train"), driven_by_teacher(both)
    assert len(data) == 12 and len(data[of_teacher]) == 6
    assert len(generate(alone, "train")[driven_by_teacher(alone)]) == 6
    # The law and the teacher see the same state and do not do the same; one of them drove.
    quiet = dataclasses.replace(both, collect=dataclasses.replace(both.collect, exploration_n=0.0))
    data, act = generate(quiet, "train"), teacher(quiet.plant)
    by_teacher_n = act(data.states[:, 1:].astype(float))
    np.testing.assert_allclose(
        data.applied_n[of_teacher], by_teacher_n[of_teacher], rtol=0, atol=2e-3
    )
    others = np.setdiff1d(np.arange(12), np.arange(12)[of_teacher])
    assert (np.abs(data.applied_n - by_teacher_n)[others].max(axis=1) > 1.0).all()


@pytest.mark.parametrize(("law", "count"), [((), 6), (load_settings().control.gains_n, 12)])
def test_a_plan_and_a_dataset_count_both_laws(tmp_path, screen, law, count):
    settings = settings_of(law=law, steps=10, clean_steps=5)
    planned = collect.plan(settings)
    steps = count * 10 + 2 * 10 + 2 * 5
    assert f"simulate {count} training, 2 held-out and 2 clean trajectories" in planned.work[0]
    assert f"({steps} steps)" in planned.work[0]
    assert collect.size_bytes(settings) == 4 * (steps * (4 + 2) + (count + 4) * 4)
    result = collect.run(settings, screen, out=tmp_path / "data")
    assert result["trajectories"] == count
    data = load_dataset(tmp_path / "data", "desktop")
    assert data.settings.get("control", {}).get("gains_n", []) == list(law)
    assert len(data.split("train")) == count
    known = brought_along(load_settings(), data.settings, data.path)
    assert len(data.split("train")[driven_by_teacher(known)]) == 6, "as the dataset says"


@pytest.mark.parametrize("law", [(), load_settings().control.gains_n])
def test_an_interrupted_collection_goes_on_under_its_own_law(tmp_path, screen, law, monkeypatch):
    """Also where that is the teacher, which its record does not mention."""
    settings, out = settings_of(law=law, steps=10), tmp_path / "data"
    whole = collect.run(settings, screen, out=tmp_path / "whole")
    with monkeypatch.context() as patched:
        patched.setattr(collect, "write_shard", Mock(side_effect=StorageError("full")))
        with pytest.raises(StorageError, match="full"):
            collect.run(settings, screen, out=out)
    assert collect.recorded_settings(out).control == settings.control
    other = settings_of(law=() if law else load_settings().control.gains_n, steps=10)
    with pytest.raises(UsageError, match=r"other settings: control\.gains_n = "):
        collect.run(other, screen, out=out)
    again = collect.run(settings, screen, out=out)
    assert again["trajectories"] == whole["trajectories"]
    names = sorted(path.name for path in out.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert all((out / of).read_bytes() == (tmp_path / "whole" / of).read_bytes() for of in names)


@pytest.mark.parametrize("frames", ["rendered", "stored"])
def test_collect_writes_a_dataset_and_describes_it(tmp_path, screen, frames):
    settings = settings_of(steps=20, clean_steps=15, frames=frames)
    result = collect.run(settings, screen, out=tmp_path / "data")
    described = ("trajectories", "test_trajectories", "clean_trajectories", "steps")
    assert [result[key] for key in described] == [6, 2, 2, 20]
    assert result["dataset"] == str(tmp_path / "data")
    assert result["training_uplink_bits"] == 6 * 20 * 2 * 64 * 128 * 3 * 8
    assert result["seconds"] > 0 and result["frames_per_s"] > 0
    json.dumps(result, allow_nan=False)

    data = load_dataset(tmp_path / "data", "desktop")
    assert data.camera == Camera("desktop").manifest()
    assert data.settings["seed"] == 0 and data.settings["collect"]["steps"] == 20
    for split, count, steps in (("train", 6, 20), ("test", 2, 20), ("clean", 2, 15)):
        found, made = data.split(split), generate(settings, split)
        assert found.states.shape == (count, steps + 1, 4)
        np.testing.assert_array_equal(found.states, made.states)
        if frames == "stored":
            assert found.frames is not None
            again = Camera("desktop").render(found.states.reshape(-1, 4))
            np.testing.assert_array_equal(found.frames.reshape(again.shape), again)
        else:
            assert found.frames is None


def test_equal_settings_make_equal_bytes(tmp_path, screen):
    for name in ("first", "second"):
        collect.run(settings_of(steps=10), screen, out=tmp_path / name)
    collect.run(settings_of(steps=10, seed=1), screen, out=tmp_path / "other")

    def contents(name):
        return {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()}

    assert contents("first") == contents("second") != contents("other")


def test_without_out_directories_are_numbered(tmp_path, screen, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = settings_of(steps=5)
    names = [collect.run(settings, screen)["dataset"] for _ in range(2)]
    assert names == ["data/desktop-0001", "data/desktop-0002"]


def test_a_finished_dataset_is_described_again_and_left_alone(tmp_path):
    notes = io.StringIO()
    screen = Screen(stdout=io.StringIO(), stderr=notes)
    first = collect.run(settings_of(steps=10), screen, out=tmp_path / "data")
    before = (tmp_path / "data" / "dataset.json").read_bytes()
    again = collect.run(settings_of(steps=10), screen, out=tmp_path / "data")
    timings = ("seconds", "frames_per_s")
    assert {k: v for k, v in again.items() if k not in timings} == {
        k: v for k, v in first.items() if k not in timings
    }
    assert again["frames_per_s"] is None
    assert "other settings" not in notes.getvalue()
    collect.run(settings_of(steps=50), screen, out=tmp_path / "data")
    assert "other settings" in notes.getvalue()
    assert (tmp_path / "data" / "dataset.json").read_bytes() == before
    with pytest.raises(DataError, match="desktop"):
        collect.run(settings_of("gym", steps=10), screen, out=tmp_path / "data")


def test_the_training_phase_s_uplink_is_told(tmp_path):
    """It precedes all the savings of semantic control."""
    notes = io.StringIO()
    screen = Screen(stdout=io.StringIO(), stderr=notes)
    collect.run(settings_of(steps=10), screen, out=tmp_path / "data")
    assert "393216 bits a step" in notes.getvalue() and "Gbit of uplink" in notes.getvalue()


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"trajectories": 0}, "collect.trajectories"),
        ({"test_trajectories": -1}, "collect.test_trajectories"),
        ({"steps": 0}, "collect.steps"),
        ({"clean_trajectories": 0}, "clean_trajectories"),
        ({"exploration_hold_steps": 0}, "exploration_hold_steps"),
        ({"theta_rad": -0.1}, "theta_rad"),
    ],
)
def test_impossible_settings_are_refused_before_anything_is_written(tmp_path, screen, change, name):
    with pytest.raises(UsageError, match=name):
        collect.run(settings_of(**change), screen, out=tmp_path / "data")
    assert not (tmp_path / "data").exists()
