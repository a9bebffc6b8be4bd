"""From what the user gives to checked settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.settings import PRESETS, Settings, load_settings
from hjepa_cli.errors import UsageError


def resolve(preset: str | None, config: Path | None, flags: Mapping[str, Any]) -> Settings:
    """Merge preset, file and flags; refuse values that make no sense before anything is touched."""
    plant = flags["plant"]
    settings = load_settings(preset, config, flags)
    if plant is not None and (own := load_settings(settings.preset).plant) != plant:
        named = plant if plant in PRESETS else "default"
        raise UsageError(
            f"preset '{settings.preset}' holds the ranges and noise of plant '{own}', "
            f"not of '{plant}'",
            hint=f"--preset {named} for plant {plant}; other values of it by --config FILE.toml",
        )
    check_settings(settings)
    return settings
