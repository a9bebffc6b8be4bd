"""The shell offers names that lie on this disk when TAB is pressed, read without torch."""

import contextlib
import re
from collections.abc import Callable, Iterable
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


def resumable(incomplete: str) -> list[str]:
    """Return unfinished runs and collections, else directories."""
    begun = parents("runs/*/*/config.toml", incomplete)
    found = [run for run in begun if not Path(run, "result.json").exists()]
    return found + parents("data/*/collecting.jsonl", incomplete) or files(incomplete)


def several(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return what completes the last of some names between commas, each of which comes once."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        left = [name for name in names() if name not in before.split(",")]
        return [f"{before}{comma}{name}" for name in matching(left, last)]

    return complete


def payloads(incomplete: str) -> list[str]:
    """Return names of codecs, also those of a family; of one with numbers of its own the begin."""
    from hjepa_cli.plugins import CODECS

    names: list[str] = []
    for name in CODECS:
        family = name[: re.match(r"[a-z-]*", name).end()]  # type: ignore[union-attr]
        members = (f"{family}{number}" for number in range(2, 33))
        names += [one for one in (name, *members) if " " not in one and one in CODECS] or [family]
    return matching(list(dict.fromkeys(names)), incomplete)


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
