"""A codec makes an embedding the bits of a packet, and an embedding again.

Codecs are looked up by the names that users give as payload (``plugins.CODECS["pca-8x6"]``). The
closed loop really encodes and decodes, so the bits counted are bits the controller lives on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from numbers import Integral
from typing import TYPE_CHECKING, Protocol

from hjepa_cli.plugins import CODECS, check_members

if TYPE_CHECKING:
    from torch import Tensor

    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.networks.model import Model


class Coder(Protocol):
    """Is both ends of a link: a codec made ready for the embeddings of one model."""

    def send(self, z: Tensor) -> Tensor:
        """Send embeddings [n, D]; the controller receives [n, D], float32."""
        ...


@dataclasses.dataclass(frozen=True)
class Codec:
    """Sends embeddings in one way.

    Attributes:
        name: as in ``--payload``.
        bits: counts the bits of one transmission of an embedding with D values. Methods that send
            none are charged the same, so nothing else counts them; another answer than a whole
            number above 0 raises UsageError.
        fit: makes it ready for a model; raises UsageError where the model's embeddings do not suit.
        fitted: it is fitted to trajectories drawn from the settings, so that curves measured
            through it depend on them.
    """

    name: str
    bits: Callable[[int], int]
    fit: Callable[[Model, Settings], Coder]
    fitted: bool = False

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, callable, "bits", "fit")
        check_members(self, bool, "fitted")
        count = self.bits

        def bits(embedding: int) -> int:
            found = count(embedding)
            if isinstance(found, Integral) and found > 0:
                return int(found)
            says = f"codec '{self.name}': bits({embedding}) = {found!r}"
            raise CODECS.fault(self.name, f"{says}; expected a whole number above 0")

        object.__setattr__(self, "bits", bits)


@dataclasses.dataclass(frozen=True)
class CodecFamily:
    """Makes codecs whose names hold numbers.

    Attributes:
        name: stands for all of theirs, as ``pca-NxB``.
        member: makes the codec of a name; ``None`` where no codec of the family is called so.
        described: the names once more for messages, with the valid numbers.
    """

    name: str
    member: Callable[[str], Codec | None]
    described: str

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, callable, "member")
        check_members(self, str, "described")
