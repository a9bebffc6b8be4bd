"""Bad input, row by row: one line, a hint, the right exit code, and nothing written or changed.

Everything here runs through the real command line and the real stages.
"""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_line import ENVIRONMENT, UNPRIVILEGED, assert_one_line_error, open_shell

from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.plugins import METHODS

PIPELINE = ("collect", "train-encoder", "train-hierarchy", "eval", "scale")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def refused(shell, code, *arguments, says=()):
    """Run a command that must fail, with and without --json, without touching a file."""
    with shell.untouched():
        outcome = shell(*arguments)
        as_json = shell(*arguments, "--json")
    assert_one_line_error(outcome, code, *says)
    assert as_json.code == code and as_json.document["error"]["code"] == code
    assert f"error: {as_json.document['error']['message']}" == outcome.err.splitlines()[0]


# --- flags


@pytest.mark.parametrize(
    ("h", "m", "l", "choices", "repaired"),
    [
        (4, 3, 1, "choose --m from 1, 2, 4", "--h 4 --m 2 --l 1"),
        (5, 2, 1, "choose --m from 1, 5", "--h 5 --m 1 --l 1"),
        (12, 6, 4, "choose --l from 1, 2, 3, 6", "--h 12 --m 6 --l 3"),
        (4, 2, 4, "choose --l from 1, 2", "--h 4 --m 2 --l 2"),
        (2, 4, 1, "choose --m from 1, 2", "--h 2 --m 2 --l 1"),
    ],
)
def test_wrong_strides_name_the_right_ones(shell, h, m, l, choices, repaired):
    strides = [f"--h={h}", f"--m={m}", f"--l={l}"]
    refused(shell, 2, "train-hierarchy", *strides, says=[choices, repaired])


def test_the_hint_for_wrong_strides_works(shell):
    hint = shell("train-hierarchy", "--h", "9", "--m", "2").err.splitlines()[1]
    arguments = hint.removeprefix("hint: hjepa ").split()
    assert shell(*arguments, "--dry-run").code == 0


def test_h_alone_means_one_level_and_with_m_or_l_the_preset_has_the_rest(shell):
    assert "4, 2, 1" in shell("train-hierarchy", "--dry-run").out
    assert "one level (h = 7)" in shell("train-hierarchy", "--h", "7", "--dry-run").out
    assert "8, 2, 1" in shell("train-hierarchy", "--h", "8", "--l", "1", "--dry-run").out
    strides = ("--h", "7", "--l", "1")
    refused(shell, 2, "train-hierarchy", *strides, says=["--m 2 does not divide --h 7", "1, 7"])


@pytest.mark.parametrize(
    ("method", "frames", "says"),
    [
        ("jepa", 3, "method jepa takes 2 or 4"),
        ("supervised", 3, "method supervised takes 2 or 4"),
        ("autoencoder", 4, "method autoencoder takes 2"),
    ],
)
def test_each_method_takes_its_own_frames(shell, method, frames, says):
    flags = ("--method", method, f"--frames={frames}")
    refused(shell, 2, "train-encoder", *flags, says=[f"--frames {frames}; {says}"])


def test_an_unknown_method_names_the_others(shell):
    refused(shell, 2, "train-encoder", "--method", "gan", says=["jepa, supervised, autoencoder"])


@pytest.mark.parametrize("value", ["0", "-4", "2.5", "nan", "four", ""])
def test_strides_are_positive_whole_numbers(shell, value):
    refused(shell, 2, "train-hierarchy", f"--h={value}", says=["--h", f"'{value}'"])


@pytest.mark.parametrize("command", PIPELINE)
def test_unknown_preset_lists_the_presets(shell, command):
    refused(shell, 2, command, "--preset", "papr", says=["'papr'", *PRESETS])


@pytest.mark.parametrize("command", ["eval", "scale"])
@pytest.mark.parametrize("methods", ["hjepa,hjpea", "ts-jepa-0", "ts-jepa-x", "hold true"])
def test_unknown_method_lists_the_methods(shell, command, methods):
    refused(shell, 2, command, "--methods", methods, says=METHODS)


@pytest.mark.parametrize("command", ["collect", "eval", "scale"])
@pytest.mark.parametrize("how", [[], ["--dry-run"]], ids=str)
def test_what_fits_no_plant_or_rollout_is_refused_before_anything_is_made(shell, command, how):
    Path("c.toml").write_text("[conditions]\npole_length = 1.1")
    says = ["pole_length = 1.1", "quadrotor"]
    with shell.untouched():
        refused(shell, 2, command, "--plant", "quadrotor", "--config", "c.toml", *how, says=says)
    if command != "collect":
        Path("c.toml").write_text("[protocol]\nhorizon = 200")
        says = ["horizon = 200", "have 120"]
        with shell.untouched():
            refused(shell, 2, command, "--quiet", "--config", "c.toml", *how, says=says)


@pytest.mark.parametrize("command", ["train-encoder", "train-hierarchy", "eval", "scale"])
def test_a_plan_refuses_the_folder_that_the_command_would(shell, command):
    Path("foreign").mkdir()
    Path("foreign/notes.txt").touch()
    says = ["foreign is not empty", "notes.txt"]
    refused(shell, 2, command, "--dry-run", "--out", "foreign", says=says)


@pytest.mark.parametrize("key", ["hierarchy", "hierarchy.h", "seed"])
def test_a_part_of_the_settings_as_toml(shell, key):
    printed = tomllib.loads(shell("config", "show", key, "--toml").out)
    everything = tomllib.loads(shell("config", "show", "--toml").out)
    for name in key.split("."):
        printed, everything = printed[name], everything[name]
    assert printed == everything


@pytest.mark.parametrize("command", ["eval", "scale"])
def test_a_depth_that_nobody_trained_names_the_command_that_does(shell, command):
    arguments = (command, "--checkpoint", "desktop-h4m2l1", "--methods", "ts-jepa-9")
    refused(shell, 66, *arguments, says=["ts-jepa-9", "hjepa train-hierarchy --h 9"])


@pytest.mark.parametrize(
    ("code", "arguments"),
    [
        (66, "eval --methods ts-jepa-9"),
        (66, "scale --methods ts-jepa-9"),
        (2, "scale --law scheduled --methods supervised-2"),
        (66, "scale --law scheduled --methods optimal"),
    ],
)
def test_a_plan_refuses_the_methods_that_the_command_would(shell, code, arguments):
    command, *flags = arguments.split()
    refused(shell, code, command, *flags, "--quiet", says=[flags[-1]])
    refused(shell, code, command, *flags, "--dry-run", says=[flags[-1]])


def test_a_plan_of_a_figure_refuses_models_of_different_seeds(shell, monkeypatch):
    from hjepa_cli.errors import DataError
    from hjepa_cli.stages.model_set import ModelSet

    def refuse(subject):
        raise DataError("a figure of models that were trained with different seeds")

    monkeypatch.setattr(ModelSet, "check_one_training_seed", refuse)
    refused(shell, 65, "eval", "--figure", "--dry-run", says=["different seeds"])
    assert shell("eval", "--dry-run").code == 0


@pytest.mark.parametrize(
    ("law", "flags", "meant"),
    [
        ("duty", ["--seeds", "3"], "scheduled"),
        ("duty", ["--scheduler", "round-robin"], "scheduled"),
        ("equal", ["--power-margin-db", "3"], "scheduled"),
        ("equal", ["--coherence-slots", "2"], "scheduled"),
        ("equal", ["--uncertainty", "levels"], "scheduled"),
        ("duty", ["--topology", "target"], "scheduled"),
        ("duty", ["--noise", "scaled"], "equal"),
        ("scheduled", ["--remeasure"], "duty"),
        ("scheduled", ["--dataset", "data"], "duty"),
    ],
)
def test_a_flag_that_the_law_would_ignore_is_refused(shell, law, flags, meant):
    says = [f"{flags[0]} is for the law {meant}", f"this is {law}", f"--law {meant}"]
    refused(shell, 2, "scale", "--law", law, *flags, says=says)


@pytest.mark.parametrize("methods", ["", ",", " , "])
def test_no_method_at_all(shell, methods):
    refused(shell, 2, "eval", "--methods", methods, says=["no method", *METHODS])


@pytest.mark.parametrize(
    "arguments",
    [
        ("eval", "--checkpoint", "no-such-model"),
        ("scale", "--checkpoint", "no-such-model"),
        ("train-hierarchy", "--encoder", "no-such-model"),
        ("models", "info", "no-such-model"),
        ("models", "verify", "no-such-model"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_unknown_model_is_named(shell, dataset, arguments):
    refused(shell, 66, *arguments, says=["no-such-model"])


@pytest.mark.parametrize(
    "snr", ["30:10", "abc", "", "10:", "10:30:0", "10:30:-5", "nan", "nan:30", "10:inf", "1:2:3:4"]
)
def test_bad_snr(shell, snr):
    refused(shell, 2, "scale", f"--snr={snr}", says=["--snr", "START:STOP"])


@pytest.mark.parametrize("snr", ["-5:30", "-10:-5", "-3", "20:20"])
def test_negative_snr_is_not_taken_for_a_flag(shell, snr):
    assert shell("scale", "--snr", snr, "--dry-run").code == 0
    assert shell("scale", f"--snr={snr}", "--dry-run").code == 0


COUNTS = [
    ("collect", "--trajectories"),
    ("collect", "--test-trajectories"),
    ("collect", "--steps"),
    ("train-encoder", "--steps"),
    ("train-encoder", "--h"),
    ("train-hierarchy", "--m"),
    ("train-hierarchy", "--l"),
]


@pytest.mark.parametrize(("command", "flag"), COUNTS)
@pytest.mark.parametrize("value", ["0", "-1", "nan", "1e3", "x"])
def test_counts_are_positive_whole_numbers(shell, command, flag, value):
    refused(shell, 2, command, f"{flag}={value}", says=[flag, f"'{value}'"])


@pytest.mark.parametrize(
    ("command", "flag"),
    [("eval", "--plant-spread"), ("scale", "--plant-spread"), ("scale", "--bandwidth-mhz")],
)
@pytest.mark.parametrize("value", ["nan", "NaN", "inf", "-inf", "-1", "wide"])
def test_numbers_are_finite_and_not_negative(shell, command, flag, value):
    refused(shell, 2, command, f"{flag}={value}", says=[flag, f"'{value}'"])


@pytest.mark.parametrize("command", ["scale", "view"])
@pytest.mark.parametrize("value", ["0", "-1", "1e6"])
def test_a_bandwidth_is_more_than_nothing_and_that_of_a_radio(shell, command, value):
    says = ["--bandwidth-mhz", f"'{value}'", "of more than 0 and at most 100000"]
    refused(shell, 2, command, f"--bandwidth-mhz={value}", says=says)


@pytest.mark.parametrize("command", ["eval", "scale", "view"])
@pytest.mark.parametrize(
    ("flag", "value", "says"),
    [
        ("--delay-steps", "257", "a whole number from 0 to 256"),  # more is not remembered
        ("--delay-steps", "-1", "a whole number from 0 to 256"),
        ("--jitter-steps", "2.5", "a whole number from 0 to 256"),
        ("--downlink-loss", "1", "at least 0 and less than 1"),
    ],
)
def test_links_that_cannot_be(shell, command, flag, value, says):
    refused(shell, 2, command, flag, value, says=[flag, says])


def test_packets_that_come_when_all_is_over(shell, tmp_path):
    (tmp_path / "short.toml").write_text("[protocol]\nwarmup_steps = 0\nsteps = 300\n")
    late = ("--delay-steps", "200", "--jitter-steps", "100")
    says = ["300 steps late", "there are 300 steps", "--delay-steps"]
    refused(shell, 2, "scale", *late, "--config", "short.toml", says=says)
    assert shell("scale", "--delay-steps", "200", "--config", "short.toml", "--dry-run").code != 70


def test_a_spread_of_one_would_make_masses_vanish(shell):
    refused(shell, 2, "eval", "--plant-spread", "1", says=["--plant-spread", "less than 1"])


@pytest.mark.parametrize(
    "command",
    [*PIPELINE, "reproduce", "view", "report", "data preview", "data export", "compare --figures"],
)
def test_an_empty_path_is_not_this_directory(shell, command):
    words = command.split()
    flag = words.pop() if "--" in command else "--out"
    refused(shell, 2, *words, flag, "", says=[flag, "an empty path"])


def test_a_view_takes_one_kind_of_link(shell):
    both = ("view", "--gap-steps", "5", "--delivery", "0.5")
    refused(shell, 2, *both, says=["--gap-steps", "--delivery", "give one"])
    refused(shell, 2, *both, "--dry-run", says=["--gap-steps", "--delivery", "give one"])


@pytest.mark.parametrize("value", ["-1", "1.5", "nan", str(2**63)])
def test_bad_seeds(shell, value):
    refused(shell, 2, "collect", f"--seed={value}", says=["seed", value])


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (("scale", "--law", "dutty"), ("duty", "equal")),
        (("scale", "--noise", "loud"), ("fixed", "scaled")),
        (("collect", "--frames", "none"), ("rendered", "stored")),
        (("collect", "--plant", "moon"), ("desktop", "gym")),
        (("train-encoder", "--device", "tpu"), ("auto", "cpu", "cuda")),
        (("eval", "--process-noise", "pink"), ("velocity", "isotropic")),
    ],
    ids=lambda value: value[1],
)
def test_unknown_choices_are_answered_with_the_choices(shell, arguments, choices):
    refused(shell, 2, *arguments, says=[arguments[2], *choices])


def test_a_plant_does_not_take_the_other_plants_preset(shell):
    refused(shell, 2, "collect", "--plant", "gym", "--preset", "smoke", says=["--preset gym"])
    refused(shell, 2, "collect", "--plant", "desktop", "--preset", "gym", says=["desktop"])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("train-encodr",), "train-encoder"),
        (("models", "lst"), "hjepa models --help"),
        (("eval", "--metods", "hold"), "--methods"),
        (("collect", "extra"), "extra"),
        (("--nonsense",), "--nonsense"),
        (("models", "info"), "NAME|PATH"),
    ],
    ids=str,
)
def test_usage_errors_are_one_line_too(shell, arguments, says):
    refused(shell, 2, *arguments, says=[says])


def test_flag_without_its_value(shell):
    outcome = shell("collect", "--json", "--trajectories")
    assert outcome.code == 2 and "--trajectories" in outcome.document["error"]["message"]


# --- config files


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("[collect]\ntrajectoris = 3\n", 2, "line 2; did you mean 'collect.trajectories'"),
        ("[colect]\n", 2, "collect"),
        ("[collect]\ntrajectories = 0\n", 2, "collect.trajectories = 0"),
        ("[collect]\ntrajectories = 2.5\n", 2, "collect.trajectories"),
        ("[collect]\nx_m = nan\n", 2, "collect.x_m"),
        ("[collect]\nx_m = -0.1\n", 2, "collect.x_m"),
        ("seed = -1\n", 2, "seed"),
        ("[actor]\ndropout = 1.0\n", 2, "actor.dropout"),
        ("[collect]\nsteps = 1\n", 2, "expected a whole number from 2 to 1000000000"),
        ("[encoder]\nbatch_frames = 1\n", 2, "encoder.batch_frames = 1 in c.toml, line 2"),
        ("[encoder]\nembedding = 7\n", 2, "embedding = 7 in c.toml, line 2; expected an even"),
        ("[encoder]\nembedding = 1\n", 2, "embedding = 1 in c.toml, line 2; expected an even"),
        ("[protocol]\ngaps = [5, 1]\n", 2, "protocol.gaps"),
        ("[protocol]\ngaps = []\n", 2, "protocol.gaps"),
        ("[protocol]\ngaps = [0, 1]\n", 2, "protocol.gaps"),
        ("[hierarchy]\nh = 6\nm = 4\n", 2, "--m 4 does not divide --h 6"),
        ("methods = ['hold', 'guess']\n", 2, "guess"),
        ("collect = 3\n", 2, "collect"),
        ("not toml", 65, "c.toml"),
        ("\x00", 65, "c.toml"),
    ],
)
def test_config_files_meet_the_same_rules_as_flags(shell, text, code, says):
    Path("c.toml").write_text(text)
    refused(shell, code, "collect", "--config", "c.toml", says=[says])


@pytest.mark.parametrize("mirror", ["augment", "none"])
def test_embeddings_without_halves_may_be_odd(shell, mirror):
    Path("c.toml").write_text(f'[encoder]\nembedding = 7\nmirror = "{mirror}"\n')
    assert shell("collect", "--config", "c.toml", "--dry-run").code == 0


def test_missing_config_file(shell):
    refused(shell, 66, "collect", "--config", "nowhere.toml", says=["nowhere.toml"])


def test_config_that_is_a_directory(shell):
    Path("c.toml").mkdir()
    refused(shell, 65, "collect", "--config", "c.toml", says=["c.toml"])


# --- datasets and checkpoints


def write_tiny_dataset(directory, plant_name):
    from tiny_dataset import write_dataset

    from hjepa_cli.core.datasets.dataset import Trajectories
    from hjepa_cli.core.plants.named import Camera

    rng = np.random.default_rng(1)

    def split(count, steps):
        return Trajectories(
            states=rng.normal(size=(count, steps + 1, 4)).astype(np.float32) * 0.01,
            applied_n=rng.normal(size=(count, steps)).astype(np.float32),
            teacher_n=rng.normal(size=(count, steps)).astype(np.float32),
        )

    directory.mkdir(parents=True)
    write_dataset(
        directory,
        settings=load_settings("gym" if plant_name == "gym" else None).as_dict(),
        splits={"train": split(2, 12), "test": split(2, 12), "clean": split(1, 14)},
        plant_name=plant_name,
        camera_manifest=Camera(plant_name).manifest(),
    )
    return directory


@pytest.fixture
def dataset(shell):
    """A whole but tiny dataset of the desktop plant, where `hjepa collect` would put it."""
    return write_tiny_dataset(Path("data") / "desktop-0001", "desktop")


@pytest.fixture
def model(shell):
    """An intact checkpoint file, of no use to any stage."""
    from hjepa_cli.storage.checkpoints import save_checkpoint

    metadata = {
        "plant": "desktop",
        "architecture": {"kind": "encoder", "h": 4, "m": 2, "l": 1},
        "settings": load_settings().as_dict(),
        "health": {},
        "dataset": "0" * 64,
    }
    path = Path("model.safetensors")
    save_checkpoint(path, {"w": np.arange(256, dtype=np.float32)}, metadata)
    return path


@pytest.mark.parametrize("command", ["train-encoder", "train-hierarchy", "eval", "scale"])
def test_dataset_that_is_not_there(shell, command):
    refused(
        shell, 66, command, "--quiet", "--dataset", "nowhere", says=["nowhere", "hjepa collect"]
    )


@pytest.mark.parametrize("command", ["train-encoder", "train-hierarchy", "eval", "scale"])
def test_empty_dataset_directory(shell, command):
    Path("empty").mkdir()
    refused(shell, 65, command, "--quiet", "--dataset", "empty", says=["empty", "hjepa collect"])


@pytest.mark.parametrize("command", ["train-encoder", "train-hierarchy", "eval", "scale"])
@pytest.mark.parametrize("manifest", ["{}", "{", '{"format": "other"}', "[]", "\x00"])
def test_foreign_dataset_directory(shell, command, manifest):
    Path("foreign").mkdir()
    Path("foreign/dataset.json").write_text(manifest)
    refused(shell, 65, command, "--quiet", "--dataset", "foreign", says=["foreign"])


def test_no_dataset_yet_names_the_command_that_makes_one(shell):
    refused(shell, 66, "train-encoder", says=["hjepa collect"])


def test_no_encoder_yet_names_the_command_that_makes_one(shell, dataset, monkeypatch):
    monkeypatch.setattr("hjepa_cli.storage.zoo.list_models", list)
    refused(shell, 66, "train-hierarchy", says=["hjepa train-encoder"])


def test_pictures_of_another_camera(shell, dataset, monkeypatch):
    """Dataset and model were made before the camera changed."""
    monkeypatch.setattr("hjepa_cli.core.plants.cartpole.camera.VERSION", 2)
    refused(shell, 65, "train-encoder", says=["another camera", "hjepa collect"])
    refused(shell, 65, "eval", "--checkpoint", "desktop-h4m2l1", says=["another camera", "train"])


@pytest.mark.parametrize("damage", ["truncate", "flip", "remove"])
def test_damaged_shard(shell, dataset, damage):
    shard = sorted(dataset.glob("shard-*"))[0]
    if damage == "remove":
        shard.unlink()
    else:
        data = bytearray(shard.read_bytes())
        data[-1] ^= 1
        shard.write_bytes(data[: 100 if damage == "truncate" else None])
    code = 66 if damage == "remove" else 65
    outcome = shell("train-encoder", "--quiet", "--out", "run")
    assert_one_line_error(outcome, code, shard.name)
    assert not list(Path("run").glob("*.safetensors")) and not Path("run/result.json").exists()


@pytest.mark.parametrize("command", ["eval", "scale", "train-hierarchy", "info", "verify"])
@pytest.mark.parametrize("damage", ["truncate", "header", "flip", "empty", "text"])
def test_damaged_checkpoint(shell, dataset, model, command, damage):
    data = bytearray(model.read_bytes())
    if damage == "flip":
        data[-1] ^= 1
    elif damage == "header":
        data[40] ^= 1
    else:
        data = {"truncate": data[:-100], "empty": b"", "text": b"weights " * 99}[damage]
    model.write_bytes(data)
    arguments = {
        "train-hierarchy": ("train-hierarchy", "--encoder", model),
        "info": ("models", "info", model),
        "verify": ("models", "verify", model),
    }.get(command, (command, "--checkpoint", model))
    refused(shell, 65, *arguments, says=[model.name])


@pytest.mark.parametrize("command", ["eval", "scale"])
def test_an_encoder_is_no_model_to_evaluate(shell, model, command):
    refused(shell, 65, command, "--checkpoint", model, says=["hjepa train-hierarchy"])


def test_encoder_and_dataset_of_different_plants(shell, model):
    dataset = write_tiny_dataset(Path("gymnasium"), "gym")
    refused(
        shell,
        65,
        "train-hierarchy",
        "--plant=gym",
        "--dataset",
        dataset,
        "--encoder",
        model,
        says=["desktop", "gym", model.name],
    )


def test_dataset_of_another_plant_than_asked_for(shell):
    dataset = write_tiny_dataset(Path("gymnasium"), "gym")
    refused(shell, 65, "train-encoder", "--dataset", dataset, says=["desktop", "gym"])


# --- output


@pytest.fixture(params=["below a file", "a file", "a foreign directory"])
def unwritable(request, shell):
    """Places where no run can be kept, and the exit code they give."""
    Path("file").write_text("precious")
    Path("foreign").mkdir()
    Path("foreign/thesis.tex").write_text("precious")
    return {
        "below a file": ("file/run", 74),
        "a file": ("file", 74),
        "a foreign directory": ("foreign", 2),
    }[request.param]


@pytest.mark.parametrize("command", ["collect", "train-encoder"])
def test_unwritable_output_is_refused_before_any_work(shell, dataset, unwritable, command):
    out, code = unwritable
    refused(shell, code, command, "--out", out, says=[out])


@pytest.mark.parametrize("out", ["sealed", "sealed/run"])
def test_a_read_only_directory_is_refused_to_everybody(shell, dataset, out):
    """Root may write anywhere, and CI is root: the child gives that privilege up."""
    Path("sealed").mkdir(mode=0o500)
    done = subprocess.run(
        [sys.executable, "-c", UNPRIVILEGED, "train-encoder", "--dataset", dataset, "--out", out],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert done.returncode == 74, done
    assert done.stderr.splitlines()[-2].startswith(f"error: cannot write {out}")
    assert not any(Path("sealed").iterdir())


def test_full_disk(dataset, shell):
    """No space left: a limit on file size stands in for it, in a child process of its own."""
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import resource, signal, sys\n"
            "from hjepa_cli.cli.app import main\n"
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
            "main(sys.argv[1:])",
            *"collect --trajectories 20 --test-trajectories 1 --quiet --out new".split(),
        ],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert done.returncode == 74, done
    assert done.stderr.startswith("error: ") and "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 2
    assert not list(Path("new").glob("*.json")) and not list(Path("new").glob("shard-*"))
    shutil.rmtree("new", ignore_errors=True)


@pytest.mark.parametrize(
    ("section", "arguments", "says"),
    [
        ("steps = 500", ("eval",), ("protocol.steps = 500", "warmup_steps = 1000")),
        ("steps = 500", ("scale",), ("protocol.steps = 500", "warmup_steps = 1000")),
        ("steps = 500", ("reproduce",), ("protocol.steps = 500", "warmup_steps = 1000")),
        ("steps = 500", ("scale", "--law", "scheduled"), ("steps = 500", "warmup_steps = 1000")),
        ("gaps = [1, 4000]", ("eval",), ("4000 steps", "protocol.steps = 3000")),
        ("gaps = [1, 4000]", ("scale",), ("4000 steps", "protocol.steps = 3000")),
        (
            "gaps = [1, 1200]",
            ("eval", "--protocol", "paper"),
            ("1200 steps", "protocol.steps = 1000"),
        ),
    ],
)
def test_protocols_that_score_too_little_are_refused_with_both_numbers(
    shell, section, arguments, says
):
    (shell.directory / "short.toml").write_text(f"[protocol]\n{section}\n")
    refused(shell, 2, *arguments, "--config", "short.toml", says=says)


def test_an_unknown_protocol_is_refused(shell):
    refused(shell, 2, "eval", "--protocol", "transient", says=["choose one of steady, paper"])
