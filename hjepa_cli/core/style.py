"""A method or a scheduler looks the same wherever it is drawn."""

import dataclasses
from typing import Any

DASH_DOT_DOT = (0, (3, 1, 1, 1, 1, 1))


@dataclasses.dataclass(frozen=True)
class Style:
    """A line of a figure looks like this; hollow markers say that a controller sees the true state.

    Curves of equally good methods lie on each other. So solid lines with large markers are drawn
    first, dashed ones with smaller markers over them, and all stay visible.
    """

    colour: str  # a method's own, of Okabe and Ito's palette where it is in most figures
    marker: str
    line: Any = "-"
    hollow: bool = False
    size: float = 4.0  # of the marker, in points

    def looks(self, scale: float = 1.0) -> dict[str, Any]:
        """Return the keywords of matplotlib's ``Axes.plot``."""
        return {
            "color": self.colour,
            "linestyle": self.line,
            "marker": self.marker,
            "markersize": scale * self.size,
            "markerfacecolor": "none" if self.hollow else self.colour,
            "markeredgecolor": self.colour if self.hollow else "white",
            "markeredgewidth": 1.0 if self.hollow else 0.4,
            "zorder": 3.0 - 0.1 * self.size,
        }


PLAIN = Style("#7F7F7F", "<", ":")  # of what has no style of its own
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, in the order in which lines of no method take their colours."""
