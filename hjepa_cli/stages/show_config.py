"""``hjepa config show``: every value that a command would use, and where it comes from."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.config.settings import Settings, dotted, origins
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.runs import to_toml

Result = dict[str, Any]


def show(
    screen: Screen,
    settings: Settings,
    *,
    config: Path | None,
    flags: Mapping[str, Any],
    key: str = "",
    as_toml: bool = False,
) -> Result:
    """Print the settings with their origins; returns the document of ``--json``.

    Args:
        screen: where to.
        settings: the resolved settings.
        config, flags: what they were resolved from, besides their preset.
        key: only this section or value.
        as_toml: print a TOML file instead of a table, a complete one without ``key``.

    Raises:
        UsageError: no such section or value.
    """
    sources = origins(settings.preset, config, flags)
    values = dotted(settings.as_dict())
    named = [name for name in sources if not key or name == key or name.startswith(f"{key}.")]
    shown = [name for name in named if name in values]  # empty lists say nothing
    if not shown:
        sections = sorted({name.split(".")[0] for name in sources})
        raise UsageError(f"no setting or section '{key}'; choose from {', '.join(sections)}")
    if as_toml:
        for line in to_toml(_only(key, settings.as_dict())).splitlines():
            screen.result(line)
    else:
        screen.table(
            f"settings of preset {settings.preset}",
            ["setting", "value", "from"],
            [[name, text(values[name]), sources[name]] for name in shown],
        )
    return {
        "preset": settings.preset,
        "values": {name: {"value": values[name], "from": sources[name]} for name in shown},
    }


def _only(key: str, values: Mapping[str, Any]) -> Result:
    """The settings with this section or value alone, and the preset that all are of."""
    if not key:
        return dict(values)
    section, _, name = key.partition(".")
    inside = values[section]
    return {"preset": values["preset"], section: {name: inside[name]} if name else inside}


def text(value: Any) -> str:
    """One value as TOML writes it, without quotes."""
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
