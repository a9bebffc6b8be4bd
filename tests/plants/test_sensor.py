"""Lens and sensor against closed forms; without them pictures and records are what they were."""

import dataclasses
import json
import math

import numpy as np
import pytest

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import CameraSettings, SensorSettings, Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.plants import corruptions
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.core.plants.frames import frames_of, same_camera
from hjepa_cli.core.plants.named import camera_of, plant, seen_as_trained, sensor_in
from hjepa_cli.core.plants.sensor import OPEN, Sensed, on_the_ground, rates_of
from hjepa_cli.errors import UsageError

ROWS, COLUMNS = np.mgrid[:64, :128]
USUAL = CameraSettings()
NOISY = {"shot_noise": 5.0, "read_noise": 4.0}


def seen(states, name="desktop", size=USUAL, **sensor):
    return camera_of(plant(name), size, SensorSettings(**sensor)).render(np.asarray(states, float))


def empty(count):
    """States of which nothing is in the picture, each another."""
    return [[100.0 + i, 0, 0, 0] for i in range(count)]


def test_off_is_the_camera_itself_and_leaves_no_trace():
    kind = plant("desktop")
    for sensor in (SensorSettings(), SensorSettings(ideal=True)):
        assert type(camera_of(kind, CameraSettings(), sensor)) is type(kind.camera())
    assert type(actual_camera(load_settings())) is type(kind.camera())
    assert "sensor" not in Settings().as_dict() and "sensor" in Settings().as_dict(complete=True)
    on = Settings(sensor=SensorSettings(vignette=0.1))
    assert sensor_in(json.loads(json.dumps(on.as_dict()))) == on.sensor
    # A sensor that does next to nothing changes nothing: the same bytes by the other way.
    states = np.random.default_rng(0).normal(size=(40, 4)) * [0.02, 0.3, 0.3, 2]
    np.testing.assert_array_equal(seen(states, vignette=1e-9), kind.camera().render(states))


def test_a_vignette_falls_with_the_square_of_the_distance():
    (frame,) = seen(empty(1), white=200.0, vignette=0.4)
    middle = 31.5, 63.5
    for row, column in ((0, 0), (63, 127), (31, 64), (10, 90), (50, 3)):
        reach = math.hypot(row - middle[0], column - middle[1]) / math.hypot(*middle)
        assert abs(frame[row, column, 0] - 200 * (1 - 0.4 * reach**2)) <= 0.501


@pytest.mark.parametrize("share", [-0.2, 0.1, 0.3])
def test_a_lens_moves_the_sides_of_a_pole_to_the_roots_of_its_polynomial(share):
    """What is seen at a radius r lies at r (1 + k r²/R²), so what lies at a is seen at a root."""
    x_m = np.array([-0.2, 0.14, 0.22])
    states = np.stack([x_m, *np.zeros((3, 3))], axis=1)
    camera = plant("desktop").camera().manifest()
    scale, width_m = camera["scale_px_m"], camera["pole_size_m"][0]
    frames = seen(states, distortion=share)
    dark = 255.0 - frames[:, 31:33, :, 1].astype(float).mean(1)  # the rows about the middle
    column = (dark * (np.arange(128) + 0.5)).sum(1) / dark.sum(1) - 64

    def seen_at(a):
        roots = np.roots([share / (31.5**2 + 63.5**2), 0, 1, -a])
        (root,) = (r.real for r in roots if abs(r.imag) < 1e-9 and abs(r.real) < 64)
        return root

    for middle, found in zip(x_m * scale, column, strict=True):
        sides = [seen_at(middle + side * width_m / 2 * scale) for side in (-1, 1)]
        assert abs(np.mean(sides) - middle) > 0.4, "or the test says nothing"
        # Between pixels it is linear, and a pixel there is not as wide as one here.
        assert abs(found - np.mean(sides)) < 0.08


def test_stains_are_behind_what_is_seen():
    states = np.array([[0.0, 0, 0.1, 0], [0.05, 0, -0.4, 0]])
    ideal, stained = seen(states).astype(int), seen(states, texture=40.0).astype(int)
    loss = ideal - stained
    ground, hidden = (ideal == 255).all(-1), (ideal == [160, 0, 0]).all(-1)
    assert hidden.sum() > 50 and (loss[hidden] == 0).all()
    assert loss.min() >= 0 and loss[ground].max() == 40 and loss[ground].min() == 0
    both = ground.all(0)  # the stains do not move with the plant
    np.testing.assert_array_equal(loss[0][both], loss[1][both])


@pytest.mark.parametrize("channels", [1, 3])
def test_ground_is_the_darkest_channel_to_the_last_bit(monkeypatch, channels):
    pictures = np.random.default_rng(0).uniform(0, 255, (2, 1, 8, 16, channels)).astype(np.float32)
    grounds = []
    monkeypatch.setattr(
        corruptions, "texture", lambda ground, *rest: (grounds.append(ground), ground)[1]
    )
    assert np.array_equal(on_the_ground(pictures, 9.0), pictures)
    np.testing.assert_array_equal(grounds[0], pictures.min(axis=-1, keepdims=True))


@pytest.mark.parametrize("exposure_ms", [5.0, 20.0])
def test_a_moving_edge_is_as_wide_as_its_way_during_the_exposure(exposure_ms):
    """Coverage of a pixel from c by an edge at e is clip(e − c, 0, 1); its mean over the way w."""
    camera, speed_m_s, x_m = plant("gym").camera().manifest(), 5.0, 0.23
    scale = camera["scale_px_m"]
    way_px, last_px = scale * speed_m_s * 1e-3 * exposure_ms, 64 + x_m * scale
    (frame,) = seen([[x_m, speed_m_s, 0, 0]], "gym", exposure_ms=exposure_ms)
    dark = 1 - frame[49, :, 0] / 255.0  # a row of the cart, below the pole
    half_px = camera["cart_size_m"][0] / 2 * scale
    columns = np.arange(128)

    def left_of(edge_px):
        """The integral of clip(u, 0, 1) from 0 to edge − column."""
        u = edge_px - columns
        return np.where(u < 0, 0, np.where(u < 1, u**2 / 2, u - 0.5))

    def covered(edge_px):
        return (left_of(edge_px) - left_of(edge_px - way_px)) / way_px

    exact = covered(last_px + half_px) - covered(last_px - half_px)
    # The midpoint rule errs by h²/8 at each of two kinks; grey levels are rounded twice.
    moment_px = way_px / OPEN
    error = 2 * moment_px**2 / 8 / way_px + 1 / 255
    assert np.abs(dark - exact).max() < error
    # As a length: an edge at rest is partly seen in one pixel at most, this one on all of its way.
    right = dark[round(last_px - way_px / 2) :]  # from the middle of the cart on
    partly = ((right > error) & (right < 1 - error)).sum()
    assert abs(partly - way_px) <= 1 and way_px > 0.6


def test_an_exposure_ends_at_the_state_and_begins_where_the_plant_was():
    """Against the plant's own equations: pictures along the true way, without a force."""
    kind = plant("gym")
    start = np.array([[0.1, 0.5, 0.2, 2.0]])
    end = kind.advance(start, np.zeros(1))
    blurred = seen(end, "gym", exposure_ms=20.0).astype(float)
    share = np.linspace(0, 1, 41)[:, None]
    # Hermite's cubic between the two, with the rates in them.
    rates = rates_of(kind.state_names)
    h00, h10 = 2 * share**3 - 3 * share**2 + 1, share**3 - 2 * share**2 + share
    h01, h11 = 3 * share**2 - 2 * share**3, share**3 - share**2
    way = h00 * start + h01 * end + 0.02 * (h10 * start @ rates + h11 * end @ rates)
    true = seen(way, "gym").astype(float).mean(0)
    ideal = seen(end, "gym").astype(float)
    assert np.abs(blurred - true).mean() < 0.1 * np.abs(ideal - true).mean()


@pytest.mark.parametrize("bayer", [True, False])
def test_noise_has_the_moments_of_each_colour_of_the_mosaic(bayer):
    """σ² is read² + shot² v/255; filling in averages 2 or 4 values, or 5 where green is seen."""
    frames = seen(empty(60), white=150.0, bayer=bayer, **NOISY)[:, 2:-2, 2:-2].astype(float)
    raw = 4.0**2 + 5.0**2 * 150 / 255
    odd_row, odd_column = ROWS[2:-2, 2:-2] % 2, COLUMNS[2:-2, 2:-2] % 2
    places = {"R": (0, 0), "G of R": (0, 1), "G of B": (1, 0), "B": (1, 1)}
    shares = {  # of the raw variance, in red, green, blue
        "R": (1, 1 / 4, 1 / 4),
        "G of R": (1 / 2, 5 / 16, 1 / 2),
        "G of B": (1 / 2, 5 / 16, 1 / 2),
        "B": (1 / 4, 1 / 4, 1),
    }
    for place, (row, column) in places.items():
        values = frames[:, (odd_row == row) & (odd_column == column)]
        for channel in range(3):
            share = shares[place][channel] if bayer else 1
            of = values[..., channel]
            # 60 · 1,860 values; neighbours share some of theirs, so about 1 % is one deviation.
            assert of.var() == pytest.approx(share * raw + 1 / 12, rel=0.04)
            assert of.mean() == pytest.approx(150, abs=0.15)
    if not bayer:
        colours = frames.reshape(-1, 3)
        assert np.abs(np.corrcoef(colours.T) - np.eye(3)).max() < 0.01


def test_shot_noise_grows_with_the_light():
    bright, dim = (
        seen(empty(10), white=white, shot_noise=8.0).astype(float).var() for white in (180.0, 45.0)
    )
    assert bright - 1 / 12 == pytest.approx(64 * 180 / 255, rel=0.03)
    assert dim - 1 / 12 == pytest.approx(64 * 45 / 255, rel=0.03)


def test_a_picture_is_the_same_alone_among_others_and_as_part_of_a_packet():
    states = np.random.default_rng(1).normal(size=(70, 4)) * [0.02, 0.3, 0.3, 2]
    options = {"texture": 20.0, "distortion": 0.1, "exposure_ms": 0.5, "bayer": True, **NOISY}
    together = seen(states, **options)
    for index in (0, 33, 69):
        np.testing.assert_array_equal(seen(states[[index]], **options)[0], together[index])
    camera = camera_of(plant("desktop"), CameraSettings(), SensorSettings(**options))
    film = frames_of(camera, states.reshape(35, 2, 4), 4)
    np.testing.assert_array_equal(film.reshape(together.shape), together)
    nearly = seen(states + 1e-9, read_noise=4.0)
    assert (nearly != seen(states, read_noise=4.0)).mean() > 0.5, "other states, other noise"


def test_pictures_of_another_size_have_their_own_pixels():
    size = CameraSettings(32, 48, grey=True)
    frames = seen(empty(40), size=size, white=128.0, vignette=0.5, read_noise=6.0)
    assert frames.shape == (40, 32, 48, 1)
    assert frames[:, 16, 24].mean() == pytest.approx(128, abs=4 * 6 / math.sqrt(40))
    assert frames[:, 0, 0].mean() == pytest.approx(64, abs=4 * 6 / math.sqrt(40))


def test_the_manifest_says_what_the_sensor_does_and_nothing_else():
    options = {"vignette": 0.2, "bayer": True}
    camera = camera_of(plant("desktop"), CameraSettings(), SensorSettings(**options))
    assert isinstance(camera, Sensed)
    ideal = plant("desktop").camera()
    assert camera.manifest() == ideal.manifest() | {"sensor": {"version": 1, **options}}
    assert same_camera(json.loads(json.dumps(camera.manifest())), camera)
    assert not same_camera(ideal.manifest(), camera)
    assert sensor_in(camera.manifest()) == SensorSettings(**options)
    assert sensor_in(ideal.manifest()) == SensorSettings()


def test_a_model_brings_its_sensor_unless_settings_have_one():
    trained = {"sensor": {"vignette": 0.3}}
    assert seen_as_trained(Settings(), trained).sensor == SensorSettings(vignette=0.3)
    for own in (SensorSettings(read_noise=2.0), SensorSettings(ideal=True)):
        assert seen_as_trained(Settings(sensor=own), trained).sensor == own
    ideal = seen_as_trained(Settings(sensor=SensorSettings(ideal=True)), trained)
    assert type(actual_camera(ideal)) is type(plant("desktop").camera())


@pytest.mark.parametrize(
    ("plant_name", "camera", "sensor", "message"),
    [
        ("desktop", {}, {"exposure_ms": 1.5}, "exposure_ms = 1.5; .* exposed for 1 ms at most"),
        ("desktop", {"grey": True}, {"bayer": True}, "a mosaic of colours; these pictures are"),
    ],
)
def test_what_a_camera_cannot_have_is_refused(plant_name, camera, sensor, message):
    with pytest.raises(UsageError, match=message):
        camera_of(plant(plant_name), CameraSettings(**camera), SensorSettings(**sensor))


def test_an_exposure_needs_rates():
    class Odd:
        name, step_s, state_names = "odd", 0.01, ("angle", "speed")

    with pytest.raises(UsageError, match="plant odd has angle, speed"):
        Sensed(plant("desktop").camera(), Odd(), SensorSettings(exposure_ms=1.0))


def test_recordings_have_been_taken_already():
    settings = load_settings("recorded")
    check_settings(settings)
    with pytest.raises(UsageError, match="pictures of a recorded plant have been taken"):
        check_settings(dataclasses.replace(settings, sensor=SensorSettings(read_noise=1.0)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("white", 0.0), ("white", 256.0), ("texture", -1.0), ("distortion", 0.6)),
        *(("distortion", -0.4), ("vignette", 1.1), ("exposure_ms", -1.0), ("bayer", 1.5)),
        *(("shot_noise", 129.0), ("read_noise", -0.1)),
    ],
)
def test_values_out_of_bounds_are_named(name, value):
    with pytest.raises(UsageError, match=rf"sensor\.{name} = {value}; expected "):
        load_settings(flags={f"sensor.{name}": value})
