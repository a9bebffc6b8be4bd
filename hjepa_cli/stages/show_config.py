"""``hjepa config show`` tells every value that a command would use, and where it comes from."""

from collections.abc import Mapping
from typing import Any

from hjepa_cli.config.schema import Settings, dotted
from hjepa_cli.errors import UsageError, meant
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.runs import to_toml

Result = dict[str, Any]


def show(
    screen: Screen,
    settings: Settings,
    *,
    sources: Mapping[str, str],
    key: str = "",
    as_toml: bool = False,
) -> Result:
    """Print the settings with their origins; return the document of ``--json``.

    Args:
        screen: shows them.
        settings: the resolved settings.
        sources: where each comes from, of :func:`hjepa_cli.config.settings.origins`.
        key: only this section or value; raise UsageError where there is none.
        as_toml: print a TOML file instead of a table, a complete one without ``key``.
    """
    values = dotted(settings.as_dict(complete=True))
    named = [name for name in sources if not key or name == key or name.startswith(f"{key}.")]
    shown = [name for name in named if name in values]  # empty lists say nothing
    if not shown:
        sections = sorted({name.split(".")[0] for name in sources})
        near = meant(key, [*sections, *values])
        raise UsageError(f"no setting or section '{key}'; {near}choose from {', '.join(sections)}")
    if as_toml:
        chosen = settings.as_dict(complete=True)
        if key:  # this section or value alone, and the preset that all are of
            section, _, name = key.partition(".")
            inside = chosen[section]
            chosen = {"preset": settings.preset, section: {name: inside[name]} if name else inside}
        for line in to_toml(chosen).splitlines():
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


def text(value: Any) -> str:
    """Return a value as TOML writes it, without quotes."""
    if isinstance(value, list):
        return f"[{', '.join(map(text, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
