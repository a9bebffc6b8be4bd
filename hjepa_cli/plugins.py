"""Extensions have names: the package's own, those of installed packages, and of the user's files.

Seven kinds of things can be added without a change to the package: plants, codecs, schedulers,
methods, sharing laws, physical layers and stages. Each is one object, made with a class of the
package, and has a name. Codecs and methods may be families, whose ``member(name)`` makes the
extension of a name, as ``pca-8x6``, or returns ``None`` for the names of others.

The package's own are listed in :data:`BUILT_IN` and imported when one is asked for; others
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
import re
import sys
import traceback
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from hjepa_cli.errors import MissingInputError, UsageError, choices, shell

GROUP = "hjepa.plugins"
LIMIT_BYTES = 2**20  # of a file that a person names and writes by hand

_CONTROL = "hjepa_cli.core.control"
BUILT_IN: dict[str, dict[str, str]] = {
    "plant": {
        "desktop": "hjepa_cli.core.plants.cartpole.plant:DESKTOP",
        "gym": "hjepa_cli.core.plants.cartpole.plant:GYM",
        "quadrotor": "hjepa_cli.core.plants.quadrotor:QUADROTOR",
        "recorded": "hjepa_cli.core.plants.recorded:UNKNOWN",
    },
    "scheduler": {
        "round-robin": "hjepa_cli.core.radio.schedulers.round_robin:ROUND_ROBIN",
        "opportunistic": "hjepa_cli.core.radio.schedulers.opportunistic:OPPORTUNISTIC",
        "max-aoi": "hjepa_cli.core.radio.schedulers.max_aoi:MAX_AOI",
        "drift-plus-penalty": "hjepa_cli.core.radio.schedulers.drift_plus_penalty:LYAPUNOV",
        "whittle": "hjepa_cli.core.radio.schedulers.whittle:WHITTLE",
        "innovation": "hjepa_cli.core.radio.schedulers.innovation:INNOVATION",
    },
    "law": {
        "duty": "hjepa_cli.core.radio.laws.duty:DUTY",
        "equal": "hjepa_cli.core.radio.laws.equal:EQUAL",
        "scheduled": "hjepa_cli.core.radio.laws.scheduled:SCHEDULED",
    },
    "phy": {
        "shannon": "hjepa_cli.core.radio.phy.shannon:SHANNON",
        "nr": "hjepa_cli.core.radio.phy.nr:NR",
    },
    "stage": {
        "tune-law": "hjepa_cli.stages.pipeline:TUNE_LAW",
        "collect": "hjepa_cli.stages.pipeline:COLLECT",
        "train-encoder": "hjepa_cli.stages.pipeline:TRAIN_ENCODER",
        "train-hierarchy": "hjepa_cli.stages.pipeline:TRAIN_HIERARCHY",
        "train-reflex": "hjepa_cli.stages.pipeline:TRAIN_REFLEX",
        "train-fusion": "hjepa_cli.stages.pipeline:TRAIN_FUSION",
        "eval": "hjepa_cli.stages.pipeline:EVAL",
        "scale": "hjepa_cli.stages.pipeline:SCALE",
        "survive": "hjepa_cli.stages.pipeline:SURVIVE",
        "reproduce": "hjepa_cli.stages.pipeline:REPRODUCE",
        "bench-link": "hjepa_cli.stages.pipeline:BENCH_LINK",
    },
    "codec": {
        "float32": f"{_CONTROL}.codecs.float:FLOAT32",
        "float16": f"{_CONTROL}.codecs.float:FLOAT16",
        "int2 … int16": f"{_CONTROL}.codecs.integers:INTEGERS",
        "pca-NxB": f"{_CONTROL}.codecs.principal_components:PRINCIPAL_COMPONENTS",
    },
    "method": {
        "hjepa": f"{_CONTROL}.methods.predictors:HJEPA",
        "hjepa-fused": f"{_CONTROL}.methods.predictors:HJEPA_FUSED",
        **{f"ts-jepa-{h}": f"{_CONTROL}.methods.predictors:TS_JEPA" for h in range(1, 6)},
        "supervised-2": f"{_CONTROL}.methods.raw_frames:SUPERVISED_2",
        "supervised-4": f"{_CONTROL}.methods.raw_frames:SUPERVISED_4",
        "autoencoder-2": f"{_CONTROL}.methods.raw_frames:AUTOENCODER_2",
        "hold": f"{_CONTROL}.methods.last_force:HOLD",
        "zero": f"{_CONTROL}.methods.last_force:ZERO",
        "hold-decay": f"{_CONTROL}.methods.reflexes:HOLD_DECAY",
        "hold-decay-linear": f"{_CONTROL}.methods.reflexes:HOLD_DECAY_LINEAR",
        "chunk": f"{_CONTROL}.methods.reflexes:CHUNK",
        "chunk-forces": f"{_CONTROL}.methods.reflexes:CHUNK_FORCES",
        "hold-true": f"{_CONTROL}.methods.true_state:HOLD_TRUE",
        "zero-true": f"{_CONTROL}.methods.true_state:ZERO_TRUE",
        "optimal": f"{_CONTROL}.methods.true_state:OPTIMAL",
        "oracle": f"{_CONTROL}.methods.true_state:ORACLE",
        "oracle-teacher": f"{_CONTROL}.methods.true_state:ORACLE_TEACHER",
        "ceiling": f"{_CONTROL}.methods.true_state:CEILING",
        "linear": f"{_CONTROL}.methods.predictors:LINEAR",
        "state-kf": f"{_CONTROL}.methods.filtered_state:STATE_KF",
        "state-48": f"{_CONTROL}.methods.filtered_state:STATE_48",
        "local": f"{_CONTROL}.methods.last_force:LOCAL",
    },
}


CLASSES = {  # what extensions are made with, those with families too
    "plant": ("hjepa_cli.core.plants.system:System",),
    "codec": (f"{_CONTROL}.codecs.codec:Codec", f"{_CONTROL}.codecs.codec:CodecFamily"),
    "scheduler": ("hjepa_cli.core.radio.schedulers.scheduler:Scheduler",),
    "method": (f"{_CONTROL}.methods.method:Method", f"{_CONTROL}.methods.method:MethodFamily"),
    "law": ("hjepa_cli.core.radio.laws.law:SharingLaw",),
    "phy": ("hjepa_cli.core.radio.phy.phy:Phy",),
    "stage": ("hjepa_cli.stages.stage:Stage",),
}


NAME = re.compile(r"\w[\w.-]{0,63}")  # goes into flags, lists between commas and paths
TAKEN = {  # names that mean something else where such a name may stand
    "stage": (
        *("resume", "view", "report", "compare", "data", "models", "config"),
        *("export", "serve", "device", "link"),
    ),
    "plant": ("default", "paper", "smoke"),
}


@dataclasses.dataclass(frozen=True)
class Source:
    """Extensions came from here.

    Attributes:
        name: the path of a file as the user named it, or an installed package with its version.
        sha256: of the file's bytes, or of the name.
        text: the file's code, which other processes run again; ``None`` of an installed one.
    """

    name: str
    sha256: str
    text: str | None = dataclasses.field(default=None, repr=False)

    @property
    def installed(self) -> bool:
        """Return whether it is an installed distribution, and no file."""
        return self.sha256 == _digest(self.name)


class Registry:
    """It finds extensions of one ``kind``: ``"plant"``, ``"codec"`` …, as in messages."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._own = BUILT_IN.get(kind, {})
        self._added: dict[str, tuple[Any, Source | None]] = {}

    def __iter__(self) -> Iterator[str]:
        """Return the names, the package's own first."""
        load_installed()
        return iter([*self._own, *self._added])

    def __contains__(self, name: str) -> bool:
        return self._place(name) is not None

    def __getitem__(self, name: str) -> Any:
        """Return the extension called ``name``, which its family makes where it has one.

        Raise UsageError, naming those that there are, where there is none.
        """
        place = self._place(name)
        if place is None:
            raise self.unknown(name)
        item = self._load(place)
        if not _is_family(item):
            return item
        made = item.member(name)
        if not isinstance(made, _imported(CLASSES[self.kind][0])) or made.name != name:
            raise self.fault(place, f"{self.kind}s {place}: member('{name}') made {made!r}")
        return made

    def unknown(self, name: str, key: str | None = None) -> UsageError:
        """Return the error for a name that there is not, in the setting ``key``."""
        return UsageError(f"unknown {self.kind} '{name}'; {choices(name, self)}", key=key)

    def fault(self, name: str, what: str) -> UsageError:
        """Return the error for what an extension returned and may not, with where it came from."""
        source = self._added[name][1] if name in self._added else self.source(name)
        if source is None:
            return UsageError(what)
        hint = f"correct {source.name}, or run it again with --debug to see the traceback"
        return UsageError(f"plugin {source.name}: {what}", hint=None if source.installed else hint)

    def values(self) -> list[Any]:
        """Return the extensions themselves, each once; of a family the family."""
        return list({id(item): item for item in map(self._load, self)}.values())

    def source(self, name: str) -> Source | None:
        """Return where an extension came from; ``None`` for the package's own and unknown ones."""
        place = self._place(name)
        return self._added[place][1] if place in self._added else None

    def add(self, item: Any, source: Source | None) -> None:
        """Take up an extension under its ``name``.

        Raise UsageError where that is taken, or no word that a flag, a list or a path can carry.
        """
        name = getattr(item, "name", None)
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise UsageError(
                f"a {self.kind} cannot be called {name!r}; choose a name of up to 64 letters, "
                "digits, '_', '-' and '.' that begins with a letter or a digit"
            )
        if name in [*self._own, *self._added, *TAKEN.get(self.kind, ())] or name in self:
            taken = "something else" if name in TAKEN.get(self.kind, ()) else f"a {self.kind}"
            raise UsageError(f"there is {taken} called '{name}' already; choose another name")
        self._added[name] = item, source

    def _place(self, name: str) -> str | None:
        """Return the name that ``name`` is registered under, its own or its family's."""
        exact = [name] if name in self._own or name in list(self) else []
        if self.kind not in WITH_FAMILIES:
            return next(iter(exact), None)
        return next((place for place in exact or list(self) if self._makes(place, name)), None)

    def _makes(self, place: str, name: str) -> bool:
        item = self._load(place)
        return item.member(name) is not None if _is_family(item) else place == name

    def _load(self, place: str) -> Any:
        if place not in self._own:
            return self._added[place][0]
        return _imported(self._own[place])


def _imported(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


def check_members(item: Any, kind: Any, *names: str, optional: bool = False) -> None:
    """Raise UsageError for a member of an extension that is not of a kind.

    The kind is a class, or ``callable`` for functions; ``None`` will do where it is ``optional``.
    """
    for name in names:
        value = getattr(item, name, None)
        if optional and value is None:
            continue
        if not (callable(value) if kind is callable else isinstance(value, kind)):
            kinds = kind if isinstance(kind, tuple) else (kind,)
            wanted = " or ".join("function" if one is callable else one.__name__ for one in kinds)
            raise UsageError(
                f"{type(item).__name__} '{item.name}': {name} = {value!r} is no {wanted}"
            )


def _is_family(item: Any) -> bool:
    return hasattr(item, "member")


WITH_FAMILIES = tuple(kind for kind, places in CLASSES.items() if len(places) > 1)
_REGISTRIES = {kind: Registry(kind) for kind in CLASSES}
PLANTS, CODECS, SCHEDULERS, METHODS, LAWS, PHYS, STAGES = _REGISTRIES.values()

_sources: list[Source] = []
_loading: contextvars.ContextVar[Source | None] = contextvars.ContextVar("loading", default=None)
_looked = False


def register(*items: Any) -> None:
    """Add extensions, each made with a class of :data:`CLASSES`, which says of which kind it is.

    Raise UsageError where it is not, or where its name is taken.
    """
    for item in items:
        for kind, places in CLASSES.items():
            if isinstance(item, tuple(map(_imported, places))):
                if kind == "plant":  # the others check themselves when they are made
                    item.check_members()
                _REGISTRIES[kind].add(item, _loading.get())
                break
        else:
            made_with = (place.partition(":")[2] for places in CLASSES.values() for place in places)
            raise UsageError(f"{item!r} extends nothing; make it with {', '.join(made_with)}")


def load_file(path: Path) -> Source:
    """Run a file that registers extensions; again only if its text has changed, in place of before.

    Raises:
        MissingInputError: there is no such file.
        UsageError: it cannot be read, does not run, or registers what cannot be; it names the line,
            and nothing of the file stays registered.
    """
    try:
        text = read_regular(path)
    except FileNotFoundError:
        raise MissingInputError(f"plugin {path} does not exist") from None
    except (OSError, ValueError) as error:
        raise UsageError(f"plugin {path} cannot be read: {error}") from None
    source = Source(str(path), _digest(text), text)
    ensure([source])
    return source


def read_regular(path: Path) -> str:
    """Return the text of a file that a person named.

    Raise OSError where it cannot be read, ValueError where it is none, or too large.
    """
    if path.exists() and not path.is_file():  # a pipe, or a device that never ends
        raise ValueError("not a regular file")
    if path.stat().st_size > LIMIT_BYTES:
        raise ValueError(f"larger than {LIMIT_BYTES} bytes")
    return path.read_text(encoding="utf-8-sig")  # editors of some systems begin with a mark


def ensure(sources: Iterable[Source]) -> None:
    """Load files as :func:`load_file`, from the text that another process has read."""
    load_installed()
    for source in sources:
        if source.text is not None and source.sha256 not in {one.sha256 for one in _sources}:
            _run(source, source.text)


def blamed(error: BaseException) -> str | None:
    """Return where in a plugin's file an error arose, here or in a worker, as ``FILE:LINE``."""
    files = "|".join(re.escape(source.name) for source in _sources if source.text is not None)
    text = "".join(traceback.format_exception(error))  # a worker's is in there as text
    found = re.findall(rf'^[ |]*File "({files})", line (\d+)', text, re.MULTILINE) if files else ()
    return ":".join(found[-1]) if found else None


def in_force() -> tuple[Source, ...]:
    """Return all that was loaded from outside of the package, in order."""
    load_installed()
    return tuple(_sources)


def load_installed() -> None:
    """Import the entry points of :data:`GROUP` of all installed packages, once.

    Raise UsageError, naming the package, where one does not import or registers what cannot be.
    """
    global _looked
    if _looked:
        return
    _looked = True
    for point in importlib.metadata.entry_points(group=GROUP):
        name = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
        source = Source(name, _digest(name))
        with _transaction(source, name, f"pip uninstall {name.split()[0]}"):
            point.load()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _run(source: Source, text: str) -> None:
    """Run a plugin's text as a module of its own."""
    name = f"hjepa_plugin_{Path(source.name).stem}_{source.sha256[:8]}"
    module = types.ModuleType(name, f"The plugin {source.name}.")
    module.__file__ = source.name
    with _transaction(source, source.name, f"correct {source.name}, or leave out --plugin"):
        for registry in _REGISTRIES.values():  # what an earlier text of this file registered
            kept = registry._added.items()
            registry._added = {
                key: (item, of) for key, (item, of) in kept if not of or of.name != source.name
            }
        sys.modules[name] = module  # dataclasses and pickle look there
        try:
            exec(compile(text, source.name, "exec"), module.__dict__)
            added = [of for one in _REGISTRIES.values() for _, of in one._added.values()]
            if source not in added:
                raise UsageError(
                    "it registers nothing",
                    hint=f"hand what {source.name} makes to hjepa_cli.register(…)",
                )
        except BaseException:
            del sys.modules[name]
            raise


@contextlib.contextmanager
def _transaction(source: Source, file: str, hint: str) -> Iterator[None]:
    """Register all or nothing; every error becomes a line that names the file and the line.

    A plugin that ends the program is an error too. What it prints goes to stderr: stdout is for
    results.
    """
    before = {kind: dict(one._added) for kind, one in _REGISTRIES.items()}
    token = _loading.set(source)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except BaseException as error:
        for kind, added in before.items():
            _REGISTRIES[kind]._added = added
        if isinstance(error, KeyboardInterrupt):
            raise
        name, lines = type(error).__name__, str(error).splitlines()
        reason = f"{name}: {lines[0]}" if lines and lines[0] else name
        if isinstance(error, UsageError):
            reason, hint = error.message, error.hint or hint
        elif isinstance(error, ModuleNotFoundError) and (folder := _beside(file, error.name)):
            hint = f"set PYTHONPATH={shell([folder])}, or install it: its folder is not searched"
        raise UsageError(f"plugin {_place(error, file)}: {reason}", hint=hint) from None
    else:
        _sources[:] = [one for one in _sources if one.name != source.name] + [source]
    finally:
        _loading.reset(token)


def _beside(file: str, module: str | None) -> Path | None:
    """Return the folder of a plugin's file where a module lies in it, too."""
    folder, top = Path(file).resolve().parent, (module or "").partition(".")[0]
    return folder if top and ((folder / f"{top}.py").is_file() or (folder / top).is_dir()) else None


def _place(error: BaseException, file: str) -> str:
    """Return ``FILE:LINE`` of the plugin where an error came from."""
    line = error.lineno if isinstance(error, SyntaxError) and error.filename == file else None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == file:
            line = trace.tb_lineno
        trace = trace.tb_next
    return file if line is None else f"{file}:{line}"
