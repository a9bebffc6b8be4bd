"""Run directories: what a stage was asked, what happened, and the result, written last.

``runs/<stage>/<nnnn>/`` holds ``config.toml`` (fully resolved, usable with ``--config``),
``environment.json`` (stage, versions, command, inputs), ``metrics.csv`` (no time, host or path),
``events.jsonl`` (timings), the checkpoints of the stage, and ``result.json`` once it is finished.
"""

import contextlib
import csv
import importlib.metadata
import io
import json
import os
import platform
import shlex
import sys
import time
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from hjepa_cli import __version__
from hjepa_cli.compute import torchrun
from hjepa_cli.compute.interrupts import exit_code
from hjepa_cli.config.settings import Settings, dotted, load_settings
from hjepa_cli.errors import DataError, Interrupted, MissingInputError, UsageError
from hjepa_cli.storage import files, tracking

ROOT = Path("runs")
CONFIG = "config.toml"
ENVIRONMENT = "environment.json"
METRICS = "metrics.csv"
EVENTS = "events.jsonl"
RESULT = "result.json"
ASKED = ("remeasure", "verify")  # flags that are work, which a finished run has done or has not

SCHEMA = 2  # of environment.json; 1 had neither a schema nor inputs

_PACKAGES = ("torch", "numpy", "scipy", "pymunk", "safetensors", "typer", "rich")


class Run:
    """A locked run directory; use it as a context manager.

    Attributes:
        directory: where everything is.
        result: the result of a finished run, else ``None``: nothing is left to do.
        resumed: the directory was there before, from an interrupted run.
    """

    def __init__(self, directory: Path, lock: IO[bytes]) -> None:
        self.directory = directory
        self.result: dict[str, Any] | None = None
        self.resumed = False
        self._lock = lock
        self._track: tracking.Tracker | None = None

    @classmethod
    def create(
        cls,
        stage: str,
        out: Path | None,
        settings: Mapping[str, Any],
        inputs: Mapping[str, Any] | None = None,
        *,
        root: Path = ROOT,
    ) -> Self:
        """Open ``out``, or a new ``runs/<stage>/<nnnn>``, for this process alone.

        Args:
            stage: the command's name.
            out: a new or empty directory, an interrupted run to take up, or a finished one.
            settings: resolved settings (:meth:`hjepa_cli.config.settings.Settings.as_dict`).
            inputs: what else the stage was given, for ``hjepa resume``: files by
                :func:`describe_input`, flags as they are.
            root: the parent of the automatic directories.

        Raises:
            UsageError: ``out`` holds something else, or a run with other settings or input files.
            LockedError: another process works in it.
            StorageError: not writable.
            MissingInputError: ``HJEPA_LOG`` asks for a package that is not installed.
        """
        track = tracking.requested()
        if out is None:
            directory = files.next_directory(root / stage)
        else:
            directory = out
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
        """What another process of the same training has open, to be read alone."""
        run = cls(out or ROOT, open(os.devnull, "rb"))
        run.resumed = out is not None and run.path(CONFIG).exists()
        if out is not None and run.path(RESULT).exists():
            run.result = files.read_json(run.path(RESULT))
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
        columns = self._columns()
        if columns is None:
            self._append(METRICS, _csv_line(row))
        elif columns != list(row):
            raise ValueError(f"metrics.csv has columns {columns}, not {list(row)}")
        self._append(METRICS, _csv_line([_cell(value) for value in row.values()]))
        if self._track is not None:
            self._track(row)

    @property
    def metrics(self) -> str:
        """The text of ``metrics.csv``; assigned, it puts the file back to an earlier state."""
        return "".join(_whole_lines(self.path(METRICS)))

    @metrics.setter
    def metrics(self, text: str) -> None:
        files.write_text(self.path(METRICS), text)

    @property
    def continue_command(self) -> str:
        """What takes this run up again."""
        return f"{torchrun.program()} resume {shlex.quote(str(self.directory))}"

    def finish(self, result: Mapping[str, Any]) -> dict[str, Any]:
        """Write ``result.json``, which makes the run a finished one, and return what it holds."""
        for name in (METRICS, EVENTS):  # appended to: a power loss must not leave a result alone
            files.make_durable(self.path(name))
        self.result = files.jsonable(result)
        files.write_json(self.path(RESULT), self.result)
        return self.result

    def close(self) -> None:
        """Give the directory back."""
        self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        if self.path(CONFIG).exists():
            self.resumed = True
            recorded = read_environment(self.directory)
            if recorded["stage"] != stage:
                raise UsageError(
                    f"{self.directory} holds a run of '{recorded['stage']}', not of '{stage}'",
                    hint="choose another directory with --out DIR",
                )
            finished = self.path(RESULT).exists()
            differences = _differences(_settings(self.directory, recorded), settings)
            if recorded["schema"] > 1:
                differences += _differences(_digests(recorded["inputs"]), _digests(inputs))
            if differences:
                raise UsageError(
                    f"{self.directory} holds {'a finished' if finished else 'an unfinished'} run "
                    f"with other settings: {'; '.join(differences)}",
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
                self.result = files.read_json(self.path(RESULT))
                return
            if further:
                done.update(dict.fromkeys(further, True))
                files.write_json(self.path(ENVIRONMENT), recorded)
            for name in (METRICS, EVENTS):
                if self.path(name).exists():  # a kill may have cut the last line
                    files.write_text(self.path(name), "".join(_whole_lines(self.path(name))))
            self.event("resumed")
            return
        files.write_json(self.path(ENVIRONMENT), environment(stage, settings, inputs))
        files.write_text(self.path(CONFIG), to_toml(settings))
        self.event("started")

    def _columns(self) -> list[str] | None:
        try:
            with open(self.path(METRICS), encoding="utf-8", newline="") as file:
                return next(csv.reader(file), None)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise files.storage_error(self.path(METRICS), error) from None

    def _append(self, name: str, text: str) -> None:
        try:
            with open(self.path(name), "a", encoding="utf-8", newline="") as file:
                file.write(text)
        except OSError as error:
            raise files.storage_error(self.path(name), error) from None


def newest_run(
    stage: str, predicate: Callable[[Path], bool] = lambda directory: True, root: Path = ROOT
) -> Path | None:
    """Return the most recently finished ``runs/<stage>/*`` that satisfies ``predicate``, if any.

    Runs whose records are damaged or of another version do not.
    """
    for directory in finished_runs(stage, root=root):
        with contextlib.suppress(DataError, MissingInputError, LookupError, TypeError):
            if predicate(directory):
                return directory
    return None


def finished_runs(*stages: str, root: Path = ROOT) -> list[Path]:
    """Return the finished ``runs/<stage>/*`` of some stages, newest first."""
    finished = []
    for place in (root / stage for stage in stages):
        for directory in (place / name for name in files.list_names(place)):
            if (directory / RESULT).is_file():
                finished.append(((directory / RESULT).stat().st_mtime_ns, directory))
    return [directory for _, directory in sorted(finished, reverse=True)]


def read_result(directory: Path) -> dict[str, Any]:
    """Return the result of a finished run. Raises MissingInputError or DataError."""
    return files.read_json(directory / RESULT)


def read_config(directory: Path) -> dict[str, Any]:
    """Return the resolved settings of a run, without the preset's name. Raises DataError."""
    path = directory / CONFIG
    try:
        return tomllib.loads(files.read_bytes(path, limit=files.JSON_LIMIT_BYTES).decode())
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid TOML: {error}") from None


def read_environment(directory: Path) -> dict[str, Any]:
    """Return what :func:`environment` recorded of a run; of schema 1, with no inputs.

    Raises:
        MissingInputError: not a run directory.
        DataError: damaged, or of a newer schema.
    """
    path = directory / ENVIRONMENT
    if not path.exists():
        raise MissingInputError(f"{directory} is not a run directory: no {ENVIRONMENT}")
    recorded = {"schema": 1, **files.read_json(path)}
    if type(recorded["schema"]) is int and recorded["schema"] == 1:
        recorded["inputs"] = {}
    else:
        files.check_schema(recorded["schema"], SCHEMA, f"run {directory}")
    if not isinstance(recorded.get("stage"), str) or not isinstance(recorded.get("inputs"), dict):
        raise DataError(f"{path} lacks fields or has malformed ones")
    return recorded


def version_of(recorded: Mapping[str, Any]) -> str | None:
    """The version of this program that made a run, of what :func:`read_environment` returns."""
    versions = recorded.get("versions")
    return versions.get("hjepa") if isinstance(versions, dict) else None


def describe_input(path: Path, digest: str) -> dict[str, str]:
    """How a run remembers a file or directory that it reads: where it was and what it was."""
    return {"path": str(path.absolute()), "sha256": digest}


def to_toml(settings: Mapping[str, Any]) -> str:
    """Return settings (one level of sections) as TOML that ``--config`` accepts.

    The preset is a comment: its values are all written out, and it is no setting.
    """
    lines = [f"# Resolved from preset {settings.get('preset', 'default')}."]
    sections = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            sections[key] = value
        elif key != "preset":
            lines.append(f"{key} = {_toml(value)}")
    for name, section in sections.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in section.items())]
    return "\n".join(lines) + "\n"


def environment(
    stage: str, settings: Mapping[str, Any], inputs: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a run depended on besides its settings: inputs, versions, machine, command."""
    versions = {"hjepa": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "schema": SCHEMA,
        "stage": stage,
        "inputs": inputs,
        "preset": settings.get("preset"),
        "command": sys.argv,
        "versions": versions,
        "system": platform.system(),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
    }


def check_ours(directory: Path) -> None:
    """Check that a directory, if it is there, is empty or a run.

    Raises:
        UsageError: it holds something else.
    """
    entries = files.list_names(directory)
    for name in entries if CONFIG not in entries else ():
        if name not in (files.LOCK_FILE, ENVIRONMENT) and not files.is_temporary(name):
            raise UsageError(
                f"{directory} is not empty and not an hjepa run: it holds '{name}'",
                hint="choose a new or empty directory with --out DIR",
            )


def _settings(directory: Path, recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a run, complete: what its version had not is as its preset says."""
    values, preset = read_config(directory), recorded.get("preset")
    try:
        known = preset if isinstance(preset, str) else None
        return load_recorded(known, directory).as_dict()
    except UsageError:  # it has settings that this version has not: they are differences
        return values


def load_recorded(preset: str | None, directory: Path) -> Settings:
    """Load the settings of a run; before there was a warm-up, loops were scored from the start.

    Raises:
        As :func:`~hjepa_cli.config.settings.load_settings`.
    """
    protocol = read_config(directory).get("protocol", {})
    scored_all = isinstance(protocol, Mapping) and "warmup_steps" not in protocol
    flags = {"protocol.warmup_steps": 0} if scored_all else {}
    return load_settings(preset, directory / CONFIG, flags)


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Name the settings that differ, as ``section.key = old, not new``."""
    before, after = dotted(old), dotted(files.jsonable(new))
    if later := after.keys() - before.keys():  # settings that there were none of had their default
        defaults = dotted(load_settings().as_dict())
        before |= {key: defaults[key] for key in later if key in defaults}
    return [
        f"{key} = {before.get(key)!r}, not {after.get(key)!r}"
        for key in sorted(before.keys() | after.keys())
        if key != "preset" and before.get(key) != after.get(key)
    ]


def _digests(inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The content of the input files; where they are may change."""
    return {
        name: value.get("sha256") for name, value in inputs.items() if isinstance(value, Mapping)
    }


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return repr(float(value))
    return json.dumps(value)  # strings, integers and booleans are the same in TOML


def _cell(value: int | float | str | None) -> str:
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def _csv_line(cells: Mapping[str, Any] | list[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _whole_lines(path: Path) -> list[str]:
    text = files.read_bytes(path).decode("utf-8", errors="replace") if path.exists() else ""
    return [line + "\n" for line in text.split("\n")[:-1]]
