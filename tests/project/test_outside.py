"""Arrays from outside: of any layout if they are right, one clear error if they are not."""

import numpy as np
import pytest
import torch

import hjepa_cli
from hjepa_cli.core.radio import channel
from hjepa_cli.errors import ArrayError, HjepaError, NumericalError, UsageError


@pytest.fixture(scope="module")
def model():
    return hjepa_cli.load_model("desktop-h4m2l1")


@pytest.fixture(scope="module")
def frames(model):
    chance = np.random.default_rng(0)
    return chance.integers(0, 256, (3, model.frames, 64, 128, 3), np.uint8)


def test_any_memory_layout_is_read_right(model, frames):
    whole = model.encode(frames)
    read_only = frames.copy()
    read_only.setflags(write=False)
    wide = np.zeros((*frames.shape[:3], 256, 3), np.uint8)
    wide[..., ::2, :] = frames
    for same in (
        read_only,
        np.asfortranarray(frames),
        wide[..., ::2, :],
        frames[::-1].copy()[::-1],
        frames[..., ::-1].copy()[..., ::-1],
        torch.from_numpy(frames),
        frames.tolist() and list(frames),
    ):
        assert torch.equal(model.encode(same), whole)


def test_an_empty_batch_has_no_embeddings(model, frames):
    assert model.encode(frames[:0]).shape == (0, 256)
    assert model.actor(torch.zeros(0, 256)).shape == (0,)
    forces_n, z = hjepa_cli.predict(model, torch.zeros(0, 256), 5)
    assert forces_n.shape == (0, 5) and z.shape == (0, 256)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda f: f / 255, r"float64 \[3, K, 64, 128, 3\] from 0 to 1"),
        (lambda f: f.astype(np.float32), r"float32 \[3, K, 64, 128, 3\] from 0 to 255"),
        (lambda f: f.astype(np.int64), r"int64 \[3, K, 64, 128, 3\]"),
        (lambda f: f > 128, r"bool \[3, K, 64, 128, 3\]"),
        (lambda f: np.moveaxis(f, -1, 2), r"uint8 \[3, K, 3, 64, 128\]"),
        (lambda f: np.swapaxes(f, 2, 3), r"uint8 \[3, K, 128, 64, 3\]"),
        (lambda f: f[:, :, ::2, ::2], r"uint8 \[3, K, 32, 64, 3\]"),
        (lambda f: f[:, :1], r"uint8 \[3, 1, 64, 128, 3\]"),
        (lambda f: f[0], r"uint8 \[K, 64, 128, 3\]"),
        (lambda f: f[..., :1], r"uint8 \[3, K, 64, 128, 1\]"),
        (lambda f: f.astype(object), "object"),
        (lambda f: f.astype(complex), "complex"),
        (lambda f: "frames", "<U6"),
        (lambda f: None, "object"),
        (lambda f: [[1], [2, 3]], "no array"),
    ],
)
def test_other_pictures_are_refused_with_what_they_are(model, frames, change, found):
    with pytest.raises(ArrayError, match=found.replace("K", str(model.frames))) as caught:
        model.encode(change(frames))
    assert caught.value.exit_code == 2


def test_pictures_that_are_not_finite_are_still_named_so(model, frames):
    with pytest.raises(NumericalError, match="expected finite"):
        model.encode(np.where(frames > 250, np.nan, frames / 255))


@pytest.mark.parametrize(
    "z",
    [
        torch.zeros(3, 255), torch.zeros(256), torch.zeros(3, 256, dtype=torch.int64),
        np.zeros((3, 255)), np.zeros((256, 3)), "z", None, [[1.0], [1.0, 2.0]],
        torch.zeros(3, 256, dtype=torch.complex64),
    ],
)  # fmt: skip
def test_other_embeddings_are_refused(model, z):
    for answer in (model.act, model.actor, lambda z: hjepa_cli.predict(model, z, 3)):
        with pytest.raises(ArrayError):
            answer(z)


def test_embeddings_may_be_arrays_of_any_layout(model, frames):
    z = model.encode(frames)
    read_only = z.numpy().copy()[::-1]
    read_only.setflags(write=False)
    assert torch.equal(model.actor(read_only[::-1]), model.actor(z))
    assert torch.equal(hjepa_cli.predict(model, z.double().numpy(), 3)[0],
                       hjepa_cli.predict(model, z, 3)[0])  # fmt: skip
    for bad in (np.nan, np.inf):
        wrong = z.clone()
        wrong[0, 0] = bad
        with pytest.raises(NumericalError):
            hjepa_cli.predict(model, wrong, 3)


STATES = [np.zeros(4), np.zeros((2, 3)), np.zeros((4, 2)), "x", None, [[1], [1, 2]], 3.0,
          np.zeros((2, 4), complex)]  # fmt: skip


@pytest.mark.parametrize("states", STATES)
def test_other_states_are_refused_by_the_camera(states):
    with pytest.raises(ArrayError):
        hjepa_cli.Camera("desktop").render(states)


@pytest.mark.parametrize("states", STATES[1:])
def test_other_states_are_refused_by_teachers_and_cart_poles(states):
    with pytest.raises(ArrayError):
        hjepa_cli.teacher("desktop")(states)
    pole = hjepa_cli.CartPole("desktop", seed=1)
    before = pole.state
    scalar = states is None or isinstance(states, float)
    for set_ in (
        lambda: setattr(pole, "state", states),
        lambda: pole.step(0.0, noise=np.zeros(3) if scalar else states),
        lambda: pole.step("force" if scalar else states),
    ):
        with pytest.raises(ArrayError):
            set_()
    assert (pole.state == before).all()


def test_states_may_have_any_layout(model):
    states = np.random.default_rng(0).uniform(-0.1, 0.1, (5, 4))
    turned = np.asfortranarray(states)[::-1]
    turned.setflags(write=False)
    for see in (hjepa_cli.Camera("desktop").render, hjepa_cli.teacher("desktop")):
        assert (see(turned[::-1]) == see(states)).all()
        assert len(see(states[:0])) == 0
        assert (see(states.tolist()) == see(states)).all()


@pytest.mark.parametrize("bad", ["x", None, [1, 2], 1j, float("nan"), 0])
def test_other_links_are_refused(bad):
    quick = {"protocol": "paper", "protocol.steps": 3}
    with pytest.raises(HjepaError):
        hjepa_cli.drive("oracle", devices=bad, settings=quick)
    if bad is not None:
        with pytest.raises(UsageError):
            hjepa_cli.drive("oracle", gap_steps=bad, settings=quick)
        with pytest.raises(UsageError):
            hjepa_cli.drive("oracle", delivery=bad if bad != 0 else -1, settings=quick)


def test_the_radio_refuses_what_is_no_array_or_does_not_go_together():
    three, four = np.full(3, 2.0), np.full(4, 2.0)
    hall = {"clutter_density": 0.2, "clutter_size_m": 5.0, "clutter_height_m": 3.0,
            "bs_height_m": 6.0, "ue_height_m": 1.0}  # fmt: skip
    for wrong in (four, "x", None, [[1], [1, 2]], 1j, np.nan):
        for call in (
            lambda wrong=wrong: channel.path_loss_db("InF-SH", three, wrong),
            lambda wrong=wrong: channel.outage_probability(three, 1.0, wrong),
            lambda wrong=wrong: channel.line_of_sight_probability(
                "InF-SH", three, **hall | {"clutter_size_m": wrong}
            ),
            lambda wrong=wrong: channel.received_snr_db(three, wrong, 1.0),
            lambda wrong=wrong: channel.thermal_noise_dbm(three, wrong),
            lambda wrong=wrong: channel.achievable_rate_bps(three, wrong),
        ):
            with pytest.raises(HjepaError):
                call()
