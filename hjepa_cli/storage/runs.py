"""A run directory says what a stage was asked, what happened, and the result, written last.

``runs/<stage>/<nnnn>/`` holds ``config.toml`` (fully resolved, usable with ``--config``),
``environment.json`` (stage, versions, plugins, command, inputs), ``metrics.csv`` (no time, host or
path), ``events.jsonl`` (timings), the checkpoints of the stage, and ``result.json`` once it is
finished.
"""

import contextlib
import csv
import hashlib
import io
import json
import os
import platform
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import IO, Any, Self

import msgspec

from hjepa_cli.compute import torchrun
from hjepa_cli.compute.interrupts import exit_code
from hjepa_cli.compute.versions import TRAINED_WITH, versions
from hjepa_cli.config.schema import OFF, Settings, dotted, left_unsaid, spelled_out, unsaid
from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    Interrupted,
    MissingInputError,
    UsageError,
    shell,
)
from hjepa_cli.plugins import Source, in_force
from hjepa_cli.storage import files, seals, tracking

ROOT = Path("runs")
CONFIG = "config.toml"
ENVIRONMENT = "environment.json"
METRICS = "metrics.csv"
EVENTS = "events.jsonl"
RESULT = "result.json"
SMOKE = "smoke"  # the preset that shows that all of it runs, too small to learn
LAST_EVENTS_BYTES = 4096
ASKED = ("remeasure", "verify")  # flags that are work, which a finished run has done or has not
STRENGTH = "augment.strength"  # without any, all else in the section says nothing
SHOWN = ("figure",)  # flags that say what is made of a result, not which one it is

SCHEMA = 3  # of environment.json; 1 had neither a schema nor inputs, 2 no settings
RESULT_SCHEMA = 2  # 1 had neither a schema nor a seal

_SEALED = {"schema", "files", seals.SEAL}  # keys of result.json that are no result
_RECORDED = (*TRAINED_WITH, "scipy", "pymunk", "safetensors", "typer", "rich")


class Run:
    """It is a locked run directory; use it as a context manager."""

    def __init__(self, directory: Path, lock: IO[bytes]) -> None:
        self.directory = directory
        self.result: dict[str, Any] | None = None  # of a finished run: nothing is left to do
        self.settings: dict[str, Any] = {}  # as config.toml has them, once it is open
        self.preset: str | None = None  # that it was begun with
        self.resumed = False  # the directory was there before, from an interrupted run
        self._lock = lock
        self._track: tracking.Tracker | None = None

    @classmethod
    def create(
        cls,
        stage: str,
        out: Path | None,
        settings: Mapping[str, Any],
        inputs: Mapping[str, Any] | None = None,
    ) -> Self:
        """Open ``out``, or a new ``runs/<stage>/<nnnn>``, for this process alone.

        Args:
            stage: the command's name.
            out: a new or empty directory, an interrupted run to take up, or a finished one.
            settings: resolved settings (:meth:`hjepa_cli.config.settings.Settings.as_dict`).
            inputs: what else the stage was given, for ``hjepa resume``: files by
                :func:`describe_input`, flags as they are.

        Raises:
            UsageError: ``out`` holds something else, or a run with other settings, flags or input
                files.
            LockedError: another process works in it.
            StorageError: not writable.
            MissingInputError: ``HJEPA_LOG`` asks for a package that is not installed.
        """
        track = tracking.requested()
        directory = out or files.next_directory(ROOT / stage)
        files.make_directory(directory)
        check_ours(directory)
        run = cls(directory, files.lock_directory(directory))
        run._track = track(directory) if track else None
        try:
            run._open(stage, settings, inputs or {})
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def follow(cls, out: Path | None) -> Self:
        """Open for reading alone what another process of the same training writes."""
        run = cls(out or ROOT, open(os.devnull, "rb"))
        run.resumed = out is not None and run.path(CONFIG).exists()
        if out is not None and run.path(RESULT).exists():
            run.result = read_result(out)
        return run

    def path(self, name: str) -> Path:
        """Return the path of a file in this directory."""
        return self.directory / name

    def event(self, kind: str, **fields: Any) -> None:
        """Append a line to ``events.jsonl``: time (s since 1970), kind and fields."""
        record = {"time": round(time.time(), 3), "event": kind, **files.jsonable(fields)}
        self._append(EVENTS, json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n")

    def metric(self, row: Mapping[str, int | float | str | None]) -> None:
        """Append a row to ``metrics.csv``; every row has the columns of the first one."""
        path, columns, lines = self.path(METRICS), None, io.StringIO()
        with files.writing(path), contextlib.suppress(FileNotFoundError):
            with open(path, encoding="utf-8", newline="") as file:
                columns = next(csv.reader(file), None)
        if columns not in (None, list(row)):
            raise ValueError(f"metrics.csv has columns {columns}, not {list(row)}")
        cells = [float(cell) if isinstance(cell, float) else cell for cell in row.values()]
        table = csv.writer(lines, lineterminator="\n")
        table.writerows([list(row), cells] if columns is None else [cells])
        self._append(METRICS, lines.getvalue())
        if self._track is not None:
            self._track(row)

    @property
    def metrics(self) -> str:
        """Return the text of ``metrics.csv``; assigned, it puts back an earlier one."""
        return "".join(_whole_lines(self.path(METRICS)))

    @metrics.setter
    def metrics(self, text: str) -> None:
        files.write_text(self.path(METRICS), text)

    continue_command = property(lambda self: continue_command(self.directory))

    def finish(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """Write ``result.json``, which makes the run a finished one, and return what it holds."""
        for name in (METRICS, EVENTS):  # appended to: a power loss must not leave a result alone
            files.make_durable(self.path(name))
        self.result = files.jsonable(result)
        if taken := self.result.keys() & _SEALED:
            raise ValueError(f"a result may not use the reserved keys {sorted(taken)}")
        seal = {"schema": RESULT_SCHEMA, "files": _tables(self.directory)}
        files.write_json(self.path(RESULT), seals.sealed({**self.result, **seal}))
        return self.result

    def close(self) -> None:
        """Give the directory back."""
        self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close()
        files.point_to(self.continue_command, error)
        if isinstance(error, Interrupted):  # of a run inside this one, perhaps
            error.hint = self.continue_command
        if isinstance(error, KeyboardInterrupt):
            raise Interrupted(
                "interrupted; what is finished is kept",
                hint=self.continue_command,
                code=exit_code(error),
            ) from None

    def _open(self, stage: str, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> None:
        self.settings = files.jsonable({key: settings[key] for key in settings if key != "preset"})
        if self.path(CONFIG).exists():
            self._take_up(stage, settings, inputs)
        else:
            self._begin(stage, settings, inputs)

    def _take_up(self, stage: str, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> None:
        """Go on with the run that is here, or read its result; refuse another one."""
        self.resumed = True
        recorded = read_environment(self.directory)
        check_plugins(self.directory, recorded)
        self.preset = recorded.get("preset")
        if recorded["stage"] != stage:
            raise UsageError(
                f"{self.directory} holds a run of '{recorded['stage']}', not of '{stage}'",
                hint="choose another directory with --out DIR",
            )
        finished = self.path(RESULT).exists()
        if changed := self._changed(recorded, settings, inputs):
            raise UsageError(
                f"{self.directory} holds {'a finished' if finished else 'an unfinished'} run "
                f"with other settings: {'; '.join(changed)}",
                hint=f"{self.continue_command} {'shows' if finished else 'continues'} it as it "
                "is; or choose another --out DIR",
            )
        done = recorded["inputs"]
        further = [flag for flag in ASKED if inputs.get(flag) and not done.get(flag)]
        if finished:
            if further:
                raise UsageError(
                    f"{self.directory} holds a run finished without --{further[0]}",
                    hint="choose another --out DIR",
                )
            self.result = read_result(self.directory)
            return
        if recorded["schema"] < SCHEMA:
            seals.warn(self.path(CONFIG))
        if further:
            done.update(dict.fromkeys(further, True))
            files.write_json(self.path(ENVIRONMENT), recorded)
        for name in (METRICS, EVENTS):
            if self.path(name).exists():  # a kill may have cut the last line
                files.write_text(self.path(name), "".join(_whole_lines(self.path(name))))
        self.event("resumed")

    def _changed(
        self, recorded: Mapping[str, Any], settings: Mapping[str, Any], inputs: Mapping[str, Any]
    ) -> list[str]:
        """Name the settings, flags and files that are others than the run was begun with."""
        try:
            kept = load_recorded(self.preset, self.directory).as_dict()
        except UsageError:  # it has settings that this version has not: they are differences
            kept = read_config(self.directory) | {"preset": self.preset}
        changed = differences(kept, settings)
        if recorded["schema"] > 1:
            begun_with = recorded["inputs"]
            given = _compared(begun_with, inputs), _compared(inputs, begun_with)
            changed += differences(*given)
        return changed

    def _begin(self, stage: str, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> None:
        """Write what the run depends on, its settings last: with them it is one."""
        environment = {  # besides its settings
            "schema": SCHEMA,
            "stage": stage,
            "inputs": inputs,
            "plugins": [{"name": one.name, "sha256": one.sha256} for one in in_force()],
            "preset": settings.get("preset"),
            "settings": self.settings,
            "command": sys.argv,
            "versions": versions(_RECORDED),
            "system": platform.system(),
            "machine": platform.machine(),
            "cpus": os.cpu_count(),
        }
        files.write_json(self.path(ENVIRONMENT), environment)
        files.write_text(self.path(CONFIG), to_toml(spelled_out(settings)))
        self.event("started")

    def _append(self, name: str, text: str) -> None:
        files.append(self.path(name), files.encoded(text))


def newest_run(
    stage: str,
    predicate: Callable[[Path], bool] = lambda directory: True,
    *,
    preset: str | None = SMOKE,
) -> Path | None:
    """Return the newest finished ``runs/<stage>/*`` that is not damaged and fits.

    Those of preset smoke have learned nothing: only who works with that ``preset`` gets them.
    """
    for directory in finished_runs(stage, preset=preset):
        with contextlib.suppress(DataError, MissingInputError, LookupError, TypeError):
            if predicate(directory):
                return directory
    return None


def finished_runs(*stages: str, preset: str | None = SMOKE) -> list[Path]:
    """Return the finished ``runs/<stage>/*`` of some stages, newest first.

    Those of preset smoke are left out, unless ``preset`` is that.
    """
    places = (ROOT / stage for stage in stages)
    every = (place / name for place in places for name in files.list_names(place))
    finished = [directory for directory in every if (directory / RESULT).is_file()]
    if preset != SMOKE:
        finished = [directory for directory in finished if not is_smoke(directory)]
    return sorted(finished, key=lambda one: (_ended_s(one), one), reverse=True)


def is_smoke(directory: Path) -> bool:
    """Return whether a run was of preset smoke; a damaged record does not say so."""
    with contextlib.suppress(HjepaError):
        return read_environment(directory).get("preset") == SMOKE
    return False


def _ended_s(directory: Path) -> float:
    """Return when a run wrote of itself last: copying and checking out change a file's time."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        with open(directory / EVENTS, "rb") as file:
            file.seek(max(os.path.getsize(directory / EVENTS) - LAST_EVENTS_BYTES, 0))
            *_, last = file.read().splitlines()
        time_s = json.loads(last)["time"]
        if isinstance(time_s, float | int) and 0 < time_s < time.time() + 86_400:
            return float(time_s)
    return (directory / RESULT).stat().st_mtime


def read_result(directory: Path) -> dict[str, Any]:
    """Return the result of a finished run, its seal and those of its tables checked.

    A run of an older version has none: that is an :class:`~hjepa_cli.errors.Unsealed`
    warning.

    Raises:
        MissingInputError: not a finished run.
        DataError: damaged, or changed after it was written.
    """
    path, environment = directory / RESULT, read_environment(directory)
    again = f"run it again: {anew(environment, directory / CONFIG)}"
    result = seals.read(path, RESULT_SCHEMA, again)
    if seals.SEAL not in result:
        if environment["schema"] == SCHEMA:
            seals.check(result, path, again)
        seals.warn(path)
        return {key: result[key] for key in result if key != "schema"}
    tables, now = result.get("files"), _tables(directory)
    if not isinstance(tables, dict):
        raise DataError(f"{path} does not name its tables", hint=again)
    for name in tables:
        if tables[name] != now.get(name):
            what = "was changed after it was written" if name in now else "is gone"
            raise DataError(f"{directory / name} {what}", hint=again)
    return {key: result[key] for key in result if key not in _SEALED}


def _tables(directory: Path) -> dict[str, str]:
    """Return the sha256 of each table of a run, and of its other records, by name."""
    records = (directory / CONFIG, directory / ENVIRONMENT)
    found = (path for path in (*directory.glob("*.csv"), *records) if path.is_file())
    return {path.name: hashlib.sha256(files.read_bytes(path)).hexdigest() for path in found}


def read_config(directory: Path) -> dict[str, Any]:
    """Return the resolved settings of a run, without the preset's name.

    Raises:
        DataError: no TOML, or not the settings that ``environment.json`` says it was begun with.
    """
    path = directory / CONFIG
    try:
        text = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES).decode("utf-8-sig")
        found = left_unsaid(tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid TOML: {error}") from None
    if (directory / ENVIRONMENT).exists():
        recorded = read_environment(directory)
        if recorded["schema"] == SCHEMA and (changed := differences(recorded["settings"], found)):
            raise DataError(
                f"{path} was changed after the run was begun: {'; '.join(changed)}",
                hint=f"put it back, or for a run with it: {anew(recorded, path)} --out DIR",
            )
    return found


def read_environment(directory: Path) -> dict[str, Any]:
    """Return what a run depends on besides its settings; of schema 1, without inputs.

    Raises:
        MissingInputError: not a run directory.
        DataError: damaged, or of a newer schema.
    """
    path = directory / ENVIRONMENT
    if not path.exists():
        raise MissingInputError(f"{directory} is not a run directory: no {ENVIRONMENT}")
    recorded = {"schema": 1, **files.read_json(path)}
    schema = recorded["schema"]
    if not (type(schema) is int and 0 < schema < SCHEMA):
        files.check_schema(schema, SCHEMA, f"run {directory}")
    if schema == 1:
        recorded["inputs"] = {}
    recorded.setdefault("plugins", [])
    try:
        msgspec.convert(recorded, _Environment)
    except msgspec.ValidationError as error:
        raise DataError(f"{path} lacks fields or has malformed ones: {error}") from None
    if schema == SCHEMA and "settings" not in recorded:
        raise DataError(f"{path} lacks fields or has malformed ones: no `settings`")
    return recorded


class _Named(msgspec.Struct):
    name: str
    sha256: str


class _Input(msgspec.Struct):
    path: str
    sha256: str


class _Environment(msgspec.Struct):
    """It is all of ``environment.json`` that is relied on, or shown."""

    stage: str
    inputs: dict[str, _Input | bool | int | float | str | list[Any] | None]
    plugins: list[_Named]
    preset: str | None = None
    settings: dict[str, Any] = {}
    command: list[str] = []
    versions: dict[str, str | None] = {}
    system: str | None = None
    machine: str | None = None
    cpus: int | None = None


def check_plugins(directory: Path, recorded: Mapping[str, Any]) -> None:
    """Raise UsageError unless the plugins are in force that a run was begun with; it loads none."""
    now = {source.sha256: source.name for source in in_force()}
    begun_with = [Source(one["name"], one["sha256"]) for one in recorded["plugins"]]
    for plugin in begun_with:
        if plugin.sha256 not in now:
            why, hint = "is not in force", continue_command(directory, begun_with)
            if plugin.installed:
                hint = f"pip install {plugin.name.replace(' ', '==')}"
            elif plugin.name in now.values():
                why, again = "has changed since", anew(recorded, directory / CONFIG)
                hint = f"restore the file, or begin anew: {again} --out DIR"
            raise UsageError(
                f"{directory} was begun with plugin {plugin.name}, which {why}", hint=hint
            )


def continue_command(directory: Path, plugins: Iterable[Source] | None = None) -> str:
    """Return what takes a run up again, with its plugins, or those that are in force now."""
    words = ["resume", str(directory), *_named(in_force() if plugins is None else plugins)]
    return f"{torchrun.program()} {shell(words)}"


def anew(recorded: Mapping[str, Any], config: Path | None = None) -> str:
    """Return the command of a recorded run: its settings in a file, its plugins and inputs."""
    words = [recorded["stage"], *(["--config", str(config)] if config else [])]
    words += _named(Source(one["name"], one["sha256"]) for one in recorded["plugins"])
    return f"hjepa {shell([*words, *inputs_of(recorded)])}"


def inputs_of(recorded: Mapping[str, Any]) -> list[str]:
    """Return what a recorded run was given as flags; paths below this directory without it.

    Further models (``checkpoint 2``) have no flag: the command finds them again.
    """
    words = []
    for name, given in recorded["inputs"].items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(given, Mapping) and isinstance(given.get("path"), str) and " " not in name:
            path = Path(given["path"])
            here = path.is_relative_to(Path.cwd())
            words += [flag, str(path.relative_to(Path.cwd()) if here else path)]
        elif given is True:
            words.append(flag)
        elif isinstance(given, float | int) and given is not False:
            words += [flag, f"{given:.15g}"]
        elif isinstance(given, str):
            words += [flag, given]
    return words


def _named(plugins: Iterable[Source]) -> list[str]:
    return [word for one in plugins if not one.installed for word in ("--plugin", one.name)]


def version_of(recorded: Mapping[str, Any]) -> str | None:
    """Return the version of this program that made a run, of :func:`read_environment`."""
    found = recorded.get("versions")
    return found.get("hjepa") if isinstance(found, dict) else None


def describe_input(path: Path, digest: str) -> dict[str, str]:
    """Return how a run remembers a file or directory that it reads: where and what it was."""
    return {"path": str(path.absolute()), "sha256": digest}


def to_toml(settings: Mapping[str, Any]) -> str:
    """Return settings (one level of sections) as TOML that ``--config`` accepts.

    The preset is a comment: its values are all written out, and it is no setting.
    """
    text, sections = f"# Resolved from preset {settings.get('preset', 'default')}.\n", ""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            lines = (f"{key} = {_toml(one)}\n" for key, one in value.items())
            sections += f"\n[{name}]\n{''.join(lines)}"
        elif name != "preset":
            text += f"{name} = {_toml(value)}\n"
    return text + sections


def check_ours(directory: Path) -> None:
    """Raise UsageError unless a directory is absent, empty or a run."""
    if not (directory / CONFIG).exists():
        files.refuse_foreign(directory, "run", lambda name: name == ENVIRONMENT)


def load_recorded(preset: object, directory: Path) -> Settings:
    """Load the settings of a run; what its version had not is as its preset says, or off.

    Before there was a warm-up, loops were scored from the start. Errors are those of
    :func:`~hjepa_cli.config.settings.load_settings`.
    """
    recorded = read_config(directory)
    flags = unsaid(recorded)
    if "protocol.warmup_steps" not in dotted(recorded):
        flags["protocol.warmup_steps"] = 0
    return load_settings(preset if isinstance(preset, str) else None, directory / CONFIG, flags)


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Name the settings that differ, as ``section.key = old, not new``.

    What there was not yet in the old ones is as the preset that they name says, or off.
    """
    before, after = dotted(old), dotted(files.jsonable(new))
    if later := after.keys() - before.keys():
        preset = before.get("preset")
        known = load_settings(preset if preset in PRESETS else None)
        defaults = dotted(known.as_dict()) | OFF
        before |= {key: defaults[key] for key in later if key in defaults}
    after |= {key: OFF[key] for key in (before.keys() & OFF.keys()) - after.keys()}
    idle = ["preset"]
    if OFF[STRENGTH] in (before.get(STRENGTH), after.get(STRENGTH)):  # nothing reads others
        idle += [key for key in before | after if key.startswith("augment.") and key != STRENGTH]
    return [
        f"{key} = {before.get(key)!r}, not {after.get(key)!r}"
        for key in sorted(before.keys() | after.keys())
        if key not in idle and before.get(key) != after.get(key)
    ]


def _compared(inputs: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Return of some inputs what a result follows from: sha256 of files, and flags as they are.

    A flag that the ``others`` say nothing of is of another version.
    """
    files_of = {
        name: value.get("sha256") for name, value in inputs.items() if isinstance(value, Mapping)
    }
    both = (inputs.keys() & others.keys()) - files_of.keys() - {*ASKED, *SHOWN}
    flags = {name: inputs[name] for name in both if not isinstance(others[name], Mapping)}
    return files_of | flags


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return repr(float(value))
    return json.dumps(value)  # strings, integers and booleans are the same in TOML


def _whole_lines(path: Path) -> list[str]:
    text = files.read_bytes(path).decode("utf-8", errors="replace") if path.exists() else ""
    return [line + "\n" for line in text.split("\n")[:-1]]
