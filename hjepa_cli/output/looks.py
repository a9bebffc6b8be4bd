"""Who asks for a figure may say how it looks: title, names of lines, axis, size.

Imports nothing heavy: flags are checked long before anything is drawn.
"""

import dataclasses
from collections.abc import Mapping, Sequence

from hjepa_cli.errors import UsageError, choices
from hjepa_cli.plugins import METHODS, SCHEDULERS

COLUMN_IN, PAGE_IN = 3.5, 7.16  # of an IEEE page


@dataclasses.dataclass(frozen=True)
class Looks:
    """A figure looks like this.

    Attributes:
        title: above it; ``None`` leaves it to the figure, an empty one leaves it out.
        labels: what lines are called, by method or scheduler; others by their own names.
        log: whether the axis that may span decades is logarithmic; ``None`` leaves it to the
            figure.
        width_in: how wide it is.
    """

    title: str | None = None
    labels: Mapping[str, str] = dataclasses.field(default_factory=dict)
    log: bool | None = None
    width_in: float = COLUMN_IN

    @classmethod
    def of(
        cls,
        title: str | None = None,
        labels: Sequence[str] | None = None,
        log: bool | None = None,
    ) -> "Looks":
        """Read what the command line or Python gives; labels are ``NAME=TEXT``.

        Raise UsageError for a label of nothing that is drawn, or without a text.
        """
        named: dict[str, str] = {}
        for one in labels or ():
            name, equals, text = one.partition("=")
            name, text = name.strip(), text.strip()
            if not (equals and text):
                raise UsageError(f"--labels {one}: not NAME=TEXT", hint="--labels hjepa=H-JEPA")
            if name not in METHODS and name not in SCHEDULERS:
                known = choices(name, [*METHODS, *SCHEDULERS])
                raise UsageError(f"--labels {one}: no method or scheduler '{name}'; {known}")
            named[name] = _literal(text)
        return cls(None if title is None else _literal(title), named, log)

    def check_drawn(self, drawn: bool, command: str) -> None:
        """Raise UsageError for looks of a figure that is not drawn; ``command`` would draw it."""
        if not drawn and self != Looks():
            raise UsageError(
                "--title, --labels, --log and --linear say how a figure looks; none is drawn",
                hint=f"{command}, with them",
            )

    def wide(self) -> "Looks":
        """Return the same for the width of a page."""
        return dataclasses.replace(self, width_in=PAGE_IN)

    def titled(self, usual: str) -> str:
        """Return the title, the usual one where none was given."""
        return usual if self.title is None else self.title

    def named(self, name: str) -> str:
        """Return what the line of a method is called."""
        return self.labels.get(name, name)

    def logarithmic(self, *, usual: bool = False) -> bool:
        """Return whether the axis is logarithmic."""
        return usual if self.log is None else self.log


def _literal(text: str) -> str:
    """Return a text in which a dollar is one, and begins no formula."""
    return text.replace("$", r"\$")


PLAIN = Looks()
