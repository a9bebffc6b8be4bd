"""The command line: flags to settings and stages, results to stdout, errors to lines and codes."""

import errno
import importlib
import inspect
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, ROOT, assert_one_line_error, open_shell
from typer.main import get_command

from hjepa_cli import __version__
from hjepa_cli.cli.builder import build
from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.core.evaluation import load_search as scheduled
from hjepa_cli.errors import (
    DataError,
    LockedError,
    MissingInputError,
    NumericalError,
    StorageError,
    UsageError,
)
from hjepa_cli.stages import collect

MODULES = {
    "collect": "collect",
    "train-encoder": "train_encoder",
    "train-hierarchy": "train_hierarchy",
    "eval": "evaluate",
    "scale": "scale",
}
HEAVY = ("torch", "pymunk", "scipy", "matplotlib", "numpy")
HELP_LIMIT_S = 0.5


def commands():
    """All commands by their full name."""
    top = get_command(build())
    for name, command in top.commands.items():
        yield name, command
        for sub_name, sub_command in getattr(command, "commands", {}).items():
            yield f"{name} {sub_name}", sub_command


class Stage:
    """Stands in for the ``run`` of every stage and remembers how it was called."""

    def __init__(self):
        self.name = self.settings = self.screen = None
        self.options = {}
        self.result = {"dataset": "data/desktop-0001", "checkpoint": "runs/x/model.safetensors"}
        self.error = None

    def install(self, monkeypatch):
        for module_name in MODULES.values():
            module = types.ModuleType(f"hjepa_cli.stages.{module_name}")

            def run(settings, screen, *, name=module_name, **options):
                return self.called(name, settings, screen, options)

            module.run = run
            monkeypatch.setitem(sys.modules, module.__name__, module)

    def called(self, name, settings, screen, options):
        self.name, self.settings, self.screen, self.options = name, settings, screen, options
        screen.say("working")
        if self.error is not None:
            raise self.error
        return self.result


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def stage(monkeypatch):
    stage = Stage()
    stage.install(monkeypatch)
    return stage


# --- starting up


@pytest.mark.parametrize("command", ["", *dict(commands())])
def test_help_answers_at_once_without_heavy_imports(command):
    """Half a second of processor time at most, in the best of a few runs.

    Where that is missed, the machine may be slow today: then help may take three times what
    starting Python with nothing but the command-line library takes. Tools of this kind that import
    torch at the top take seconds to say what their flags are.
    """
    code = (
        "import sys\n"
        "from hjepa_cli.cli.app import main\n"
        "try: main(sys.argv[1:])\n"
        f"finally: print('heavy:', *sorted(set(sys.modules) & set({HEAVY!r})), file=sys.stderr)"
    )
    library_s = help_s = math.inf
    for _ in range(5):
        done, seconds = timed("-c", code, *command.split(), "--help")
        assert done.returncode == 0 and "Usage: hjepa" in done.stdout
        assert done.stderr == "heavy:\n"
        help_s = min(help_s, seconds)
        if help_s < HELP_LIMIT_S:
            return
        library_s = min(library_s, timed("-c", "import typer.rich_utils, rich.progress")[1])
        if help_s < 3 * library_s:
            return
    pytest.fail(f"help took {help_s:.2f} s, the library alone {library_s:.2f} s")


@pytest.mark.parametrize(
    ("words", "made"),
    [
        (["serve", "--model", "eval"], {"serve"}),
        (["models", "info"], {"models list", "models info", "models verify"}),
        (["--help", "serve"], set(dict(commands()))),
        (["sevre"], set(dict(commands()))),
    ],
)
def test_a_command_line_makes_the_command_alone_that_it_begins_with(words, made):
    """Help of the program and refusals of what there is not know all."""
    top = get_command(build(words)).commands
    found = {f"{name} {sub}" for name, group in top.items() for sub in inside(group)}
    found |= {name for name, command in top.items() if not hasattr(command, "commands")}
    assert found == {name for name in made if not hasattr(top.get(name), "commands")}


def inside(group):
    return getattr(group, "commands", ())


def timed(*arguments):
    """A Python process that has ended, and the processor time that it took."""
    started = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, env=ENVIRONMENT, check=False
    )
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done, ended.ru_utime + ended.ru_stime - started.ru_utime - started.ru_stime


@pytest.mark.parametrize(("name", "command"), list(commands()), ids=str)
def test_every_option_has_help_and_a_panel(name, command):
    assert command.help
    for parameter in command.params:
        assert parameter.help, f"{name} {parameter.name}"
        if parameter.param_type_name == "option":
            assert parameter.rich_help_panel, f"{name} {parameter.name}"


@pytest.mark.parametrize("name", MODULES)
def test_shared_options_are_everywhere(name):
    flags = {flag for parameter in dict(commands())[name].params for flag in parameter.opts}
    shared = "--out --seed --preset --config --plant --json --dry-run --quiet --debug"
    assert flags.issuperset(shared.split())
    if name != "collect":
        assert "--device" in flags


def test_a_flag_that_is_not_given_changes_nothing(shell, stage):
    """Or --config could never set its value."""
    for name in MODULES:
        assert shell(name).code == 0 and stage.settings == load_settings()
        switches = {key: value for key, value in stage.options.items() if value is not None}
        assert not any(switches.values()), switches


@pytest.mark.parametrize(
    ("arguments", "defaults"),
    [
        ("collect --help", ("tuned law. [default: 200]", "[default: desktop]")),
        ("collect --help --preset smoke", ("tuned law. [default: 24]", "8]")),
        ("collect --plant gym --help", ("tuned law. [default: 200]", "[default: gym]")),
        ("train-encoder --help", ("[default: gate]", "encoder. [default: 1200]")),
        ("train-encoder --preset=smoke --help", ("[default: no-gate]", "encoder. [default: 6]")),
        ("scale --help", ("cell. [default: 20]", "round-robin, max-aoi, innovation]")),
        ("view --help", ("[default: hjepa,hold]", "[default: 0.05]")),
    ],
)
def test_help_shows_the_defaults_of_the_preset_in_force(shell, monkeypatch, arguments, defaults):
    monkeypatch.setenv("COLUMNS", "200")
    outcome = shell(*arguments.split())
    assert outcome.code == 0
    for default in defaults:
        assert default in outcome.out


@pytest.mark.parametrize("command", [*MODULES, "config show"])
def test_help_leaves_the_program_as_it_was(shell, command):
    before = shell(*command.split(), "--help").out
    shell(*command.split(), "--help", "--preset", "smoke")
    assert shell(*command.split(), "--help").out == before


@pytest.mark.parametrize("arguments", [[], ["models"], ["data"], ["config"]])
def test_a_group_alone_shows_its_help(shell, arguments):
    outcome = shell(*arguments)
    assert outcome.code == 0 and "Usage:" in outcome.out and outcome.err == ""


def test_version(shell):
    outcome = shell("--version")
    assert (outcome.code, outcome.out, outcome.err) == (0, f"hjepa {__version__}\n", "")


def test_python_dash_m_and_the_installed_command_are_the_same_program():
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", "--version"],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, f"hjepa {__version__}\n")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["scripts"] == {"hjepa": "hjepa_cli.cli.app:main"}


# --- flags to settings


def test_the_five_lines_reach_their_stages(shell, stage):
    for line in (
        "collect --trajectories 200",
        "train-encoder",
        "train-hierarchy --h 4 --m 2 --l 1",
        "eval",
        "scale --snr 10:30",
    ):
        name, *arguments = line.split()
        assert shell(name, *arguments).code == 0
        assert stage.name == MODULES[name]
        assert stage.settings == load_settings()  # the lines spell out the defaults


FLAGS = [
    (
        "collect",
        "--trajectories 7 --test-trajectories 3 --steps 50 --frames stored --seed 9 --out o",
        {
            "collect.trajectories": 7,
            "collect.test_trajectories": 3,
            "collect.steps": 50,
            "collect.frames": "stored",
            "seed": 9,
        },
        {"out": Path("o")},
    ),
    ("collect", "--plant gym", {"plant": "gym", "preset": "gym"}, {"out": None}),
    ("collect", "--preset gym", {"plant": "gym", "collect.x_m": 0.5}, {"out": None}),
    (
        "train-encoder",
        "--h 6 --steps 3 --no-gate --device cpu --dataset d --out o",
        {"encoder.h": 6, "encoder.steps": 3, "encoder.gate": False, "device": "cpu"},
        {"dataset": Path("d"), "out": Path("o")},
    ),
    ("train-encoder", "--preset smoke --gate", {"encoder.gate": True}, {}),
    (
        "train-hierarchy",
        "--h 12 --m 6 --l 3 --encoder e --dataset d",
        {"hierarchy.h": 12, "hierarchy.m": 6, "hierarchy.l": 3},
        {"encoder": "e", "dataset": Path("d"), "out": None},
    ),
    (
        "eval",
        "--methods oracle,hold,oracle --process-noise isotropic --plant-spread 0.2 --remeasure "
        "--checkpoint desktop-h4m2l1",
        {
            "methods": ("oracle", "hold"),
            "protocol.process_noise": "isotropic",
            "protocol.plant_spread": 0.2,
        },
        {"checkpoint": "desktop-h4m2l1", "dataset": None, "out": None, "remeasure": True},
    ),
    (
        "scale",
        "--snr -5:30 --law equal --bandwidth-mhz 5.5 --noise scaled --verify --methods hjepa",
        {
            "radio.snr_db": "-5:30",
            "radio.law": "equal",
            "radio.bandwidth_hz": 5.5e6,
            "radio.noise": "scaled",
            "methods": ("hjepa",),
        },
        {"checkpoint": None, "verify": True, "remeasure": False},
    ),
    ("scale", "--snr=-10:-5:2.5", {"radio.snr_db": "-10:-5:2.5"}, {}),
]


def lookup(settings, key):
    for part in key.split("."):
        settings = getattr(settings, part)
    return settings


@pytest.mark.parametrize(("command", "flags", "expected", "passed"), FLAGS)
def test_flags_become_settings(shell, stage, command, flags, expected, passed):
    outcome = shell(command, *flags.split())
    assert outcome.code == 0, outcome
    assert stage.name == MODULES[command]
    assert {key: lookup(stage.settings, key) for key in expected} == expected
    assert {key: stage.options[key] for key in passed} == passed
    untouched = {"collect.clean_steps", "actor.hidden", "encoder.embedding"}
    for key in untouched:
        assert lookup(stage.settings, key) == lookup(load_settings(), key)


def test_precedence_is_flag_then_config_then_preset_then_default(shell, stage):
    Path("c.toml").write_text("seed = 5\n[collect]\ntrajectories = 11\nsteps = 60\n")
    shell("collect", "--preset", "smoke", "--config", "c.toml", "--steps", "70")
    settings = stage.settings
    assert settings.collect.steps == 70  # flag
    assert (settings.collect.trajectories, settings.seed) == (11, 5)  # file
    assert settings.collect.test_trajectories == load_settings("smoke").collect.test_trajectories
    assert settings.collect.exploration_n == load_settings().collect.exploration_n


@pytest.mark.parametrize("command", MODULES)
def test_stages_take_what_the_command_line_passes(shell, monkeypatch, command):
    """The stand-in accepts anything; the real stages must accept the same."""
    stage = Stage()
    with monkeypatch.context() as patch:
        stage.install(patch)
        shell(command)
    real = importlib.import_module(f"hjepa_cli.stages.{MODULES[command]}")
    inspect.signature(real.run).bind(stage.settings, stage.screen, **stage.options)


# --- results


def test_json_is_one_strict_document_and_notes_stay_on_stderr(shell, stage):
    stage.result = {"checkpoint": Path("m"), "health": {"effective_rank": float("nan")}}
    outcome = shell("train-encoder", "--json")
    assert outcome.code == 0 and outcome.err == "working\n"
    assert outcome.document == {"checkpoint": "m", "health": {"effective_rank": None}}


def test_quiet_prints_only_where_the_result_is(shell, stage):
    stage.result = {"dataset": "data/desktop-0001", "seconds": 3.0}
    outcome = shell("collect", "--quiet")
    assert (outcome.code, outcome.out, outcome.err) == (0, "data/desktop-0001\n", "")


@pytest.mark.parametrize("command", MODULES)
@pytest.mark.parametrize("preset", sorted({*PRESETS} - {"recorded"}))  # which needs a dataset
def test_dry_run_shows_a_plan_and_writes_nothing(shell, command, preset):
    with shell.untouched():
        outcome = shell(command, "--dry-run", "--preset", preset)
        document = shell(command, "--dry-run", "--preset", preset, "--json").document
    assert outcome.code == 0 and outcome.err == ""
    lines = outcome.out.splitlines()
    assert lines[0] == f"hjepa {command} would"
    verbs = {line.split()[0] for line in lines[1:-1]}
    assert verbs == {"read", "do", "write"}
    assert lines[-1].startswith("  in about ")
    plan = document["plan"]
    assert plan["command"] == command and plan["writes_bytes"] > 0 and plan["minutes"] > 0
    assert [f"  do    {line}" for line in plan["work"]] == [
        line for line in lines if line.startswith("  do ")
    ]


def test_dry_run_tells_cached_curves_from_those_to_measure(shell):
    def planned(*flags):
        return shell("eval", "--dry-run", "--json", "--methods", "oracle", *flags).document["plan"]

    before = planned("--preset", "smoke")
    assert before["work"][0].startswith("drive ") and before["work"][0].endswith("oracle")
    assert shell("eval", "--preset", "smoke", "--methods", "oracle", "--quiet").code == 0
    after, again = planned("--preset", "smoke"), planned("--preset", "smoke", "--remeasure")
    assert after["work"] == ["take the cached curves of oracle"]
    assert again["work"] == before["work"]
    assert after["seconds"] < again["seconds"]


def test_dry_run_follows_the_flags(shell):
    small, large, stored = (
        shell("collect", "--dry-run", "--json", *flags.split()).document["plan"]
        for flags in ("--trajectories 10", "--trajectories 1000", "--frames stored")
    )
    # By the teacher, and as many by the tuned law.
    assert "simulate 20 training" in small["work"][0]
    assert "simulate 2000 training" in large["work"][0]
    assert small["writes_bytes"] < large["writes_bytes"] < stored["writes_bytes"]
    # 75,200 steps + 480 first frames, 64 x 128 x 3 bytes each
    assert stored["writes_bytes"] == pytest.approx(75_680 * 24_576, rel=0.01)
    named = shell("train-encoder", "--dry-run", "--out", "here").out
    assert "here" in named


@pytest.mark.parametrize("preset", ["default", "quadrotor"])
def test_dry_run_promises_the_size_that_collect_needs(shell, preset):
    plan = shell("collect", "--dry-run", "--json", "--preset", preset).document["plan"]
    assert plan["writes_bytes"] == collect.size_bytes(load_settings(preset))


@pytest.mark.parametrize(
    ("flags", "passes"),
    [
        ("", "1200 steps of 250 frames (15 passes over 100 steps of 200 trajectories)"),
        ("--preset paper", "(150 passes over 100 steps of 200 trajectories)"),  # as its file says
        ("--method supervised", "(8 passes over 100 steps of 400 trajectories)"),
        ("--method autoencoder --frames 2", "2400 steps of 250 frames (15 passes over 100 steps"),
    ],
)
def test_dry_run_counts_passes_over_what_a_method_learns_from(shell, flags, passes):
    """A JEPA from the teacher's trajectories, baselines from the law's too; by their beginning."""
    plan = shell("train-encoder", "--dry-run", "--json", *flags.split()).document["plan"]
    assert passes in plan["work"][1]


def test_dry_run_plans_to_harden_an_encoder_once(shell):
    """The zoo's models are hard already."""
    import numpy as np

    from hjepa_cli.storage.checkpoints import save_checkpoint

    def planned(*flags):
        plan = shell("train-hierarchy", "--dry-run", "--json", *flags).document["plan"]
        return [line for line in plan["work"] if "harden" in line], plan["seconds"]

    Path("c.toml").write_text("[augment]\nstrength = 0.0\n")
    encoder = Path("e.safetensors")
    settings = load_settings()
    metadata = {
        "plant": "desktop",
        "architecture": {"kind": "encoder", "h": 4, "m": 4, "l": 4},
        "settings": settings.as_dict(),
    }
    save_checkpoint(encoder, {"w": np.zeros(1, np.float32)}, metadata)
    lines, seconds = planned("--encoder", encoder)
    assert lines == [f"harden the encoder for {settings.augment.steps} steps on worse pictures"]
    off, quicker = planned("--encoder", encoder, "--config", "c.toml")
    assert off == [] and quicker < seconds - 150
    assert planned("--encoder", "desktop-h4m2l1")[0] == []


@pytest.mark.parametrize(
    ("encoder", "times"),
    [
        ("", ", those for training 3 times"),
        ("shift_px = 0", ""),
        ('mirror = "augment"', ", those for training 6 times"),
        ('mirror = "augment"\nshift_px = 0', ", those for training 2 times"),
    ],
)
def test_dry_run_counts_the_copies_that_the_hierarchy_learns_from(shell, encoder, times):
    Path("c.toml").write_text(f"[encoder]\n{encoder}")
    arguments = ("train-hierarchy", "--config", "c.toml", "--dry-run", "--json")
    encoding = shell(*arguments).document["plan"]["work"][0]
    assert encoding.partition(" frames")[2] == times


def test_dry_run_bounds_the_loads_of_a_search(shell):
    flags = ("scale", "--law", "scheduled", "--methods", "oracle", "--dry-run", "--json")
    most = scheduled.MAX_BISECTIONS + 2 * scheduled.MAX_WIDENINGS
    assert f"up to {most} loads" in shell(*flags).document["plan"]["work"][0]


def test_dry_run_still_refuses_what_the_command_would(shell):
    assert_one_line_error(shell("eval", "--dry-run", "--checkpoint", "nowhere"), 66)
    assert_one_line_error(shell("train-encoder", "--dry-run", "--dataset", "nowhere"), 66)
    assert_one_line_error(shell("scale", "--dry-run", "--snr", "30:10"), 2)


@pytest.mark.parametrize("law", ["duty", "equal", "scheduled"])
def test_dry_run_tells_of_the_verification(shell, law):
    flags = ("scale", "--law", law, "--methods", "oracle", "--dry-run", "--json")
    plain, verified = (shell(*flags, *more).document["plan"] for more in ((), ("--verify",)))
    (check,) = set(verified["work"]) - set(plain["work"])
    assert check.startswith("simulate ") and verified["seconds"] > plain["seconds"]


# --- errors

EXPECTED = [
    (UsageError("u", hint="h"), 2),
    (DataError("d", hint="h"), 65),
    (MissingInputError("m", hint="h"), 66),
    (NumericalError("n", hint="h"), 70),
    (StorageError("s", hint="h"), 74),
    (LockedError("l", hint="h"), 75),
    (OSError(errno.ENOSPC, "No space left on device", "runs/x"), 74),
    (PermissionError(errno.EACCES, "Permission denied", "runs/x"), 74),
    (KeyboardInterrupt(), 130),
    (ZeroDivisionError("division by zero"), 1),
    (RuntimeError("first\nsecond\x1b[31m"), 1),
    (MemoryError(), 70),
]


@pytest.mark.parametrize(("error", "code"), EXPECTED, ids=lambda value: repr(value))
def test_every_error_is_one_line_with_its_code(shell, stage, error, code):
    stage.error = error
    outcome = shell("train-encoder", "--quiet")
    assert_one_line_error(outcome, code)
    as_json = shell("train-encoder", "--quiet", "--json")
    assert as_json.code == code and as_json.err == outcome.err
    (document,) = as_json.document.values()
    assert document["code"] == code
    lines = [f"error: {document['message']}", f"hint: {document['hint']}"]
    assert outcome.err.splitlines() == lines


def test_hints_name_the_command_in_full(shell):
    for line in (
        "config show nonsense",
        "data export --split val",
        "models verify nowhere --quiet",
    ):
        outcome = shell(*line.split())
        command, sub_command, *_ = line.split()
        if "--help" in outcome.err:
            assert f"hint: hjepa {command} {sub_command} --help" in outcome.err
    assert "hint: commands: info, verify" not in shell("data", "bogus").err
    assert shell("bogus").err.splitlines()[1].startswith("hint: commands: collect, ")
    assert shell("data", "bogus").err.splitlines()[1] == "hint: hjepa data --help"


def test_disk_errors_name_the_file(shell, stage):
    stage.error = OSError(errno.ENOSPC, "No space left on device", "runs/x")
    assert_one_line_error(shell("collect", "--quiet"), 74, "No space left on device", "runs/x")


def test_unexpected_errors_name_their_type_and_the_way_to_the_traceback(shell, stage, monkeypatch):
    stage.error = ZeroDivisionError("division by zero")
    outcome = shell("eval", "--quiet")
    assert_one_line_error(outcome, 1, "ZeroDivisionError", "division by zero", "--debug")
    assert "Traceback" in shell("eval", "--quiet", "--debug").err
    monkeypatch.setenv("HJEPA_DEBUG", "1")
    assert "Traceback" in shell("eval", "--quiet").err


def test_a_failing_stage_leaves_stdout_empty(shell, stage):
    stage.error = NumericalError("loss is NaN at step 7", hint="lower the learning rate")
    outcome = shell("train-encoder")
    assert outcome.out == "" and outcome.err.splitlines()[0] == "working"


def test_markup_in_arguments_is_not_interpreted(shell):
    outcome = shell("eval", "--methods", "[/red][bold]x[/bold]")
    assert_one_line_error(outcome, 2, "[/red][bold]x[/bold]")


SLOW_STAGE = """
import sys, time, types
module = types.ModuleType("hjepa_cli.stages.collect")
def run(settings, screen, **options):
    screen.say("ready")
    for _ in range(3000):  # one long sleep could begin just after the signal, and sleep on
        time.sleep(0.01)
module.run = run
sys.modules[module.__name__] = module
from hjepa_cli.cli.app import main
main(["collect"])
"""


def test_ctrl_c_ends_with_130_and_one_line(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW_STAGE],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        cwd=tmp_path,
    )
    assert process.stderr.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 130 and out == ""
    assert err.splitlines()[0] == "error: interrupted" and len(err.splitlines()) == 2


@pytest.mark.parametrize("flags", [[], ["--json"]])
def test_a_closed_pipe_ends_quietly(tmp_path, flags):
    """`hjepa ... | head -0`: no traceback, no "Exception ignored in"."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", "collect", "--dry-run", *flags],
        stdout=write_end,
        stderr=subprocess.PIPE,
        env=ENVIRONMENT,
        cwd=tmp_path,
        check=False,
    )
    os.close(write_end)
    assert (done.returncode, done.stderr) == (74, b"")


def test_a_terminal_without_unicode_does_not_crash(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", "models", "info", "modèle-θ̇"],
        capture_output=True,
        env={**ENVIRONMENT, "PYTHONIOENCODING": "ascii"},
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 66 and b"Traceback" not in done.stderr


# --- models


@pytest.fixture
def zoo(tmp_path_factory, monkeypatch):
    """A zoo with one intact and one damaged model."""
    import numpy as np

    from hjepa_cli.storage import zoo as module
    from hjepa_cli.storage.checkpoints import save_checkpoint

    root = tmp_path_factory.mktemp("zoo")
    monkeypatch.setattr(module, "zoo_directory", lambda: root)
    metadata = {
        "plant": "desktop",
        "seed": 3,
        "architecture": {"kind": "hierarchy", "h": 4, "m": 2, "l": 1, "embedding": 256},
        "health": {"probe_r2": {"x": 0.98}, "effective_rank": 7.5},
    }
    for name in ("good", "torn"):
        (root / name).mkdir()
        path = root / name / "model.safetensors"
        save_checkpoint(path, {"w": np.arange(64, dtype=np.float32)}, metadata)
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(data)
    return root


def test_models_list_shows_all_and_hides_no_damage(shell, zoo):
    outcome = shell("models", "list")
    assert outcome.code == 0
    assert "good" in outcome.out and "4/2/1" in outcome.out and "damaged" in outcome.out
    good, torn = shell("models", "list", "--json").document["models"]
    assert (good["name"], good["plant"], good["strides"]) == (
        "good",
        "desktop",
        {"h": 4, "m": 2, "l": 1},
    )
    assert good["size_bytes"] == (zoo / "good" / "model.safetensors").stat().st_size
    assert torn["name"] == "torn" and "sha256" in torn["error"]


def test_models_info_by_name_and_by_path(shell, zoo):
    outcome = shell("models", "info", "good")
    assert outcome.code == 0
    for text in ("health.probe_r2.x", "0.98", "architecture.embedding", "256"):
        assert text in outcome.out
    by_name = shell("models", "info", "good", "--json").document
    by_path = shell("models", "info", zoo / "good" / "model.safetensors", "--json").document
    assert by_name == by_path and by_name["metadata"]["seed"] == 3


def test_models_verify_checks_what_is_named_or_everything(shell, zoo):
    good = shell("models", "verify", "good")
    assert good.code == 0 and "good: intact" in good.out
    both = shell("models", "verify")
    assert both.code == 65 and "good: intact" in both.out  # one bad model hides no good one
    assert "sha256" in both.err and "Traceback" not in both.err
    assert shell("models", "verify", "torn", "--json").document["error"]["code"] == 65
    several = shell("models", "verify", "torn", "nowhere", "good", "--quiet")
    assert several.code == 65 and "good: intact" in several.out
    assert several.err.startswith("error: 2 files are damaged or unreadable: ")
    assert "torn" in several.err and "'nowhere'" in several.err
    assert shell("models", "verify", "nowhere", "torn").code == 66


def test_models_of_an_unknown_name_lists_the_zoo(shell, zoo):
    assert_one_line_error(shell("models", "info", "god"), 66, "god", "good")


# --- the whole program

TINY = """
[collect]
trajectories = 6
test_trajectories = 4
clean_trajectories = 2
[encoder]
steps = 2
[actor]
epochs = 1
[hierarchy]
coarse_steps = 2
flat_steps = 2
medium_steps = 2
low_steps = 2
[protocol]
steps = 50
curve_devices = 4
bracket_devices = 8
gaps = [1, 20]
bootstrap = 50
"""


@pytest.mark.slow
def test_the_five_lines_from_pixels_to_device_counts(shell):
    """The real stages, in an empty directory, each finding what the one before has left.

    Preset smoke, made smaller still: does it run, and are the documents those of the contract?
    """
    Path("tiny.toml").write_text(TINY)
    small = ("--preset", "smoke", "--config", "tiny.toml", "--json")

    def document(line):
        outcome = shell(*line.split()[1:], *small)
        assert outcome.code == 0, outcome.err
        return outcome.document

    collected = document("hjepa collect --trajectories 6")
    assert collected.keys() >= {"dataset", "test_trajectories", "seconds", "frames_per_s"}
    assert (collected["trajectories"], collected["steps"]) == (12, 100)
    assert (Path(collected["dataset"]) / "dataset.json").is_file()

    encoder = document("hjepa train-encoder")
    assert encoder["health"]["probe_r2"].keys() == {"x", "x_dot", "theta", "theta_dot"}
    assert encoder["health"].keys() >= {"effective_rank", "action_sensitivity", "actor_nrmse"}
    for gate in encoder["gates"].values():
        assert gate.keys() >= {"value", "threshold", "passed"}

    model = document("hjepa train-hierarchy --h 4 --m 2 --l 1")
    assert model["strides"] == {"h": 4, "m": 2, "l": 1}
    assert "1-20" in model["nmae_windows"]
    assert shell("models", "verify", model["checkpoint"]).code == 0

    evaluated = document("hjepa eval")
    assert evaluated["horizon"] == list(range(101))
    assert list(evaluated["methods"]) == list(load_settings().methods)
    for entry in evaluated["methods"].values():
        keys = "nmae nmae_ci95 score score_ci95 lq_ratio bits_per_transmission tolerance_p"
        keys += " tolerance_gap_steps tolerance_gap_ci95 gap_curve delivery_curve"
        assert entry.keys() >= set(keys.split())
        assert len(entry["nmae"]) == 101

    scaled = document("hjepa scale --snr 10:30")
    assert scaled.keys() >= {"law", "bandwidth_hz", "slot_s", "rows", "limit_bits_per_s"}
    assert {row["snr_db"] for row in scaled["rows"]} == {10, 15, 20, 25, 30}
    for row in scaled["rows"]:
        assert row.keys() >= {"snr_db", "method", "devices", "devices_ci95", "bits_per_s"}

    finished = Path(encoder["checkpoint"]).parent
    with shell.untouched():
        assert document(f"hjepa train-encoder --out {finished}") == encoder


def test_document_has_no_nan_even_from_numpy(shell, stage):
    import numpy as np

    stage.result = {"methods": {"hold": {"nmae": np.array([0.5, np.nan])}}}
    assert shell("eval", "--json").document == {"methods": {"hold": {"nmae": [0.5, None]}}}
    assert json.loads(shell("eval", "--json").out)


def test_no_two_inputs_have_one_name() -> None:
    """Tables of inputs become one: the later of two alike would take the place of the other."""
    from hjepa_cli.cli import flags

    tables = [
        table
        for name, table in vars(flags).items()
        if isinstance(table, dict) and name != "INPUTS"
        if table and all(isinstance(one, flags.Input) for one in table.values())
    ]
    assert sum(map(len, tables)) == len(flags.INPUTS) > 100
