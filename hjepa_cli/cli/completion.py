"""The shell offers names that lie on this disk when TAB is pressed, read without torch."""

import contextlib
from pathlib import Path

from hjepa_cli.errors import HjepaError


def models(incomplete: str) -> list[str]:
    """Return models of the zoo, finished training runs, checkpoint files."""
    from hjepa_cli.storage.checkpoints import MODEL_FILE
    from hjepa_cli.storage.zoo import list_models

    names: list[str] = []
    with contextlib.suppress(HjepaError):
        names += list_models()
    trained = parents(f"runs/train-*/*/{MODEL_FILE}", incomplete)
    return matching(names, incomplete) + trained + files(incomplete, ".safetensors")


def datasets(incomplete: str) -> list[str]:
    """Return finished datasets in data/, else directories."""
    return parents("data/*/dataset.json", incomplete) or files(incomplete)


def runs(incomplete: str) -> list[str]:
    """Return finished runs, else directories."""
    return parents("runs/**/result.json", incomplete) or files(incomplete)


def settings(incomplete: str) -> list[str]:
    """Return sections of the settings and the values in them."""
    from hjepa_cli.config.schema import declared

    names = dict.fromkeys(name for key in declared() for name in (key.partition(".")[0], key))
    return matching(list(names), incomplete)


def matching(names: list[str], incomplete: str) -> list[str]:
    """Return those that go on from what was typed."""
    return [name for name in names if name.startswith(incomplete)]


def parents(pattern: str, incomplete: str) -> list[str]:
    """Return the directories of files that a pattern finds here."""
    return matching([str(path.parent) for path in sorted(Path().glob(pattern))], incomplete)


def files(incomplete: str, suffix: str | None = None) -> list[str]:
    """Return directories, and files of a suffix, that go on from what was typed."""
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
