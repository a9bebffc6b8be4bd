"""Animations: what they show is what happened, and what the controller had in its hands."""

import io
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import assert_one_line_error, open_shell
from test_evaluate import untrained

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import LastForce, StrideController
from hjepa_cli.core.control.loop import Draws, LinkDraws, every_step, simulate
from hjepa_cli.core.control.methods.true_state import true_state_driver
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.named import plant
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import view
from hjepa_cli.stages.view import Believer, Film, Link, make_link

image_module = pytest.importorskip("PIL.Image")
from hjepa_cli.output import animation, live  # noqa: E402 - needs pillow

SMALL = """
[collect]
trajectories = 3
steps = 9
[protocol]
steps = 12
"""


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return untrained(tmp_path_factory.mktemp("model") / "model.safetensors")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    Path("small.toml").write_text(SMALL)
    return shell


class Counting:
    """A planner whose embedding counts control steps."""

    stride = 4

    def plan(self, z):
        return torch.zeros(len(z), 4), z + 4


# --- beliefs


def test_belief_is_the_step_that_a_counting_planner_has_reached():
    """After a packet worth z the controller believes z + j, j steps later, whatever the phase."""
    controller = StrideController(Counting(), devices=2)
    believer = Believer(controller, torch.tensor([[1.0], [0.0]], dtype=torch.float64))
    packets = {0: [10.0, 20.0], 3: [100.0], 9: [200.0]}
    arrivals = {0: [True, True], 3: [False, True], 9: [True, False]}
    expected = np.array([10.0, 20.0])
    for k in range(15):
        delivered = np.array(arrivals.get(k, [False, False]))
        received = torch.tensor(packets[k])[:, None] if k in packets else None
        if k in packets:
            expected[delivered] = packets[k]
        believer.act(delivered, received)
        np.testing.assert_allclose(believer.believed[-1][:, 0], expected)
        expected += 1


def test_a_probe_simulates_no_more_than_it_sees(checkpoint, monkeypatch):
    simulated = []

    def counting(*given):
        simulated.append(generate(*given))
        return simulated[-1]

    monkeypatch.setattr(view, "generate", counting)
    monkeypatch.setattr(view, "PROBE_TRAJECTORIES", 2)
    settings = load_settings(flags={"collect.trajectories": 3, "collect.steps": 9})
    view.fit_probe(settings, Model.load(checkpoint), Screen(quiet=True))
    [recorded] = simulated
    assert len(recorded) == 2


def test_a_probe_reads_what_embeddings_hold_linearly():
    random = torch.Generator().manual_seed(0)
    states = torch.randn(300, 4, generator=random)
    z = states @ torch.randn(4, 16, generator=random) + 3.0
    probe = health.fit_probe(z[:200], states[:200])
    torch.testing.assert_close(
        health.read_probe(probe, z[200:]), states[200:].double(), atol=1e-4, rtol=0
    )


def test_watching_a_loop_sees_every_state_and_force():
    settings = load_settings("smoke")
    draws = Draws.make(settings.protocol, 2, 0)
    method = true_state_driver("optimal", plant("desktop"), 1)
    sensed, watched = [], []

    def sensor(seen):
        sensed.append(seen[:, -1].copy())
        return seen[:, -1]

    simulate(
        plant("desktop"),
        draws,
        every_step(draws.steps, 2)[None],
        method.controller(2),
        sensor,
        watch=lambda k, states, forces_n: watched.append((k, states.copy(), forces_n.copy())),
    )
    assert [k for k, *_ in watched] == list(range(draws.steps))
    np.testing.assert_array_equal([states for _, states, _ in watched], sensed)
    assert (np.abs([forces for *_, forces in watched]) <= 20).all()


# --- the link


def test_fading_delivers_the_share_that_was_asked_for(checkpoint):
    settings = load_settings(flags={"seed": 1})
    model = Model.load(checkpoint, "cpu")
    link = make_link(settings, model, 4, snr_db=20.0, delivery=0.2, gap_steps=None)
    # 4,000 slots: standard error sqrt(0.2 * 0.8 / 4000) = 0.0063; five of them
    assert link.delivered.mean() == pytest.approx(0.2, abs=0.032)
    weakest = link.snr_db[1:][link.delivered[1:]].min()
    assert weakest > link.snr_db[1:][~link.delivered[1:]].max()
    assert np.mean(10 ** (link.snr_db / 10)) == pytest.approx(100, rel=0.08)  # 5 / sqrt(4000)
    wider = make_link(settings, model, 9, snr_db=20.0, delivery=0.2, gap_steps=None)
    np.testing.assert_array_equal(wider.delivered[:, :4], link.delivered)


def test_a_periodic_link_loses_nothing(checkpoint):
    model = Model.load(checkpoint, "cpu")
    link = make_link(
        load_settings(flags={"protocol": "paper"}),
        model,
        2,
        snr_db=10.0,
        delivery=0.5,
        gap_steps=80,
    )
    assert np.flatnonzero(link.delivered[:, 0]).tolist() == list(range(0, 1000, 80))
    assert not link.sends_always and (link.snr_db == 10).all()


def test_a_late_link_shows_packets_when_they_arrive(checkpoint):
    """Sent every 80 steps and 30 late: the newest is 30 to 109 steps old, at first none."""
    late = {"protocol": "paper", "protocol.steps": 200, "protocol.delay_steps": 30}
    model = Model.load(checkpoint, "cpu")
    link = make_link(load_settings(flags=late), model, 2, 10.0, 0.5, 80)
    assert np.flatnonzero(link.sent[:, 0]).tolist() == [0, 80, 160]
    assert np.flatnonzero(link.delivered[:, 0]).tolist() == [30, 110, 190]
    expected = [-1] * 30 + [30 + k for k in range(80)] + [30 + k for k in range(80)]
    assert link.age_steps[:190, 0].tolist() == expected
    assert link.late == ", packets 30 steps late"
    states = np.zeros((200, 2, 4))
    film = Film("hjepa", states, states, np.ones((200, 2), bool))
    kind = plant("desktop")
    shots = animation.Pictures([film], link, kind, kind.camera(), 10)
    assert [shots.age(0, k) for k in (29, 30, 109)] == [
        *("no packet", "packet 30 ms old", "packet 109 ms old"),
    ]
    shots.draw(0)


def test_a_believer_passes_on_what_is_planned_and_asks_nobody_for_an_age_who_takes_none():
    """Forces over a lossy downlink, with late packets, are those without a believer."""
    kind, late = plant("desktop"), {"protocol.delay_steps": 5, "protocol.downlink_loss": 0.4}
    settings = load_settings(flags={"protocol": "paper", "protocol.steps": 80, **late})
    draws = Draws.make(settings.protocol, 2, 0)
    read = lambda seen: torch.from_numpy(seen[:, -1]).float()  # noqa: E731
    act = lambda z: z @ torch.tensor([3.0, 5.0, 40.0, 4.0])  # noqa: E731

    def forces(wrap):
        seen, controller = [], wrap(LastForce(act, 2, tau_steps=8.0))
        watch = lambda k, states, forces_n: seen.append(forces_n.copy())  # noqa: E731
        simulate(kind, draws, every_step(80, 2)[None], controller, read, watch=watch)
        return np.stack(seen)

    probe = torch.zeros(5, 4).double()
    assert np.array_equal(forces(lambda one: Believer(one, probe)), forces(lambda one: one))


# --- pictures


def pictures(steps=300, devices=2, every=10):
    """An animation of a made-up loop: one row, the belief a little off the truth."""
    random = np.random.default_rng(0)
    delivered = random.random((steps, devices)) < 0.1
    delivered[0] = True
    snr_db = random.normal(20, 3, (steps, devices))
    link = Link(delivered, snr_db, True, "made up", LinkDraws())
    states = np.zeros((steps, devices, 4))
    states[..., 0] = 0.02
    states[..., 2] = 0.1
    believed = states + np.array([0.0, 0, 0.2, 0])
    film = Film("hjepa", states, believed, np.ones((steps, devices), bool))
    kind = plant("desktop")
    return animation.Pictures([film], link, kind, kind.camera(), every)


def test_age_counts_from_the_last_arrival():
    shots = pictures()
    for device in range(2):
        age = 0
        for k, arrived in enumerate(shots.link.delivered[:, device]):
            age = 0 if arrived else age + 1
            assert shots.link.age_steps[k, device] == age


def test_the_strip_shows_every_slot_of_the_last_while():
    shots = pictures()
    k = 290
    panel = np.asarray(shots._panel(shots.films[0], 1, k))
    row = panel[-8]  # above the ticks
    width = shots.grid.panel_px[0]
    for column in range(width):
        slot = k - (width - 1 - column)
        nearby = shots.link.delivered[
            max(slot, 0) : max(slot + 2, 0), 1
        ]  # a bar is two columns wide
        assert (tuple(row[column]) == animation.ARRIVED) == nearby.any(), column


def tilt(scene):
    """The angle [rad] of the pole in a scene, from where its colour lies in two of its rows."""
    redness = np.asarray(scene).astype(float)
    redness = np.clip(redness[..., 0] - redness[..., 2], 0, None)
    rows = np.array([10, 30])
    columns = (redness[rows] * np.arange(redness.shape[1])).sum(axis=1) / redness[rows].sum(axis=1)
    return np.arctan((columns[0] - columns[1]) / (rows[1] - rows[0]))


def test_truth_and_belief_lie_beside_each_other_where_they_are():
    """The true pole leans by 0.1 rad, the believed one by 0.3; the cart is in the middle."""
    shots = pictures()
    true, believed = shots.scenes(shots.films[0], 0, 0)
    assert tilt(true) == pytest.approx(0.1, abs=0.02)
    assert tilt(believed) == pytest.approx(0.3, abs=0.02)
    assert np.asarray(true).min() < 30 < 100 < np.asarray(believed).min()
    row = 48 - animation.SKY_PX + 2  # of the cart
    blue = 255 - np.asarray(true)[row, :, 0].astype(float)
    middle = (blue * (np.arange(len(blue)) + 0.5)).sum() / blue.sum()
    assert middle == pytest.approx(animation.VIEW_PX[0] / 2, abs=0.6)
    panel = np.asarray(shots._panel(shots.films[0], 0, 0))
    assert panel.shape[1] == 2 * animation.VIEW_PX[0] * shots.grid.scale + 2


def test_poles_are_drawn_four_times_as_large_as_they_were():
    """There were two pixels for one of the camera; what is out of its sight is called so."""
    shots = pictures(devices=3)
    assert shots.grid.scale == 8 and shots.size_px <= animation.MOST_PX
    assert shots.in_sight(shots.films[0], 0, 0)
    shots.films[0].states[5, 0, 0] = 3.0
    assert not shots.in_sight(shots.films[0], 0, 5)
    seen, _ = shots.scenes(shots.films[0], 0, 5)
    assert len(np.unique(np.asarray(seen).reshape(-1, 3), axis=0)) == 1
    shots.draw(5)


@pytest.mark.parametrize(("devices", "methods"), [(1, 2), (2, 2), (5, 1), (12, 2), (24, 2)])
def test_many_devices_are_tiled_into_a_picture_of_bounded_size(devices, methods):
    laid = animation.grid(devices, methods)
    assert laid.columns * laid.rows >= devices
    assert all(size <= most for size, most in zip(laid.size_px, animation.MOST_PX, strict=True))


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 30), (60, 24), (200, 60)])
@pytest.mark.parametrize("devices", [1, 3])
def test_terminal_pictures_fit_the_terminal_and_can_be_made_out(width, height, devices):
    """A pole is at least two thirds of the least scene: six lines of twelve pixels."""
    shots = pictures(devices=devices)
    lines = rendered(shots, 50, width, height)
    assert max(map(len, lines)) <= width and len(lines) <= height - 1
    text = "\n".join(lines)
    shown = live.layout(devices, 1, width, height)
    assert shown.rows >= live.LEAST_ROWS
    assert text.count("ms old") == text.count("theta off by +11.5°") == shown.devices
    assert "▀" in text and "50 ms" in text and "left true, right believed" in text
    assert (f"{shown.devices} of {devices} devices fit here" in text) == (shown.devices < devices)


def test_a_terminal_of_the_usual_size_shows_two_methods():
    assert live.layout(3, 2, 80, 24).rows > live.LEAST_ROWS
    assert live.layout(3, 2, 80, 24).devices == 1


def rendered(shots, k, width, height):
    """A picture of the terminal as lines without colours."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=width, height=height, color_system=None)
    console.print(live.terminal_picture(shots, k, width, height))
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_the_terminal_marks_what_arrived_and_what_was_lost():
    """A character per picture, the newest at the right."""
    shots = pictures(steps=300, devices=1, every=10)
    (strip,) = (line for line in rendered(shots, 290, 80, 24) if line and not line.strip("█· "))
    slots = shots.link.delivered[:291, 0]
    marks = ["█" if slots[max(end - 10, 0) : end].any() else "·" for end in range(1, 292, 10)]
    assert strip.strip() == "".join(marks)[-len(strip.strip()) :]


def test_the_terminal_shows_what_the_controller_believes_beside_the_truth():
    shots = pictures(devices=1)
    laid = live.layout(1, 1, 80, 24)
    lines = live._scenes(shots, shots.films[0], 0, 0, laid).plain.splitlines()
    assert len(lines) == laid.rows
    for line in lines:
        assert line == "▀" * laid.scene_columns + " " + "▀" * laid.scene_columns


# --- the command


def test_view_writes_the_same_gif_twice(shell, checkpoint):
    arguments = ["view", "--checkpoint", checkpoint, "--config", "small.toml", "--devices", "1"]
    arguments += ["--every", "3", "--delivery", "0.5", "--json"]
    document = shell(*arguments).document
    assert document["pictures"] == 4 and document["file"] == "hjepa-view.gif"
    assert document["methods"].keys() == {"hjepa", "hold"}
    first = Path("hjepa-view.gif").read_bytes()
    image = image_module.open(io.BytesIO(first))
    assert image.n_frames == 4 and image.info["duration"] == 50 and image.info["loop"] == 0
    shell(*arguments, "--out", "again.gif")
    assert Path("again.gif").read_bytes() == first
    left = {path.name for path in Path().iterdir()}
    assert left == {"small.toml", "hjepa-view.gif", "again.gif"}


def test_a_gif_keeps_the_colours_of_the_strip(tmp_path):
    """Few pixels have them: a palette of the commonest colours would not."""
    shots, path = pictures(steps=30), tmp_path / "a.gif"
    animation.write(shots, path, 10, lambda: None)
    with image_module.open(path) as image:
        image.seek(image.n_frames - 1)
        shown = np.asarray(image.convert("RGB")).reshape(-1, 3)
    for colour in (animation.ARRIVED, animation.LOST):
        assert (np.abs(shown.astype(int) - colour).max(axis=1) <= 1).any(), colour


@pytest.mark.parametrize(("fps", "shown_ms"), [(1, 1000), (24, 40), (30, 30), (45, 20), (50, 20)])
def test_the_rate_that_is_told_is_the_gif_s(tmp_path, fps, shown_ms):
    path = tmp_path / "a.gif"
    animation.write(pictures(steps=20), path, fps, lambda: None)
    with image_module.open(path) as image:
        assert image.info["duration"] == shown_ms
    assert animation.true_fps(path, fps) == pytest.approx(1000 / shown_ms)
    assert animation.true_fps(Path("a.mp4"), fps) == fps


def test_view_tells_the_rate_that_it_wrote(shell, checkpoint):
    arguments = ("view", "--checkpoint", checkpoint, "--config", "small.toml", "--every", "6")
    assert "2 pictures at 33.3 per second" in shell(*arguments, "--fps", "30").err


def test_view_writes_mp4(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    import imageio_ffmpeg

    shots, path = pictures(steps=40), tmp_path / "a.mp4"
    animation.write(shots, path, 10, lambda: None)
    read = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(read, capture_output=True, check=True)
    width, height = shots.size_px
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3).astype(int)
    assert len(frames) == len(shots) == 4
    for shown, drawn in zip(frames, shots, strict=True):  # lossy, but the same picture
        assert np.abs(shown - np.asarray(drawn)).mean() < 6


def test_a_folder_for_the_file_is_made_before_anything_is_simulated(shell, checkpoint, monkeypatch):
    monkeypatch.setattr("hjepa_cli.stages.view.film", lambda *_: pytest.fail("simulated"))
    Path("file").write_text("")
    outcome = shell("view", "--out", "file/a.gif", "--checkpoint", checkpoint, "--quiet")
    assert_one_line_error(outcome, 74, "file")
    monkeypatch.undo()
    arguments = ("view", "--checkpoint", checkpoint, "--config", shell.directory / "small.toml")
    monkeypatch.chdir(shell.directory)
    assert shell(*arguments, "--every", "12", "--out", "new/a.gif", "--quiet").code == 0
    assert Path("new/a.gif").stat().st_size > 0


def test_dry_run_says_what_would_be_drawn(shell, checkpoint):
    with shell.untouched():
        outcome = shell("view", "--checkpoint", checkpoint, "--dry-run", "--devices", "5")
    assert outcome.code == 0 and "5 devices" in outcome.out and "hjepa-view.gif" in outcome.out


def test_what_cannot_be_viewed_is_refused(shell, checkpoint):
    small = ["--checkpoint", checkpoint, "--config", "small.toml", "--quiet"]
    with shell.untouched():
        oracle = ["view", "--methods", "oracle", *small]
        assert_one_line_error(shell(*oracle), 2, "oracle", "hjepa")
        assert_one_line_error(shell(*oracle, "--dry-run"), 2, "oracle", "hjepa")
        assert_one_line_error(shell("view", "--out", "a.avi", *small), 2, ".avi", ".mp4")
        assert_one_line_error(shell("view", "--fps", "60", *small), 2, "--fps 60", "50", ".mp4")
        assert_one_line_error(shell("view", "--live", *small), 2, "terminal")
        many = shell("view", "--devices", "100", *small)
        assert_one_line_error(many, 2, "100 devices", "1920 × 1440", "--devices with at most 24")
        assert_one_line_error(shell("view", "--delivery", "0", *small), 2, "--delivery")
        assert_one_line_error(shell("view", "--snr", "nan", *small), 2, "--snr")
