"""Other people's agents get the cart-poles as Gymnasium environments (extra ``gym``).

Importing this module registers ``hjepa/CartPole-v0`` (the agent sees the state) and
``hjepa/CartPolePixels-v0`` (it sees the camera). Starts, process noise and length are those of the
closed loop of ``--protocol paper``, which is over for a pole that has fallen; here an episode also
ends when the cart has left the picture, because agents learn little there.
"""

import math
from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

try:
    import gymnasium
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        'hjepa_cli.gym needs gymnasium: pip install "hjepa[gym]"', name=missing.name
    ) from None
from gymnasium import spaces

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.checks import check_count
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.arrays import described
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.control.loop import noise_per_step
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.named import Camera, CartPole
from hjepa_cli.errors import ArrayError, NumericalError, UsageError

Observation = NDArray[Any]
REWARDS = ("lq", "score")
LOSSES = 0x1055  # this stream's branch of the seed tree


class CartPoleEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """The observation is a cart-pole's state (x, x_dot, theta, theta_dot) in SI units.

    The action [1] in -1 … 1 is the force ÷ its limit, 20 N. ``info`` has ``state`` and ``score``,
    the share of control steps of this action inside the band |x| ≤ 0.05 m, |theta| ≤ 0.05 rad.

    Args:
        plant: ``"desktop"`` (1 ms control steps, 1,000 of them) or ``"gym"`` (20 ms, 300).
        reward: ``"lq"``: 1 - min(xᵀQx + Ru², 50) ÷ 50 with the teacher's Q and R; ``"score"``: 1
            inside the band, else 0. Both are means over the control steps of the action.
        action_repeat: control steps that each action is held for.
        noise: process noise as in the protocol, or none.
        render_mode: ``"rgb_array"`` or ``None``.

    Raises:
        UsageError: unknown plant or reward, or steps that are not a count.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        *,
        plant: str = "desktop",
        reward: str = "lq",
        action_repeat: int = 1,
        noise: bool = True,
        render_mode: str | None = None,
    ) -> None:
        if reward not in REWARDS:
            raise UsageError(f"unknown reward '{reward}'; choose one of {', '.join(REWARDS)}")
        check_count("action_repeat", action_repeat)
        self._pole = CartPole(plant)
        self._kind = self._pole.plant
        preset = "gym" if plant == "gym" else None
        # Episodes have a start.
        self._protocol = load_settings(preset, flags={"protocol": "paper"}).protocol
        self._camera = Camera(self._kind)
        self._reward, self._repeat = reward, action_repeat
        self._noise = noise_per_step(self._protocol) * noise
        self._k = 0
        self.render_mode = render_mode
        render_fps = max(round(1 / (self._kind.step_s * action_repeat)), 1)
        self.metadata = type(self).metadata | {"render_fps": render_fps}
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        states = spaces.Box(-STATE_LIMIT, STATE_LIMIT, (4,), np.float32)
        self.observation_space: spaces.Space[Any] = states

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start as the closed loop does: anywhere in its range, then one step without a force."""
        super().reset(seed=seed)
        # A new simulation: what pymunk remembers of the last episode would move the last bits.
        self._pole = CartPole(self._kind)
        half_widths = np.array(self._protocol.half_widths)
        self._pole.state = self.np_random.uniform(-1, 1, 4) * half_widths
        self._pole.step(0.0)  # from k = -1 to 0, which nobody scores
        self._k = 0
        return self._observe(), self._info(float(self._kind.in_band(self._pole.state)))

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply a force for ``action_repeat`` control steps; raise NumericalError if not finite."""
        kind, limit_n = self._kind, self._kind.force_limit_n
        forces = np.asarray(action, float)
        if forces.size != 1:
            raise ArrayError(f"the action: {described(forces)}; expected one number, in -1 to 1")
        share = float(forces.reshape(-1)[0])
        if not math.isfinite(share):
            raise NumericalError(f"the action is not finite at step {self._k}: {share}")
        force_n = min(max(share, -1.0), 1.0) * limit_n
        score = cost = 0.0
        steps = max(1, min(self._repeat, self._protocol.steps - self._k))  # after the end, too
        for _ in range(steps):
            state = self._pole.state
            score += float(kind.in_band(state))
            cost += float(kind.cost(state, np.float64(force_n)))
            self._pole.step(force_n)
            moved = self._pole.state + self.np_random.standard_normal(4) * self._noise
            self._pole.state = np.clip(moved, -STATE_LIMIT, STATE_LIMIT)
        self._k += steps
        x_m, _, theta_rad, _ = self._pole.state
        fallen = abs(theta_rad) > math.pi / 2 or abs(x_m) > kind.window_m[0] / 2
        reward = score / steps if self._reward == "score" else 1 - cost / steps / COST_CAP
        over = self._k >= self._protocol.steps
        return self._observe(), reward, bool(fallen), bool(over), self._info(score / steps)

    def render(self) -> Any:
        """Return the camera's frame uint8 [64, 128, 3], in render mode ``rgb_array``."""
        return self._frame() if self.render_mode == "rgb_array" else None

    def _observe(self) -> Observation:
        return self._pole.state.astype(np.float32)

    def _frame(self) -> NDArray[np.uint8]:
        (frame,) = self._camera.render(self._pole.state[None])
        return frame

    def _info(self, score: float) -> dict[str, Any]:
        return {"state": self._pole.state, "score": score}


class CartPolePixelsEnv(CartPoleEnv):
    """The camera sees the same cart-pole: observations are frames uint8 [64, 128, 3].

    One frame shows no velocity. ``gymnasium.wrappers.FrameStackObservation(env, 10)`` gives the
    last ten; an encoder takes those that ``model.look`` says, how many steps back, the oldest
    first: ``stack[[-1 - back for back in model.look]]``. Those of ``reset`` are its one frame, as
    wrappers have no other: a pole at rest to an encoder.

    Args:
        **options: those of :class:`CartPoleEnv`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.observation_space = spaces.Box(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8)

    def _observe(self) -> Observation:
        return self._frame()


class LossyChannel(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """This uplink loses observations: the agent then sees the last one that got through.

    The first observation of an episode always arrives. ``info`` has ``delivered`` and
    ``age_steps``, the actions since the observation was taken.

    Args:
        env: any environment.
        delivery_probability: p, of each observation, independently. For a Rayleigh-fading link,
            1 - ``hjepa_cli.core.radio.channel.outage_probability(rate_bps, bandwidth_hz, snr_db)``.
            Raise UsageError outside 0 … 1.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], delivery_probability: float) -> None:
        # For ``spec``, from which ``gymnasium.make`` makes it again.
        kept = {"delivery_probability": delivery_probability}
        gymnasium.utils.RecordConstructorArgs.__init__(self, **kept)
        super().__init__(env)
        if not (isinstance(delivery_probability, Real) and 0 <= delivery_probability <= 1):
            raise UsageError(f"delivery_probability = {delivery_probability}; expected 0 to 1")
        self.delivery_probability = delivery_probability
        self._received: Any = None
        self._age = 0
        self._random = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; a seed also fixes which observations get lost."""
        if seed is not None:  # a stream of its own: losses do not change the plant's noise
            self._random = generator(seed, LOSSES)
        observation, info = super().reset(seed=seed, options=options)
        self._received, self._age = observation, 0
        return observation, info | {"delivered": True, "age_steps": 0}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Act; what is seen of it may be old."""
        observation, reward, terminated, truncated, info = super().step(action)
        delivered = bool(self._random.random() < self.delivery_probability)
        if delivered:
            self._received, self._age = observation, 0
        else:
            self._age += 1
        info = info | {"delivered": delivered, "age_steps": self._age}
        return self._received, reward, terminated, truncated, info


# By name, so that a ``spec`` can be written down, and made again elsewhere.
gymnasium.register("hjepa/CartPole-v0", entry_point="hjepa_cli.gym:CartPoleEnv")
gymnasium.register("hjepa/CartPolePixels-v0", entry_point="hjepa_cli.gym:CartPolePixelsEnv")
