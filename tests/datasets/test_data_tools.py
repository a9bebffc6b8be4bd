"""Tools around datasets and settings, through the real command line."""

import io
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_line import ENVIRONMENT, assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.plants.named import Camera, CartPole, teacher

COLUMNS = {"action", "ep_len", "ep_offset", "pixels", "state", "teacher_action"}
SIZES = "[collect]\ntrajectories = 3\ntest_trajectories = 2\nclean_trajectories = 2\nsteps = 11\n"
SIZES += "[control]\ngains_n = []\n"  # the teacher's labels, and no other trajectories than its own


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    Path("small.toml").write_text(SIZES)
    assert shell("collect", "--config", "small.toml", "--quiet").code == 0
    return shell


# --- info and verify


def test_info_tells_what_is_in_the_manifest(shell):
    document = shell("data", "info", "--json").document
    assert document["dataset"] == "data/desktop-0001" and document["plant"] == "desktop"
    assert document["splits"]["train"] == {"trajectories": 3, "steps": 11, "shards": 1}
    files = [path for path in Path("data/desktop-0001").iterdir() if path.is_file()]
    assert document["size_bytes"] == sum(path.stat().st_size for path in files)
    outcome = shell("data", "info", "data/desktop-0001")
    assert outcome.code == 0 and "3 trajectories of 11 steps" in outcome.out
    assert_one_line_error(shell("data", "info", "nowhere"), 66, "nowhere")


def test_verify_reads_every_shard_and_hides_no_intact_one(shell):
    shell("collect", "--config", "small.toml", "--quiet", "--seed", "1")
    document = shell("data", "verify", "--json").document
    first, second = document["verified"]
    assert first["sha256"] != second["sha256"]
    states = load_dataset(Path("data/desktop-0001")).split("test").states
    low, high = first["states"]["test"][2]
    assert (low, high) == (states[..., 2].min(), states[..., 2].max())

    (shard,) = Path("data/desktop-0001").glob("shard-00001*")
    content = bytearray(shard.read_bytes())
    content[-1] ^= 1
    shard.write_bytes(content)
    outcome = shell("data", "verify")
    assert outcome.code == 65 and "sha256 does not match" in outcome.err
    assert "data/desktop-0002: intact" in outcome.out


def test_nothing_to_verify_or_to_describe(tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    for command in ("info", "verify", "preview", "export"):
        with shell.untouched():
            assert_one_line_error(shell("data", command), 66, "no dataset", "hjepa collect")


# --- preview


def test_preview_is_a_grid_of_the_datasets_frames(shell):
    image_module = pytest.importorskip("PIL.Image")
    from hjepa_cli.output.pictures import LABEL_PX, MARGIN_PX

    outcome = shell("data", "preview", "--split", "test", "--rows", "9", "--columns", "3", "--json")
    path = Path(outcome.document["picture"])
    sheet = np.asarray(image_module.open(path))
    rows, columns = 2, 3  # two trajectories only
    assert sheet.shape == (
        rows * (64 + LABEL_PX + MARGIN_PX) + MARGIN_PX,
        columns * (128 + MARGIN_PX) + MARGIN_PX,
        3,
    )
    states = load_dataset(Path("data/desktop-0001")).split("test").states
    for row in range(rows):
        for column, step in enumerate((0, 5, 10)):
            top = MARGIN_PX + row * (64 + LABEL_PX + MARGIN_PX) + LABEL_PX
            left = MARGIN_PX + column * (128 + MARGIN_PX)
            (frame,) = Camera("desktop").render(states[row, step + 1][None])
            assert (sheet[top : top + 64, left : left + 128] == frame).all()
    again = shell("data", "preview", "--split", "test", "--rows", "9", "--columns", "3", "--quiet")
    assert again.out == f"{path}\n"


# --- export


def exported(shell, name, *flags):
    """The columns of an export as arrays, and what it says about itself."""
    assert shell("data", "export", "--out", name, "--split", "train", *flags).code == 0
    if name.endswith(".npz"):
        with np.load(name) as file:
            arrays = {key: file[key] for key in file.files if key != "hjepa"}
            return arrays, json.loads(str(file["hjepa"]))
    h5py = pytest.importorskip("h5py")
    with h5py.File(name, "r", swmr=True) as file:  # as stable-worldmodel opens it
        return {key: file[key][:] for key in file}, json.loads(file.attrs["hjepa"])


@pytest.mark.parametrize("name", ["a.h5", "a.npz"])
def test_export_has_the_columns_of_stable_worldmodel(shell, name):
    arrays, about = exported(shell, name)
    assert set(arrays) == COLUMNS
    assert arrays["ep_len"].dtype == np.int32 and arrays["ep_offset"].dtype == np.int64
    assert arrays["ep_len"].tolist() == [12, 12, 12]  # 11 steps and the frame before them
    assert arrays["ep_offset"].tolist() == [0, 12, 24]
    assert arrays["pixels"].shape == (36, 64, 128, 3) and arrays["pixels"].dtype == np.uint8
    assert arrays["action"].shape == (36, 1) and abs(arrays["action"]).max() <= 1
    assert about["plant"] == "desktop" and about["split"] == "train"


def test_hdf5_is_of_a_layout_that_all_libraries_read_and_append_to(shell):
    """HDF5 1.10 reads what its version 1.10 wrote; stable-worldmodel resizes every dataset."""
    before, _ = exported(shell, "a.h5")
    h5py = pytest.importorskip("h5py")
    with h5py.File("a.h5", "r+", libver=("v110", "v110")) as file:
        assert file.libver == ("v110", "v110")
        for name, dataset in file.items():
            assert dataset.chunks and dataset.maxshape[0] is None, name
            assert dataset.id.get_create_plist().get_layout() == h5py.h5d.CHUNKED
            rows = len(dataset)
            dataset.resize(rows + 1, axis=0)
            dataset[rows] = dataset[0]
    with h5py.File("a.h5") as file:
        for name, values in before.items():
            assert (file[name][:-1] == values).all() and (file[name][-1] == values[0]).all()


@pytest.mark.parametrize("kind", ["npz", "h5", "png"])
def test_an_export_follows_links_and_refuses_pipes(shell, kind):
    if kind == "h5":
        pytest.importorskip("h5py")
    command = ("data", "preview") if kind == "png" else ("data", "export")
    Path(f"link.{kind}").symlink_to(f"real.{kind}")
    assert shell(*command, "--out", f"link.{kind}").code == 0
    assert Path(f"link.{kind}").is_symlink() and Path(f"real.{kind}").stat().st_size
    os.mkfifo(f"pipe.{kind}")
    outcome = shell(*command, "--out", f"pipe.{kind}", "--quiet")
    assert_one_line_error(outcome, 74, f"pipe.{kind}: it is a pipe", "--out FILE")
    assert Path(f"pipe.{kind}").is_fifo()


def test_exported_rows_follow_the_plant(shell):
    """An action leads from its row to the next: replayed in the simulator, nothing else does."""
    arrays, about = exported(shell, "a.npz")
    for offset, length in zip(arrays["ep_offset"], arrays["ep_len"], strict=True):
        pole = CartPole("desktop")
        pole.state = arrays["state"][offset]
        for row in range(offset, offset + length - 1):
            pole.step(arrays["action"][row, 0] * about["force_limit_n"])
            np.testing.assert_allclose(pole.state, arrays["state"][row + 1], atol=2e-4)
    rendered = Camera("desktop").render(arrays["state"])
    assert (rendered == arrays["pixels"]).all()
    label = teacher("desktop")(arrays["state"]) / about["force_limit_n"]
    np.testing.assert_allclose(arrays["teacher_action"][:, 0], label, atol=2e-4)


@pytest.mark.parametrize("name", ["a.h5", "a.npz"])
def test_equal_data_give_equal_export_bytes(shell, name):
    exported(shell, name)
    first = Path(name).read_bytes()
    exported(shell, name)
    assert Path(name).read_bytes() == first


def test_stored_frames_are_exported_as_they_are(shell):
    shell("collect", "--config", "small.toml", "--frames", "stored", "--out", "s", "--quiet")
    stored, _ = exported(shell, "s.npz", "s")
    rendered, _ = exported(shell, "r.npz", "data/desktop-0001")
    assert (stored["pixels"] == rendered["pixels"]).all()


def test_export_without_pixels(shell):
    arrays, _ = exported(shell, "new/folder/a.npz", "--no-pixels")
    assert set(arrays) == COLUMNS - {"pixels"}
    outcome = shell("data", "export", "--no-pixels", "--out", "a.npz")
    assert "export 3/3 (100 %)" in outcome.err


def test_bad_exports_are_refused_before_anything_is_written(shell):
    with shell.untouched():
        assert_one_line_error(shell("data", "export", "--out", "a.mat"), 2, "a.mat", "npz")
        assert_one_line_error(shell("data", "export", "--format", "zarr"), 2, "zarr", "hdf5")
        for kind, name, hint in (("npz", "a.hdf5", "a.npz"), ("hdf5", "a.npz", "a.h5")):
            outcome = shell("data", "export", "--format", kind, "--out", name)
            assert_one_line_error(outcome, 2, f"--format {kind}", name, f"--out {hint}")
        assert_one_line_error(shell("data", "export", "--split", "val"), 2, "val", "train, test")
        assert_one_line_error(shell("data", "preview", "--rows", "0"), 2, "--rows")
        assert_one_line_error(shell("data", "preview", "--out", "a.jpg"), 2, ".jpg", "FILE.png")
        plan = shell("data", "export", "--dry-run", "--json").document["plan"]
    assert "render 36 frames" in plan["work"]


def test_the_size_that_an_export_promises_follows_the_plant(shell):
    Path("tiny.toml").write_text("[collect]\ntrajectories = 2\nsteps = 500")
    made = ("--config", "tiny.toml", "--preset", "quadrotor", "--out", "q")
    assert shell("collect", *made, "--quiet").code == 0
    arguments = ("data", "export", "q", "--no-pixels", "--out", "q.npz", "--json")
    plan = shell(*arguments, "--dry-run").document["plan"]
    written = shell(*arguments).document
    assert plan["writes_bytes"] == written["rows"] * 4 * (6 + 2 + 2)


# --- config show


def test_config_show_names_the_origin_of_every_value(shell):
    Path("c.toml").write_text("seed = 5\n[protocol]\nsteps = 70\n")
    document = shell(
        *"config show --preset smoke --config c.toml --device cpu --json".split()
    ).document
    values = document["values"]
    assert values["seed"] == {"value": 5, "from": "c.toml"}
    assert values["protocol.steps"] == {"value": 70, "from": "c.toml"}
    assert values["device"] == {"value": "cpu", "from": "flag"}
    assert values["protocol.curve_devices"]["from"] == "preset smoke"
    assert values["actor.hidden"] == {
        "value": load_settings().actor.hidden,
        "from": "default",
    }
    assert sum(len(section) for section in sections().values()) == len(values)


def sections():
    """All values of the settings by section."""
    found = {}
    for key, value in load_settings().as_dict(complete=True).items():
        if key != "preset":
            found[key] = value if isinstance(value, dict) else {key: value}
    return found


def test_config_show_of_a_section_or_value(shell):
    values = shell("config", "show", "radio", "--json").document["values"]
    assert set(values) == {f"radio.{name}" for name in load_settings().as_dict()["radio"]}
    (value,) = shell("config", "show", "radio.law", "--json").document["values"].values()
    assert value == {"value": "duty", "from": "default"}
    assert_one_line_error(shell("config", "show", "rad"), 2, "'rad'", "radio")


@pytest.mark.parametrize("preset", ["gym", "paper"])
def test_config_show_toml_is_a_complete_config_file(shell, preset):
    """Also of what is off in the preset and on by default: a tuned law, worse pictures."""
    text = shell("config", "show", "--toml", "--preset", preset, "--seed", "4").out
    Path("c.toml").write_text(text)
    settings = load_settings(config=Path("c.toml")).as_dict() | {"preset": preset}
    assert settings == load_settings(preset, flags={"seed": 4}).as_dict()
    assert tomllib.loads(text)["seed"] == 4


# --- completion


def complete(words, directory):
    """What bash is offered for the last of ``words``."""
    environment = ENVIRONMENT | {
        "_HJEPA_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    code = (
        "import sys\nfrom hjepa_cli.cli.app import main\n"
        "try: main([])\nfinally: assert 'torch' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=directory,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_shell_completes_models_runs_presets_and_datasets(shell, tmp_path):
    from hjepa_cli.storage.zoo import list_models

    run = tmp_path / "runs/train-hierarchy/0001"
    run.mkdir(parents=True)
    (run / "model.safetensors").touch()
    offered = complete(["hjepa", "eval", "--checkpoint", "''"], tmp_path)
    assert set(offered) >= {*list_models(), "runs/train-hierarchy/0001"}
    if list_models():
        name = list_models()[0]
        assert complete(["hjepa", "models", "info", name[:3]], tmp_path)[0] == name
    assert complete(["hjepa", "eval", "--preset", "sm"], tmp_path) == ["smoke"]
    assert complete(["hjepa", "data", "info", "dat"], tmp_path) == ["data/desktop-0001"]
    assert complete(["hjepa", "config", "show", "radio.l"], tmp_path) == ["radio.law"]


def test_png_bytes_do_not_depend_on_the_day(shell):
    pytest.importorskip("PIL")
    shell("data", "preview", "--out", "a.png")
    os.utime("a.png", (0, 0))
    shell("data", "preview", "--out", "b.png")
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes()
    assert io.BytesIO(Path("a.png").read_bytes()).read(4) == b"\x89PNG"
