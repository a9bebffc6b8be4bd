"""Plants other than the cart-poles: one module each, found by its name.

A module holds ``SYSTEM``, a :class:`hjepa_cli.core.system.System` of the module's name; a preset of
the same name holds its ranges and noise (docs/own_plant.md).
"""

import hashlib
import importlib
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hjepa_cli.core.system import System

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


def load(name: str) -> "System":
    """Return the system of one of :data:`NAMES`."""
    system: System = importlib.import_module(f"{__name__}.{name}").SYSTEM
    assert system.name == name, f"{name}.py holds a system called {system.name}"
    return system


def source_sha256(name: str) -> str:
    """Digest of the module of one of :data:`NAMES`: what is measured on a system depends on it."""
    file = importlib.import_module(f"{__name__}.{name}").__file__
    assert file is not None
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()
