"""A plant that hjepa does not know: MuJoCo moves and shows a puck that two forces push around.

Nothing but pictures and actions goes through import, both trainings and offline evaluation; there
are no states, and pictures have another size.
"""

import os

import numpy as np
import pytest
from command_line import open_shell

os.environ.setdefault("MUJOCO_GL", "egl")
mujoco = pytest.importorskip("mujoco")

PUCK = """<mujoco>
<option timestep="0.005" integrator="RK4" gravity="0 0 0"/>
<visual><global offwidth="96" offheight="48"/><quality shadowsize="0"/></visual>
<worldbody>
  <light pos="0 0 3" dir="0 0 -1" directional="true"/>
  <camera name="top" pos="0 0 1.05" fovy="50"/>
  <geom type="plane" size="2 2 .1" rgba="1 1 1 1"/>
  <body pos="0 0 .1">
    <joint name="x" type="slide" axis="1 0 0" damping="0.3"/>
    <joint name="y" type="slide" axis="0 1 0" damping="0.3"/>
    <geom type="cylinder" size=".09 .03" rgba=".1 .3 .8 1" mass="1"/>
  </body>
</worldbody>
<actuator>
  <motor joint="x" ctrlrange="-4 4"/>
  <motor joint="y" ctrlrange="-4 4"/>
</actuator>
</mujoco>"""
LIMIT_N, STEPS, SUBSTEPS = 4.0, 80, 4
CONFIG = """
[encoder]
embedding = 64
hidden = 256
steps = 300
batch_trajectories = 8
photometric = "none"
[augment]
strength = 0.0
[actor]
hidden = 256
epochs = 40
[hierarchy]
coarse_steps = 400
flat_steps = 50
medium_steps = 100
low_steps = 100
[protocol]
bootstrap = 200
"""


def record(episodes, seed, exploration_n):
    """Return frames [N, T, 48, 96, 3], actions and the law's answers [N, T, 2]."""
    model = mujoco.MjModel.from_xml_string(PUCK)
    data = mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, 48, 96)
    except Exception as error:  # MuJoCo's own, of machines without OpenGL
        pytest.skip(f"MuJoCo cannot render here: {error}")
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    random = np.random.default_rng(seed)
    frames = np.empty((episodes, STEPS, 48, 96, 3), np.uint8)
    actions, expert = np.empty((2, episodes, STEPS, 2))
    for n in range(episodes):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = random.uniform(-1, 1, 2) * [0.55, 0.22]
        data.qvel[:] = random.uniform(-1, 1, 2) * [1.2, 0.7]
        for k in range(STEPS):
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "top")
            frames[n, k] = renderer.render()
            if k % 5 == 0:
                push_n = random.normal(0, exploration_n, 2)
            law_n = -16 * data.qpos - 3.2 * data.qvel
            expert[n, k] = law_n.clip(-LIMIT_N, LIMIT_N)
            actions[n, k] = (expert[n, k] + push_n).clip(-LIMIT_N, LIMIT_N)
            data.ctrl[:] = actions[n, k]
            mujoco.mj_step(model, data, SUBSTEPS)
    renderer.close()
    return {"frames": frames, "actions": actions, "expert_actions": expert}


@pytest.mark.slow
def test_a_recorded_plant_is_learned_and_beats_holding_three_times(tmp_path, monkeypatch, capsys):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    np.savez(tmp_path / "train.npz", **record(32, 0, 1.5))
    np.savez(tmp_path / "test.npz", **record(8, 1, 0.0))
    (tmp_path / "small.toml").write_text(CONFIG)

    def run(*words):
        outcome = shell(*words, "--json")
        assert outcome.code == 0, outcome
        return outcome.document

    said = ("--fps", 50, "--limit", LIMIT_N, "--size", 48, 96, "--test", "test.npz")
    imported = run("data", "import", "train.npz", *said, "--out", "d")
    assert imported["frame_shape"] == [48, 96, 3] and imported["limits"] == [LIMIT_N] * 2
    assert imported["states"] == [] and not imported["alignment"]["clear"]
    small = ("--config", "small.toml", "--dataset", "d")
    encoder = run("train-encoder", *small, "--out", "encoder", "--no-gate")
    assert encoder["health"]["probe_r2"] == {}
    assert {"effective_rank", "action_sensitivity", "action_r2"} <= encoder["gates"].keys()
    run("train-hierarchy", *small, "--encoder", "encoder", "--out", "model")
    found = run("eval", *small, "--checkpoint", "model", "--methods", "hjepa,hold,oracle,zero")
    assert list(found["methods"]) == ["hjepa", "hold", "zero"] and "oracle" in found["skipped"]
    hjepa, hold = (np.mean(found["methods"][name]["nmae"][1:]) for name in ("hjepa", "hold"))
    assert 3 * hjepa < hold, (hjepa, hold)
    latent = found["latent"]["hjepa"]
    assert latent["steps"][0] == 4 and latent["error"][-1] < 0.5 * latent["still"][-1]
