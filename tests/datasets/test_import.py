"""Recordings of every format become the same dataset, and unsound ones none."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import recordings
from command_line import ENVIRONMENT, assert_one_line_error, open_shell

import hjepa_cli
from hjepa_cli.core.datasets.importing import assembly
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.core.plants.resizing import area_means, fitted
from hjepa_cli.stages import import_data
from hjepa_cli.storage import files
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.shards import ShardLog

SIZE = ("--size", recordings.H, recordings.W)
SAID = ("--fps", 20, "--limit", 1, *SIZE)


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def save(path, frames, actions, states=None):
    more = {} if states is None else {"states": states}
    np.savez(path, frames=frames, actions=actions, **more)
    return path


def trajectories(path, split="train"):
    return hjepa_cli.load_dataset(path).split(split)


def assert_same_rows(found, frames, actions, states=None):
    """Frame j is kept, and action j + 1 leads on from it: index 0 is the frame before k = 0."""
    steps = found.steps
    assert np.array_equal(found.frames, frames[:, : steps + 1])
    assert np.array_equal(found.applied_n, actions[:, 1 : steps + 1].astype(np.float32))
    if states is not None:
        assert np.array_equal(found.states, states[:, : steps + 1].astype(np.float32))


WRITERS = {
    "npz": lambda root, f, a, s: save(root / "r.npz", f, a, s),
    "folder": lambda root, f, a, s: recordings.folder(root / "r", f, a, s),
    "video": lambda root, f, a, s: recordings.film(root / "r", f, a, codec="ffv1", suffix="mkv"),
    "lerobot2": lambda root, f, a, s: recordings.lerobot(root / "r", f, a, s, version=2),
    "lerobot3": lambda root, f, a, s: recordings.lerobot(root / "r", f, a, s, version=3),
    "minari": lambda root, f, a, s: recordings.minari(root / "r", f, a),
    "minari2": lambda root, f, a, s: recordings.minari(root / "r", f, a, encoded=True),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_gives_the_same_frames_actions_and_states(kind, shell, tmp_path):
    for module in ("av", "pyarrow", "h5py", "PIL"):
        pytest.importorskip(module)
    frames, actions, states = recordings.make(episodes=4, steps=12)
    if kind == "lerobot2":
        actions, states = actions.astype(np.float32), states.astype(np.float32)
    source = WRITERS[kind](tmp_path, frames, actions, states)
    outcome = shell("data", "import", source, *SAID, "--out", "d", "--json")
    assert outcome.code == 0, outcome
    document = outcome.document
    assert document["frames_per_s"] > 0 and not document["left_out"]
    known = states if document["states"] else None
    assert (known is None) == (kind in ("video", "minari", "minari2"))
    test = hjepa_cli.load_dataset(tmp_path / "d").splits["test"]["trajectories"]
    assert test == 1
    held = [2]  # evenly spaced: the middle one of four
    kept = [n for n in range(4) if n not in held]
    lossless = kind not in ("lerobot2", "lerobot3", "minari2")
    train, out = trajectories(tmp_path / "d"), trajectories(tmp_path / "d", "test")
    if not lossless:  # which these formats mostly have; here pictures come back all the same
        assert "losses" in outcome.err
    assert_same_rows(train, frames[kept], actions[kept], None if known is None else known[kept])
    assert_same_rows(out, frames[held], actions[held])
    assert hjepa_cli.load_dataset(tmp_path / "d").plant == "recorded"


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_our_own_data_come_back_bit_for_bit(suffix, shell, tmp_path):
    if suffix == "h5":
        pytest.importorskip("h5py")
    (tmp_path / "c.toml").write_text("[collect]\nclean_trajectories = 2\nclean_steps = 9\n")
    few = ("--trajectories", 3, "--test-trajectories", 2, "--steps", 8)
    assert shell("collect", *few, "--config", "c.toml", "--out", "own").code == 0
    splits = ("train", "test", "clean")
    for split in splits:
        assert (
            shell("data", "export", "own", "--split", split, "--out", f"{split}.{suffix}").code == 0
        )
    train, test, clean = (f"{split}.{suffix}" for split in splits)
    outcome = shell("data", "import", train, "--test", test, "--clean", clean, "--out", "again")
    assert outcome.code == 0, outcome
    own, again = (hjepa_cli.load_dataset(name) for name in ("own", "again"))
    assert again.kind.step_s == own.kind.step_s and again.kind.state_names == own.kind.state_names
    for split in splits:
        was, now = own.split(split), again.split(split)
        assert np.array_equal(now.frames, frames_of(own.kind.camera(), was.states))
        assert np.array_equal(now.states, was.states)
        limit_n = own.kind.force_limit_n  # what networks see: applied ÷ limit
        assert np.array_equal(now.applied_n, was.applied_n / limit_n)
        assert np.array_equal(now.teacher_n, was.teacher_n / limit_n)


def test_episodes_of_unequal_length_are_cut_so_that_no_frame_is_lost(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=3, steps=30)
    lengths = (30, 13, 20)
    parts = {f"frames_{n}": frames[n, :rows] for n, rows in enumerate(lengths)}
    parts |= {f"actions_{n}": actions[n, :rows] for n, rows in enumerate(lengths)}
    np.savez(tmp_path / "r.npz", **parts)
    assert shell("data", "import", "r.npz", *SAID, "--out", "d").code == 0
    train, test = trajectories(tmp_path / "d"), trajectories(tmp_path / "d", "test")
    assert train.steps == test.steps == 12
    assert len(test) == 1 and np.array_equal(test.frames[0], frames[1, :13])
    starts = [0, 12, 17]  # of 30 rows: the last one ends with the episode
    assert np.array_equal(train.frames[:3], np.stack([frames[0, s : s + 13] for s in starts]))
    assert np.array_equal(train.frames[3:], np.stack([frames[2, s : s + 13] for s in (0, 7)]))
    # Asked for trajectories that one is too short for: refused, or left out and said.
    assert_one_line_error(
        shell("data", "import", "r.npz", *SAID, "--steps", 15, "--out", "e"),
        65,
        "episode 1: 12 steps",
    )
    left = shell("data", "import", "r.npz", *SAID, "--steps", 15, "--skip-bad", "--held-out", 0.3,
                 "--out", "e", "--json")  # fmt: skip
    assert left.code == 65 and "test" in left.document["error"]["message"]  # held out: that one


def test_a_single_episode_is_held_out_at_its_end(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=1, steps=40)
    save(tmp_path / "r.npz", frames, actions)
    assert shell("data", "import", "r.npz", *SAID, "--steps", 6, "--out", "d").code == 0
    train, test = trajectories(tmp_path / "d"), trajectories(tmp_path / "d", "test")
    assert np.array_equal(train.frames[-1], frames[0, 25:32])
    assert np.array_equal(test.frames[-1], frames[0, 33:40])


@pytest.mark.parametrize(
    ("share", "left"), [(0.2, "6 pictures to train on and 1 to"), (0.9, "1 pictures")]
)
@pytest.mark.parametrize("more", [(), ("--steps", 2)])
def test_a_single_episode_too_short_to_hold_out_is_refused(share, left, more, shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=1, steps=7)
    save(tmp_path / "r.npz", frames, actions)
    with shell.untouched():
        refused = shell("data", "import", "r.npz", *SAID, *more, "--held-out", share, "--out", "d")
    assert_one_line_error(refused, 2, f"--held-out {share:g} leaves {left}", "--held-out 0.5")
    assert shell("data", "import", "r.npz", *SAID, *more, "--held-out", 0.5, "--out", "d").code == 0


def test_an_offset_moves_actions_to_the_frames_they_lead_from(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=3, steps=14)
    late = np.zeros_like(actions)
    late[:, 2:] = actions[:, :-2]  # logged two rows late
    save(tmp_path / "r.npz", frames, late)
    assert shell("data", "import", "r.npz", *SAID, "--action-offset", 2, "--out", "d").code == 0
    found = trajectories(tmp_path / "d")
    assert found.steps == 11
    assert np.array_equal(found.applied_n, actions[[0, 2], 1:12].astype(np.float32))
    assert np.array_equal(found.frames, frames[[0, 2], :12])


def test_inverse_dynamics_find_actions_that_are_logged_late(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=24, steps=60, lag=1)
    save(tmp_path / "r.npz", frames, actions)
    outcome = shell("data", "import", "r.npz", *SAID, "--out", "d", "--json")
    assert outcome.code == 0
    found = outcome.document["alignment"]
    assert found["best"] == 1 and found["clear"]
    assert "--action-offset 1" in outcome.err
    outcome = shell("data", "import", "r.npz", *SAID, "--action-offset", 1, "--out", "e", "--json")
    found = outcome.document["alignment"]
    assert found["best"] == 0 and "better than 1" in outcome.err


def test_pictures_of_other_kinds_are_converted_and_that_is_said(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=3, steps=8)
    alpha = np.concatenate([frames, np.full_like(frames[..., :1], 255)], axis=-1)
    kinds = {
        "rgba": (alpha, frames, "alpha"),
        "float": ((frames / 255.0).astype(np.float32), frames, "float"),
        "grey": (frames[..., 0], frames[..., :1].repeat(3, -1), "grey"),
        "first": (np.moveaxis(frames, -1, 2), frames, None),
        "16bit": (frames.astype(np.uint16) * 257, frames, "16-bit"),
    }
    for name, (given, wanted, said) in kinds.items():
        save(tmp_path / "r.npz", given, actions)
        outcome = shell("data", "import", "r.npz", *SAID, "--out", name, "--json")
        assert outcome.code == 0, outcome
        assert np.array_equal(trajectories(tmp_path / name).frames, wanted[[0, 2]]), name
        assert said is None or any(said in text for text in outcome.document["converted"])
    save(tmp_path / "r.npz", frames, actions)
    assert shell("data", "import", "r.npz", *SAID, "--grey", "--out", "g").code == 0
    assert trajectories(tmp_path / "g").frames.shape[-1] == 1


def test_area_means_are_those_of_a_finer_grid():
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (1, 12, 20, 3), dtype=np.uint8)
    fine = picture.repeat(7, 1).repeat(9, 2).astype(float)  # 84 × 180: divided by 7 × 9 and others
    for height, width in ((4, 5), (7, 9), (12, 20), (21, 36)):
        if 84 % height or 180 % width:  # no whole parts of the finer grid
            continue
        wanted = fine.reshape(1, height, 84 // height, width, 180 // width, 3).mean((2, 4))
        found = area_means(area_means(picture, 1, height), 2, width)
        assert np.allclose(found, wanted, atol=1e-3)
        assert np.abs(fitted(picture, (height, width, 3)) - wanted).max() < 0.501


def broken(name, frames, actions):
    """Return a recording with one flaw in episode 1, row 3, and words of the message."""
    actions, said = actions.copy(), ("episode 1, row 3",)
    if name == "nan":
        actions[1, 3, 1] = np.nan
    elif name == "large":
        actions[1, 3, 0] = 7.0
        said += ("its limit 1",)
    elif name == "float":
        frames = (frames / 255).astype(np.float32)
        frames[1, 3, 0, 0, 0] = 40.0
        said += ("expected 0 to 1",)
    elif name == "nan picture":
        frames = (frames / 255).astype(np.float32)
        frames[1, 3, 0, 0, 0] = np.nan
    return frames, actions, said


@pytest.mark.parametrize("flaw", ["nan", "large", "float", "nan picture"])
def test_a_flaw_is_named_by_episode_and_row_and_nothing_is_left(flaw, shell, tmp_path):
    clean, actions, _ = recordings.make(episodes=4, steps=9)
    frames, actions, said = broken(flaw, clean, actions)
    save(tmp_path / "r.npz", frames, actions)
    with shell.untouched():
        assert_one_line_error(shell("data", "import", "r.npz", *SAID, "--out", "d"), 65, *said)
        assert_one_line_error(shell("data", "import", "r.npz", *SAID), 65, *said)  # next free data/
    outcome = shell("data", "import", "r.npz", *SAID, "--skip-bad", "--out", "d", "--json")
    assert outcome.code == 0, outcome
    assert any(said[0] in text for text in outcome.document["left_out"])
    count = sum(of["trajectories"] for of in hjepa_cli.load_dataset(tmp_path / "d").splits.values())
    assert count == 3


def test_bad_folders_films_and_tables_are_refused_in_one_line(shell, tmp_path):
    pytest.importorskip("av")
    pytest.importorskip("PIL")
    frames, actions, _ = recordings.make(episodes=3, steps=8)

    def refused(*words, code=65, args=SAID):
        with shell.untouched():
            assert_one_line_error(shell("data", "import", "r", *args, "--out", "d"), code, *words)

    def rewrite(old, new):
        path = tmp_path / "r" / "rows.csv"
        path.write_text(path.read_text().replace(old, new))

    root = recordings.folder(tmp_path / "r", frames, actions)
    rewrite("1_0003.png", "../../secret.png")
    refused("episode 1", "row 3", "leads out of")
    rewrite("../../secret.png", "/etc/passwd")
    refused("leads out of")
    rewrite("/etc/passwd", "1_9999.png")
    refused("episode 1", "row 3", "does not exist")
    rewrite("1_9999.png", "1_0003.png")
    (root / "1_0003.png").write_bytes(b"no picture")
    refused("episode 1", "row 3", "does not decode")
    rewrite("action_x", "torque")
    refused("no column", code=2, args=(*SAID, "--actions", "torque,none"))
    rewrite("action_y", "other")
    refused("no column whose name begins with action")
    refused("nobody says how many pictures a second", code=2,
            args=("--actions", "torque,other", "--limit", 1))  # fmt: skip
    refused("nobody says what limits the 2 actions have", "--limit", code=2,
            args=("--actions", "torque,other", "--fps", 20))  # fmt: skip
    rewrite("\n", ",1\n")
    rewrite("0_0000.png", "0_0000.png,9")
    refused("line 2", "columns")
    for path in root.iterdir():
        path.unlink()
    root.rmdir()

    root = recordings.film(tmp_path / "r", frames, actions, codec="ffv1", suffix="mkv")
    (root / "run_1.csv").write_text("action_x,action_y\n" + "0,0\n" * 12)
    refused("run_1", "12 actions, and 8 pictures")
    (root / "run_1.csv").write_text("action_x,action_y\n" + "0,0\n" * 3)
    refused("run_1", "row 3", "8 pictures, and 3 actions")
    times = [0, 0.05, 0.1, 0.2, 0.25, 0.3, 0.35, 0.4]
    rows = "".join(f"{t},0,0\n" for t in times)
    (root / "run_1.csv").write_text("time_s,action_x,action_y\n" + rows)
    refused("run_1", "row 3", "100 ms after", "constant")
    (root / "run_1.csv").unlink()
    refused("run_1.csv does not exist", code=66)
    data = (root / "run_1.mkv").read_bytes()
    (root / "run_1.mkv").write_bytes(b"film" * 100)
    refused("run_1.mkv does not decode")
    (root / "run_1.mkv").write_bytes(data)


def test_the_import_ends_with_its_units_and_warns_where_others_are_likely(shell, tmp_path):
    pytest.importorskip("PIL")
    frames, actions, _ = recordings.make(episodes=3, steps=8)
    sizes = np.abs(actions).max(axis=(0, 1))
    source = save(tmp_path / "r.npz", frames, actions)
    outcome = shell("data", "import", source, *SAID, "--out", "in unit", "--json")
    listed = ", ".join(f"{size:.4g}" for size in sizes)
    words = f"20 pictures/s (from --fps), limits 1, 1; largest recorded {listed}"
    said = outcome.err.splitlines()[-2:]
    assert said[0] == words and "are they in the same unit" not in outcome.err
    assert said[1].endswith("data preview 'in unit', hjepa train-encoder --dataset 'in unit'")
    assert outcome.document["largest"] == pytest.approx(sizes)

    more = ("--limit", "1,25", *SIZE, "--fps", 20)
    outcome = shell("data", "import", source, *more, "--out", "large")
    assert "action 0 is" not in outcome.err
    assert f"action 1 is never above {sizes[1]:.3g}, {sizes[1] / 25:.1%} of" in outcome.err

    root = recordings.folder(tmp_path / "r", frames, actions)
    table = (root / "rows.csv").read_text().splitlines()
    for unit, warned in ((20, True), (0.02, False)):
        times = ["time", *(unit * (row % 8) for row in range(24))]
        rows = [f"{row},{time}" for row, time in zip(table, times, strict=True)]
        (root / "rows.csv").write_text("\n".join(rows))
        outcome = shell("data", "import", root, "--limit", 1, *SIZE, "--out", f"u{unit}")
        assert f"{1 / unit:g} pictures/s (from its column of times)" in outcome.err
        assert ("divide it by 1000" in outcome.err) == warned


def test_tables_of_other_programs_are_read_or_refused_by_what_is_in_them(shell, tmp_path):
    pytest.importorskip("PIL")
    frames, actions, _ = recordings.make(episodes=2, steps=8)
    root = recordings.folder(tmp_path / "r", frames, actions)
    table = (root / "rows.csv").read_text()

    def refused(text, *words):
        (root / "rows.csv").write_text(text)
        with shell.untouched():
            outcome = shell("data", "import", root, *SAID, "--out", "d")
        assert_one_line_error(outcome, 65, *words)

    for separator in ";\t":
        words = ("rows.csv", f"separated by {separator!r}, expected ','")
        refused(table.replace(",", separator), *words)
    refused(table.replace("action_y", "action_x"), "rows.csv has 2 columns 'action_x'")
    header, *rows = table.splitlines()
    for names in (header, header.replace("episode", "run")):
        refused(names, "rows.csv has a header and no rows")
    broken = "\n".join([header, "", *rows]).replace("0_0000.png,", "0_0000.png,x")
    refused(broken, "rows.csv, line 3: action_x = 'x")
    (root / "rows.csv").write_text("\n".join(["", header, "", *rows, "", "  ", ""]))
    outcome = shell("data", "import", root, *SAID, "--out", "d")
    assert outcome.code == 0, outcome
    assert np.array_equal(trajectories(tmp_path / "d").frames, frames[[0]])


def test_columns_are_found_by_their_names_in_every_table(shell, tmp_path):
    """A folder for each episode, whose tables have the columns in another order."""
    pytest.importorskip("PIL")
    frames, actions, states = recordings.make(episodes=3, steps=8)
    for number in range(3):
        one = slice(number, number + 1)
        (tmp_path / "r").mkdir(exist_ok=True)
        recordings.folder(tmp_path / "r" / f"e{number}", frames[one], actions[one], states[one])
    path = tmp_path / "r" / "e2" / "rows.csv"
    header, *rows = path.read_text().splitlines()
    turned = [",".join(reversed(row.split(","))) for row in rows]
    names = ",".join(reversed(header.split(",")))
    path.write_text("\n".join([names, *turned]))
    assert shell("data", "import", "r", *SAID, "--out", "d").code == 0
    assert_same_rows(
        trajectories(tmp_path / "d"), *(of[[0, 2]] for of in (frames, actions, states))
    )
    path.write_text("\n".join([names.replace("state_1", "state_b"), *turned]))
    with shell.untouched():
        refused = shell("data", "import", "r", *SAID, "--out", "e")
    assert_one_line_error(refused, 2, "e2/rows.csv has no column 'state_1'")


def test_pictures_and_episodes_are_found_whatever_their_columns_are_called(shell, tmp_path):
    """In capitals, or unnamed: by what is in them, else by names with numbers of any length."""
    pytest.importorskip("PIL")
    frames, actions, _ = recordings.make(episodes=2, steps=12)
    root = recordings.folder(tmp_path / "r", frames, actions)
    for one in root.glob("*.png"):
        episode, number = one.stem.split("_")
        one.rename(root / f"{episode}_{int(number)}.png")
    table = re.sub(r"_0*(\d+)\.png", r"_\1.png", (root / "rows.csv").read_text())
    header, *rows = table.splitlines()
    for number, names in enumerate(("Episode,FRAME", "Episode,filename", "episode")):
        cut = header.replace("episode,frame", names), *rows[::-1]
        if number == 2:
            cut = cut[0], *(re.sub(r",\w+\.png", "", row) for row in rows)
        (root / "rows.csv").write_text("\n".join(cut))
        assert shell("data", "import", root, *SAID, "--out", f"d{number}").code == 0
        found = trajectories(tmp_path / f"d{number}")
        wanted = frames[[0]] if number == 2 else frames[[1], ::-1]
        assert np.array_equal(found.frames, wanted), names


@pytest.mark.parametrize("step_s", [0.0, -0.05])
def test_times_that_do_not_rise_are_refused_before_any_work(step_s, shell, tmp_path):
    pytest.importorskip("PIL")
    root = recordings.folder(tmp_path / "r", *recordings.make(episodes=2, steps=8)[:2])
    header, *rows = (root / "rows.csv").read_text().splitlines()
    timed = [f"{row},{step_s * number}" for number, row in enumerate(rows)]
    (root / "rows.csv").write_text("\n".join([f"{header},Time_s", *timed]))
    with shell.untouched():
        refused = shell("data", "import", root, "--limit", 1, *SIZE, "--out", "d")
    assert_one_line_error(refused, 65, f"does not rise: {1e3 * step_s:g} ms between pictures")


def test_the_limits_that_a_refusal_names_are_taken(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=2, steps=8)
    actions[..., 0], actions[0, 3, 1] = 0, 1.23444  # to four digits that is less
    save(tmp_path / "r.npz", frames, actions)
    unlimited = ("--fps", 20, *SIZE, "--out", "d")
    outcome = shell("data", "import", "r.npz", *unlimited)
    assert_one_line_error(outcome, 2, "are 0,1.234", "hint: --limit 1,1.235, or")
    outcome = shell("data", "import", "r.npz", "--limit", "1,1.235", *unlimited)
    assert outcome.code == 0 and "action 0 is never above 0, 0.0% of its limit 1" in outcome.err


def test_npz_never_unpickles_and_says_what_is_missing(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=3, steps=8)
    ragged = np.empty(2, object)
    ragged[:] = [frames[0], frames[1, :5]]
    cases = {
        "pickled": {"frames": ragged, "actions": actions},
        "no actions": {"frames": frames},
        "no frames": {"actions": actions},
        "[N, T + 1, H, W, C]": {"frames": frames[0, :, :, 0], "actions": actions},
        "has no actions_1": {"frames_0": frames[0], "frames_1": frames[1], "actions_0": actions[0]},
    }
    for words, arrays in cases.items():
        np.savez(tmp_path / "r.npz", **arrays)
        with shell.untouched():
            outcome = shell("data", "import", "r.npz", *SAID, "--out", "d")
            assert_one_line_error(outcome, 65, words.split("has ")[-1])
    (tmp_path / "r.npz").write_bytes(b"PK\3\4 no zip")
    assert_one_line_error(shell("data", "import", "r.npz", *SAID), 65, "no NPZ file")
    assert_one_line_error(shell("data", "import", "nowhere", *SAID), 66, "does not exist")
    (tmp_path / "notes.txt").write_text("x")
    assert_one_line_error(shell("data", "import", "notes.txt", *SAID), 2, "no recording")
    assert not (tmp_path / "data").exists()


def test_values_that_make_no_sense_are_refused(shell, tmp_path):
    frames, actions, _ = recordings.make(episodes=3, steps=8)
    save(tmp_path / "r.npz", frames, actions)
    for words, given in {
        "16 to 1024": ("--size", 8, 40),
        "--limit has 3 values": ("--limit", "1,2,3"),
        "recorded.mirror": ("--mirror-signs", "1,0.5"),
        "no middle": ("--mirror-signs", "-1,1", "--size", 24, 41),
        "trajectories of 2 to 7": ("--steps", 40),
        "--states and --expert name columns": ("--states", "x"),
        "--camera chooses among those of a LeRobotDataset": ("--camera", "front"),
        "--test r.npz is what is trained on": ("--test", "r.npz"),
        "--clean r.npz is what is trained on": ("--clean", "r.npz"),
    }.items():
        with shell.untouched():
            args = (*SAID, *given, "--out", "d")
            assert_one_line_error(shell("data", "import", "r.npz", *args), 2, words)


def test_arrays_of_some_episodes_only_or_of_no_real_numbers_are_refused(shell, tmp_path):
    frames, actions, states = recordings.make(episodes=3, steps=8)
    arrays = {f"frames_{n}": frames[n] for n in range(3)}
    arrays |= {f"actions_{n}": actions[n] for n in range(3)}
    for given, words in (
        (arrays | {"states_1": states[1]}, "3 episodes with pictures, 1 with states"),
        (arrays | {"actions_1": actions[1] * 1j}, "episode 1: actions are no real numbers"),
    ):
        np.savez(tmp_path / "r.npz", **given)
        with shell.untouched():
            refused = shell("data", "import", "r.npz", *SAID, "--out", "d")
        assert_one_line_error(refused, 65, words)
    np.savez(tmp_path / "r.npz", frames=frames, actions=actions, expert=actions / 2)
    assert shell("data", "import", "r.npz", *SAID, "--out", "d").code == 0
    found = trajectories(tmp_path / "d")
    assert np.array_equal(found.teacher_n, found.applied_n / 2)


IMPORT = [sys.executable, "-m", "hjepa_cli", "data", "import"]


def test_an_import_that_is_killed_goes_on_and_ends_in_the_same_bytes(tmp_path):
    frames, actions, _ = recordings.make(episodes=6, steps=20)
    big = fitted(frames.reshape(-1, *frames.shape[2:]), (64, 128, 3)).reshape(6, 20, 64, 128, 3)
    save(tmp_path / "r.npz", np.tile(big, (75, 1, 1, 1, 1)), np.tile(actions, (75, 1, 1)))
    said = ["r.npz", "--fps", "20", "--limit", "1", "--quiet"]

    def start(out):
        command = [*IMPORT, *said, "--out", out]
        return subprocess.Popen(command, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.DEVNULL)

    assert start("whole").wait(120) == 0
    killed = start("again")
    deadline = time.monotonic() + 60
    log = tmp_path / "again" / "collecting.jsonl"
    while not (log.exists() and log.read_bytes().count(b"\n") >= 2):
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert not (tmp_path / "again" / "dataset.json").exists()
    command = [sys.executable, "-m", "hjepa_cli", "resume", "again", "--json"]
    done = subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, timeout=120)
    assert done.returncode == 0, done
    names = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "again").iterdir())
    assert len(names) > 4  # several shards
    for name in names:
        if name != ".lock":
            assert (tmp_path / "whole" / name).read_bytes() == (
                tmp_path / "again" / name
            ).read_bytes()


@pytest.mark.parametrize("stop", [1, 2, 3, 5])
def test_a_resumed_import_tells_each_flaw_once_and_asks_for_what_is_missing(
    stop, shell, tmp_path, monkeypatch
):
    """Of episode 1 only the first of three trajectories shows the flaw; none is taken."""
    frames, actions, _ = recordings.make(episodes=4, steps=10)
    frames = (frames / 255).astype(np.float32)
    frames[1, 1, 0, 0, 0] = np.nan
    command = ("data", "import", save(tmp_path / "r.npz", frames, actions), *SAID, "--steps", 3)
    command += ("--skip-bad", "--json", "--out")
    monkeypatch.setattr(assembly, "SHARD_BYTES", 2 * 4 * recordings.H * recordings.W * 3)
    whole, asked, add = shell(*command, "whole").document, [], ShardLog.add
    assert len(whole["left_out"]) == 1 and whole["train_trajectories"] == 6

    def stopping(log, described):
        add(log, described)
        if len(log.done) == stop:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(ShardLog, "add", stopping)
        assert shell(*command, "again").code == 130
    there = sum(path.stat().st_size for path in (tmp_path / "again").glob("shard-*"))
    monkeypatch.setattr(files, "check_free_space", lambda _, size_bytes: asked.append(size_bytes))
    again = shell("resume", "again", "--json").document
    assert again["left_out"] == whole["left_out"]
    assert asked == [4 * 3 * 4 * recordings.H * recordings.W * 3 - there]
    for path in (tmp_path / "whole").glob("[ds]*"):
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_an_unfinished_import_is_planned_and_refuses_pictures_that_were_replaced(
    shell, tmp_path, monkeypatch
):
    """Nothing tells of them but their own size and time: those of the folder stay."""
    frames, actions, _ = recordings.make(episodes=2, steps=9)
    source = recordings.folder(tmp_path / "r", frames, actions)

    def stopped(*given):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(import_data, "write_shards", stopped)
        assert shell("data", "import", source, *SAID, "--out", "d").code == 130
    with shell.untouched():
        planned = shell("resume", "d", "--dry-run")
    assert planned.code == 0 and "cut 2 episodes" in planned.out and "resume d" in planned.out
    picture = source / "1_0004.png"
    picture.write_bytes(picture.read_bytes())
    for more in ((), ("--dry-run",)):
        with shell.untouched():
            outcome = shell("resume", "d", "--quiet", *more)
        assert_one_line_error(outcome, 2, "the source has changed since d was begun", "delete d")


def test_arrays_from_python(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames, actions, states = recordings.make(episodes=4, steps=9)
    size = recordings.H, recordings.W
    data = hjepa_cli.Dataset.from_arrays(frames, 3 * actions, states, size=size)
    assert data.path.name == "recorded-0001" and data.plant == "recorded"
    assert data.kind.state_names == tuple(f"state_{i}" for i in range(4))
    limits = np.abs(3 * actions).max(axis=(0, 1))
    wanted = (3 * actions[[0, 1, 3]] / limits)[:, 1:].astype(np.float32)
    assert np.array_equal(data.split("train").applied_n, wanted)
    ended = np.concatenate([3 * actions[:, :-1], np.full_like(actions[:, :1], np.nan)], axis=1)
    ended = hjepa_cli.Dataset.from_arrays(frames, ended, size=size, out="whole")
    most = np.abs(3 * actions[:, :-1]).max(axis=(0, 1))
    np.testing.assert_allclose(ended.settings["recorded"]["limits"], most)
    ragged = hjepa_cli.Dataset.from_arrays(
        [frames[0], frames[1, :7]], [actions[0], actions[1, :6]], size=size, out="ragged"
    )
    assert ragged.split("train").states.shape[-1] == 0
    with pytest.raises(hjepa_cli.errors.DataError, match="episode 0, row 2"):
        hjepa_cli.Dataset.from_arrays(frames, np.where(np.arange(9)[:, None] == 2, np.nan, actions))
    bad = frames / 255
    bad[3, 2, 0, 0, 0] = 40.0
    for out in (None, "bad", "empty"):
        Path("empty").mkdir(exist_ok=True)
        with pytest.raises(hjepa_cli.errors.DataError, match="episode 3, row 2"):
            hjepa_cli.Dataset.from_arrays(bad, actions, size=size, out=out)
    left = sorted(str(path) for path in (*tmp_path.glob("data/*"), *tmp_path.glob("[be]*")))
    assert left == [str(data.path.absolute()), str(tmp_path / "empty")]
    assert not any(Path("empty").iterdir())
    assert (
        json.loads((data.path / "dataset.json").read_text())["config"]["import"]["format"]
        == "arrays"
    )


@pytest.mark.slow
def test_training_on_our_own_data_imported_again_is_the_same_training(shell, tmp_path):
    """Bit for bit, where pictures are not moved: of recordings nobody knows what that means."""
    few = ("--trajectories", 12, "--test-trajectories", 4, "--steps", 20)
    text = "[encoder]\nshift_px = 0\nsteps = 2\n[control]\ngains_n = []\n"  # which no recording has
    (tmp_path / "c.toml").write_text(text)
    collected = ("collect", "--preset", "smoke", "--config", "c.toml", *few, "--out", "own")
    assert shell(*collected).code == 0
    for split in ("train", "test"):
        assert shell("data", "export", "own", "--split", split, "--out", f"{split}.npz").code == 0
    mirrored = ("--mirror-signs", "-1", "--test", "test.npz", "--out", "again")
    assert shell("data", "import", "train.npz", *mirrored).code == 0
    weights = []
    for name in ("own", "again"):
        trained = (
            "--preset",
            "smoke",
            "--config",
            "c.toml",
            "--dataset",
            name,
            "--out",
            f"e-{name}",
        )
        outcome = shell("train-encoder", *trained, "--json")
        assert outcome.code == 0, outcome
        weights.append(load_checkpoint(tmp_path / f"e-{name}" / "model.safetensors").tensors)
        gates = {gate for gate in outcome.document["gates"] if gate.startswith("probe")}
        assert bool(gates) == (name == "own")  # of recordings nobody knows what is enough
        assert set(outcome.document["health"]["probe_r2"]) == {"x", "x_dot", "theta", "theta_dot"}
    assert weights[0].keys() == weights[1].keys()
    assert all(np.array_equal(weights[0][key], weights[1][key]) for key in weights[0])
