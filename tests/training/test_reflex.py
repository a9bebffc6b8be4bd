"""Rivals without a predictor: forces that fade, networks of packet and age, and their training."""

import dataclasses
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import Shell, assert_one_line_error, open_shell
from played import play

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import LastForce, Oracle, ReflexController
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.control.loop import Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.control.sensors import true_state
from hjepa_cli.core.networks.model import Model, build_modules, tensors_of
from hjepa_cli.core.networks.reflex import Reflex
from hjepa_cli.core.networks.symmetry import reflect
from hjepa_cli.core.plants.cartpole.teacher import gains
from hjepa_cli.core.plants.linear import gains_at_rest, linearise, lqr_gain
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training import decay_fit, reflex_training
from hjepa_cli.core.training.decay_fit import Trial
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.progress import PROGRESS_FILE
from hjepa_cli.core.training.search import best
from hjepa_cli.errors import DataError, Interrupted, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import collect, resume, train_encoder, train_hierarchy, train_reflex
from hjepa_cli.storage import zoo
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint

QUIET = Screen(quiet=True)
TINY = {
    "control.gains_n": [],
    "encoder.frames": 2,
    "collect.trajectories": 4,
    "collect.test_trajectories": 2,
    "collect.clean_trajectories": 2,
    "collect.steps": 6,
    "collect.clean_steps": 12,
    "encoder.embedding": 16,
    "encoder.hidden": 16,
    "actor.hidden": 16,
    "actor.epochs": 1,
    "actor.batch": 20,
    "hierarchy.shifted_copies": 1,
    "hierarchy.rollout_steps": 4,
    "hierarchy.batch_trajectories": 2,
    "hierarchy.coarse_steps": 1,
    "hierarchy.flat_steps": 1,
    "hierarchy.medium_steps": 1,
    "hierarchy.low_steps": 1,
    "reflex.steps": 3,
    "reflex.batch_packets": 4,
    "reflex.batch_ages": 3,
    "reflex.search_devices": 2,
    "reflex.search_steps": 12,
    "reflex.search_candidates": 4,
    "reflex.search_rounds": 1,
    "reflex.fit_devices": 2,
    "reflex.fit_candidates": 4,
    "reflex.fit_rounds": 1,
    "protocol.warmup_steps": 0,
    "protocol.steps": 12,
    "protocol.gaps": [1, 4, 10],
    "protocol.horizon": 10,
}


def settings(plant_name: str = "desktop", **changes: object) -> Settings:
    changed = {key.replace("__", "."): value for key, value in changes.items()}
    return load_settings(flags=TINY | {"plant": plant_name} | changed)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def prepare(root: Path, options: Settings) -> None:
    """A dataset and a hierarchy of random networks."""
    collect.run(options, QUIET, out=root / "data")
    architecture = train_encoder.describe_architecture(options) | {
        "kind": "hierarchy",
        "h": 4,
        "m": 2,
        "l": 1,
        "actor_hidden": 16,
        "actor_dropout": 0.0,
    }
    kind = plant(options.plant)
    torch.manual_seed(0)
    modules = build_modules(architecture, kind.action_shape, kind.force_signs)
    metadata = {
        "architecture": architecture,
        "plant": options.plant,
        "settings": options.as_dict(),
        "health": {},
    }
    save_checkpoint(root / "model.safetensors", tensors_of(modules), metadata)


def train(root: Path, out: Path, options: Settings) -> dict[str, Any]:
    return train_reflex.run(
        options,
        QUIET,
        dataset=root / "data",
        checkpoint=str(root / "model.safetensors"),
        out=out,
    )


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a hierarchy of random networks, and reflexes trained beside it."""
    root = tmp_path_factory.mktemp("reflex")
    prepare(root, settings())
    train(root, root / "run", settings())
    return root


def test_a_force_that_fades_needs_no_predictor() -> None:
    """An audit found these scores with its own loops, n = 256; their standard error is about .01.

    The gains push towards where the pole falls: u = −K x with negative K.
    """
    kind, gaps, devices, steps = plant("desktop"), (80, 110, 140), 256, 1000
    options = dataclasses.replace(load_settings(flags={"protocol": "paper"}).protocol, steps=steps)
    draws = Draws.make(options, devices, seed=0)
    law_n = np.array([22.8, 10.2, 58.6, 5.5])
    fading = LastForce(
        lambda states: (law_n * states).sum(-1),
        3 * devices,
        tau_steps=8.6,
        force_limit_n=kind.force_limit_n,
    )
    schedules = np.stack([gap_schedule(gap, steps, devices) for gap in gaps])
    found = simulate(kind, draws, schedules, fading, true_state).score.mean(axis=1)
    teacher = Oracle(kind.teacher(), kind.advance, kind.force_limit_n, devices)
    best = simulate(kind, draws, every_step(steps, devices)[None], teacher, true_state).score.mean()
    np.testing.assert_allclose(found / best, [0.918, 0.858, 0.773], atol=0.03)


def deliveries(steps: int, devices: int) -> np.ndarray:
    """Random packets; the last device gets its first one late."""
    arrive = np.random.default_rng(1).random((steps, devices)) < 0.2
    arrive[0, :-1], arrive[:5, -1], arrive[5, -1] = True, False, True
    return arrive


@pytest.mark.parametrize("shape", [(), (2,)])
def test_a_decaying_hold_against_its_formula(shape: tuple[int, ...]) -> None:
    random, devices, tau = np.random.default_rng(0), 4, np.array([2.0, 5.0, 5.0, 30.0])
    gain = np.array([1.0, 0.5, 4.0, 1.0])
    controller = LastForce(
        lambda x: x, devices, gain=gain, tau_steps=tau, force_limit_n=3.0, action_shape=shape
    )
    fresh, age = np.zeros((devices, *shape)), np.zeros(devices)
    for delivered in deliveries(40, devices):
        packets = random.normal(size=(delivered.sum(), *shape))
        assert not delivered.any() or np.abs(packets).max() > 0
        age += 1
        fresh[delivered], age[delivered] = packets, 0
        ahead = controller.planned_n()
        played = controller.act(delivered, packets if delivered.any() else None)
        np.testing.assert_array_equal(played[~delivered], ahead[~delivered])
        factor = (gain * np.exp(-age / tau)).reshape(-1, *[1] * len(shape))
        np.testing.assert_allclose(played, np.clip(factor * fresh, -3, 3), rtol=1e-12)


class InNewton:
    """A reflex as a reaction, with a limit of 2 N."""

    def __init__(self, network: Reflex) -> None:
        self.network, self.stride = network, network.shape[0]
        self.remembers = network.longest_age if network.sees_forces else 0
        self.asked = 0

    def plan(self, z: torch.Tensor, ages: torch.Tensor, sent_n: torch.Tensor) -> torch.Tensor:
        self.asked += len(z)
        sent = sent_n.unsqueeze(1) / 2 if self.remembers else None
        return 2 * self.network.act(z, ages.unsqueeze(1), sent).squeeze(1)


def reflex(*, sees_forces: bool = False, forces_at_once: int = 3, **more: Any) -> Reflex:
    torch.manual_seed(0)
    return Reflex(
        8, 16, longest_age=7, forces_at_once=forces_at_once, sees_forces=sees_forces, **more
    ).eval()


@pytest.mark.parametrize("shape", [(), (2,)])
@pytest.mark.parametrize(("sees_forces", "at_once"), [(False, 3), (True, 1)])
@torch.inference_mode()
def test_a_reflex_is_played_as_it_is_asked(
    shape: tuple[int, ...], sees_forces: bool, at_once: int
) -> None:
    """Device by device, step by step, with the whole history at hand; ages beyond 7 count as 7."""
    network = reflex(sees_forces=sees_forces, forces_at_once=at_once, action_shape=shape)
    devices, steps, reaction = 4, 40, InNewton(network)
    controller = ReflexController(reaction, devices, action_shape=shape)
    last: list[torch.Tensor | None] = [None] * devices
    since: list[list[np.ndarray]] = [[] for _ in range(devices)]
    for delivered in deliveries(steps, devices):
        z = torch.randn(int(delivered.sum()), 8)
        for row, device in enumerate(np.flatnonzero(delivered)):
            last[device], since[device] = z[row], []
        asked, ahead = reaction.asked, controller.planned_n()
        played = controller.act(delivered, z if delivered.any() else None)
        np.testing.assert_array_equal(played[~delivered], ahead[~delivered])
        assert reaction.asked - asked <= devices + delivered.sum()
        for device in range(devices):
            packet = last[device]
            if packet is None:
                assert not played[device].any()
                continue
            age = len(since[device])
            begun = age - age % at_once
            sent = torch.zeros(1, 1, 7, *shape)
            for step, force_n in enumerate(since[device][:7]):
                sent[0, 0, step] = torch.as_tensor(force_n) / 2
            ages = torch.tensor([[begun]])
            plan = network.act(packet[None], ages, sent if sees_forces else None)[0, 0]
            np.testing.assert_allclose(played[device], 2 * plan[age - begun], atol=1e-6)
            since[device].append(played[device])


@pytest.mark.parametrize("mirror", [(-1.0,), (1.0, -1.0)])
@pytest.mark.parametrize("sees_forces", [False, True])
def test_reflexes_commute_with_the_mirror(mirror: tuple[float, ...], sees_forces: bool) -> None:
    shape, signs = (len(mirror),), torch.tensor(mirror)
    z, ages, sent = torch.randn(5, 8), torch.arange(10).reshape(5, 2), torch.randn(5, 2, 7, *shape)
    for exact in (True, False):
        network = reflex(
            sees_forces=sees_forces, action_shape=shape, mirror=mirror if exact else None
        )
        straight = network(z, ages, sent if sees_forces else None)
        flipped = network(reflect(z), ages, signs * sent if sees_forces else None)
        assert torch.allclose(flipped, signs * straight, atol=1e-6) is exact


@pytest.mark.parametrize("name", ["desktop", "quadrotor"])
def test_plans_are_what_the_oracle_plays(name: str) -> None:
    kind = plant(name)
    limit_n, count = kind.force_limit_n, len(kind.state_names)
    states = 0.2 * np.random.default_rng(0).normal(size=(6, count))
    oracle = Oracle(kind.teacher(), kind.advance, limit_n, 6, states=count)
    expected = play(oracle, states, 6, 20)
    plans = reflex_training.follow(kind, kind.teacher(), states, 20)
    np.testing.assert_allclose(limit_n * plans.teacher, expected, atol=1e-5)
    sides = np.tile(kind.force_signs, (6, 1))
    mirrored = reflex_training.follow(kind, kind.teacher(), states, 20, sides=sides).teacher
    signs = np.reshape(kind.force_signs, kind.action_shape)
    np.testing.assert_allclose(limit_n * mirrored, signs * expected, atol=1e-5)


def test_plans_with_exploration_answer_the_state_that_the_pushes_lead_to() -> None:
    kind, stream = plant("desktop"), np.random.default_rng(0)
    states = 0.05 * stream.normal(size=(6, 4))
    pushes_n = reflex_training.pushes(
        kind, 6, 25, exploration_n=1.0, hold_steps=10, generator=stream
    )
    assert pushes_n.shape == (6, 25) and (pushes_n[:, :10] == pushes_n[:, :1]).all()
    plans = reflex_training.follow(kind, kind.teacher(), states, 25, pushes_n=pushes_n)
    for age in range(25):
        force_n = kind.teacher()(states)
        np.testing.assert_allclose(20 * plans.teacher[:, age], force_n, atol=1e-5)
        states = kind.advance(states, np.clip(force_n + pushes_n[:, age], -20, 20))
        np.testing.assert_allclose(
            plans.sent[:, age] - plans.teacher[:, age], pushes_n[:, age] / 20, atol=1e-6
        )


def test_a_loss_asks_for_the_right_forces_and_sees_the_past_alone() -> None:
    network = reflex(sees_forces=True, forces_at_once=1)
    z, forces = torch.randn(3, 8), torch.randn(3, 9)
    drawn = torch.tensor([2, 0]), torch.tensor([[4, 1], [7, 0]])

    def loss(sent: torch.Tensor) -> float:
        plans = reflex_training.Plans(forces, sent)
        return reflex_training.reflex_loss(network, z, plans, *drawn).item()

    sent = torch.randn(3, 9)
    past = torch.zeros(2, 2, 7)
    past[0, 0, :4], past[0, 1, :1], past[1, 0] = sent[2, :4], sent[2, :1], sent[0, :7]
    answer = network(z[[2, 0]], drawn[1], past)[..., 0]
    labels = torch.stack([forces[2, [4, 1]], forces[0, [7, 0]]])
    expected = (answer - labels).square().mean()
    assert loss(sent) == pytest.approx(expected.item(), rel=1e-5)
    later = sent.clone()
    later[2, 4:] += 1.0
    assert loss(later) == loss(sent)


def test_gains_at_rest_are_the_teachers() -> None:
    quadrotor, desktop = plant("quadrotor"), plant("desktop")
    a, b = linearise(quadrotor.advance, np.zeros(6), np.zeros(2))
    expected = lqr_gain(a, b, quadrotor.state_weights, quadrotor.force_weights)
    np.testing.assert_allclose(gains_at_rest(quadrotor.teacher(), 6), expected, atol=1e-5)
    still = gains(desktop, np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(gains_at_rest(desktop.teacher(), 4), still, rtol=1e-3)


def test_a_search_finds_the_top_of_a_hill() -> None:
    top = np.array([0.5, -1.0, 2.0])
    found = best(
        lambda drawn: -np.square(drawn - top).sum(axis=1),
        np.zeros(3),
        np.ones(3),
        candidates=20,
        rounds=40,
        seed=0,
    )
    np.testing.assert_allclose(found, top, atol=0.05)


@pytest.mark.parametrize("late", [{}, {"delay_steps": 5, "jitter_steps": 4}], ids=["ideal", "late"])
@pytest.mark.parametrize("name", ["desktop", "quadrotor"])
def test_searches_move_devices_as_the_loop_does(name: str, late: dict[str, int]) -> None:
    """Pymunk and the exact equations are not the same to the last bit, so a step may differ."""
    kind = plant(name)
    ideal = load_settings(flags={"plant": name, "protocol": "paper"}).protocol
    options = dataclasses.replace(ideal, **late)
    trial, on_time = (
        Trial.make(kind, kind.teacher(), one, devices=3, steps=60, seed=0)
        for one in (options, ideal)
    )
    assert np.array_equal(trial.teacher, on_time.teacher)  # who is never late
    law_n, taus = gains_at_rest(kind.teacher(), len(kind.state_names)), (4.0, 20.0)
    found = decay_fit.shares_of_laws(trial, np.stack([law_n, 2 * law_n]), np.array(taus))
    for number, tau in enumerate(taus):

        def act(states: np.ndarray, times: int = 1 + number) -> np.ndarray:
            forces_n = -times * states @ law_n.T
            return forces_n.reshape(len(states), *kind.action_shape)

        loops = 3 * len(trial.gaps)
        shape = kind.action_shape
        fading = LastForce(
            act, loops, tau_steps=tau, force_limit_n=kind.force_limit_n, action_shape=shape
        )
        shares = trial.shares(fading, true_state)
        rows = slice(number * len(trial.gaps), (number + 1) * len(trial.gaps))
        np.testing.assert_allclose(found[rows], shares, atol=1.5 / 60)


def test_late_packets_are_met_by_a_force_that_is_made_for_one_gap() -> None:
    """By the gap that is tolerated a search cannot tell candidates that fail at short ones."""
    flags = {"protocol": "paper", "protocol.delay_steps": 40}
    kind, options = plant("desktop"), load_settings(flags=flags).protocol
    drawn = {"devices": 8, "steps": 300, "seed": 0}
    trial = Trial.make(kind, kind.teacher(), options, gap_steps=60, **drawn)
    assert trial.gaps.tolist() == [60.0]
    assert Trial.make(kind, kind.teacher(), options, **drawn).gaps.tolist() != [60.0]
    law, _ = decay_fit.search_law(trial, candidates=24, rounds=8, seed=0)
    own = gains_at_rest(kind.teacher(), 4)
    both = np.stack([law.gains_n, own]), np.array([law.tau_steps, law.tau_steps])
    found, teacher = trial.quality(decay_fit.shares_of_laws(trial, *both))
    assert found > teacher + 0.02
    with pytest.raises(UsageError, match=r"gap_steps = 13, and reflex\.search_steps = 12"):
        check_settings(settings(reflex__gap_steps=13))


def test_a_search_beats_the_law_that_it_starts_from() -> None:
    """On other draws than the search's; the teacher's own gains, held, tolerate nothing here."""
    kind, options = plant("gym"), load_settings("gym", flags={"protocol": "paper"}).protocol
    trial = Trial.make(kind, kind.teacher(), options, devices=8, steps=150, seed=0)
    law, _ = decay_fit.search_law(trial, candidates=24, rounds=4, seed=0)
    other = Trial.make(kind, kind.teacher(), options, devices=24, steps=150, seed=5)
    teacher_n = gains_at_rest(kind.teacher(), 4)
    both = np.stack([law.gains_n, teacher_n]), np.array([law.tau_steps, 1e6])
    found, held = other.quality(decay_fit.shares_of_laws(other, *both))
    assert found > held + 0.1


def test_a_run_says_what_it_found_and_repeats_to_the_last_bit(
    workplace: Path, tmp_path: Path
) -> None:
    result = train(workplace, workplace / "run", settings())  # finished: told again
    again = train(workplace, tmp_path / "again", settings())
    first = load_checkpoint(Path(result["checkpoint"]))
    assert load_checkpoint(Path(again["checkpoint"])).digest == first.digest
    said = first.metadata["reflex"]
    assert np.shape(said["law"]["gains_n"]) == (1, 4) and said["tau_steps"] > 0
    assert said["fitted"]["seed"] == decay_fit.SEARCH_SEED
    assert result["nmae_windows"].keys() == {name for name in METHODS if METHODS[name].reflex}
    rows = (workplace / "run" / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows] == ["level", "chunk", "chunk_forces"]


def test_encoder_and_actor_are_the_models(workplace: Path) -> None:
    source = load_checkpoint(workplace / "model.safetensors").tensors
    taken = load_checkpoint(workplace / "run" / "model.safetensors").tensors
    for name, array in source.items():
        if name.startswith(("encoder.", "actor.")):
            rounded = torch.from_numpy(array).bfloat16().float().numpy()
            kept = taken[name]
            assert (kept == rounded).all() or (kept == array).all(), name  # weights, or statistics


@pytest.mark.parametrize("stop", [2, 5])  # in the first network and in the second
def test_an_interrupted_run_ends_in_the_same_bytes(
    workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    update, seen = Optimiser.step, 0

    def step(self: Optimiser, *rest: Any) -> float:
        nonlocal seen
        seen += 1
        if seen == stop:
            os.kill(os.getpid(), signal.SIGINT)
        return update(self, *rest)

    with monkeypatch.context() as patched, pytest.raises(Interrupted):
        patched.setattr(Optimiser, "step", step)
        train(workplace, tmp_path / "run", settings())
    assert (tmp_path / "run" / PROGRESS_FILE).exists()
    resume.run(tmp_path / "run", QUIET)
    for name in ("model.safetensors", "metrics.csv"):
        expected = (workplace / "run" / name).read_bytes()
        assert (tmp_path / "run" / name).read_bytes() == expected, name


def test_two_forces_and_six_states_train_and_play(tmp_path: Path) -> None:
    options = settings("quadrotor")
    prepare(tmp_path, options)
    model = Model.load(Path(train(tmp_path, tmp_path / "run", options)["checkpoint"]), "cpu")
    assert methods_of(model) == tuple(name for name in METHODS if METHODS[name].reflex)
    assert np.shape(model.metadata["reflex"]["law"]["gains_n"]) == (2, 6)
    draws = Draws.make(options.protocol, 3, seed=0)
    schedule = gap_schedule(5, draws.steps, 3)[None]
    for name in methods_of(model):
        method = build_driver(name, options, model)
        forces: list[np.ndarray] = []
        simulate(
            plant("quadrotor"),
            draws,
            schedule,
            method.controller(3),
            method.sensor,
            watch=lambda k, states, forces_n, kept=forces: kept.append(forces_n),
        )
        assert np.shape(forces) == (draws.steps, 3, 2) and np.abs(forces).max() > 0
        assert method.bits_per_transmission == 16 * 8 + 16


def test_a_method_that_fades_is_the_actor_times_its_decay(workplace: Path) -> None:
    model = Model.load(workplace / "run" / "model.safetensors", "cpu")
    z = torch.randn(3, 16)
    for name, actor in (("hold-decay", model.actor), ("hold-decay-linear", model.law)):
        decay = model.decays[name]
        played = play(build_driver(name, settings(), model).controller(3), z, 3, 9)
        with torch.inference_mode():
            fresh_n = actor(z).numpy().astype(float)
        factors = decay.gain * np.exp(-np.arange(9) / decay.tau_steps)
        expected = np.clip(fresh_n[:, None] * factors, -20, 20)
        np.testing.assert_allclose(played, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tau_steps": 0}, "tau_steps = 0"),
        ({"tau_steps": -1.0}, "tau_steps = -1"),
        ({"gain": "1"}, "finite numbers"),
        ({"gain": True}, "finite numbers"),
        ({"gain": None}, "finite numbers"),
        ({"law": {"gains_n": [[1.0] * 4], "gain": 1.0}}, "tau_steps"),
        ({"law": {"gains_n": [[1.0] * 3], "gain": 1.0, "tau_steps": 1.0}}, "1 forces on 4 states"),
        ({"law": {"gains_n": [[1.0] * 4] * 2, "gain": 1.0, "tau_steps": 1.0}}, "1 forces"),
        ({"law": {"gains_n": 3, "gain": 1.0, "tau_steps": 1.0}}, "len"),
        ({"law": None}, "NoneType"),
    ],
)
def test_damaged_metadata_are_refused(
    workplace: Path, tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    good = load_checkpoint(workplace / "run" / "model.safetensors")
    metadata = good.metadata | {"reflex": good.metadata["reflex"] | change}
    save_checkpoint(tmp_path / "bad.safetensors", good.tensors, metadata)
    with pytest.raises(DataError, match="does not say how its forces fade") as caught:
        Model.load(tmp_path / "bad.safetensors")
    assert says in caught.value.message


def test_tensors_of_another_length_are_refused(workplace: Path, tmp_path: Path) -> None:
    good = load_checkpoint(workplace / "run" / "model.safetensors")
    for key, value in (("longest_age", 9), ("forces_at_once", 3)):
        metadata = good.metadata | {"architecture": good.metadata["architecture"] | {key: value}}
        save_checkpoint(tmp_path / "bad.safetensors", good.tensors, metadata)
        with pytest.raises(DataError, match="does not fit its architecture"):
            Model.load(tmp_path / "bad.safetensors")


def test_a_hierarchy_can_be_trained_on_its_encoder(workplace: Path, tmp_path: Path) -> None:
    result = train_hierarchy.run(
        settings(),
        QUIET,
        dataset=workplace / "data",
        encoder=str(workplace / "run"),
        out=tmp_path / "hierarchy",
    )
    model = Model.load(Path(result["checkpoint"]), "cpu")
    assert "hjepa" in methods_of(model) and "longest_age" not in model.architecture


@pytest.fixture
def shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


def test_models_that_do_not_fit_are_refused(workplace: Path, shell: Shell) -> None:
    data = workplace / "data"
    encoder = load_checkpoint(workplace / "model.safetensors")
    lone = encoder.metadata | {
        "architecture": encoder.metadata["architecture"] | {"kind": "encoder"}
    }
    save_checkpoint(shell.directory / "lone.safetensors", encoder.tensors, lone)
    given = ("train-reflex", "--dataset", data, "--out", "r", "--checkpoint")
    refused = shell(*given, "lone.safetensors")
    assert_one_line_error(refused, 65, "holds no actor", "hjepa train-hierarchy")
    says = f"was trained on plant gym, dataset {data} is of plant desktop"
    assert_one_line_error(shell(*given, "gym-h4m2l1"), 65, says, "hint: hjepa train-hierarchy")
    given_to = ("train-hierarchy", "--dataset", data, "--dry-run", "--encoder", "gym-h4m2l1")
    assert_one_line_error(shell(*given_to), 65, says, "hint: hjepa train-encoder --plant desktop")
    given_to = ("train-fusion", "--dataset", data, "--dry-run", "--checkpoint", "gym-h4m2l1")
    assert_one_line_error(shell(*given_to), 65, says, "hint: hjepa train-hierarchy")
    assert_one_line_error(shell(*given, "no-model"), 66, "no-model")
    assert not (shell.directory / "r").exists()


def test_a_dry_run_plans_and_writes_nothing(workplace: Path, shell: Shell) -> None:
    with shell.untouched():
        planned = shell(
            *("train-reflex", "--preset", "smoke", "--dataset", workplace / "data"),
            *("--checkpoint", workplace / "model.safetensors", "--dry-run", "--json"),
        )
    assert planned.code == 0 and "train 2 networks for 10 steps" in planned.out


def test_eval_says_how_to_train_what_is_missing(
    workplace: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zoo, "list_models", list)  # which has the reflexes of another model
    (shell.directory / "tiny.toml").write_text(
        "[protocol]\nwarmup_steps = 0\nsteps = 12\ngaps = [1, 4]\ncurve_devices = 2\n"
        "bracket_devices = 2\n"
        "bracket = 0.9\nhorizon = 8\n[collect]\nclean_trajectories = 2\nclean_steps = 9\n"
    )
    outcome = shell(
        *("eval", "--config", "tiny.toml", "--methods", "oracle,hold-decay", "--checkpoint"),
        workplace / "model.safetensors",
    )
    assert outcome.code == 0, outcome
    assert "hold-decay skipped, no model of it here: hjepa train-reflex" in outcome.err
