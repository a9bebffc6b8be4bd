"""Numbers depend on these versions."""

import importlib.metadata
import platform
from collections.abc import Sequence

from hjepa_cli import __version__

NUMBERS_FROM = ("hjepa", "numpy", "pymunk", "scipy", "torch")  # another version, other last digits
TRAINED_WITH = ("hjepa", "python", "torch", "numpy")  # as checkpoints name them


def versions(names: Sequence[str] = TRAINED_WITH) -> dict[str, str]:
    """Return the version of each of ``names``: ``"hjepa"``, ``"python"`` or a package's."""
    found = {"hjepa": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = found.get(name) or importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return {name: found[name] for name in names}
