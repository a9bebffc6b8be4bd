"""Settings: one frozen dataclass per stage, filled from TOML presets and overridden by flags.

``presets/default.toml`` holds every value and is the only place where defaults live; the other
presets, ``--config FILE.toml`` and flags override single values of it. Precedence: flag >
``--config`` > ``--preset`` > default.
"""

import dataclasses
import difflib
import math
import sys
import tomllib
import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.plugins import PLANTS

T = typing.TypeVar("T")

CONFIG_LIMIT_BYTES = 2**20
_SHIPPED = sorted(
    Path(entry.name).stem for entry in (resources.files("hjepa_cli.config") / "presets").iterdir()
)
PRESETS = ("default", *(name for name in _SHIPPED if name != "default"))
PROTOCOLS = ("steady", "paper")  # scored after a warm-up, or from the start on as in the paper


@dataclasses.dataclass(frozen=True)
class CollectSettings:
    """``collect``: how the dataset is made."""

    trajectories: int
    test_trajectories: int
    clean_trajectories: int
    steps: int
    clean_steps: int
    start: tuple[float, ...]  # initial states are uniform in ± these; none: a cart-pole's four
    x_m: float
    x_dot_m_s: float
    theta_rad: float
    theta_dot_rad_s: float
    exploration_n: float
    exploration_hold_steps: int
    frames: Literal["rendered", "stored"]

    @property
    def half_widths(self) -> tuple[float, ...]:
        """Of the initial states, one per state."""
        return self.start or (self.x_m, self.x_dot_m_s, self.theta_rad, self.theta_dot_rad_s)


@dataclasses.dataclass(frozen=True)
class EncoderSettings:
    """``train-encoder``: the JEPA with its companion P^H, then the probe actor; or a baseline."""

    method: Literal["jepa", "supervised", "autoencoder"]
    frames: int  # κ, of the input
    embedding: int
    hidden: int
    h: int
    frame_input: Literal["difference", "pair"]
    stride_actions: Literal["all", "held"]
    residual: bool
    centre: bool
    steps: int
    batch_trajectories: int
    batch_frames: int
    rollout_steps: int
    optimizer: Literal["adamw", "sgd"]
    schedule: Literal["one-cycle", "constant"]
    learning_rate: float
    weight_decay: float
    gradient_clip: float
    ema_decay: float
    inverse_dynamics: float
    regulariser: Literal["none", "vicreg", "sigreg"]
    regulariser_weight: float
    mirror: Literal["exact", "augment", "none"]
    shift_px: int
    light_spread: float
    camera_noise: float
    precision: Literal["auto", "bf16", "fp32"]
    gate: bool
    gate_r2: tuple[float, ...]  # one per state; none: a cart-pole's four
    gate_r2_x: float
    gate_r2_x_dot: float
    gate_r2_theta: float
    gate_r2_theta_dot: float
    gate_rank: float
    gate_sensitivity: float
    gate_actor_nrmse: float

    @property
    def least_r2(self) -> tuple[float, ...]:
        """The gates of the linear probes, one per state."""
        four = (self.gate_r2_x, self.gate_r2_x_dot, self.gate_r2_theta, self.gate_r2_theta_dot)
        return self.gate_r2 or four


@dataclasses.dataclass(frozen=True)
class ActorSettings:
    """The semantic actor, fitted by both training stages."""

    hidden: int
    dropout: float
    schedule: Literal["one-cycle", "constant"]
    learning_rate: float
    weight_decay: float
    gradient_clip: float
    batch: int
    epochs: int


@dataclasses.dataclass(frozen=True)
class HierarchySettings:
    """``train-hierarchy``: P^H, P^M, P^L and ts-jepa-1 on frozen embeddings."""

    h: int
    m: int
    l: int
    shifted_copies: int
    rollout_steps: int
    batch_trajectories: int
    coarse_starts: int
    flat_starts: int
    fine_trajectories: int
    optimizer: Literal["adamw", "sgd"]
    schedule: Literal["one-cycle", "constant"]
    gradient_clip: float
    coarse_steps: int
    coarse_learning_rate: float
    coarse_weight_decay: float
    flat_steps: int
    medium_steps: int
    medium_learning_rate: float
    medium_weight_decay: float
    low_steps: int
    low_learning_rate: float
    low_weight_decay: float


@dataclasses.dataclass(frozen=True)
class ReflexSettings:
    """``train-reflex``: what answers a packet by its age, and the search for decaying holds."""

    forces_at_once: int
    steps: int
    batch_packets: int
    batch_ages: int
    learning_rate: float
    weight_decay: float
    gradient_clip: float
    search_devices: int
    search_steps: int
    search_candidates: int
    search_rounds: int
    fit_devices: int
    fit_candidates: int
    fit_rounds: int


@dataclasses.dataclass(frozen=True)
class ProtocolSettings:
    """``eval`` and ``scale``: the closed-loop protocol."""

    warmup_steps: int  # not scored
    steps: int  # scored
    curve_devices: int
    bracket_devices: int
    start: tuple[float, ...]  # as in [collect]
    x_m: float
    x_dot_m_s: float
    theta_rad: float
    theta_dot_rad_s: float
    noise: tuple[float, ...]  # standard deviation per control step; none: a cart-pole's two
    noise_x_dot_m_s: float
    noise_theta_dot_rad_s: float
    process_noise: Literal["velocity", "isotropic"]
    plant_spread: float
    payload: str
    gaps: tuple[int, ...]
    acceptable_score: float
    acceptable_lq_ratio: float
    bracket: float
    horizon: int
    bootstrap: int

    @property
    def half_widths(self) -> tuple[float, ...]:
        """Of the initial states, one per state."""
        return self.start or (self.x_m, self.x_dot_m_s, self.theta_rad, self.theta_dot_rad_s)

    @property
    def total_steps(self) -> int:
        """Steps of a simulation: the warm-up, then those that are scored."""
        return self.warmup_steps + self.steps

    @property
    def velocity_noise(self) -> tuple[float, ...]:
        """Standard deviation of what disturbs a step, one per state; 0 for positions."""
        return self.noise or (0.0, self.noise_x_dot_m_s, 0.0, self.noise_theta_dot_rad_s)


@dataclasses.dataclass(frozen=True)
class ConditionSettings:
    """``eval`` and ``scale``: how devices differ from those that models were trained on."""

    light: float
    camera_noise: float
    pole_length: float


@dataclasses.dataclass(frozen=True)
class RadioSettings:
    """``scale``: the radio cell."""

    law: Literal["duty", "equal", "scheduled"]
    snr_db: str
    bandwidth_hz: float
    noise: Literal["fixed", "scaled"]
    schedulers: tuple[str, ...]  # the rest is for the law "scheduled"
    uncertainty: Literal["age", "levels"]
    seeds: int
    power_margin_db: float
    coherence_slots: float
    overhead_bits: int
    block_error: float
    harq_rounds: int
    topology: Literal["target", "hall"]
    scenario: Literal["InF-LOS", "InF-SL", "InF-DL", "InF-SH", "InF-DH"]
    carrier_ghz: float
    power_dbm: float
    noise_figure_db: float

    @property
    def load_depends_on_snr(self) -> bool:
        """Law scheduled: by the halls' margins, or by what several copies of a packet are worth."""
        return self.topology == "hall" or (self.harq_rounds > 1 and self.block_error > 0)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Everything that defines a run besides the paths it reads and writes."""

    preset: str
    plant: str  # one of PLANTS
    seed: int
    device: Literal["auto", "cpu", "cuda"]
    methods: tuple[str, ...]
    collect: CollectSettings
    encoder: EncoderSettings
    actor: ActorSettings
    hierarchy: HierarchySettings
    reflex: ReflexSettings
    protocol: ProtocolSettings
    conditions: ConditionSettings
    radio: RadioSettings

    def as_dict(self) -> dict[str, Any]:
        """Return nested plain data, ready for JSON (tuples become lists).

        Empty lists are left out: they stand for values that say the same, and digests of settings
        stay what they were before there were such lists.
        """
        return typing.cast(dict[str, Any], _plain(dataclasses.asdict(self)))


def load_settings(
    preset: str | None = None,
    config: Path | None = None,
    flags: Mapping[str, Any] | None = None,
) -> Settings:
    """Merge default < preset < config file < flags.

    A plant has its own ranges and noise, so ``plant`` in flags or file alone means its preset.

    Args:
        preset: one of :data:`PRESETS`; ``None`` is that of the plant, else ``"default"``.
        config: a TOML file of the same shape as the presets.
        flags: dotted key (``"collect.steps"``) to value; ``None`` values were not given. The key
            ``"protocol"`` takes one of :data:`PROTOCOLS`, which sets several values between
            preset and config file.

    Raises:
        UsageError: unknown preset, protocol or key, or a value of the wrong type, naming the valid
            choices.
        MissingInputError: the config file is not there.
        DataError: the config file is not TOML.
    """
    name = preset or _preset_of_plant(config, flags or {})
    values: dict[str, Any] = {}
    for source, changes in _layers(name, config, flags or {}):
        if values:
            _override(values, changes, source)
        else:
            values = changes
    settings = _build(Settings, values | {"preset": name}, "")
    if settings.plant not in PLANTS:
        raise UsageError(f"plant = {settings.plant!r}; choose one of {', '.join(PLANTS)}")
    return settings


def origins(
    preset: str | None = None,
    config: Path | None = None,
    flags: Mapping[str, Any] | None = None,
) -> dict[str, str]:
    """Where each value of :func:`load_settings` comes from.

    Returns:
        Dotted key to ``"default"``, ``"preset NAME"``, ``"protocol paper"``, the config file's path
        or ``"flag"``.

    Raises:
        As :func:`load_settings`.
    """
    flags = flags or {}
    layers = _layers(preset or _preset_of_plant(config, flags), config, flags)
    return {key: source for source, changes in layers for key in dotted(changes)}


def dotted(values: Mapping[str, Any], separator: str = ".") -> dict[str, Any]:
    """Nested values by the path to them: ``{"a": {"b": 1}}`` → ``{"a.b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            below = dotted(value, separator)
            flat |= {f"{key}{separator}{name}": entry for name, entry in below.items()}
        else:
            flat[key] = value
    return flat


def _preset_of_plant(config: Path | None, flags: Mapping[str, Any]) -> str:
    plant = flags.get("plant") or (_read_config(config).get("plant") if config else None)
    return plant if plant in PRESETS else "default"


def _layers(
    preset: str, config: Path | None, flags: Mapping[str, Any]
) -> list[tuple[str, dict[str, Any]]]:
    """What defines the settings, weakest first: a source and the values it sets."""
    if preset not in PRESETS:
        raise UsageError(f"unknown preset '{preset}'; choose one of {', '.join(PRESETS)}")
    chosen = flags.get("protocol") or PROTOCOLS[0]
    if chosen not in PROTOCOLS:
        raise UsageError(f"unknown protocol {chosen!r}; choose one of {', '.join(PROTOCOLS)}")
    layers = [("default", _read_preset("default"))]
    if preset != "default":
        layers.append((f"preset {preset}", _read_preset(preset)))
    # What the presets set for the paper's protocol alone is a layer of its own.
    paper = [values.get("protocol", {}).pop("paper", {}) for _, values in layers]
    if chosen == "paper":
        layers += [("protocol paper", {"protocol": values}) for values in paper]
    if config is not None:
        layers.append((str(config), _read_config(config)))
    for key, value in flags.items():
        if value is not None and key != "protocol":
            section, _, field = key.rpartition(".")
            layers.append(("flag", {section: {field: value}} if section else {field: value}))
    return layers


def _read_preset(name: str) -> dict[str, Any]:
    text = (resources.files("hjepa_cli.config") / "presets" / f"{name}.toml").read_text(
        encoding="utf-8"
    )
    return tomllib.loads(text)


def _read_config(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > CONFIG_LIMIT_BYTES:
            raise DataError(f"config file {path} is larger than {CONFIG_LIMIT_BYTES} bytes")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MissingInputError(f"config file {path} does not exist") from None
    except RecursionError:
        raise DataError(f"config file {path} is nested too deeply") from None
    except (OSError, ValueError) as error:
        raise DataError(f"config file {path} is not readable TOML: {error}") from None


def _override(values: dict[str, Any], changes: Mapping[str, Any], source: str) -> None:
    """Write ``changes`` into ``values`` in place, refusing keys that default.toml does not have."""
    for key, value in changes.items():
        if key not in values:
            near = difflib.get_close_matches(key, values, n=1)
            suggestion = (
                f"did you mean '{near[0]}'?" if near else f"valid keys: {', '.join(values)}"
            )
            raise UsageError(f"unknown setting '{key}' in {source}; {suggestion}")
        if isinstance(values[key], dict):
            if not isinstance(value, Mapping):
                raise UsageError(f"'{key}' in {source} is a section, not a value")
            _override(values[key], value, f"{source}, section [{key}]")
        else:
            values[key] = value


def _build(kind: type[T], values: Mapping[str, Any], prefix: str) -> T:
    """Instantiate a settings dataclass, checking the type of every value."""
    hints = typing.get_type_hints(kind)
    return kind(**{name: _convert(hints[name], values[name], prefix + name) for name in hints})


NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


def _convert(hint: Any, value: Any, name: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, f"{name}.")
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        if value not in choices:
            raise UsageError(f"{name} = {value!r}; choose one of {', '.join(choices)}")
        return value
    if typing.get_origin(hint) is tuple:
        item = typing.get_args(hint)[0]
        if not isinstance(value, list | tuple):
            raise UsageError(f"{name} = {value!r}; expected a list")
        return tuple(_convert(item, entry, name) for entry in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) <= sys.float_info.max else math.inf
    if type(value) is not hint:
        raise UsageError(f"{name} = {value!r}; expected {NAMES[hint]}")
    if hint is float and not math.isfinite(value):
        raise UsageError(f"{name} = {value}; expected a finite number")
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items() if entry != ()}
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    return value
