"""hjepa does semantic predictive control over wireless links with a hierarchical JEPA.

The names in ``__all__`` are the public Python interface; each is imported when it is first used, so
that ``import hjepa_cli`` costs nothing. Examples: docs/reference/python.md.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Camera": "hjepa_cli.core.plants.named",
    "CartPole": "hjepa_cli.core.plants.named",
    "Dataset": "hjepa_cli.core.datasets.dataset",
    "Model": "hjepa_cli.core.networks.model",
    "collect": "hjepa_cli.api",
    "drive": "hjepa_cli.api",
    "evaluate": "hjepa_cli.api",
    "load_dataset": "hjepa_cli.api",
    "load_model": "hjepa_cli.api",
    "load_settings": "hjepa_cli.config.settings",
    "predict": "hjepa_cli.api",
    "register": "hjepa_cli.plugins",
    "scale": "hjepa_cli.api",
    "simulate_cell": "hjepa_cli.api",
    "teacher": "hjepa_cli.core.plants.named",
    "train_encoder": "hjepa_cli.api",
    "train_hierarchy": "hjepa_cli.api",
    "train_reflex": "hjepa_cli.api",
}

if TYPE_CHECKING:
    from hjepa_cli.api import (
        collect,
        drive,
        evaluate,
        load_dataset,
        load_model,
        predict,
        scale,
        simulate_cell,
        train_encoder,
        train_hierarchy,
        train_reflex,
    )
    from hjepa_cli.config.settings import load_settings
    from hjepa_cli.core.datasets.dataset import Dataset
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.plants.named import Camera, CartPole, teacher
    from hjepa_cli.plugins import register

__all__ = [
    "Camera",
    "CartPole",
    "Dataset",
    "Model",
    "collect",
    "drive",
    "evaluate",
    "load_dataset",
    "load_model",
    "load_settings",
    "predict",
    "register",
    "scale",
    "simulate_cell",
    "teacher",
    "train_encoder",
    "train_hierarchy",
    "train_reflex",
]


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'hjepa_cli' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
