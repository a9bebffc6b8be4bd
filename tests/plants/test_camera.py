"""The camera against 32 × supersampling, and the symmetries that exact coverage must have."""

import hashlib

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.plants.cartpole.camera import VERSION
from hjepa_cli.core.plants.named import Camera
from hjepa_cli.errors import UsageError

# What the pictures show (m): window, cart, pole, as the specification has them.
SCENES = {
    "desktop": {"window": (0.6, 0.3), "cart": (0.06, 0.03), "pole": (0.016, 0.2)},
    "gym": {"window": (3.2, 1.6), "cart": (0.32, 0.16), "pole": (0.085, 1.0)},
}
SAMPLES = 32
CAMERAS = {name: Camera(name) for name in SCENES}
names = st.sampled_from(sorted(SCENES))
places = st.floats(-0.45, 0.45)  # of the window's width
poses = st.lists(st.tuples(places, st.floats(-7, 7)), min_size=1, max_size=5)


def states_of(name, poses):
    """States from (place as a share of the window's width, theta)."""
    width_m = SCENES[name]["window"][0]
    return np.array([[place * width_m, 0.0, theta, 0.0] for place, theta in poses])


def supersampled(name, x_m, theta):
    """Shares of each pixel that show cart and pole [64, 128], by asking points one by one."""
    scene, manifest = SCENES[name], CAMERAS[name].manifest()
    scale = 128 / scene["window"][0]
    points = (np.arange(128 * SAMPLES) + 0.5) / SAMPLES
    right = (points[None] - 64) / scale - x_m
    up = (manifest["pivot_row_px"] - points[: 64 * SAMPLES, None]) / scale
    along = right * np.sin(theta) + up * np.cos(theta)
    across = right * np.cos(theta) - up * np.sin(theta)
    width, length = scene["pole"]
    pole = (along >= 0) & (along <= length) & (np.abs(across) <= width / 2)
    cart = (np.abs(right) <= scene["cart"][0] / 2) & (np.abs(up) <= scene["cart"][1] / 2)

    def share(mask):
        return mask.reshape(64, SAMPLES, 128, SAMPLES).mean(axis=(1, 3))

    return share(cart & ~pole), share(pole)


def shares(name, frame):
    """Recover both shares [64, 128] from the colours: three channels, two unknowns."""
    manifest = CAMERAS[name].manifest()
    ground, cart, pole = (
        np.array(manifest[f"{part}_rgb"], float) for part in ("background", "cart", "pole")
    )
    mixing = np.stack([cart - ground, pole - ground], axis=1)
    solved = np.linalg.lstsq(mixing, (frame - ground).reshape(-1, 3).T, rcond=None)[0]
    return solved.reshape(2, 64, 128)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("largest_rad", [0.35, 3.2])
def test_coverage_against_supersampling(name, largest_rad):
    draws = generator(0).uniform(-1, 1, (5, 2)) * [0.4, largest_rad]
    states = states_of(name, draws)
    for state, frame in zip(states, CAMERAS[name].render(states), strict=True):
        # 32 samples in a row resolve an edge to 1/64; colours in 8 bits add less than 1/128.
        for ours, theirs in zip(
            shares(name, frame), supersampled(name, state[0], state[2]), strict=True
        ):
            assert np.abs(ours - theirs).max() < 0.025


@given(names, poses, st.integers(-20, 20))
def test_shifts_by_whole_pixels_shift_the_picture(name, poses, shift_px):
    states = states_of(name, poses)
    shifted = states.copy()
    shifted[:, 0] += shift_px * SCENES[name]["window"][0] / 128
    before, after = CAMERAS[name].render(states), CAMERAS[name].render(shifted)
    if shift_px < 0:
        before, after, shift_px = after, before, -shift_px
    np.testing.assert_array_equal(after[:, :, shift_px:], before[:, :, : 128 - shift_px])


@given(names, poses)
@example("desktop", [(0.0, 0.0), (0.1, 0.0), (0.0, np.pi), (-0.2, np.pi / 2), (0.3, np.pi / 4)])
def test_mirrored_states_give_mirrored_pictures(name, poses):
    states = states_of(name, poses)
    mirrored = CAMERAS[name].render(-states)[:, :, ::-1]
    np.testing.assert_array_equal(mirrored, CAMERAS[name].render(states))


@pytest.mark.parametrize("name", SCENES)
def test_a_batch_is_as_many_single_frames(name):
    states = states_of(name, generator(1).uniform(-1, 1, (100, 2)) * [0.6, 4])
    together = CAMERAS[name].render(states)
    alone = np.concatenate([CAMERAS[name].render(states[i : i + 1]) for i in range(100)])
    np.testing.assert_array_equal(together, alone)
    assert together.shape == (100, 64, 128, 3) and together.dtype == np.uint8
    assert CAMERAS[name].render(states[:0]).shape == (0, 64, 128, 3)


@pytest.mark.parametrize("name", SCENES)
def test_a_fiftieth_of_a_pixel_is_seen(name):
    """Of the cart, and of the pole's tip; pictures that repeat would hide the velocities."""
    window_m, length_m = SCENES[name]["window"][0], SCENES[name]["pole"][1]
    step_m = 0.02 * window_m / 128
    states = np.zeros((401, 4))
    states[:, 0] = np.arange(401) * step_m
    moves = CAMERAS[name].render(states)
    assert (moves[1:] != moves[:-1]).any(axis=(1, 2, 3)).all()
    states = np.zeros((401, 4))
    states[:, 2] = np.arange(401) * step_m / length_m
    leans = CAMERAS[name].render(states)
    assert (leans[1:] != leans[:-1]).any(axis=(1, 2, 3)).all()


@pytest.mark.parametrize("name", SCENES)
def test_the_centroid_follows_the_cart(name):
    """Steadily, and to what averaging over square pixels leaves of a box's edges (f(1 − f)/2)."""
    states = np.zeros((201, 4))
    states[:, 0] = np.linspace(-2, 2, 201) * SCENES[name]["window"][0] / 128
    ink = 255.0 - CAMERAS[name].render(states).mean(axis=-1)
    centroid = (ink.sum(axis=1) * (np.arange(128) + 0.5)).sum(axis=-1) / ink.sum(axis=(1, 2))
    np.testing.assert_allclose(centroid, 64 + np.linspace(-2, 2, 201), rtol=0, atol=0.03)
    assert (np.diff(centroid) > 0).all()


@given(names, places, st.floats(-3.1, 3.1))
def test_full_turns_are_not_seen(name, place, theta):
    once = CAMERAS[name].render(states_of(name, [(place, theta)]))
    again = CAMERAS[name].render(states_of(name, [(place, theta + 2 * np.pi)]))
    np.testing.assert_allclose(once.astype(int), again.astype(int), rtol=0, atol=1)


def test_velocities_are_not_seen():
    states = np.array([[0.01, 0.0, 0.1, 0.0], [0.01, 3.0, 0.1, -9.0]])
    still, moving = CAMERAS["desktop"].render(states)
    np.testing.assert_array_equal(still, moving)


@pytest.mark.parametrize("name", SCENES)
def test_what_leaves_the_window_is_cut_off(name):
    camera, width_m = CAMERAS[name], SCENES[name]["window"][0]
    states = states_of(name, [(0.8, 0.0), (-50 / width_m, 1.0), (1e9, 1.0), (0.45, np.pi / 2)])
    empty = np.array(camera.manifest()["background_rgb"])
    frames = camera.render(states)
    assert (frames[:3] == empty).all()
    assert (frames[3, 46:51, 127] != empty).any() and (frames[3, :, 0] == empty).all()


@pytest.mark.parametrize("name", SCENES)
def test_the_upright_pole_stays_in_view(name):
    """All of it, for any angle of the training range, with a margin above."""
    states = states_of(name, [(0, theta) for theta in np.linspace(-0.4, 0.4, 9)])
    frames = CAMERAS[name].render(states)
    empty = np.array(CAMERAS[name].manifest()["background_rgb"])
    assert (frames[:, :3] == empty).all() and (frames[:, -3:] == empty).all()
    for frame in frames:
        area_px = shares(name, frame)[1].sum()
        width, length = np.array(SCENES[name]["pole"]) * 128 / SCENES[name]["window"][0]
        assert area_px == pytest.approx(width * length, rel=2e-3)


def test_golden_pictures():
    """A change of any pixel must raise VERSION: datasets store states and render them on load."""
    states = np.array(
        [[0, 0, 0, 0], [0.0123, 0, 0.1, 0], [-0.1, 0, -0.35, 0], [0.2, 0, 1.6, 0], [0.05, 0, 3, 0]]
    )
    digest = hashlib.sha256(CAMERAS["desktop"].render(states).tobytes()).hexdigest()
    assert (VERSION, digest[:16]) == (1, "7ed030d917c8647f")


def test_manifest_is_plain_data_that_fixes_the_picture():
    desktop, gym = CAMERAS["desktop"].manifest(), CAMERAS["gym"].manifest()
    assert desktop.keys() == gym.keys() and desktop != gym
    assert desktop["version"] == VERSION and desktop["scale_px_m"] == pytest.approx(213.333333)
    colours = {tuple(desktop[f"{part}_rgb"]) for part in ("background", "cart", "pole")}
    assert len(colours) == 3


def test_an_unknown_plant_names_the_choices():
    with pytest.raises(UsageError, match=r"moon.*desktop, gym"):
        Camera("moon")


@pytest.mark.parametrize(
    ("states", "shape"),
    [([[0, 0, 0]], r"\(1, 3\)"), ([0, 0, 0, 0], r"\(4,\)"), (0, r"\(\)"), ([[[0] * 4]], r"\(1, 1")],
    ids=str,
)
def test_states_of_another_shape_are_refused(states, shape):
    with pytest.raises(ValueError, match=rf"states: shape {shape}.*, not \(n, 4\): x, x_dot"):
        Camera("desktop").render(states)
    with pytest.raises(ValueError, match=r"state: shape \(1, 3\), not \(4,\)"):
        Camera("desktop").sketch_px([[0, 0, 0]])


@pytest.mark.parametrize("far", [1e308, -1e308, 1e5])
def test_a_cart_that_is_far_away_is_not_seen(far):
    """And nothing overflows, which would be a warning, and so an error here."""
    seen = CAMERAS["desktop"].render([[far, far, 0, far], [0.0, 0, far, 0]])
    assert (seen[0] == 255).all() and (seen[1] != 255).any()
