"""A stage is a step of the pipeline, as the command line, Python and ``hjepa resume`` call it.

Nothing heavy is imported here: a stage says what it is called and what it takes before the module
that does its work is imported.
"""

import dataclasses
import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import check_members
from hjepa_cli.stages.plan import Plan

TAKEN = (  # names that every stage or its command has a meaning for
    *("settings", "screen", "out", "preset", "config", "plant", "seed", "device", "methods"),
    *("protocol", "workers", "cluster", "plugin", "json", "quiet", "dry_run", "debug", "help"),
)


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stage has a command and, but for ``collect``, run directories of its own.

    Attributes:
        name: of the command and of ``runs/<name>/``.
        help: one line.
        run: ``run(settings, screen, *, out, **inputs)`` does the work in the directory ``out``
            (``None`` is the next free one) and returns the document of ``--json``. With ``out`` of
            an interrupted run it goes on, with that of a finished one it tells the result again.
        plan: ``plan(settings, *, out, **inputs)`` tells what ``run`` would do, and writes nothing.
        inputs: the keyword arguments that both take, named as a run records them, each a path, or
            a switch where its default is ``False``; without a default it must be given. ``further``
            is the list of all models after the first.
        product: key of the result that says where it is, ``None`` where that is the run directory.
        shared: whether several processes of torchrun may do it together.
    """

    name: str
    help: str
    run: Callable[..., dict[str, Any]]
    plan: Callable[..., Plan]
    inputs: tuple[str, ...] = ()
    product: str | None = None
    shared: bool = False

    def __post_init__(self) -> None:
        """Raise UsageError for members that no command can be made of."""
        check_members(self, str, "help")
        check_members(self, callable, "run", "plan")
        check_members(self, tuple, "inputs")
        check_members(self, str, "product", optional=True)
        check_members(self, bool, "shared")
        for word in self.inputs:
            if not isinstance(word, str) or not re.fullmatch("[a-z][a-z0-9]*(_[a-z0-9]+)*", word):
                raise self._no_input(word, "choose a name of small letters, digits and single '_'")
            if word in TAKEN:
                raise self._no_input(word, f"these mean something else: {', '.join(TAKEN)}")
        for name, given in (("run", ("settings", "screen", "out")), ("plan", ("settings", "out"))):
            function = getattr(self, name)
            if isinstance(function, Imported):  # when it is called
                continue
            signature = inspect.signature(function)
            try:
                signature.bind(**dict.fromkeys((*given, *self.inputs)))
            except TypeError as error:
                raise UsageError(
                    f"stage '{self.name}': {name}{signature} cannot be called with "
                    f"{', '.join((*given, *self.inputs))}: {error}"
                ) from None
            for word in self.inputs:
                default = self.default(word)
                if default is not None and default is not ... and default is not False:
                    raise self._no_input(word, f"its default is {default!r}, not None or False")

    def default(self, word: str) -> Any:
        """Return what ``run`` does without an input; ``...`` where it must be given."""
        run = getattr(self.run, "function", self.run)
        parameter = inspect.signature(run).parameters.get(word)
        if parameter is None:  # of **kwargs
            return None
        return ... if parameter.default is parameter.empty else parameter.default

    def _no_input(self, word: object, why: str) -> UsageError:
        return UsageError(f"stage '{self.name}': {word!r} cannot be an input; {why}")


@dataclasses.dataclass(frozen=True)
class Imported:
    """The function at ``"module:function"`` is imported when it is called."""

    place: str

    @property
    def function(self) -> Callable[..., Any]:
        """Return the function itself, imported now."""
        module, _, name = self.place.partition(":")
        found: Callable[..., Any] = getattr(importlib.import_module(module), name)
        return found

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Import and call it."""
        return self.function(*given, **named)
