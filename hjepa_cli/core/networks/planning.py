"""Networks offer forces from an embedding to a controller, some steps at a time."""

from typing import Protocol

from torch import Tensor

from hjepa_cli.core.arrays import Integers


class Planner(Protocol):
    """It turns embeddings into a stride of forces and the embeddings that the next starts from."""

    @property
    def stride(self) -> int:
        """Return the control steps planned at a time."""

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Map embeddings [n, D] to forces_n [n, stride, *A] and the next embeddings [n, D]."""

    def follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        """Move embeddings [n, D] on by their ages in steps [n], under forces_n [n, L, *A].

        Of a row's forces only so many are read as its age has steps.
        """


class Reaction(Protocol):
    """It makes forces from a packet of any age."""

    @property
    def stride(self) -> int:
        """Return the control steps planned at a time."""

    @property
    def remembers(self) -> int:
        """Return how many of the forces sent since the packet it wants to see."""

    def plan(self, z: Tensor, ages: Tensor, sent_n: Tensor) -> Tensor:
        """Map embeddings [n, D] of ages [n] to forces_n [n, stride, *A].

        The forces sent since are [n, remembers, *A], 0 where none has been sent yet.
        """
