"""A method says what devices send, and what their controller makes of it.

Commands, tables and figures ask the description for all that they must know of a method; so these
modules import torch only where they build.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.core.style import Style
from hjepa_cli.errors import UsageError, choices
from hjepa_cli.plugins import METHODS, check_members

if TYPE_CHECKING:
    from torch import nn

    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.control.drivers import Driver
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.networks.planning import Planner
    from hjepa_cli.core.plants.system import System

Sent = Literal["true state", "decoded state", "embedding", "frames", "nothing"]
Architecture = Mapping[str, Any]
Modules = Callable[[Architecture, tuple[int, ...], tuple[float, ...]], "nn.ModuleDict"]


@dataclasses.dataclass(frozen=True)
class Method:
    """Describes one way to drive devices.

    Attributes:
        name: as in ``--methods``.
        sends: what is in a packet; those on the true state need no model.
        build: makes it ready with settings and a model that offers it; on the true state with any
            model or ``None``.
        offered: whether a model of an architecture, of any kind, offers it to a plant.
        trained_by: the command that trains such a model with the settings, or why there is none.
        needs_link: whether packets go over the radio at all.
        fitted: it is fitted in closed form to trajectories drawn from the settings, where it is
            measured; cached curves then depend on them.
        reflex: it answers a packet by its age, and predicts nothing.
        compared: it is in the figure of ``eval`` unless methods are named.
        style: how figures draw it; ``None`` leaves that to them.
        does: what it does, in a few words for readers of a report, as "predicts the embedding".
        planner: makes the planner of a model's own predictor, for methods that play one.
        kind: of the architectures that a plugin's own training writes, which offer the method;
        modules: builds the untrained networks of such an architecture, by the arguments of
            :func:`~hjepa_cli.core.networks.model.build_modules`.
    """

    name: str
    sends: Sent
    build: Callable[[Settings, Any], Driver]
    offered: Callable[[Architecture, System], bool] = lambda architecture, plant: False
    trained_by: Callable[[Settings], str] = lambda settings: "it needs no training"
    needs_link: bool = True
    fitted: bool = False
    reflex: bool = False
    compared: bool = False
    style: Style | None = None
    does: str = ""
    planner: Callable[[Model], Planner] | None = None
    kind: str | None = None
    modules: Modules | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        if self.sends not in get_args(Sent):
            known = choices(self.sends, get_args(Sent), "choose one of")
            raise UsageError(f"Method '{self.name}': sends = {self.sends!r}; {known}")
        check_members(self, callable, "build", "offered", "trained_by")
        check_members(self, callable, "planner", "modules", optional=True)
        check_members(self, bool, "needs_link", "fitted", "reflex", "compared")
        check_members(self, str, "does")
        check_members(self, str, "kind", optional=True)
        check_members(self, Style, "style", optional=True)

    @property
    def needs_model(self) -> bool:
        """Tell whether a trained model must offer it."""
        return self.sends != "true state"

    def offers(self, architecture: Architecture, plant: System) -> tuple[str, ...]:
        """Return its name where a model of the architecture offers it to the plant."""
        own = self.kind is not None and architecture["kind"] == self.kind
        offered = guarded(METHODS, self.name, self.offered)
        return (self.name,) if own or offered(architecture, plant) else ()


@dataclasses.dataclass(frozen=True)
class MethodFamily:
    """Makes methods whose names hold numbers.

    Attributes:
        name: stands for all of theirs, as ``ts-jepa-N``.
        member: makes the method of a name; ``None`` where no method of the family is called so.
        members_of: the names that an architecture might offer.
    """

    name: str
    member: Callable[[str], Method | None]
    members_of: Callable[[Architecture], Sequence[str]]

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, callable, "member", "members_of")

    def offers(self, architecture: Architecture, plant: System) -> tuple[str, ...]:
        """Return the names that a model of the architecture offers to the plant."""
        members = (self.member(name) for name in dict.fromkeys(self.members_of(architecture)))
        return tuple(name for one in members if one for name in one.offers(architecture, plant))


def of_hierarchy(architecture: Architecture, plant: System) -> bool:
    """Tell whether a model comes from ``train-hierarchy``."""
    return architecture["kind"] in ("hierarchy", "flat")


def training(stage: str, flags: str = "") -> Callable[[Settings], str]:
    """Return the command of a training stage with the settings' preset, for messages."""

    def command(settings: Settings) -> str:
        preset = "" if settings.preset == "default" else f" --preset {settings.preset}"
        return f"hjepa {stage}{preset}{flags}"

    return command
