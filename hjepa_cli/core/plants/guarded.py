"""Functions of plugins name their plugin in what goes wrong.

An error in a plugin's file has a line there. One that the package finds in what it was given, or in
how a function lets itself be called, has none.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from hjepa_cli.compute import memory
from hjepa_cli.errors import ArrayError, HjepaError, NumericalError
from hjepa_cli.plugins import Registry, blamed

P = ParamSpec("P")
R = TypeVar("R")


def guarded(registry: Registry, name: str, call: Callable[P, R]) -> Callable[P, R]:
    """Return a function of an extension, whose errors name it; of the package's own itself."""
    if registry.source(name) is None:
        return call

    @functools.wraps(call)
    def answered(*of: P.args, **named: P.kwargs) -> R:
        try:
            return call(*of, **named)
        except (ArrayError, NumericalError) as error:
            raise registry.fault(name, f"{registry.kind} '{name}': {error.message}") from error
        except Exception as error:
            if isinstance(error, HjepaError) or blamed(error) or memory.ran_out(error):
                raise
            what = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
            raise registry.fault(name, f"{registry.kind} '{name}': {what}") from error

    return answered
