"""Extensions by name: the package's own, those of installed packages, and files that the user names.

Six kinds of things can be added without a change to the package: plants, codecs, schedulers,
methods, sharing laws and stages. Each is one object that says what it extends and what it is
called. The package's own are listed in :data:`BUILT_IN` and imported when one is asked for; others
come from an entry point of the group ``hjepa.plugins``, a module that calls :func:`register`, or
from a file that the user names (``--plugin FILE.py``). Nothing else ever causes an import: what a
dataset, a checkpoint or a run says is data.
"""

import contextlib
import contextvars
import dataclasses
import hashlib
import importlib
import importlib.metadata
import sys
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from hjepa_cli.errors import MissingInputError, UsageError

GROUP = "hjepa.plugins"

BUILT_IN: dict[str, dict[str, str]] = {
    "plant": {
        "desktop": "hjepa_cli.core.plants.cartpole.plant:DESKTOP",
        "gym": "hjepa_cli.core.plants.cartpole.plant:GYM",
        "quadrotor": "hjepa_cli.core.plants.quadrotor:QUADROTOR",
    },
}


@dataclasses.dataclass(frozen=True)
class Source:
    """Where extensions came from.

    Attributes:
        name: the path of a file as the user named it, or an installed distribution with its version.
        sha256: of the file's bytes, or of the name.
        text: the file's code, which other processes run again; ``None`` of an installed one.
    """

    name: str
    sha256: str
    text: str | None = dataclasses.field(default=None, repr=False)


class Registry:
    """Extensions of one kind.

    Args:
        kind: ``"plant"``, ``"codec"`` …, as in messages.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._own = BUILT_IN.get(kind, {})
        self._added: dict[str, tuple[Any, Source | None]] = {}

    def __iter__(self) -> Iterator[str]:
        """Names, the package's own first."""
        load_installed()
        return iter([*self._own, *self._added])

    def __contains__(self, name: object) -> bool:
        return name in self._own or name in list(self)

    def __getitem__(self, name: str) -> Any:
        """The extension called ``name``.

        Raises:
            UsageError: there is none, naming those that there are.
        """
        if name in self._own:
            module, _, attribute = self._own[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
        if name not in self:
            raise UsageError(f"unknown {self.kind} '{name}'; choose from {', '.join(self)}")
        return self._added[name][0]

    def source(self, name: str) -> Source | None:
        """Where an extension came from; ``None`` for the package's own, and for unknown names."""
        return self._added[name][1] if name in self._added else None

    def add(self, item: Any, source: Source | None) -> None:
        """Take up an extension under its ``name``. Raises UsageError where that is taken."""
        name = getattr(item, "name", None)
        if not isinstance(name, str) or not name:
            raise UsageError(f"a {self.kind} without a name: {item!r}")
        if name in self._own or name in self._added:
            raise UsageError(f"there is a {self.kind} called '{name}' already; choose another name")
        self._added[name] = item, source


KINDS = ("plant", "codec", "scheduler", "method", "law", "stage")
PLANTS, CODECS, SCHEDULERS, METHODS, LAWS, STAGES = (Registry(kind) for kind in KINDS)
_REGISTRIES = {one.kind: one for one in (PLANTS, CODECS, SCHEDULERS, METHODS, LAWS, STAGES)}

_sources: list[Source] = []
_loading: contextvars.ContextVar[Source | None] = contextvars.ContextVar("loading", default=None)
_looked = False


def register(*items: Any) -> None:
    """Add extensions: a plant, codec, scheduler, method, sharing law or stage each.

    Each says by its attribute ``extends`` which of them it is, as the classes of the package do
    that it is made with, and has a ``name``.

    Raises:
        UsageError: it says nothing of the kind, has no name, or one that is taken.
    """
    for item in items:
        kind = getattr(item, "extends", None)
        if kind not in _REGISTRIES:
            raise UsageError(f"{item!r} extends nothing; it must be a {' or '.join(KINDS)}")
        _REGISTRIES[kind].add(item, _loading.get())


def load_file(path: Path) -> Source:
    """Run a file that registers extensions; a second time only if it has changed its place or text.

    Raises:
        MissingInputError: there is no such file.
        UsageError: it cannot be read, does not run, or registers what cannot be; in one line with
            the file and the line. Nothing of it stays registered then.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise MissingInputError(f"plugin {path} does not exist") from None
    except (OSError, ValueError) as error:
        raise UsageError(f"plugin {path} cannot be read: {error}") from None
    source = Source(str(path), hashlib.sha256(text.encode()).hexdigest(), text)
    ensure([source])
    return source


def ensure(sources: Iterable[Source]) -> None:
    """Load the files that another process has loaded, from the text that it read.

    Raises:
        UsageError: as :func:`load_file`.
    """
    load_installed()
    for source in sources:
        if source.text is not None and source.sha256 not in {one.sha256 for one in _sources}:
            _run(source, source.text)


def in_force() -> tuple[Source, ...]:
    """All that was loaded from outside of the package, in order."""
    load_installed()
    return tuple(_sources)


def load_installed() -> None:
    """Import the entry points of :data:`GROUP` of all installed packages, once.

    Raises:
        UsageError: one does not import, or registers what cannot be, naming its package.
    """
    global _looked
    if _looked:
        return
    _looked = True
    for point in importlib.metadata.entry_points(group=GROUP):
        name = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
        source = Source(name, hashlib.sha256(name.encode()).hexdigest())
        with _transaction(source, name, hint=f"pip uninstall {name.split()[0]}"):
            point.load()


def _run(source: Source, text: str) -> None:
    """Run a plugin's text as a module of its own."""
    name = f"hjepa_plugin_{Path(source.name).stem}_{source.sha256[:8]}"
    module = types.ModuleType(name, f"The plugin {source.name}.")
    module.__file__ = source.name
    with _transaction(source, source.name):
        sys.modules[name] = module  # dataclasses and pickle look there
        try:
            exec(compile(text, source.name, "exec"), module.__dict__)
        except BaseException:
            del sys.modules[name]
            raise


@contextlib.contextmanager
def _transaction(source: Source, file: str, hint: str | None = None) -> Iterator[None]:
    """Register all or nothing; every error becomes a line that names the file and the line."""
    before = {kind: dict(one._added) for kind, one in _REGISTRIES.items()}
    token = _loading.set(source)
    try:
        yield
    except Exception as error:
        for kind, added in before.items():
            _REGISTRIES[kind]._added = added
        reason = error.message if isinstance(error, UsageError) else _reason(error)
        raise UsageError(f"plugin {_place(error, file)}: {reason}", hint=hint) from None
    else:
        _sources.append(source)
    finally:
        _loading.reset(token)


def _reason(error: Exception) -> str:
    first = next(iter(str(error).splitlines()), "")
    return f"{type(error).__name__}: {first}" if first else type(error).__name__


def _place(error: Exception, file: str) -> str:
    """``FILE:LINE`` of the plugin where an error came from."""
    line = error.lineno if isinstance(error, SyntaxError) and error.filename == file else None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == file:
            line = trace.tb_lineno
        trace = trace.tb_next
    return file if line is None else f"{file}:{line}"
