"""What networks offer to a controller: forces from an embedding, some steps at a time."""

from typing import Protocol

from torch import Tensor


class Planner(Protocol):
    """Turns embeddings into one stride of forces and the embedding the next stride starts from."""

    @property
    def stride(self) -> int:
        """Control steps planned at a time."""
        ...

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings [n, D] → forces_n [n, stride, *A], next embeddings [n, D]."""
        ...


class Reaction(Protocol):
    """Forces from a packet of any age."""

    @property
    def stride(self) -> int:
        """Control steps planned at a time."""
        ...

    @property
    def remembers(self) -> int:
        """How many of the forces sent since the packet it wants to see."""
        ...

    def plan(self, z: Tensor, ages: Tensor, sent_n: Tensor) -> Tensor:
        """Embeddings [n, D], ages [n], forces sent [n, remembers, *A] → forces_n [n, stride, *A].

        What has not been sent yet is 0.
        """
        ...
