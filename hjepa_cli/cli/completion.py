"""What the shell offers when TAB is pressed: names that lie on this disk, read without torch."""

import contextlib
import dataclasses
import typing
from pathlib import Path

from hjepa_cli.errors import HjepaError


def models(incomplete: str) -> list[str]:
    """Models of the zoo, finished training runs, checkpoint files."""
    from hjepa_cli.storage.checkpoints import MODEL_FILE
    from hjepa_cli.storage.zoo import list_models

    names: list[str] = []
    with contextlib.suppress(HjepaError):
        names += list_models()
    names += [str(path.parent) for path in sorted(Path("runs").glob(f"train-*/*/{MODEL_FILE}"))]
    return matching(names, incomplete) + files(incomplete, ".safetensors")


def datasets(incomplete: str) -> list[str]:
    """Finished datasets in data/, and directories."""
    names = [str(path.parent) for path in sorted(Path("data").glob("*/dataset.json"))]
    return matching(names, incomplete) or files(incomplete)


def runs(incomplete: str) -> list[str]:
    """Finished runs, and directories."""
    names = [str(path.parent) for path in sorted(Path("runs").glob("**/result.json"))]
    return matching(names, incomplete) or files(incomplete)


def settings(incomplete: str) -> list[str]:
    """Sections of the settings and the values in them."""
    from hjepa_cli.config.settings import Settings

    names = []
    for name, kind in typing.get_type_hints(Settings).items():
        names.append(name)
        if dataclasses.is_dataclass(kind):
            names += [f"{name}.{field.name}" for field in dataclasses.fields(kind)]
    return matching(names, incomplete)


def matching(names: list[str], incomplete: str) -> list[str]:
    """Those that go on from what was typed."""
    return [name for name in names if name.startswith(incomplete)]


def files(incomplete: str, suffix: str | None = None) -> list[str]:
    """Directories, and files of a suffix, that go on from what was typed."""
    folder, _, start = incomplete.rpartition("/")
    parent = Path(folder or ("/" if incomplete.startswith("/") else "."))
    found = []
    with contextlib.suppress(OSError):
        for path in sorted(parent.iterdir()):
            shown = path.name.startswith(start) and (start or not path.name.startswith("."))
            if shown and path.is_dir():
                found.append(f"{path}/")
            elif shown and suffix and path.suffix == suffix:
                found.append(str(path))
    return found
