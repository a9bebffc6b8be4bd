"""A stage is a step of the pipeline, as the command line, Python and ``hjepa resume`` call it.

Nothing heavy is imported here: a stage says what it is called and what it takes before the module
that does its work is imported.
"""

import dataclasses
import importlib
from collections.abc import Callable
from typing import Any

from hjepa_cli.stages.plan import Plan


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
        inputs: the keyword arguments that both take, named as a run records them; ``further`` is
            the list of all models after the first.
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
