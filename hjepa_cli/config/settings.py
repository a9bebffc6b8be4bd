"""Settings come in layers: declared defaults < preset < protocol < ``--config`` < flags.

The defaults are those of :mod:`hjepa_cli.config.schema`; presets (TOML files in ``presets/``),
``--config FILE.toml`` and flags override single values.
"""

import dataclasses
import functools
import operator
import re
import tomllib
import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from hjepa_cli.config.schema import (
    PAPER_PROTOCOL,
    Settings,
    bare,
    choices_of,
    declared,
    dotted,
    must_be,
    plain,
)
from hjepa_cli.errors import DataError, MissingInputError, UsageError, choices, meant
from hjepa_cli.plugins import LAWS, PHYS, PLANTS, read_regular

_FOLDER = resources.files("hjepa_cli.config") / "presets"
_CONTROL_LAWS = resources.files("hjepa_cli.config") / "control_laws.toml"
PRESETS = ("default", *sorted(Path(entry.name).stem for entry in _FOLDER.iterdir()))
PROTOCOLS = ("steady", "paper")  # scored after a warm-up, or from the start on as in the paper


@dataclasses.dataclass(frozen=True)
class Layer:
    """A source has values: a preset, a protocol, a file (then with its ``text``), or a flag."""

    source: str
    values: dict[str, Any]
    text: str | None = None

    def place(self, key: str) -> str:
        """Return where a file sets a key, for a message: `` in c.toml, line 3``; else nothing."""
        if self.text is None:
            return ""
        line = _line_of(self.text, key)
        return f" in {self.source}" if line is None else f" in {self.source}, line {line}"


def load_settings(
    preset: str | None = None,
    config: str | Path | None = None,
    flags: Mapping[str, Any] | None = None,
) -> Settings:
    """Merge default < control law of the plant < preset < config file < flags.

    A plant has its own ranges and noise, so ``plant`` in flags or file alone means its preset.

    Args:
        preset: one of :data:`PRESETS`; ``None`` is that of the plant, else ``"default"``.
        config: a TOML file of the same shape as the presets.
        flags: values by dotted key (``"collect.steps"``), ``None`` where not given; ``"protocol"``
            is one of :data:`PROTOCOLS`, which sets several between preset and config file.

    Raises:
        UsageError: unknown preset, protocol or key, or a value of the wrong type or out of bounds,
            naming the key, what it must be, and the file and line that set it.
        MissingInputError: the config file is not there.
        DataError: the config file is not TOML.
    """
    name, layers = _layers(preset, config, flags or {})
    values: dict[str, Any] = {}
    for layer in layers:
        _merge(values, layer.values, layer)

    try:
        return validated(values | {"preset": name})
    except UsageError as error:
        error.locate(functools.partial(_place, layers))
        raise


def locate(
    error: UsageError, preset: str | None, config: str | Path | None, flags: Mapping[str, Any]
) -> None:
    """Name the file and the line, in an error about a setting that is none of a flag or preset."""
    if error.key is not None:
        _, layers = _layers(preset, config, flags)
        error.locate(functools.partial(_place, layers))


def origins(
    preset: str | None = None,
    config: str | Path | None = None,
    flags: Mapping[str, Any] | None = None,
) -> dict[str, str]:
    """Return where each value of :func:`load_settings` comes from, by dotted key.

    That is ``"default"``, ``"preset NAME"``, ``"protocol paper"``, the config file's path or
    ``"flag"``.
    """
    _, layers = _layers(preset, config, flags or {})
    return {key: layer.source for layer in layers for key in dotted(layer.values)}


def validated(values: Mapping[str, Any]) -> Settings:
    """Make settings of nested values, each of the type and within the bounds of its declaration.

    Raise UsageError with the key, its value, and what it must be.
    """
    values = {key: plain(value) for key, value in values.items()}
    try:
        settings = msgspec.convert(values, Settings)
    except msgspec.ValidationError as error:
        path = str(error).rpartition("`$.")[2].rstrip("`")  # as protocol.gaps[1]
    else:
        for key, names in (("plant", PLANTS), ("radio.law", LAWS), ("radio.phy", PHYS)):
            if (value := operator.attrgetter(key)(settings)) not in names:
                known = choices(value, names, "choose one of")
                raise UsageError(f"{key} = {value!r}; {known}", key=key)
        return settings
    key, _, index = path.rstrip("]").partition("[")
    hint, value = declared().get(key), functools.reduce(operator.getitem, key.split("."), values)
    if hint is None:
        raise UsageError(f"{key} = {value!r}; expected a section")
    if index:
        hint, value = typing.get_args(bare(hint))[0], value[int(index)]
    words = choices_of(hint)
    wanted = choices(value, words, "choose one of") if words else f"expected {must_be(hint)}"
    raise UsageError(f"{path} = {value!r}; {wanted}", key=key)


def _place(layers: list[Layer], key: str) -> str:
    """Return where the layer that counts sets a key, for a message."""
    found = (layer for layer in reversed(layers) if key in dotted(layer.values))
    return next((layer.place(key) for layer in found), "")


def _layers(
    preset: str | None, config: str | Path | None, flags: Mapping[str, Any]
) -> tuple[str, list[Layer]]:
    """Return the preset's name and what defines the settings, weakest first."""
    for key in flags:
        if not isinstance(key, str):
            raise UsageError(f"unknown setting {key!r}; expected a dotted key as 'protocol.steps'")
    file = [] if config is None else [_read_config(Path(config))]
    if preset is None:  # that of the plant
        plant = flags.get("plant") or next((one.values.get("plant") for one in file), None)
        preset = plant if plant in PRESETS else "default"
    if preset not in PRESETS:
        raise UsageError(f"unknown preset '{preset}'; {choices(preset, PRESETS, 'choose one of')}")
    protocol = flags.get("protocol") or PROTOCOLS[0]
    if protocol not in PROTOCOLS:
        raise UsageError(
            f"unknown protocol {protocol!r}; {choices(protocol, PROTOCOLS, 'choose one of')}"
        )
    defaults = dataclasses.asdict(Settings())
    del defaults["preset"]
    layers, paper = [Layer("default", defaults)], [PAPER_PROTOCOL]
    if preset != "default":
        values = tomllib.loads((_FOLDER / f"{preset}.toml").read_text(encoding="utf-8"))
        paper.append(values.get("protocol", {}).pop("paper", {}))
        layers.append(Layer(f"preset {preset}", values))
    plants = [flags.get("plant"), *(one.values.get("plant") for one in reversed([*layers, *file]))]
    plant = next(one for one in plants if one is not None)
    if law := _control_laws().get(str(plant)):
        layers.insert(1, Layer(f"tuned law of {plant}", {"control": law}))
    if protocol == "paper":
        layers += [Layer("protocol paper", {"protocol": values}) for values in paper]
    layers += file
    for key, value in flags.items():
        if value is not None and key != "protocol":
            for name in reversed(key.split(".")):
                value = {name: value}
            layers.append(Layer("flag", value))
    return preset, layers


@functools.cache
def _control_laws() -> dict[str, Any]:
    """Return the section [control] of each plant that has one, as ``tune-law`` found it."""
    return tomllib.loads(_CONTROL_LAWS.read_text(encoding="utf-8"))


def _read_config(path: Path) -> Layer:
    try:
        text = read_regular(path)
        return Layer(str(path), tomllib.loads(text), text)
    except FileNotFoundError:
        raise MissingInputError(f"config file {path} does not exist") from None
    except RecursionError:
        raise DataError(f"config file {path} is nested too deeply") from None
    except (OSError, ValueError) as error:
        raise DataError(f"config file {path} is not readable TOML: {error}") from None


def _merge(
    values: dict[str, Any], changes: Mapping[str, Any], layer: Layer, prefix: str = ""
) -> None:
    """Write changes into values in place; refuse keys that there are not, once there are some."""
    if not values:
        values |= changes
        return
    for name, value in changes.items():
        key = prefix + name
        if name not in values:
            near = meant(name, values, prefix).rstrip()
            suggestion = near or f"valid keys: {', '.join(values)}"
            raise UsageError(f"unknown setting '{key}'{layer.place(key)}; {suggestion}")
        inside = isinstance(values[name], dict)
        if inside != isinstance(value, Mapping):
            kind = "a section, not a value" if inside else "a value, not a section"
            raise UsageError(f"'{key}'{layer.place(key)} is {kind}")
        if inside:
            _merge(values[name], value, layer, f"{key}.")
        else:
            values[name] = value


def _line_of(text: str, key: str) -> int | None:
    """Return the line that sets a key or opens its section; ``None`` where that is not certain."""
    if '"""' in text or "'''" in text:  # lines in there may look like others
        return None
    section, found = "", []
    for number, line in enumerate(text.split("\n"), start=1):
        if header := re.match(r"\s*\[\s*([\w.-]+)\s*\]", line):
            name, section = header[1], f"{header[1]}."
        elif assigned := re.match(r"\s*([\w.-]+)\s*=", line):
            name = section + assigned[1]
        else:
            continue
        if name == key:
            found.append(number)
    return found[0] if len(found) == 1 else None
