"""``hjepa reproduce``: each stage reads what the one before it left in the folder, nothing else."""

import json
from pathlib import Path

import pytest
from command_line import assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import Interrupted, NumericalError
from hjepa_cli.plugins import STAGES
from hjepa_cli.stages import (
    collect,
    evaluate,
    report,
    reproduce,
    scale,
    train_encoder,
    train_hierarchy,
)

ORDER = ["collect", "train-encoder", "train-hierarchy", "eval", "scale"]
MODULES = (collect, train_encoder, train_hierarchy, evaluate, scale)


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def calls(monkeypatch):
    """Stages that only remember how they were called."""
    made = []

    def install(name, module):
        def run(settings, screen, **inputs):
            made.append((name, {"settings": settings, **inputs}))
            if failing == [name]:
                raise NumericalError("the encoder failed its gate", hint="h")
            if failing == [f"interrupt {name}"]:
                raise Interrupted("interrupted", hint=f"hjepa resume f/{name}")
            return {"stage": name}

        monkeypatch.setattr(module, "run", run)

    failing = []
    for name, module in zip(ORDER, MODULES, strict=True):
        install(name, module)
    monkeypatch.setattr(
        report, "run", lambda screen, paths, *, out, figures: {"report": out, "paths": paths}
    )
    made.append(failing)
    return made


def test_the_stages_run_in_order_on_each_others_results(shell, calls):
    document = shell("reproduce", "--preset", "smoke", "--out", "f", "--json").document
    _, *made = calls
    assert [name for name, _ in made] == ORDER
    inputs = dict(made)
    assert inputs["collect"]["out"] == Path("f/data")
    for name in ORDER[1:]:
        assert inputs[name]["dataset"] == Path("f/data") and inputs[name]["out"] == Path("f", name)
    assert inputs["train-hierarchy"]["encoder"] == Path("f/train-encoder/model.safetensors")
    assert (
        inputs["eval"]["checkpoint"] == inputs["scale"]["checkpoint"] == Path("f/train-hierarchy")
    )
    assert document["report"] == "f/report.html" and document["eval"] == {"stage": "eval"}


def test_times_are_planned_as_they_were_measured():
    """On two cores of a server; elsewhere they may be off by more, so within a half is enough."""
    planned_s = {part.command: part.seconds for part in reproduce.parts(load_settings())}
    trained_s = sum(planned_s[name] for name in ORDER[:3])
    measured = {
        "trainings": (trained_s, 14 * 60),
        "train-encoder": (planned_s["train-encoder"], 399),
        "eval": (planned_s["eval"], 9 * 60),
    }
    for name, (seconds, took_s) in measured.items():
        assert took_s / 1.5 < seconds < 1.5 * took_s, name


def test_a_finished_folder_prints_its_result_again(shell, calls):
    first = shell("reproduce", "--out", "f", "--json").document
    again = shell("reproduce", "--out", "f", "--json").document
    assert again == first and len(calls) == 1 + len(ORDER)


def test_what_stops_a_stage_stops_here_and_the_same_command_goes_on(shell, calls):
    calls[0].append("train-encoder")
    outcome = shell("reproduce", "--out", "f", "--quiet")
    assert_one_line_error(outcome, 70, "gate")
    assert [name for name, _ in calls[1:]] == ORDER[:2]
    events = [json.loads(line) for line in Path("f/events.jsonl").read_text().splitlines()]
    assert [event.get("stage") for event in events if event["event"] == "finished"] == ["collect"]
    calls[0].clear()
    assert shell("reproduce", "--out", "f", "--quiet").out == "f/report.html\n"


def test_an_interrupted_reproduction_is_resumed_as_a_whole(shell, calls):
    """Not the stage alone that was interrupted; with the same settings, and no other flag."""
    calls[0].append("interrupt train-hierarchy")
    stopped = shell("reproduce", "--preset", "smoke", "--seed", "3", "--out", "f", "--quiet")
    assert_one_line_error(stopped, 130, "hint: hjepa resume f\n")
    calls[0].clear()
    resumed = shell("resume", "f", "--json").document
    assert resumed["report"] == "f/report.html" and set(ORDER) <= resumed.keys()
    assert [name for name, _ in calls[1:]] == ORDER[:3] + ORDER
    assert calls[1][1] == calls[4][1]  # what collect was given, settings included
    assert calls[1][1]["settings"].seed == 3
    assert shell("resume", "f", "--json").document == resumed  # finished: told again


@pytest.mark.parametrize("preset", ["default", "paper", "smoke", "gym"])
def test_dry_run_plans_all_stages_and_writes_nothing(shell, preset):
    with shell.untouched():
        plan = shell("reproduce", "--preset", preset, "--dry-run", "--json").document["plan"]
    stages = [line.split(":")[0] for line in plan["work"]]
    assert list(dict.fromkeys(stages)) == ORDER
    single = shell("train-encoder", "--preset", preset, "--dry-run", "--json").document["plan"]
    assert plan["seconds"] > single["seconds"]


def test_dry_run_plans_to_harden_the_encoder_that_is_trained_here(shell):
    """Whatever the zoo has, whose models are hard already."""
    plan = shell("reproduce", "--dry-run", "--json").document["plan"]
    hardening = [line for line in plan["work"] if "harden the encoder" in line]
    assert len(hardening) == 1 and hardening[0].startswith("train-hierarchy: ")


def test_dry_run_plans_the_law_and_the_methods_of_the_settings(shell):
    def plan(law, methods="hjepa,oracle,optimal"):
        Path("c.toml").write_text(f"[radio]\nlaw = {law!r}")
        arguments = ("reproduce", "--config", "c.toml", "--methods", methods, "--dry-run", "--json")
        return shell(*arguments).document["plan"]

    scheduled, duty = plan("scheduled"), plan("duty")
    assert duty["work"][-1] == "scale: count devices"
    assert scheduled["work"][-1].startswith("scale: simulate up to ")
    assert "for 2 methods" in scheduled["work"][-1]  # optimal has no link
    assert scheduled["seconds"] > duty["seconds"]
    assert plan("duty", "hjepa,supervised-2")["work"][-2].endswith("the curves of hjepa")


@pytest.mark.parametrize(
    ("flags", "config", "says"),
    [
        (["--methods", "ts-jepa-7"], "", ["ts-jepa-7", "train-hierarchy --h 7", "ts-jepa-4"]),
        (["--methods", "supervised-2"], "", ["supervised-2", "--method supervised"]),
        (["--methods", "hjepa"], "[hierarchy]\nh = 1\nm = 1\nl = 1", ["hjepa", "ts-jepa-1"]),
        ([], '[encoder]\nmethod = "supervised"', ["'supervised'", "'jepa'"]),
        ([], "[collect]\nsteps = 4", ["4 steps"]),
        (["--methods", "hjepa"], "[hierarchy]\nh = 160", ["--h 160"]),
        ([], "[protocol]\nhorizon = 120", ["horizon = 120"]),
        ([], '[radio]\nsnr_db = "30:10"', ["--snr"]),
        (["--methods", "optimal,local"], '[radio]\nlaw = "scheduled"', ["nothing to schedule"]),
        ([], '[radio]\nlaw = "scheduled"\n[protocol]\nsteps = 1', ["protocol.steps = 1"]),
    ],
)
@pytest.mark.parametrize("how", [[], ["--dry-run"]], ids=str)
def test_what_a_late_stage_would_refuse_is_refused_at_once(shell, calls, flags, config, says, how):
    """Though the zoo has a model of supervised-2: only what is trained here is measured here."""
    Path("c.toml").write_text(config)
    with shell.untouched():
        outcome = shell("reproduce", "--config", "c.toml", *flags, *how)
    assert_one_line_error(outcome, 2, *says)
    assert len(calls) == 1


def test_the_methods_it_serves_are_those_of_the_models_it_trains():
    """Also of one level, of a depth of one, and of plants of six states."""
    from hjepa_cli.config.checks import without_model
    from hjepa_cli.config.settings import load_settings

    def served(preset, h, m, l):
        flags = {"hierarchy.h": h, "hierarchy.m": m, "hierarchy.l": l}
        return set(reproduce.servable(load_settings(preset, flags=flags))) - set(without_model())

    always = {"ts-jepa-1", "hold", "zero", "linear", "state-kf", "local"}
    assert served(None, 8, 2, 1) == always | {"hjepa", "ts-jepa-8", "state-48"}
    assert served(None, 7, 7, 7) == always | {"ts-jepa-7", "state-48"}
    assert served("quadrotor", 1, 1, 1) == always


def test_methods_of_other_models_are_left_out(shell, calls):
    """So that a preset's methods go with other strides; the zoo's models stay the zoo's."""
    outcome = shell("reproduce", "--methods", "hjepa,ts-jepa-7,supervised-2,oracle")
    assert outcome.code == 0
    for name in ("ts-jepa-7", "supervised-2"):
        assert f"{name} left out" in outcome.err
    inputs = dict(calls[1:])
    for stage in ("eval", "scale"):
        assert inputs[stage]["settings"].methods == ("hjepa", "oracle")


def test_the_stages_take_what_they_are_given():
    """The stand-ins accept anything; the real stages must accept the same."""
    import inspect

    from hjepa_cli.config.settings import load_settings
    from hjepa_cli.output.screen import Screen

    settings, screen = load_settings("smoke"), Screen(quiet=True)
    bound = []
    with pytest.MonkeyPatch.context() as patch:
        for module in MODULES:
            signature = inspect.signature(module.run)

            def run(*given, signature=signature, **named):
                bound.append(signature.bind(*given, **named))
                return {}

            patch.setattr(module, "run", run)
        for name, inputs in reproduce.inputs_in(Path("f")).items():
            STAGES[name].run(settings, screen, **inputs)
    assert len(bound) == len(ORDER)
