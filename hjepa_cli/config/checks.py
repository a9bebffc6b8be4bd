"""Settings must meet these rules before anything is read, written or imported.

``schema.py`` declares the type and the bounds of each value; here are the names, and what values
must be to each other. Every message names the setting, what it is and what it may be.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from numbers import Integral
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hjepa_cli.config.schema import (
    RECORDED,
    EncoderSettings,
    NrSettings,
    ProtocolSettings,
    RadioSettings,
    Settings,
    declared,
    flag_of,
)
from hjepa_cli.config.settings import PRESETS, load_settings, locate, validated
from hjepa_cli.errors import UsageError, meant
from hjepa_cli.plugins import CODECS, LAWS, METHODS, PHYS, PLANTS, SCHEDULERS, Registry

LATE = "+"  # between a method and the steps that its packets are late

FRAMES = {"jepa": (2, 4), "supervised": (2, 4), "autoencoder": (2,)}  # κ, by --method
FARTHEST_BACK = 15  # steps that a device remembers frames of

LARGEST_STRIDE = 10_000

# What is read of a cell in one topology only, and what a simulation of one uplink reads of it.
TOPOLOGIES = {
    "radio.power_margin_db": "target",
    **dict.fromkeys(("radio.scenario", "radio.carrier_ghz", "radio.power_dbm"), "hall"),
    "radio.noise_figure_db": "hall",
}
DEFAULT_NR = NrSettings()
# What is read of fading of some kinds only; all but "block" have a Doppler.
FADINGS = {
    "radio.speed_m_s": ("jakes", "tdl"),
    "radio.delay_spread_s": ("tdl",),
    "radio.coherence_slots": ("block",),
}
UPLINK = ("radio.power_margin_db", "radio.coherence_slots", "radio.block_error")


def resolve(preset: str | None, config: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Merge preset, file and flags; refuse values that make no sense before anything is touched."""
    plant = flags["plant"]
    settings = load_settings(preset, config, flags)
    held = [load_settings(settings.preset, file).plant for file in (None, config)]
    if plant not in (None, RECORDED, *held):  # of a recorded one its dataset holds all
        other = f"--preset {plant} for plant {plant}; other values of it by --config FILE.toml"
        own = f'--config FILE.toml with plant = "{plant}" and its values'
        raise UsageError(
            f"preset '{settings.preset}' holds the ranges and noise of plant '{held[0]}', "
            f"not of '{plant}'",
            hint=other if plant in PRESETS else own,
        )
    try:
        check_settings(settings)
    except UsageError as error:
        locate(error, preset, config, flags)
        raise
    return settings


def check_settings(settings: Settings) -> None:
    """Raise UsageError naming the first setting that breaks a rule, and its valid values.

    Settings that were made or changed in Python have not met any of the rules before.
    """
    settings = validated(dataclasses.asdict(settings))
    check_strides(settings.hierarchy.h, settings.hierarchy.m, settings.hierarchy.l)
    _check_encoder(settings.encoder)
    check_methods(settings.methods)
    gaps = settings.protocol.gaps
    if not gaps or gaps[0] != 1 or list(gaps) != sorted(set(gaps)):
        raise UsageError(
            f"protocol.gaps = {list(gaps)}; expected ascending steps from 1 on",
            key="protocol.gaps",
        )
    if (gap := settings.reflex.gap_steps) > settings.reflex.search_steps:
        raise UsageError(
            f"reflex.gap_steps = {gap}, and reflex.search_steps = {settings.reflex.search_steps} "
            "are scored; expected a gap no longer than that",
            key="reflex.gap_steps",
        )
    check_payload(settings.protocol.payload)
    _check_link(settings.protocol)
    _check_names(SCHEDULERS, settings.radio.schedulers, "radio.schedulers")
    if settings.plant == RECORDED and settings.sensor.works:
        raise UsageError(
            "[sensor] is of simulated cameras; the pictures of a recorded plant have been taken",
            key="sensor",
        )
    if settings.conditions.pole_length != 1:
        PLANTS[settings.plant].with_pole_length(settings.conditions.pole_length)


def check_strides(h: int, m: int, l: int) -> None:
    """Raise UsageError, naming strides that would do, unless m divides h, and l divides m."""
    if not 1 <= h <= LARGEST_STRIDE:
        raise UsageError(f"--h {h}; expected 1 to {LARGEST_STRIDE}", key="hierarchy.h")
    fitting_m = _largest_divisor(h, m)
    fitting_l = _largest_divisor(fitting_m, l)
    hint = f"hjepa train-hierarchy --h {h} --m {fitting_m} --l {fitting_l}"
    for name, value, outer_name, outer in (("m", m, "h", h), ("l", l, "m", m)):
        if value < 1 or outer % value:
            fitting = ", ".join(str(divisor) for divisor in _divisors(outer))
            raise UsageError(
                f"--{name} {value} does not divide --{outer_name} {outer}; "
                f"choose --{name} from {fitting}",
                hint=hint,
                key=f"hierarchy.{name}",
            )


def check_methods(methods: tuple[str, ...]) -> None:
    """Raise UsageError for no name, or one that no method has (of ``ts-jepa-N``, any N has)."""
    _check_names(METHODS, methods, "methods")


def _check_names(registry: Registry, names: tuple[str, ...], key: str) -> None:
    if not names:
        kind = registry.kind
        raise UsageError(f"no {kind} given; choose from {', '.join(registry)}", key=key)
    for name in names:
        if name not in registry:
            raise registry.unknown(name, key)


def needs_model(method: str) -> bool:
    """Return whether a method, on time or late, needs a trained model; unknown ones do."""
    name = method.partition(LATE)[0]
    return name not in METHODS or METHODS[name].needs_model


def without_model() -> tuple[str, ...]:
    """Return the methods that need no trained model."""
    return tuple(name for name in METHODS if not METHODS[name].needs_model)


def compared_methods() -> tuple[str, ...]:
    """Return the methods of the paper's Fig. 3, and the ceiling of prediction."""
    return tuple(name for name in METHODS if METHODS[name].compared)


def check_payload(name: str) -> None:
    """Raise UsageError where no codec is called so."""
    if name not in CODECS:
        described = [getattr(codec, "described", codec.name) for codec in CODECS.values()]
        raise UsageError(
            f"unknown payload '{name}'; {meant(name, CODECS)}choose {', '.join(described[:-1])}, "
            f"or {described[-1]}",
            key="protocol.payload",
        )


def check_warmup(protocol: ProtocolSettings) -> None:
    """Raise UsageError for fewer scored steps than the warm-up before them has."""
    if protocol.steps < protocol.warmup_steps:
        raise UsageError(
            f"protocol.steps = {protocol.steps} are scored after protocol.warmup_steps = "
            f"{protocol.warmup_steps}; expected at least as many as the warm-up has",
            hint=f"--protocol paper, or steps = {protocol.warmup_steps} or more in "
            "--config FILE.toml",
            key="protocol.steps",
        )


def check_gaps(protocol: ProtocolSettings) -> None:
    """Raise UsageError for fewer scored steps than the warm-up has, or than the longest gap."""
    check_warmup(protocol)
    if (longest := protocol.gaps[-1]) > protocol.steps:
        raise UsageError(
            f"protocol.gaps end with {longest} steps, and protocol.steps = {protocol.steps} are "
            "scored; expected gaps no longer than that",
            hint=f"steps = {longest} or more, or shorter gaps, in --config FILE.toml",
            key="protocol.gaps",
        )


def _check_link(protocol: ProtocolSettings) -> None:
    """Raise UsageError where the first packet may arrive when all is over."""
    latest = protocol.delay_steps + protocol.jitter_steps
    if latest >= protocol.total_steps:
        raise UsageError(
            f"packets may come {latest} steps late, and there are {protocol.total_steps} steps; "
            "nobody would be heard",
            hint="less --delay-steps and --jitter-steps, or more steps in --config FILE.toml",
            key="protocol.delay_steps" if protocol.delay_steps else "protocol.jitter_steps",
        )


def check_cell(
    radio: RadioSettings,
    given: Mapping[str, object] = MappingProxyType({}),
    nr: NrSettings = DEFAULT_NR,
    *,
    command: str = "scale",
) -> None:
    """Raise UsageError for what was set of a cell and is not read, naming what would read it.

    Set is what differs from the defaults; and of ``given``, the flags by the key of their setting
    or input, all that is neither ``None`` nor ``False``. What is read must go with the rest.
    """
    flags = [key for key, value in given.items() if value not in (None, False)]
    unlike = changed(radio) | changed(nr, "nr")
    # Aged knowledge is of one fade, whatever the law; only a simulation has taps.
    aged = radio.phy == "nr" and nr.cqi_age_slots > 0 and radio.fading in ("block", "jakes")
    for key in dict.fromkeys((*flags, *unlike)):
        flag = flag_of(declared()[key]) if key in declared() else None
        named = f"{key} = {unlike.get(key)!r}"
        if key in flags:
            named = flag.name if flag else f"--{key}"
        leave, where = f"or leave out {named}", None if key in flags else key
        layers = [phy for phy in PHYS if key in PHYS[phy].uses]
        if layers and radio.phy not in layers:
            raise UsageError(
                f"{named} is for the physical layer {' or '.join(layers)}, this is {radio.phy}",
                hint=f"hjepa {command} --phy {layers[0]} …, {leave}",
                key=where,
            )
        laws = [law for law in LAWS if key in LAWS[law].uses]
        moves = aged and key in ("radio.fading", "radio.speed_m_s", "radio.carrier_ghz")
        if laws and radio.law not in laws and not moves:
            raise UsageError(
                f"{named} is for the law {' or '.join(laws)}, this is {radio.law}",
                hint=f"hjepa scale --law {laws[0]} …, {leave}",
                key=where,
            )
        topology = TOPOLOGIES.get(key, radio.topology)
        carried = key == "radio.carrier_ghz" and radio.fading != "block"
        if topology != radio.topology and not carried:
            raise UsageError(
                f"{named} is for the topology {topology}, this is {radio.topology}",
                hint=f"hjepa scale --law scheduled --topology {topology} …, {leave}",
                key=where,
            )
        fades = FADINGS.get(key)
        if fades and not fits_fading(radio.fading, fades):
            raise UsageError(
                f"{named} is for --fading {', '.join(fades)}; this is {radio.fading}",
                hint=f"hjepa scale --law scheduled --fading {fades[0]} …, {leave}",
                key=where,
            )
    if radio.topology == "hall" and radio.fading.startswith("tdl"):
        raise UsageError(
            f"--fading {radio.fading} has a line of sight of its own, or none; --topology hall "
            "draws one for each device",
            hint="--fading jakes or block, or --topology target",
            key="radio.fading",
        )
    if radio.harq_rounds > 1 and radio.block_error == 0:
        raise UsageError(
            f"radio.harq_rounds = {radio.harq_rounds} is for a radio.block_error above 0; without "
            "one no packet is repeated",
            hint="set block_error in --config FILE.toml, or leave out harq_rounds",
            key="radio.harq_rounds",
        )
    if radio.phy == "nr":
        _check_nr(radio, nr)
    PHYS[radio.phy].check(radio, nr)


def _check_nr(radio: RadioSettings, nr: NrSettings) -> None:
    """Raise UsageError for what was set of an NR uplink and other settings of it leave no use."""
    schedulers = [SCHEDULERS[name] for name in radio.schedulers if radio.law == "scheduled"]
    adapts, decides = nr.mcs < 0, any(not one.in_turn for one in schedulers)
    needs = {
        "nr.bler_target": (adapts or nr.reports == "grant", "an MCS that adapts"),
        "nr.link_adaptation": (
            adapts and nr.cqi_age_slots > 0,
            "--cqi-age-slots and an MCS that adapts",
        ),
        "nr.grants_per_slot": (decides or nr.grants == "dynamic", "--grants dynamic"),
        "nr.reports": (any(one.wants_reports for one in schedulers), "a scheduler as innovation"),
    }
    for key, value in changed(nr, "nr").items():
        read, what = needs.get(key, (True, ""))
        if not read and (flag := flag_of(declared()[key])):
            raise UsageError(
                f"{flag.name} {value} is for {what}; nothing reads it here",
                hint=f"leave out {flag.name}",
                key=key,
            )


def fits_fading(fading: str, fades: Sequence[str]) -> bool:
    """Return whether a kind of fading is among some, of which tdl stands for all its profiles."""
    return fading.partition("-")[0] in fades


def check_uplink(radio: RadioSettings) -> None:
    """Raise UsageError for what was set of a cell and a simulation of one uplink does not read."""
    for key, value in changed(radio).items():
        if key not in UPLINK and (key, value) != ("radio.law", "scheduled"):
            raise UsageError(
                f"{key} = {value!r} is for hjepa scale; simulate_cell reads {', '.join(UPLINK)}",
                hint="hjepa scale --law scheduled, or leave it out",
            )


def changed(
    of: RadioSettings | NrSettings | ProtocolSettings, section: str = "radio"
) -> dict[str, Any]:
    """Return the settings of a section that are not as declared, by dotted key."""
    values = {field: getattr(of, field.name) for field in dataclasses.fields(of)}
    return {f"{section}.{field.name}": v for field, v in values.items() if v != field.default}


def check_schedulable(methods: Sequence[str], steps: int) -> None:
    """Raise UsageError for methods that cannot compete for the slots of one uplink.

    Their packets take several slots, come late or need no link, or there are fewer than two slots.
    """
    described = {name: METHODS[split_late(name)[0]] for name in methods}
    if raw := [name for name, method in described.items() if method.sends == "frames"]:
        raise UsageError(
            f"law scheduled fits packets into slots; {', '.join(raw)} needs several slots for one",
            hint="choose --law duty for it, or other --methods",
            key="methods",
        )
    for name, method in described.items():
        if not method.needs_link:
            raise UsageError(
                f"'{name}' has no link to share; choose a method that has one", key="methods"
            )
        if split_late(name)[1]:
            raise UsageError(
                f"'{name}': under law scheduled packets arrive in the slot they get", key="methods"
            )
    if steps < 2:
        raise UsageError(
            f"protocol.steps = {steps}; law scheduled needs at least 2, as in the first slot "
            "everybody is heard",
            key="protocol.steps",
        )


def check_count(name: str, value: object) -> None:
    """Raise UsageError for a number of something, from Python, that is no whole one from 1 on."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
        raise UsageError(f"{name} = {value}; expected a whole number, at least 1")


def late(method: str, steps: int) -> str:
    """Name a method whose packets arrive so many steps after they were sent: ``supervised-2+3``."""
    return f"{method}{LATE}{steps}" if steps else method


def split_late(name: str) -> tuple[str, int]:
    """Return the method behind :func:`late`, and the steps; raise UsageError for other endings."""
    method, sign, steps = name.partition(LATE)
    if sign and not re.fullmatch(r"[0-9]{1,18}", steps):
        raise UsageError(f"method '{name}'; expected whole steps after the {LATE}: {method}{LATE}3")
    return method, int(steps or 0)


def _check_encoder(encoder: EncoderSettings) -> None:
    if encoder.frames not in FRAMES[encoder.method]:
        fitting = " or ".join(map(str, FRAMES[encoder.method]))
        raise UsageError(
            f"--frames {encoder.frames}; method {encoder.method} takes {fitting}",
            key="encoder.frames",
        )
    if (back := encoder.look[0]) > FARTHEST_BACK:
        most = FARTHEST_BACK * encoder.frame_gap // back
        raise UsageError(
            f"encoder.frame_gap = {encoder.frame_gap} of {encoder.frames} frames is {back} steps "
            f"back; a device remembers {FARTHEST_BACK}: choose 1 to {most}",
            key="encoder.frame_gap",
        )
    if encoder.mirror == "exact" and encoder.embedding % 2:
        raise UsageError(
            f"encoder.embedding = {encoder.embedding}; expected an even number, for a half that a "
            'mirror keeps and one that it negates, or mirror = "augment" or "none"',
            key="encoder.embedding",
        )


def _divisors(number: int) -> list[int]:
    return [divisor for divisor in range(1, number + 1) if number % divisor == 0]


def _largest_divisor(number: int, limit: int) -> int:
    return max((d for d in _divisors(number) if d <= limit), default=1)
