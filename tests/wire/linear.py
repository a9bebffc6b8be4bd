"""A linear world whose predictor is exact: then every force must be the law of the true state.

z is the state itself, and the model's networks are the plant's own equations. So a controller that
moves a late embedding on under any other forces than those that were played is found out at once.
"""

from pathlib import Path

import numpy as np

from hjepa_cli.wire import protocol
from hjepa_cli.wire.bundle import Bundle
from hjepa_cli.wire.controller import Controller
from hjepa_cli.wire.device import Device

SIZE, STRIDE = 8, 4
KEY = bytes(range(32))
PERIOD_S = 0.01
_random = np.random.default_rng(5)
TURN, _ = np.linalg.qr(_random.normal(size=(SIZE, SIZE)))
A = 0.999 * TURN.astype(np.float32)
B = _random.normal(size=SIZE).astype(np.float32) * 0.3
LAW = -0.5 * (A.T @ B) / np.float32(B @ B)  # takes half of z's part along B away: stable


def law_n(z):
    return z @ LAW


def moved(z, force_n):
    return z @ A.T + np.asarray(force_n)[..., None] * B


class LinearRuntime:
    """It has a runtime's methods, in closed form."""

    def plan(self, z):
        forces_n = np.empty((len(z), STRIDE, 1), np.float32)
        for step in range(STRIDE):
            forces_n[:, step, 0] = law_n(z)
            z = moved(z, forces_n[:, step, 0])
        return forces_n, z.astype(np.float32)

    def follow(self, z, forces_n, ages):
        z = z.copy()
        for step in range(int(ages.max(initial=0))):
            on = ages > step
            z[on] = moved(z[on], forces_n[on, step, 0])
        return z


def bundle(plant="linear", digest=b"d" * 32):
    manifest = {
        "plant": plant,
        "embedding": SIZE,
        "frames": 2,
        "action_shape": [],
        "stride": STRIDE,
        "force_limit_n": 1000.0,
        "step_s": 0.001,
    }
    return Bundle(Path("."), manifest, digest)


def controller(**more):
    return Controller(bundle(), LinearRuntime(), KEY, **more)


def device(number=1, **more):
    return Device(bundle(), number, KEY, PERIOD_S, **more)


def connect(server, *devices, now_s=0.0):
    for one in devices:
        for data, _ in server.receive(one.upkeep(now_s), one.number, now_s):
            one.receive(data, 0, now_s)
        assert one.connected


def settle(server, now_s):
    """Return all that a controller has to say now."""
    outgoing = []
    while more := server.work(now_s):
        outgoing += more
    return outgoing


class World:
    """One plant, its device, and a link whose delays are given in steps."""

    def __init__(self, server, one, up=lambda k: 0, down=lambda k: 0, kicks=()):
        self.server, self.device, self.up, self.down, self.kicks = server, one, up, down, kicks
        self.z = np.random.default_rng(one.number).normal(size=SIZE).astype(np.float32)
        self.flying_up, self.flying_down, self.errors = {}, {}, []
        connect(server, one)

    def run(self, steps, gap):
        for k in range(steps):
            now_s = k * PERIOD_S
            if k in self.kicks:
                self.z = self.z + np.float32(1.0)
            if k % gap == 0:
                data = self.device.embed(k, self.z)
                self.flying_up.setdefault(k + self.up(k), []).append(data)
            for data in self.flying_up.pop(k, []):
                assert self.server.receive(data, self.device.number, now_s) == []
            for data, _ in settle(self.server, now_s):
                delay = self.down(k)
                if delay is not None:
                    self.flying_down.setdefault(k + delay, []).append(data)
            for data in self.flying_down.pop(k, []):
                self.device.receive(data, k, now_s)
            played = self.device.play(k)
            self.errors.append(abs(float(played.forces_n[0]) - float(law_n(self.z))))
            self.z = moved(self.z, played.forces_n[0])
        return np.array(self.errors)


def planned_steps(one):
    return one.counts[protocol.SOURCES[protocol.PLANNED]]
