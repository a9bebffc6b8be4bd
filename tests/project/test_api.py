"""The public Python interface: light to import, the same numbers as the commands."""

import doctest
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import ENVIRONMENT, ROOT
from played import play
from test_evaluate import untrained
from test_model_set import saved

import hjepa_cli
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.errors import DataError, UsageError

QUICK = {
    "protocol": "paper",
    "protocol.steps": 40,
    "protocol.curve_devices": 4,
    "protocol.bracket_devices": 8,
    "control.gains_n": [],
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    return hjepa_cli.load_model(untrained(path))


def test_importing_the_package_imports_nothing_else():
    code = "import sys, hjepa_cli; print(*sorted(m for m in sys.modules if m.startswith('hjepa')))"
    code += "; assert not {'torch', 'numpy', 'typer', 'rich'} & set(sys.modules)"
    code += "; assert set(hjepa_cli.__all__) <= set(dir(hjepa_cli))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "hjepa_cli\n"), done.stderr


def test_every_public_name_is_there_documented_and_in_the_docs():
    text = (ROOT / "docs/reference/python.md").read_text()
    assert sorted(hjepa_cli.__all__) == sorted(hjepa_cli._HOMES)
    for name in hjepa_cli.__all__:
        assert getattr(hjepa_cli, name).__doc__, name
        assert f"`{name}`" in text, name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        hjepa_cli.nothing  # noqa: B018 - the access is what is tested


def test_the_examples_of_the_documentation():
    from hjepa_cli.storage.zoo import list_models

    if "desktop-h4m2l1" not in list_models():
        pytest.skip("the examples use a model that the zoo does not have")
    failed, attempted = doctest.testfile(
        str(ROOT / "docs/reference/python.md"), module_relative=False
    )
    assert failed == 0 and attempted > 20


def test_predict_plays_what_the_controller_plays(model):
    z = torch.nn.functional.normalize(torch.randn(3, 256), dim=-1) * 16
    for method in ("hjepa", "ts-jepa-1"):
        forces_n, _ = hjepa_cli.predict(model, z, 11, method=method)
        controller = build_driver(method, load_settings(), model).controller(3)
        np.testing.assert_allclose(forces_n.numpy(), play(controller, z, 3, 11), rtol=1e-6)
    whole, z_whole = hjepa_cli.predict(model, z, 8)
    part, z_part = hjepa_cli.predict(model, z, 4)
    torch.testing.assert_close(hjepa_cli.predict(model, z_part, 4)[1], z_whole)
    torch.testing.assert_close(whole[:, :4], part)
    for wrong in ({"steps": 0}, {"steps": 2.5}, {"steps": 5, "method": "oracle"}):
        with pytest.raises(UsageError):
            hjepa_cli.predict(model, z, **wrong)


def test_drive_keeps_every_state_and_scores_like_eval():
    driven = hjepa_cli.drive("hold-true", gap_steps=10, devices=4, settings=QUICK)
    states = driven["states"]
    assert states.shape == (40, 4, 4) and driven["forces_n"].shape == (40, 4)
    inside = (abs(states[..., 0]) <= 0.05) & (abs(states[..., 2]) <= 0.05)
    np.testing.assert_allclose(driven["score"], inside.mean(axis=0))
    # held: the force changes only when a packet comes, at most every tenth step of each device
    changes = (np.diff(driven["forces_n"], axis=0) != 0).sum(axis=0)
    assert (changes <= 4).all() and (changes > 0).all()
    perfect = hjepa_cli.drive("hold-true", devices=4, settings=QUICK)
    same = hjepa_cli.drive("optimal", gap_steps=39, devices=4, settings=QUICK)
    np.testing.assert_array_equal(perfect["states"], same["states"])
    never = hjepa_cli.drive("zero-true", delivery=0.0, devices=2, settings=QUICK)
    assert (never["forces_n"][1:] == 0).all()
    late = hjepa_cli.drive("hold-true+9", devices=2, settings=QUICK)
    assert (late["forces_n"][:9] == 0).all() and (late["forces_n"][9] != 0).all()
    with pytest.raises(UsageError):
        hjepa_cli.drive("oracle", gap_steps=3, delivery=0.5)
    with pytest.raises(UsageError):
        hjepa_cli.drive("oracle", gap_steps=0)


def test_a_simulated_cell_is_the_stage_s():
    """The law ``scheduled``: without fades, a turn every N slots is a gap of N."""
    calm = {**QUICK, "radio.power_margin_db": 300.0}
    cell = hjepa_cli.simulate_cell("hold-true", devices=10, settings=calm)
    assert cell["score"].shape == cell["cost"].shape == cell["packets"].shape == (10,)
    assert (cell["packets"] == 4).all() or cell["packets"].sum() == 39
    turns = hjepa_cli.drive("hold-true", gap_steps=10, devices=10, settings=QUICK)
    np.testing.assert_array_equal(cell["score"], turns["score"])
    faded = hjepa_cli.simulate_cell("hold-true", devices=10, blocks=10, settings=QUICK)
    assert 0.85 < faded["packets"].mean() / 39 < 0.95  # margin of 10 dB: exp(-0.1) = 0.905
    asked = hjepa_cli.simulate_cell("hold-true", devices=10, scheduler="innovation", settings=QUICK)
    assert asked["reports"] > 0 == cell["reports"]
    for wrong in ({"scheduler": "luck"}, {"blocks": 11}):
        with pytest.raises(UsageError):
            hjepa_cli.simulate_cell("hold-true", devices=10, settings=QUICK, **wrong)


def test_a_model_of_another_plant_is_refused(tmp_path):
    gym = hjepa_cli.load_model(untrained(tmp_path / "gym.safetensors", plant_name="gym"))
    for call in (hjepa_cli.drive, hjepa_cli.simulate_cell):
        for method in ("hjepa", "oracle"):
            with pytest.raises(DataError, match="drives plant gym, not desktop") as caught:
                call(method, model=gym, devices=2, settings=QUICK)
        assert '{"plant": "gym"}' in caught.value.hint
        assert len(call("hold", model=gym, devices=2, settings=QUICK | {"plant": "gym"})["score"])


@pytest.mark.parametrize(
    ("method", "says"),
    [
        ("optimal", "no link"),
        ("local", "no link"),
        ("hold-true+9", "arrive in the slot"),
        ("supervised-2", "needs several slots"),
        ("supervised-2+3", "needs several slots"),
    ],
)
def test_a_simulated_cell_refuses_what_the_stage_does_not_schedule(model, method, says):
    with pytest.raises(UsageError, match=says):
        hjepa_cli.simulate_cell(method, model=model, devices=4, settings=QUICK)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("topology", "hall"),
        ("harq_rounds", 2),
        ("overhead_bits", 24),
        ("seeds", 2),
        ("schedulers", ("max-aoi",)),
        ("bandwidth_hz", 1e6),
        ("law", "equal"),
    ],
)
def test_a_simulated_cell_refuses_settings_that_it_does_not_read(name, value):
    law = {"radio.law": "scheduled", "radio.block_error": 0.1}
    with pytest.raises(UsageError, match=f"radio.{name} = .* is for hjepa scale"):
        hjepa_cli.simulate_cell(
            "hold-true", devices=4, settings=QUICK | law | {f"radio.{name}": value}
        )
    assert hjepa_cli.simulate_cell("hold-true", devices=4, settings=QUICK | law)["packets"].sum()


def test_a_simulated_cell_needs_two_slots():
    with pytest.raises(UsageError, match="steps = 1; law scheduled needs at least 2"):
        hjepa_cli.simulate_cell(
            "hold-true", devices=4, settings={"protocol": "paper", "protocol.steps": 1}
        )
    two = hjepa_cli.simulate_cell(
        "hold-true", devices=4, settings={"protocol": "paper", "protocol.steps": 2}
    )
    assert two["packets"].sum() <= 1


@pytest.mark.parametrize(
    ("call", "method", "options"),
    [
        (hjepa_cli.drive, "oracle", {"gap_steps": np.inf}),
        (hjepa_cli.drive, "oracle", {"gap_steps": np.nan}),
        (hjepa_cli.drive, "oracle", {"delivery": np.nan}),
        (hjepa_cli.drive, "oracle", {"devices": -1}),
        (hjepa_cli.drive, "oracle", {"devices": 0}),
        (hjepa_cli.drive, "oracle", {"devices": 2.5}),
        (hjepa_cli.drive, "oracle", {"devices": True}),
        (hjepa_cli.drive, "oracle+x", {}),
        (hjepa_cli.drive, "oracle+", {}),
        (hjepa_cli.drive, "oracle+-3", {}),
        (hjepa_cli.simulate_cell, "oracle", {"devices": -1}),
        (hjepa_cli.simulate_cell, "oracle", {"devices": 4, "blocks": 1.5}),
    ],
)
def test_bad_values_are_one_clear_line(call, method, options):
    with pytest.raises(UsageError) as caught:
        call(method, settings=QUICK, **options)
    wrong = [*map(str, options.values()), *([method] if "+" in method else [])]
    assert any(value in caught.value.message for value in wrong)
    assert "\n" not in caught.value.message


def test_a_late_method_is_one_over_a_late_link(model):
    """A predictor of 4 steps brings packets up to date when they are 4 steps old.

    What holds the last force takes them for fresh.
    """
    late = QUICK | {"protocol.delay_steps": 3}
    forces = {}
    for name, heard_at in (("hjepa", 4), ("hold", 3)):
        forces[name], same = (
            hjepa_cli.drive(method, model=model, devices=2, settings=values)["forces_n"]
            for method, values in ((f"{name}+3", QUICK), (name, late))
        )
        np.testing.assert_array_equal(forces[name], same)
        assert (same[:heard_at] == 0).all() and (same[heard_at] != 0).all()
    assert np.abs(forces["hjepa"][4:] - forces["hold"][4:]).max() > 1e-3
    never = hjepa_cli.drive("hold-true+99999999999", devices=2, settings=QUICK)
    assert (never["forces_n"] == 0).all()


def test_a_model_brings_its_pictures_and_its_law(tmp_path):
    law = [-9.0, -9.0, -70.0, -9.0]
    flags = {"camera.height_px": 32, "camera.width_px": 64, "camera.grey": True}
    trained = load_settings(flags=flags | {"encoder.hidden": 8, "control.gains_n": law})
    path = saved(tmp_path / "model.safetensors", trained, kind="flat", h=1, m=1, l=1, hidden=8)
    small = hjepa_cli.load_model(path)
    for method in ("hold", "zero"):
        driven = hjepa_cli.drive(method, model=small, devices=2, settings=QUICK)
        assert np.isfinite(driven["forces_n"]).all()
    sampled = QUICK | {"collect.trajectories": 3, "collect.test_trajectories": 2}
    hjepa_cli.drive("state-kf", model=small, devices=2, settings=sampled | {"collect.steps": 40})
    with_law, own, other = (
        hjepa_cli.drive("hold-true", model=one, devices=2, settings=QUICK | changes)["forces_n"]
        for one, changes in ((small, {}), (None, {"control.gains_n": law}), (None, {}))
    )
    np.testing.assert_array_equal(with_law, own)
    assert (with_law != other).any()


def test_stages_return_their_documents_and_print_nothing(capsys):
    small = {"collect.trajectories": 2, "collect.test_trajectories": 2, "collect.steps": 10}
    small |= {"control.gains_n": []}
    data = hjepa_cli.collect(preset="smoke", settings=small, out="d")
    assert data.path == Path("d") and len(data.split("train")) == 2
    assert hjepa_cli.load_dataset("d").digest == data.digest
    result = hjepa_cli.scale(
        snr="10,20", law="equal", methods=["oracle"], preset="smoke", settings=QUICK, out="s"
    )
    assert result["law"] == "equal" and [row["snr_db"] for row in result["rows"]] == [10, 20]
    assert result["rows"] == hjepa_cli.scale(
        snr="10,20", law="equal", methods=["oracle"], preset="smoke", settings=QUICK
    )["rows"]  # fmt: skip
    assert capsys.readouterr() == ("", "")
    with pytest.raises(UsageError, match="did you mean"):
        hjepa_cli.evaluate(settings={"protocol.step": 3})
