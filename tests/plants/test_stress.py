"""Named conditions do what they say, in any order, and are refused where they make no sense."""

import dataclasses

import numpy as np
import pytest

from hjepa_cli.config.schema import CameraSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.plants import stress
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.stress import CONDITIONS, parse, rows, under, written
from hjepa_cli.errors import UsageError

STATES = np.random.default_rng(0).uniform(-1, 1, (6, 2, 4)) * [0.05, 0.1, 0.2, 0.5]
ROWS, COLUMNS = np.meshgrid(np.arange(64.0), np.arange(128.0), indexing="ij")


def seen(text: str, states: np.ndarray = STATES) -> np.ndarray:
    settings = under(load_settings(), text)
    return frames_of(actual_camera(settings), states).astype(float)


def applied(name: str, severity: float, pictures: np.ndarray) -> np.ndarray:
    random = np.random.default_rng(1)
    return CONDITIONS[name].apply(pictures.astype(np.float32), severity, random)


def ramp(of: np.ndarray) -> np.ndarray:
    """Pictures [1, 1, 64, 128, 3] that tell a place, which lines between pixels keep exact."""
    return np.broadcast_to(of[..., None], (1, 1, 64, 128, 3))


def test_moving_a_picture_by_whole_pixels_is_moving_the_cart() -> None:
    scale_px_m = plant("desktop").camera().scale_px_m
    moved = STATES.copy()
    moved[..., 0] += 4 / scale_px_m
    np.testing.assert_array_equal(seen("shift=4"), seen("", moved))
    down = seen("shift_down=3")
    np.testing.assert_array_equal(down[:, :, 3:], seen("")[:, :, :-3])
    half = applied("shift", 0.25, ramp(COLUMNS))
    np.testing.assert_allclose(half[0, 0, :, 1:, 0], (COLUMNS - 0.25)[:, 1:], atol=1e-4)


def test_a_rotation_is_clockwise_around_the_middle() -> None:
    angle = np.radians(20)
    turned = [applied("rotation", 20.0, ramp(of))[0, 0, ..., 0] for of in (ROWS, COLUMNS)]
    # What was at the right of the middle is below it now: (right, down) ↦ R (right, down).
    for row, column in ((40, 80), (31, 20), (20, 60)):
        down, right = turned[0][row, column] - 31.5, turned[1][row, column] - 63.5
        back = (
            np.sin(angle) * right + np.cos(angle) * down + 31.5,
            np.cos(angle) * right - np.sin(angle) * down + 63.5,
        )
        np.testing.assert_allclose(back, (row, column), atol=1e-3)


def test_blur_jitter_and_noise_are_as_wide_as_they_say() -> None:
    dot = np.zeros((1, 1, 64, 128, 3))
    dot[..., 32, 64, :] = 255
    weight = applied("blur", 1.5, dot)[0, 0, ..., 0] / 255
    assert weight.sum() == pytest.approx(1, abs=1e-4)
    assert ((ROWS - 32) ** 2 * weight).sum() == pytest.approx(1.5**2, rel=0.01)
    pictures = np.broadcast_to(ramp(COLUMNS), (300, 4, 64, 128, 3))
    moves = (pictures - applied("jitter", 0.1, pictures))[:, :, 30, 60, 0]
    assert moves.std() == pytest.approx(0.1, rel=4 / np.sqrt(2 * moves.size))
    assert abs(np.corrcoef(moves.T)[0, 1]) < 4 / np.sqrt(300), "each frame is moved for itself"
    grey = np.full((4, 2, 64, 128, 3), 127.5)
    for name, width in (("noise", 8.0), ("shot", 8.0 / np.sqrt(2))):
        drawn = applied(name, 8.0, grey) - grey
        assert drawn.std() == pytest.approx(width, rel=4 / np.sqrt(2 * drawn.size))
    mosaic = applied("bayer", 0.0, np.full((1, 1, 64, 128, 3), [10.0, 100.0, 200.0]))
    np.testing.assert_allclose(mosaic[0, 0, 5, 7], [10.0, 100.0, 200.0], rtol=1e-5)


def test_light_goes_by_factors_and_the_camera_clips_once() -> None:
    nominal = seen("")
    expected = np.clip(np.rint(0.5 * nominal), 0, 255)
    np.testing.assert_array_equal(seen("light=0.5"), expected)
    assert np.abs(seen("gradient=0.2")[0, 0, 0, [0, -1], 0] - [255, 0.8 * 255]).max() <= 0.5
    assert seen("gamma=2")[..., 1].max() == 255
    np.testing.assert_allclose(
        seen("gamma=2"), 255 * (nominal / 255) ** 2, atol=0.51, err_msg="v ↦ v²"
    )
    red = seen("colour=0.2")[0, 0, 0, 0]
    np.testing.assert_allclose(red, [255, 255 / 1.2, 255 / 1.44], atol=0.5)
    both = seen("flicker=0.02", np.repeat(STATES[:1], 200, 0))[:, :, 0, 0, 0]
    assert set(both.ravel()) == {255.0, 250.0}
    share = (both[:, 0] != both[:, 1]).mean()
    assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(200)


def test_objects_cover_what_they_say_and_nothing_else() -> None:
    nominal = seen("")
    for text, pixels in (
        ("corner=8", 64), ("dark_object=8", 64), ("post=4", 4 * 64), ("bar=3", 3 * 128),
        ("top=0.25", 16 * 128), ("rectangle=8", 64),
    ):  # fmt: skip
        changed = (seen(text) != nominal).any(-1).sum((-2, -1))
        assert changed.max() == pixels, text
    first, last = seen("rectangle=16").transpose(1, 0, 2, 3, 4)
    hidden = [(of != same).any(-1) for of, same in ((first, nominal[:, 0]), (last, nominal[:, 1]))]
    assert (hidden[0] ^ hidden[1]).mean() < 0.01, "one place for both frames of a packet"


def test_worse_jpegs_are_worse_and_faults_hit_the_share_they_say() -> None:
    nominal = seen("")
    errors = [np.abs(seen(f"jpeg={quality}") - nominal).mean() for quality in (95, 75, 50)]
    assert errors == sorted(errors) and errors[0] > 0
    many = np.repeat(STATES, 100, 0)
    for text, level in (("black=0.3", 0), ("saturated=0.3", 255)):
        share = (seen(text, many) == level).all((1, 2, 3, 4)).mean()
        assert abs(share - 0.3) < 4 * np.sqrt(0.21 / 600)
    assert (seen("frozen=1")[:, 0] == seen("frozen=1")[:, 1]).all()
    torn = seen("torn=1")
    np.testing.assert_array_equal(torn[:, 1, :32], nominal[:, 1, :32])
    assert (torn[:, 1] != nominal[:, 1]).any((1, 2, 3)).all()


def test_order_does_not_matter_and_the_same_states_look_the_same_again() -> None:
    text = "noise=4+light=0.7+corner=8"
    assert written(parse(text)) == "corner=8+light=0.7+noise=4"
    np.testing.assert_array_equal(seen(text), seen("light=0.7+corner=8+noise=4"))
    assert (seen(text) != seen(text, STATES + 1e-9)).any()


def step_of(text: str, forces_n: list[float], start: np.ndarray) -> np.ndarray:
    conditions = under(load_settings(), text).conditions
    simulation = actual_plant("desktop", conditions).simulation(len(start))
    simulation.states = start
    for force_n in forces_n:
        simulation.step(np.full(len(start), force_n))
    return simulation.states


def test_friction_dead_zone_and_late_drives_change_what_moves_the_cart() -> None:
    start = STATES[:, 0]
    kind = plant("desktop")
    moved = step_of("viscous=2", [1.0], start)
    np.testing.assert_allclose(moved, kind.advance(start, 1.0 - 2 * start[:, 1]), atol=2e-6)
    # A saturated drive does not make up for friction.
    braked = step_of("viscous=2", [25.0], backwards := start * [1, 0, 1, 1] - [0, 1, 0, 0])
    np.testing.assert_allclose(braked, kind.advance(backwards, np.full(6, 20.0 + 2)), atol=2e-5)
    rolling = start * [1, 0, 0, 0] + [0, 0.05, 0, 0]
    # 0.3 kg slow down by F/m: 0.3 N for 1 ms take 1 mm/s, and the pole leaves that as it is.
    dry = step_of("coulomb=0.3", [0.0], rolling)
    np.testing.assert_allclose(dry, kind.advance(rolling, np.full(6, -0.3)), atol=2e-6)
    still = step_of("coulomb=5", [0.0] * 5, rolling * [1, 0, 0, 0] + [0, 1e-4, 0, 0])
    assert np.abs(still[:, 1]).max() < 1e-4, "it stops, and does not turn back"
    np.testing.assert_array_equal(
        step_of("dead_zone=0.5", [0.4, 0.6, -0.3], start), step_of("", [0.0, 0.6, 0.0], start)
    )
    np.testing.assert_array_equal(
        step_of("actuation=2", [1.0, 2.0, 3.0], start), step_of("", [0.0, 0.0, 1.0], start)
    )
    np.testing.assert_array_equal(step_of("mass=1.2", [1.0], start), _heavier(start, 1.2, 1.0))


def _heavier(start: np.ndarray, factor: float, force_n: float) -> np.ndarray:
    simulation = plant("desktop").simulation(
        len(start), mass_scale=np.full((len(start), 2), factor)
    )
    simulation.states = start
    simulation.step(np.full(len(start), force_n))
    return simulation.states


def test_conditions_with_a_setting_of_their_own_set_it() -> None:
    settings = under(load_settings(), "downlink=0.5+late=20+length=0.9+light=0.8+mass_spread=0.2")
    assert settings.protocol.downlink_loss == 0.5 and settings.protocol.delay_steps == 20
    assert settings.conditions.pole_length == 0.9 and settings.protocol.plant_spread == 0.2
    assert settings.conditions.stress == "light=0.8"
    assert under(settings, "noise=4").conditions.stress == "light=0.8+noise=4"
    with pytest.raises(UsageError, match=r"protocol\.downlink_loss"):
        actual_plant(
            "desktop", load_settings(flags={"conditions.stress": "downlink=0.5"}).conditions
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lihgt=0.5", "did you mean 'light'"),
        ("fog", "choose from texture, rotation"),
        ("light=-1", "light=-1; expected a number from 0 to 4"),
        ("light=nan", "expected a number"),
        ("light=bright", "'bright' is no number; factor: light=0.7"),
        ("light=0.7+light=0.8", "light twice"),
        ("late=1.5", "a whole number from 0 to 256"),
        ("jpeg=0", "1 to 100"),
    ],
)
def test_what_is_no_condition_is_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        rows([text])


def test_friction_of_what_has_no_cart_is_refused() -> None:
    settings = under(load_settings("quadrotor"), "viscous=1")
    with pytest.raises(UsageError, match="plant quadrotor has none"):
        actual_plant("quadrotor", settings.conditions)


def test_rows_of_names_are_severities_within_bounds_that_change_something() -> None:
    assert len(rows(["audit"])) == len(stress.AUDIT_ROWS) == len(set(stress.AUDIT_ROWS))
    assert rows(["light", "noise=8", "light"]) == [*rows(["light"]), "noise=8"]
    assert set(rows(["audit"])) <= {written(parse(text)) for text in rows(["audit"])}
    nominal = seen("")
    for text in rows(["all"]):
        ((condition, severity),) = parse(text).items()
        assert severity != condition.nominal
        if condition.apply is not None and condition.name not in ("black", "saturated", "torn"):
            assert (seen(text) != nominal).any() or condition.name in ("frozen", "dead_pixels"), (
                text
            )


@pytest.mark.parametrize("name", ["default", "gym"])
def test_every_condition_can_be_simulated(name: str) -> None:
    changes = {"protocol.warmup_steps": 0, "protocol.steps": 4, "protocol.curve_devices": 2}
    settings = load_settings(name, flags={**changes, "protocol.bracket_devices": 2})
    for text in ("mass=1.2", "viscous=1", "coulomb=0.3", "dead_zone=1", "actuation=3", "late=2"):
        simulator = Simulator(under(settings, text), None)
        block = Block("oracle", (Point("gap", 2.0),), 0, 2)
        assert np.isfinite(block.compute(simulator, lambda steps: None).cost).all()


@pytest.mark.parametrize("shape", [(17, 40, 1), (32, 24, 3), (120, 160, 1)], ids=str)
def test_pictures_of_any_size_get_worse_and_grey_ones_have_no_colours(shape) -> None:
    pictures = np.random.default_rng(0).uniform(0, 255, (3, 2, *shape)).astype(np.float32)
    grey = shape[2] == 1
    for one in CONDITIONS.values():
        if one.apply is None or (grey and one.of_colours):
            continue
        for severity in one.ladder:
            worse = applied(one.name, severity, pictures)
            assert worse.shape == pictures.shape and np.isfinite(worse).all(), one.name
    size = CameraSettings(*shape[:2], grey=grey)
    settings = dataclasses.replace(under(load_settings(), "colour=0.1"), camera=size)
    if grey:
        with pytest.raises(UsageError, match="grey"):
            actual_camera(settings)
    else:
        assert frames_of(actual_camera(settings), STATES).shape == (6, 2, *shape)


def test_recordings_are_retaken_as_a_camera_would_have_seen_them() -> None:
    settings = under(load_settings(), "light=0.5+corner=8")
    recorded = dataclasses.replace(settings, plant="recorded")
    clean = frames_of(actual_camera(load_settings()), STATES)
    expected = frames_of(actual_camera(settings), STATES)
    np.testing.assert_array_equal(actual_camera(recorded).retake(clean), expected)
    with pytest.raises(UsageError, match="actuation is of forces"):
        actual_camera(under(recorded, "actuation=3"))
