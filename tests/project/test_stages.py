"""Stages are registered objects: light to list, called by the inputs that they declare."""

import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, block, open_shell

from hjepa_cli import plugins
from hjepa_cli.cli.commands import COMMANDS, LOOKS
from hjepa_cli.cli.flags import INPUTS
from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import DataError, Interrupted
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import STAGES
from hjepa_cli.stages import bench_link
from hjepa_cli.stages.resume import given_to
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.files import jsonable
from hjepa_cli.storage.runs import Run
from hjepa_cli.storage.zoo import resolve_model

PLUGIN = block("plugins.md", "Stage(")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def square(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The plugin's stage, for one test."""
    monkeypatch.setattr(STAGES, "_added", {})
    monkeypatch.setattr(plugins, "_sources", list(plugins._sources))
    Path("square.py").write_text(PLUGIN)
    yield plugins.load_file(Path("square.py"))
    for name in [name for name in sys.modules if name.startswith("hjepa_plugin_square")]:
        del sys.modules[name]


def test_listing_stages_imports_nothing_heavy():
    code = (
        "import sys; from hjepa_cli.plugins import STAGES;"
        "print(*STAGES); assert all(STAGES[name].help for name in STAGES);"
        "assert not {'torch', 'numpy', 'scipy', 'pymunk'} & set(sys.modules), sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    pipeline = (
        "tune-law collect train-encoder train-hierarchy train-reflex train-fusion eval scale "
        "survive reproduce bench-link"
    )
    assert (done.returncode, done.stdout) == (0, f"{pipeline}\n"), done.stderr


@pytest.mark.parametrize("name", plugins.BUILT_IN["stage"])
def test_a_stage_runs_and_plans_with_the_inputs_that_it_declares(name):
    """All are optional keywords of both functions, which are where a call would look for them."""
    stage = STAGES[name]
    assert stage.name == name
    for function in (stage.run, stage.plan):
        signature = inspect.signature(function.function)
        keywords = {
            key: parameter
            for key, parameter in signature.parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        }
        assert keywords.keys() - {*LOOKS} == {"out", *stage.inputs}
        assert all(parameter.default is not parameter.empty for parameter in keywords.values())


@pytest.mark.parametrize("name", plugins.BUILT_IN["stage"])
def test_the_flag_of_an_input_is_its_name(name):
    """Hints make the flag of what a run recorded, and that is named as the keyword."""
    [command] = [one for one in COMMANDS if one.name == name]
    flags = {key.partition(":")[0]: INPUTS[key].name for key in command.takes if key in INPUTS}
    for word in STAGES[name].inputs:
        assert word == "further" or flags[word] == f"--{word.replace('_', '-')}"


MODEL, OTHER = "desktop-h4m2l1", "desktop-reflex"
BENCH = {
    "model": Path("exported"),
    "devices": 3,
    "steps": 1002,
    "lockstep": True,
    "gap_steps": 7,
    "delivery": 0.5,
    "trace": Path("trace"),
    "harm": "kill",
    "checkpoint": MODEL,
    "backend": "torch",
}
GIVEN = [
    ("train-encoder", {"dataset": Path("data")}),
    ("train-hierarchy", {"dataset": Path("data"), "encoder": MODEL}),
    ("train-reflex", {"dataset": Path("data"), "checkpoint": MODEL}),
    ("train-fusion", {"dataset": Path("data"), "checkpoint": MODEL}),
    ("eval", {"checkpoint": MODEL, "further": [OTHER], "dataset": Path("data"), "remeasure": True}),
    ("eval", {"checkpoint": MODEL, "figure": True}),
    ("scale", {"checkpoint": MODEL, "further": [OTHER], "dataset": Path("data"), "verify": True}),
    ("scale", {"checkpoint": MODEL, "remeasure": True}),
    ("scale", {"checkpoint": MODEL, "tolerance_steps": 7.5}),
    ("survive", {"checkpoint": MODEL, "further": [OTHER]}),
    ("bench-link", BENCH),
    ("bench-link", {**BENCH, "lockstep": False, "period_ms": 7.5, "delivery": None}),
]


class Recorded(Exception):
    """A run would have begun; ``inputs`` is what it would have recorded."""

    def __init__(self, inputs):
        super().__init__(inputs)
        self.inputs = inputs


@pytest.mark.parametrize(("name", "given"), GIVEN)
def test_what_a_stage_was_given_is_what_resume_gives_it(name, given, shell, monkeypatch):
    """Else it would go on with something else, without a word."""

    def create(stage, out, settings, inputs):
        raise Recorded(jsonable(inputs))

    made_of = {"checkpoint": {"sha256": load_checkpoint(resolve_model(MODEL)).digest}}
    bundle = SimpleNamespace(digest=b"", frames=4, manifest=made_of, plant="desktop")
    monkeypatch.setattr(bench_link, "open_bundle", lambda path: bundle)
    monkeypatch.setattr(bench_link, "check_plant", lambda bundle, settings: None)
    Path("trace").write_text("0\nlost\n")
    methods = ("hjepa", "hold-decay") if "further" in given else ("hjepa",)
    flags = {"survival.intervals_steps": (10,)}
    if "tolerance_steps" not in given:  # which nothing is measured with
        flags["methods"] = methods
    settings = load_settings("smoke", flags=flags)
    if "dataset" in given:
        STAGES["collect"].run(settings, Screen(quiet=True), out=Path("data"))
    monkeypatch.setattr(Run, "create", create)
    given = {word: resolve_model(one) if one == MODEL else one for word, one in given.items()}
    if "further" in given:
        given["further"] = [resolve_model(OTHER)]
    with pytest.raises(Recorded) as caught:
        STAGES[name].run(settings, Screen(quiet=True), **given)
    again = given_to(STAGES[name], caught.value.inputs)
    places = {word: one.absolute() for word, one in given.items() if isinstance(one, Path)}
    places |= {"further": [one.absolute() for one in given.get("further", [])]}
    asked = {word: one for word, one in (given | places).items() if one not in (None, False, [])}
    assert {word: one for word, one in again.items() if one not in (None, False, [])} == asked


def test_every_input_of_every_stage_is_given_above():
    for name in plugins.BUILT_IN["stage"]:
        given = {word for stage, words in GIVEN if stage == name for word in words}
        assert given == {*STAGES[name].inputs}


def test_resume_refuses_what_a_stage_does_not_take():
    """As of another version, whose flag had another name."""
    with pytest.raises(DataError, match="was given 'gap', which hjepa bench-link does not take"):
        given_to(STAGES["bench-link"], {"devices": 3, "gap": 7})


def test_a_stage_of_a_plugin_is_resumed_with_what_it_was_given(square, shell):
    """A file by its place, a flag as it was, the settings of the run."""
    Path("three").write_text("3")
    Path("stop").touch()
    settings = load_settings("smoke", flags={"seed": 7})
    with pytest.raises(Interrupted) as caught:
        STAGES["square"].run(
            settings, Screen(quiet=True), out=Path("r"), number=Path("three"), negative=True
        )
    assert caught.value.hint == "hjepa resume r --plugin square.py"
    with shell.untouched():
        plan = shell("resume", "r", "--dry-run", "--json").document["plan"]
    assert plan["work"][1:] == ["square, negative = True"] and plan["reads"][0].endswith("three")
    Path("stop").unlink()
    assert shell("resume", "r", "--json").document == {"square": -9, "seed": 7}


def test_a_run_of_a_stage_that_is_not_there_is_named(square, shell, monkeypatch):
    """What is missing is its plugin, as long as that may be; then the stage."""
    Path("stop").touch()
    Path("three").write_text("3")
    with pytest.raises(Interrupted):
        STAGES["square"].run(
            load_settings("smoke"), Screen(quiet=True), out=Path("r"), number=Path("three")
        )
    monkeypatch.setattr(STAGES, "_added", {})
    assert_one_line_error(shell("resume", "r"), 65, "'square'")
    monkeypatch.setattr(plugins, "_sources", [])
    assert_one_line_error(shell("resume", "r"), 2, "hint: hjepa resume r --plugin square.py")
