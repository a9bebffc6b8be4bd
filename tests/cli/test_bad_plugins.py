"""Plugins that are wrong, or go wrong: one line with the file and the line, whenever it happens."""

import builtins
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import Shell, assert_one_line_error, block, open_shell

from hjepa_cli import plugins
from hjepa_cli.cli.commands import COMMANDS, GROUPS, SHARED, commands
from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.stages import stage
from hjepa_cli.storage.shards import ShardLog

SQUARE = block("plugins.md", "Stage(")
LAW = block("plugins.md", "ClosedFormLaw(")
SCHEDULER = block("plugins.md", "Scheduler(")
CODEC = block("plugins.md", "Codec(")
METHOD = block("plugins.md", "least-squares")
PHY = block("plugins.md", "register(Phy(")
PLANT = block("own_plant.md", "class Pendulum")
STEP = "step_s: float = 5e-3"
QUICK = """
[protocol]
warmup_steps = 0
steps = 60
gaps = [1, 20, 40]
bracket = 0.3
curve_devices = 4
bracket_devices = 4
bootstrap = 20
horizon = 10
"""


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys) -> Iterator[Shell]:
    """A command line of a process that has loaded no plugin before."""
    forget(monkeypatch)
    Path(tmp_path, "n.txt").write_text("7")
    yield open_shell(tmp_path, monkeypatch, capsys)
    for name in [name for name in sys.modules if name.startswith("hjepa_plugin_")]:
        del sys.modules[name]


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    for registry in plugins._REGISTRIES.values():
        monkeypatch.setattr(registry, "_added", {})
    monkeypatch.setattr(plugins, "_sources", [])


def refused(shell: Shell, text: str, *says: str) -> None:
    """Loading is refused in one line that names the file, the line and the next step."""
    Path("bad.py").write_text(text)
    outcome = shell("collect", "--plugin", "bad.py", "--dry-run")
    assert_one_line_error(outcome, 2, *says, "hint: correct bad.py, or leave out --plugin")
    assert re.match(r"error: plugin bad\.py:\d+: ", outcome.err), outcome.err
    assert not plugins._sources and not any(one._added for one in plugins._REGISTRIES.values())


# A stage is a command


def test_the_stage_of_the_documentation_is_a_command(shell):
    Path("square.py").write_text(SQUARE)
    square = ("square", "--plugin", "square.py")
    assert_one_line_error(shell(*square), 2, "--number", "hint: hjepa square --plugin square.py")
    assert_one_line_error(shell(*square, "--number", "gone"), 66, "'gone' does not exist")
    plan = shell(*square, "--number", "n.txt", "--negative", "--dry-run", "--json").document["plan"]
    assert plan["reads"] == ["n.txt"] and plan["work"] == ["square, negative = True"]
    done = shell(*square, "--number", "n.txt", "--negative", "--seed", "3", "--out", "r", "--json")
    assert done.document == {"square": -49, "seed": 3}
    help_ = shell(*square, "--help").out
    assert "--number" in help_ and "--negative" in help_ and "required" in help_
    Path("n.txt").write_text("x")
    assert_one_line_error(
        shell(*square, "--number", "n.txt"), 2, "plugin square.py:16: ValueError: invalid literal"
    )


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('Stage("square"', 'Stage("view"', "something else called 'view'"),
        ('Stage("square"', 'Stage("models"', "something else called 'models'"),
        ('Stage("square"', 'Stage("collect"', "a stage called 'collect'"),
        ('Stage("square"', 'Stage("a b"', "cannot be called 'a b'"),
        ('Stage("square"', 'Stage("../../x"', "cannot be called '../../x'"),
        ('Stage("square"', 'Stage("-x"', "cannot be called '-x'"),
        ('Stage("square"', "Stage(7", "cannot be called 7"),
        ("run, plan, inputs", "None, plan, inputs", "run = None is no function"),
        ("run, plan, inputs", "run, 5, inputs", "plan = 5 is no function"),
        ('"Square a number."', "None", "help = None is no str"),
        ('("number", "negative")', '"number"', "inputs = 'number' is no tuple"),
        ('("number", "negative")', '("number", "seed")', "'seed' cannot be an input"),
        ('("number", "negative")', '("number", "a b")', "'a b' cannot be an input"),
        ('("number", "negative")', '("number", "more")', "cannot be called with"),
        ('("number", "negative")', "()", "cannot be called with"),
        ("negative=False", "negative=3", "its default is 3, not None or False"),
    ],
)
def test_a_stage_that_can_be_no_command_is_refused(shell, old, new, says):
    refused(shell, SQUARE.replace(old, new), says)


def test_names_that_are_taken_are_those_of_the_program():
    own = {one.name for one in COMMANDS} - set(plugins.BUILT_IN["stage"])
    assert set(plugins.TAKEN["stage"]) == {name for name in own if " " not in name} | set(GROUPS)
    assert set(plugins.TAKEN["plant"]) == set(PRESETS) - set(plugins.BUILT_IN["plant"])
    taken = {name.partition(":")[0] for one in commands() for name in one.all_taken}
    declared = {name for name in taken if "." not in name}
    others = {*plugins.BUILT_IN["stage"]} - {"bench-link"}  # whose inputs are its own
    inputs = {word for name in others for word in plugins.STAGES[name].inputs}
    assert set(SHARED) == inputs - {"further"}
    assert {"preset", "seed", "plugin", "json", "dry_run", "cluster"} <= declared & set(stage.TAKEN)


@pytest.mark.parametrize(
    "name", ["", "a,b", "a b", "x\n", "a/b", "hold+3", ".x", "a" * 65, "paper"]
)
@pytest.mark.parametrize(
    "text", [LAW, SCHEDULER, CODEC, METHOD, PHY, PLANT], ids=lambda text: text[3:20]
)
def test_names_that_no_list_flag_or_path_can_carry_are_refused(shell, text, name):
    own = re.search(r'"(half-duty|patient|signs|least-squares|two-thirds|pendulum)"', text)[0]
    if name != "paper":
        refused(shell, text.replace(own, repr(name)), f"cannot be called {name!r}")
    elif text is PLANT:
        refused(shell, text.replace(own, repr(name)), "something else called 'paper'")


# Members


@pytest.mark.parametrize(
    ("text", "old", "new", "says"),
    [
        (CODEC, "fit=fit", "fit=5", "fit = 5 is no function"),
        (CODEC, "bits=lambda embedding: embedding", "bits=8", "bits = 8 is no function"),
        (LAW, "axis=GAP", 'axis="gap"', "axis = 'gap' is no Axis"),
        (LAW, "devices=devices", "devices=3", "devices = 3 is no function"),
        (LAW, '"in every other slot"', "None", "help = None is no str"),
        (METHOD, '"embedding",', '"embeding",', "did you mean 'embedding'?"),
        (METHOD, "offered=of_hierarchy", "offered=None", "offered = None is no function"),
        (METHOD, "fitted=True", "fitted='yes'", "fitted = 'yes' is no bool"),
        (PHY, "layer=layer", "layer=3", "layer = 3 is no function"),
        (SCHEDULER, "np.where(view.able, view.waited, 0.0))", "0, 'yes')", "= 'yes' is no bool"),
        (PLANT, "step_s: float = 5e-3", "step_s: float = 0.0", "step_s = 0.0; expected more"),
        (PLANT, '("rad", "rad/s")', '("rad",)', "state_names is for 2 values, state_units for 1"),
        (PLANT, '("theta", "theta_dot")', '("theta", "theta")', "expected a name for each state"),
        (PLANT, '("theta", "theta_dot")', "(1, 2)", "state_names = (1, 2); expected a name"),
        (PLANT, STEP, f"mirror: ClassVar = 0.5\n    {STEP}", "mirror = 0.5; expected 1 or -1"),
        (PLANT, STEP, f"mirror: ClassVar = None\n    {STEP}", "mirror = None; expected 1 or -1"),
        (PLANT, STEP, f"action_shape: ClassVar = (1, 1)\n    {STEP}", "expected () or (m,)"),
        (PLANT, STEP, f"action_shape: ClassVar = (1.0,)\n    {STEP}", "expected () or (m,)"),
    ],
)
def test_members_of_another_kind_are_refused(shell, text, old, new, says):
    assert old in text
    refused(shell, text.replace(old, new), says)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ("pole_mass_kg=0", "a number above 0"),
        ("half_length_m=-0.2", "a number above 0"),
        ("gravity_m_s2=float('nan')", "a number above 0"),
        ("pole_width_m='0.02'", "a number above 0"),
        ("substeps=2.5", "a number above 0"),
        ("window_m=1.2", "2 numbers above 0"),
        ("cart_size_m=(0.1, 0)", "2 numbers above 0"),
        ("state_weights=(1, 1, 1, -1)", "4 numbers above 0"),
    ],
)
def test_a_cart_pole_that_cannot_be_is_refused(shell, change, wanted):
    made = (
        "import dataclasses\nfrom hjepa_cli import register\n"
        "from hjepa_cli.core.plants.named import plant\n"
        "register(dataclasses.replace(plant('desktop'), name='mine', {}))"
    )
    refused(shell, made.format(change), f"plant 'mine': {change.partition('=')[0]} = ", wanted)
    Path("good.py").write_text(made.format("substeps=4, state_weights=(1, 0, 9.0, 0)"))
    assert plugins.load_file(Path("good.py")).name == "good.py"


def test_a_family_that_makes_something_else_is_named(shell):
    made = "CodecFamily('mine-N', lambda name: 8 if name == 'mine-8' else None, 'mine-N')"
    Path("bad.py").write_text(
        "from hjepa_cli import register\n"
        f"from hjepa_cli.core.control.codecs.codec import CodecFamily\nregister({made})\n"
    )
    plugins.load_file(Path("bad.py"))
    with pytest.raises(plugins.UsageError, match=r"plugin bad.py: codecs mine-N: .* made 8"):
        plugins.CODECS["mine-8"]


def test_a_file_that_registers_nothing_is_refused(shell):
    """What it makes would be missed only later, as unknown."""
    for text in ("", LAW.replace("register(", "id(")):
        Path("bad.py").write_text(text)
        outcome = shell("collect", "--plugin", "bad.py", "--dry-run")
        assert_one_line_error(outcome, 2, "plugin bad.py: it registers nothing", "hint: hand what")
        assert not plugins._sources


def test_a_module_beside_a_plugin_is_found_on_the_path_alone(shell, monkeypatch):
    """Workers run its text where its folder may not be, so that nobody searches there."""
    Path("beside.py").write_text("name = 'patient'")
    Path("mine.py").write_text("import beside\n" + SCHEDULER.replace('"patient"', "beside.name"))
    plan = "scale", "--law", "scheduled", "--scheduler", "patient", "--dry-run"
    outcome = shell(*plan, "--plugin", "mine.py")
    assert_one_line_error(outcome, 2, "plugin mine.py:1: ModuleNotFoundError: No module named 'be")
    assert outcome.err.endswith(
        f"hint: set PYTHONPATH={Path.cwd()}, or install it: its folder is not searched\n"
    )
    monkeypatch.syspath_prepend(Path.cwd())
    assert shell(*plan, "--plugin", "mine.py").code == 0
    sys.modules.pop("beside")


# Going wrong


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import sys\nsys.exit()", "bad.py:2: SystemExit"),
        ("import sys\nsys.exit(3)", "bad.py:2: SystemExit: 3"),
        ("raise SystemExit", "bad.py:1: SystemExit"),
        ("class Own(BaseException): pass\nraise Own('no')", "bad.py:2: Own: no"),
    ],
)
def test_a_plugin_that_ends_the_program_is_refused(shell, text, says):
    refused(shell, text, says)


def test_an_interruption_while_plugins_load_is_one(shell):
    Path("slow.py").write_text("from hjepa_cli import register\nraise KeyboardInterrupt")
    assert_one_line_error(shell("collect", "--plugin", "slow.py"), 130, "interrupted")


@pytest.mark.parametrize("how", ["import sys; sys.exit(0)", "raise SystemExit(0)", "int('x')"])
def test_a_stage_that_ends_the_program_has_not_succeeded(shell, how):
    Path("square.py").write_text(
        SQUARE.replace('if Path("stop").exists():', "if 1:\n            " + how)
    )
    outcome = shell("square", "--plugin", "square.py", "--number", "n.txt")
    assert_one_line_error(outcome, 2, "plugin square.py:1")


@pytest.mark.parametrize(
    ("old", "new", "flags", "says"),
    [
        ("return record.finish", "return 5\n        record.finish", (), "square returned 5"),
        ('return Plan("square"', 'return (7, "square"', ("--dry-run",), "square planned (7,"),
    ],
)
def test_a_stage_that_returns_something_else_is_named(shell, old, new, flags, says):
    Path("square.py").write_text(SQUARE.replace(old, new))
    assert_one_line_error(
        shell("square", "--plugin", "square.py", "--number", "n.txt", *flags), 2, says
    )


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("-3", "law 'half-duty': devices(…) = -3; expected a whole number"),
        ("None", "devices(…) = None"),
        ("float('nan')", "devices(…) = nan"),
        ("2.5", "devices(…) = 2.5"),
        ("1 / 0", "plugin mine.py:9: ZeroDivisionError: division by zero"),
        ("link.no_such", "plugin mine.py:9: AttributeError"),
    ],
)
def test_a_law_that_counts_wrong_is_named(shell, value, says):
    Path("mine.py").write_text(LAW.replace("int(gap_steps * link.packets_per_slot / 2)", value))
    Path("c.toml").write_text(QUICK)
    outcome = shell(
        *("scale", "--plugin", "mine.py", "--law", "half-duty", "--methods", "hold-true"),
        *("--snr", "20", "--config", "c.toml", "--workers", "0", "--quiet"),
    )
    assert_one_line_error(outcome, 2, "error: plugin mine.py", says)


@pytest.mark.parametrize(
    ("score", "says"),
    [
        ("view.no_such", "plugin mine.py:7: AttributeError"),
        ("view.age[:-1] * 1.0", "scheduler 'patient': score(…) is ("),
        ("view.age * np.nan", "score(…) is NaN for device 0"),
        ("None", "score(…) is () of object"),
    ],
)
def test_a_scheduler_that_scores_wrong_is_named(shell, score, says):
    Path("mine.py").write_text(SCHEDULER.replace("np.where(view.able, view.waited, 0.0)", score))
    Path("c.toml").write_text(QUICK)
    outcome = shell(
        *("scale", "--plugin", "mine.py", "--law", "scheduled", "--scheduler", "patient"),
        *("--methods", "hold-true", "--snr", "20", "--config", "c.toml", "--workers", "0"),
        "--quiet",
    )
    assert_one_line_error(outcome, 2, "error: plugin mine.py", says)


def test_a_function_that_takes_something_else_is_named(shell):
    """No line of the file is in the traceback of such a call."""
    Path("mine.py").write_text(LAW.replace("gap_steps, need, link", "gap_steps"))
    plugins.load_file(Path("mine.py"))
    with pytest.raises(plugins.UsageError, match=r"mine.py: law 'half-duty': TypeError: devices\("):
        plugins.LAWS["half-duty"].asked("devices", 1.0, None, None)


def test_an_error_of_a_worker_is_traced_to_the_plugin(shell):
    """What comes back from another process has its traceback as text alone."""
    from concurrent.futures.process import _ExceptionWithTraceback

    Path("mine.py").write_text("def fail():\n    return 1 / 0\n" + LAW)
    plugins.load_file(Path("mine.py"))
    [module] = [one for name, one in sys.modules.items() if name.startswith("hjepa_plugin_mine")]
    try:
        module.fail()
    except ZeroDivisionError as error:
        function, arguments = _ExceptionWithTraceback(error, error.__traceback__).__reduce__()
    assert plugins.blamed(function(*arguments)) == "mine.py:2"
    assert plugins.blamed(ValueError('File "mine.py", line 3')) is None


# What it prints, how it is read


def test_prints_of_a_plugin_are_not_in_the_document(shell):
    Path("square.py").write_text(
        "print('loading')\n" + SQUARE.replace("if Path(", "print('running')\n        if Path(")
    )
    outcome = shell("square", "--plugin", "square.py", "--number", "n.txt", "--json")
    assert outcome.document == {"square": 49, "seed": 0}
    assert "loading" in outcome.err and "running" in outcome.err


@pytest.mark.parametrize("kind", ["pipe", "device", "large", "directory"])
@pytest.mark.parametrize(("flag", "code"), [("--plugin", 2), ("--config", 65)])
def test_files_that_never_end_are_not_read(shell, monkeypatch, kind, flag, code):
    path = Path("/dev/zero" if kind == "device" else "x")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "directory":
        path.mkdir()
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(2**20 + 1)
    monkeypatch.setattr(builtins, "open", None)  # a pipe would hang the test
    says = "larger than 1048576 bytes" if kind == "large" else "not a regular file"
    assert_one_line_error(shell("collect", flag, path, "--dry-run"), code, str(path), says)


# The next step


def test_hints_name_the_plugins_and_inputs_of_a_run(shell, monkeypatch):
    Path("square.py").write_text(SQUARE)
    square = ("square", "--plugin", "square.py", "--number", "n.txt", "--negative", "--out", "r")
    again = "hjepa square --config r/config.toml --plugin square.py --negative --number n.txt"
    Path("stop").touch()
    assert shell(*square).code == 130
    forget(monkeypatch)  # without the plugin: what is missing comes before what is unknown
    outcome = shell("resume", "r")
    assert_one_line_error(outcome, 2, "square.py, which is not in force")
    assert outcome.err.endswith("hint: hjepa resume r --plugin square.py\n")

    Path("square.py").write_text(SQUARE + "# edited\n")
    outcome = shell("resume", "r", "--plugin", "square.py")
    assert_one_line_error(outcome, 2, "has changed since")
    assert outcome.err.endswith(f"hint: restore the file, or begin anew: {again} --out DIR\n")

    Path("square.py").write_text(SQUARE)
    config = Path("r/config.toml")
    kept = config.read_text()
    config.write_text(kept.replace("seed = 0", "seed = 1"))
    outcome = shell("resume", "r", "--plugin", "square.py")
    assert_one_line_error(outcome, 65, "was changed after the run was begun", f"{again} --out DIR")
    config.write_text(kept)
    Path("stop").unlink()
    assert shell("resume", "r", "--plugin", "square.py").code == 0
    result = Path("r/result.json")
    result.write_text(result.read_text().replace("-49", "-48"))
    outcome = shell("resume", "r", "--plugin", "square.py")
    assert_one_line_error(outcome, 65, f"run it again: {again}")


def test_a_collection_of_a_plant_that_is_not_there_is_named(shell):
    Path("c").mkdir()
    ShardLog(Path("c"), load_settings().as_dict() | {"plant": "pendulum"})
    with shell.untouched():
        outcome = shell("resume", "c")
    assert_one_line_error(outcome, 2, "of plant 'pendulum'", "hint: hjepa resume c --plugin FILE")


SMALL = """
plant = "pendulum"
[collect]
trajectories = 2
test_trajectories = 2
clean_trajectories = 1
steps = 4
clean_steps = 4
start = [0.3, 2.0]
[encoder]
gate_r2 = [0.9, 0.9]
[protocol]
start = [0.1, 0.3]
noise = [0.0, 0.03]
"""


def test_a_collection_goes_on_with_the_plant_that_it_was_begun_with(shell):
    """Shards of two texts of a file would be trajectories of two plants."""
    stops = "import os\n        if devices == 1 and os.path.exists('stop'): raise KeyboardInterrupt"
    text = PLANT.replace("return Integrated(", f"{stops}\n        return Integrated(")
    Path("c.toml").write_text(SMALL)
    collect = ("collect", "--plugin", "mine.py", "--config", "c.toml", "--out", "c", "--quiet")

    Path("mine.py").write_text(text.replace("return draw(", "return 0.5 * draw("))
    with shell.untouched():  # a plant that cannot be seen is found before anything is there
        assert_one_line_error(shell(*collect), 2, "render(…) is float64")
    Path("mine.py").write_text(text)
    Path("stop").touch()
    assert shell(*collect).code == 130
    Path("stop").unlink()
    Path("mine.py").write_text(text.replace("mass_kg: float = 0.1", "mass_kg: float = 0.9"))
    for again in (collect, ("resume", "c", "--plugin", "mine.py")):
        with shell.untouched():
            outcome = shell(*again)
        assert_one_line_error(outcome, 2, "begun with plugin mine.py, which has changed", "delete")
    Path("mine.py").write_text(text)
    assert shell("resume", "c", "--plugin", "mine.py").code == 0


def test_hints_are_of_the_plant_that_a_plugin_adds(shell):
    """Without it the next step would be refused, or take the default's plant."""
    Path("my plant.py").write_text(PLANT)
    Path("c.toml").write_text(SMALL)
    given = ("--plugin=my plant.py", "--config", "c.toml")
    own = "--plugin 'my plant.py' --config c.toml"
    for command, hint in (
        (("train-encoder",), f"hjepa collect {own} --plant pendulum, or pass --dataset DIR"),
        (("eval", "--methods", "hjepa", "--workers", "0"), f"hjepa train-hierarchy {own}"),
    ):
        outcome = shell(*command, *given)
        assert outcome.code == 66 and outcome.err.endswith(f"hint: {hint}\n"), outcome.err
