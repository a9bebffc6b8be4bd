"""Rules that settings must meet before anything is read, written or imported.

``settings.py`` checks types and names; here are the values. Every message names the setting, what
it is and what it may be, whether it came from a flag or a file.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from numbers import Integral
from typing import Any

from hjepa_cli.config.settings import (
    EncoderSettings,
    ProtocolSettings,
    RadioSettings,
    Settings,
    dotted,
)
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import PLANTS

# Every method `eval` and `scale` may be asked for; those without a model are skipped.
METHODS = (
    "hjepa",
    "ts-jepa-1",
    "ts-jepa-2",
    "ts-jepa-3",
    "ts-jepa-4",
    "ts-jepa-5",
    "supervised-2",
    "supervised-4",
    "autoencoder-2",
    "hold",
    "zero",
    "hold-decay",
    "hold-decay-linear",
    "chunk",
    "chunk-forces",
    "hold-true",
    "zero-true",
    "optimal",
    "oracle",
    "linear",
    "state-kf",
    "state-48",
    "local",
)

# Those of train-reflex: functions of the last packet and its age, without a predictor.
REFLEXES = ("hold-decay", "hold-decay-linear", "chunk", "chunk-forces")

# The paper's Fig. 3, and the ceiling of prediction.
COMPARED = (
    *("hjepa", "ts-jepa-1", "ts-jepa-2", "ts-jepa-3", "ts-jepa-4", "ts-jepa-5"),
    *("supervised-2", "supervised-4", "autoencoder-2", "hold", "zero", "optimal", "oracle"),
)

# Those that send the true state: they render and encode nothing.
TRUE_STATE = ("hold-true", "zero-true", "optimal", "oracle")

# Those that send camera frames as they are and act on them: no codec, no prediction.
RAW_FRAMES = ("supervised-2", "supervised-4", "autoencoder-2")

LATE = "+"  # between a method and the steps that its packets are late

# Those whose packets need no link, or that send none.
LINKLESS = ("optimal", "local")

ANY_DEPTH = re.compile(r"ts-jepa-[1-9]\d{0,4}")  # of a level that somebody trains

# Those fitted in closed form to embeddings, where they are measured.
ANCHORS = ("linear", "state-kf", "state-48", "local")

FRAMES = {"jepa": (2,), "supervised": (2, 4), "autoencoder": (2,)}  # κ, by --method

SCHEDULERS = (
    *("round-robin", "opportunistic", "max-aoi", "drift-plus-penalty", "whittle"),
    "innovation",
)

FLAGS_OF_LAWS = {  # of `scale`; all others mean something under each law
    "--scheduler": ("scheduled",),
    "--uncertainty": ("scheduled",),
    "--topology": ("scheduled",),
    "--power-margin-db": ("scheduled",),
    "--coherence-slots": ("scheduled",),
    "--seeds": ("scheduled",),
    "--noise": ("equal",),
    "--remeasure": ("duty", "equal"),
    "--dataset": ("duty", "equal"),
}

CARRIER_GHZ = (0.5, 100.0)  # validity of TR 38.901, clause 7.4
MAX_HARQ_ROUNDS = 16
LARGEST_SEED = 2**63 - 1
LARGEST_BANDWIDTH_HZ = 1e11  # beyond any radio band; keeps device counts in range
LARGEST_STRIDE = 10_000
# Counts that may be 0, and those of at least two: nothing is learned without a next one.
FROM_TWO = ("collect.steps", "encoder.batch_frames")
ZERO_ALLOWED = (
    *("seed", "encoder.shift_px", "hierarchy.shifted_copies", "radio.overhead_bits"),
    "protocol.warmup_steps",
)
NEGATIVE_ALLOWED = ("encoder.gate_", "radio.power_dbm")  # thresholds of R²; decibels
POSITIVE = (
    *("radio.bandwidth_hz", "protocol.acceptable_score", "protocol.bracket"),
    *("conditions.light", "conditions.pole_length"),
)
BELOW_ONE = (
    *("actor.dropout", "encoder.ema_decay", "encoder.light_spread"),
    *("protocol.plant_spread", "protocol.bracket"),
)


def check_settings(settings: Settings) -> None:
    """Check every value that has a rule.

    Raises:
        UsageError: naming the first setting that breaks one, and its valid values.
    """
    for key, value in _numbers(settings.as_dict()):
        _check_number(key, value)
    if settings.seed > LARGEST_SEED:
        raise UsageError(f"seed = {settings.seed}; expected at most {LARGEST_SEED}")
    check_strides(settings.hierarchy.h, settings.hierarchy.m, settings.hierarchy.l)
    _check_frames(settings.encoder)
    _check_halves(settings.encoder)
    check_methods(settings.methods)
    gaps = settings.protocol.gaps
    if not gaps or gaps[0] != 1 or list(gaps) != sorted(set(gaps)):
        raise UsageError(f"protocol.gaps = {list(gaps)}; expected ascending steps from 1 on")
    parse_payload(settings.protocol.payload)
    _check_radio(settings.radio)
    if settings.radio.bandwidth_hz > LARGEST_BANDWIDTH_HZ:
        raise UsageError(
            f"radio.bandwidth_hz = {settings.radio.bandwidth_hz:g}; "
            f"expected at most {LARGEST_BANDWIDTH_HZ:g}"
        )
    if settings.conditions.pole_length != 1:
        PLANTS[settings.plant].with_pole_length(settings.conditions.pole_length)


def check_strides(h: int, m: int, l: int) -> None:
    """Check that the strides of the three levels nest: h a multiple of m, m a multiple of l.

    Raises:
        UsageError: naming the strides that would do.
    """
    if not 1 <= h <= LARGEST_STRIDE:
        raise UsageError(f"--h {h}; expected 1 to {LARGEST_STRIDE}")
    fitting_m = _largest_divisor(h, m)
    fitting_l = _largest_divisor(fitting_m, l)
    hint = f"hjepa train-hierarchy --h {h} --m {fitting_m} --l {fitting_l}"
    for name, value, outer_name, outer in (("m", m, "h", h), ("l", l, "m", m)):
        if value < 1 or outer % value:
            choices = ", ".join(str(divisor) for divisor in _divisors(outer))
            raise UsageError(
                f"--{name} {value} does not divide --{outer_name} {outer}; "
                f"choose --{name} from {choices}",
                hint=hint,
            )


def check_methods(methods: tuple[str, ...]) -> None:
    """Check method names.

    Raises:
        UsageError: no name, or a name that no method has (``ts-jepa-N`` is one for any depth N).
    """
    if not methods:
        raise UsageError(f"no method given; choose from {', '.join(METHODS)}")
    for method in methods:
        if method not in METHODS and not ANY_DEPTH.fullmatch(method):
            raise UsageError(f"unknown method '{method}'; choose from {', '.join(METHODS)}")


def check_warmup(protocol: ProtocolSettings) -> None:
    """Check that no less is scored than was left out before.

    Raises:
        UsageError: fewer scored steps than the warm-up has.
    """
    if protocol.steps < protocol.warmup_steps:
        raise UsageError(
            f"protocol.steps = {protocol.steps} are scored after protocol.warmup_steps = "
            f"{protocol.warmup_steps}; expected at least as many as the warm-up has",
            hint=f"--protocol paper, or steps = {protocol.warmup_steps} or more in "
            "--config FILE.toml",
        )


def check_gaps(protocol: ProtocolSettings) -> None:
    """Check that what is scored is long enough for the gaps between packets.

    Raises:
        UsageError: fewer scored steps than the warm-up has, or than the longest gap.
    """
    check_warmup(protocol)
    if (longest := protocol.gaps[-1]) > protocol.steps:
        raise UsageError(
            f"protocol.gaps end with {longest} steps, and protocol.steps = {protocol.steps} are "
            "scored; expected gaps no longer than that",
            hint=f"steps = {longest} or more, or shorter gaps, in --config FILE.toml",
        )


def check_flags_of_law(law: str, given: Mapping[str, bool]) -> None:
    """Check that flags of ``scale`` that were given mean something under its law.

    Raises:
        UsageError: naming the law that the flag is for.
    """
    for flag, laws in FLAGS_OF_LAWS.items():
        if given[flag] and law not in laws:
            raise UsageError(
                f"{flag} is for the law {' or '.join(laws)}, this is {law}",
                hint=f"hjepa scale --law {laws[0]} {flag} …, or leave out {flag}",
            )


def check_schedulable(methods: Sequence[str], steps: int) -> None:
    """Check that methods can compete for the slots of one uplink, and that there are slots to win.

    Raises:
        UsageError: packets that take several slots, come late or need no link, or fewer than two
            steps.
    """
    if raw := [name for name in methods if split_late(name)[0] in RAW_FRAMES]:
        raise UsageError(
            f"law scheduled fits packets into slots; {', '.join(raw)} needs several slots for one",
            hint="choose --law duty for it, or other --methods",
        )
    for name in methods:
        method, delay_steps = split_late(name)
        if method in LINKLESS:
            raise UsageError(f"'{name}' has no link to share; choose a method that has one")
        if delay_steps:
            raise UsageError(f"'{name}': under law scheduled packets arrive in the slot they get")
    if steps < 2:
        raise UsageError(
            f"protocol.steps = {steps}; law scheduled needs at least 2, as in the first slot "
            "everybody is heard"
        )


def check_count(name: str, value: object) -> None:
    """Check what is given from Python as a number of something.

    Raises:
        UsageError: not a whole number of at least 1.
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
        raise UsageError(f"{name} = {value}; expected a whole number, at least 1")


def late(method: str, steps: int) -> str:
    """A method whose packets arrive ``steps`` steps after they were sent: ``supervised-2+3``."""
    return f"{method}{LATE}{steps}" if steps else method


def split_late(name: str) -> tuple[str, int]:
    """The method behind :func:`late`, and the steps.

    Raises:
        UsageError: what follows the sign is no number of steps.
    """
    method, sign, steps = name.partition(LATE)
    if sign and not re.fullmatch(r"[0-9]{1,18}", steps):
        raise UsageError(f"method '{name}'; expected whole steps after the {LATE}: {method}{LATE}3")
    return method, int(steps or 0)


def parse_payload(name: str) -> tuple[str, int, int]:
    """Read the name of a payload.

    Returns:
        Its kind (``float32``, ``float16``, ``int``, ``pca``), bits per value, and components.

    Raises:
        UsageError: no such payload.
    """
    if name in ("float32", "float16"):
        return name, int(name[-2:]), 0
    if (whole := re.fullmatch(r"int(\d{1,2})", name)) and 2 <= int(whole[1]) <= 16:
        return "int", int(whole[1]), 0
    parts = re.fullmatch(r"pca-(\d{1,3})x(\d{1,2})", name)
    if parts and 1 <= int(parts[1]) <= 256 and 1 <= int(parts[2]) <= 16:
        return "pca", int(parts[2]), int(parts[1])
    raise UsageError(
        f"unknown payload '{name}'; choose float32, float16, int2 … int16, or pca-NxB for N "
        "principal components (1 to 256) of B bits (1 to 16), like pca-8x6"
    )


def _check_frames(encoder: EncoderSettings) -> None:
    taken = FRAMES[encoder.method]
    if encoder.frames not in taken:
        choices = " or ".join(str(count) for count in taken)
        raise UsageError(f"--frames {encoder.frames}: method {encoder.method} takes {choices}")


def _check_halves(encoder: EncoderSettings) -> None:
    if encoder.mirror == "exact" and encoder.embedding % 2:
        raise UsageError(
            f"encoder.embedding = {encoder.embedding}; expected an even number, for a half that a "
            'mirror keeps and one that it negates, or mirror = "augment" or "none"'
        )


def _check_radio(radio: RadioSettings) -> None:
    if not radio.schedulers:
        raise UsageError(f"no scheduler given; choose from {', '.join(SCHEDULERS)}")
    for scheduler in radio.schedulers:
        if scheduler not in SCHEDULERS:
            raise UsageError(
                f"unknown scheduler '{scheduler}'; choose from {', '.join(SCHEDULERS)}"
            )
    low, high = CARRIER_GHZ
    if not low <= radio.carrier_ghz <= high:
        raise UsageError(f"radio.carrier_ghz = {radio.carrier_ghz:g}; expected {low:g} to {high:g}")
    if radio.coherence_slots < 1:
        raise UsageError(f"radio.coherence_slots = {radio.coherence_slots:g}; expected 1 or more")
    if radio.block_error > 0.5:
        raise UsageError(f"radio.block_error = {radio.block_error:g}; expected at most 0.5")
    if radio.harq_rounds > MAX_HARQ_ROUNDS:
        raise UsageError(
            f"radio.harq_rounds = {radio.harq_rounds}; expected 1 to {MAX_HARQ_ROUNDS}"
        )
    if radio.topology == "hall" and radio.law != "scheduled":
        raise UsageError(
            f"topology hall is for the law scheduled; law {radio.law} starts from the SNR itself"
        )


def _check_number(key: str, value: float) -> None:
    least = 0 if key in ZERO_ALLOWED else 2 if key in FROM_TWO else 1
    if isinstance(value, int) and value < least:
        raise UsageError(f"{key} = {value}; expected at least {least}")
    if value <= 0 and key in POSITIVE:
        raise UsageError(f"{key} = {value}; expected more than 0")
    if value < 0 and not key.startswith(NEGATIVE_ALLOWED):
        raise UsageError(f"{key} = {value}; expected at least 0")
    if value >= 1 and key in BELOW_ONE:
        raise UsageError(f"{key} = {value}; expected less than 1")


def _numbers(values: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Every number of nested settings with its dotted key; those in lists one by one."""
    for key, value in dotted(values).items():
        for entry in value if isinstance(value, list) else [value]:
            if isinstance(entry, int | float) and not isinstance(entry, bool):
                yield key, entry


def _divisors(number: int) -> list[int]:
    return [divisor for divisor in range(1, number + 1) if number % divisor == 0]


def _largest_divisor(number: int, limit: int) -> int:
    return max((d for d in _divisors(number) if d <= limit), default=1)
