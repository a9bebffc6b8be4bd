"""Planners give controllers a model's predictions: one stride of forces at a time, in newton."""

from typing import TYPE_CHECKING

from torch import Tensor, nn

from hjepa_cli.core.networks.hierarchy import hold, plan_stride
from hjepa_cli.core.networks.reflex import Reflex

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model


class Hierarchy:
    """Plans as H-JEPA: one coarse stride at a time, filled in by the finer levels."""

    def __init__(self, model: "Model") -> None:
        self._model = model
        self.stride = model.strides.h

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Plan a stride, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        networks = self._model.networks
        with self._model.autocast():
            actions, _, z_next = plan_stride(
                self._model.act,
                networks["high"],
                networks["medium"],
                networks["low"],
                z,
                self._model.strides,
                recompute_waypoint=self._model.architecture["stride_actions"] == "all",
            )
        return self._model.force_limit_n * actions, z_next


class OnePredictor:
    """Plans as TS-JEPA: one predictor of a fixed depth, the action held in between."""

    def __init__(self, model: "Model", predictor: nn.Module, stride: int) -> None:
        self._model, self._predictor, self.stride = model, predictor, stride

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Plan a stride, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        with self._model.autocast():
            actions = hold(self._model.act(z), self.stride)
            return self._model.force_limit_n * actions, self._predictor(z, actions)

    def step(self, z: Tensor, forces_n: Tensor) -> Tensor:
        """Go a stride on under given forces: z [N, D], forces_n [N, *A] → embeddings [N, D]."""
        with self._model.autocast():
            actions = forces_n.to(self._model.device).unsqueeze(1) / self._model.force_limit_n
            return self._predictor(z, actions)  # type: ignore[no-any-return]


class ReflexReaction:
    """Plays a reflex in newton, as a :class:`~hjepa_cli.core.networks.planning.Reaction`."""

    def __init__(self, model: "Model", reflex: nn.Module) -> None:
        assert isinstance(reflex, Reflex)
        self._model, self._reflex = model, reflex
        self.stride = reflex.shape[0]
        self.remembers = reflex.longest_age if reflex.sees_forces else 0

    def plan(self, z: Tensor, ages: Tensor, sent_n: Tensor) -> Tensor:
        """Plan forces, as :class:`~hjepa_cli.core.networks.planning.Reaction` says."""
        limit_n, device = self._model.force_limit_n, self._model.device
        sent = (sent_n / limit_n).unsqueeze(1).to(device) if self.remembers else None
        with self._model.autocast():
            actions = self._reflex.act(z.to(device), ages.unsqueeze(1).to(device), sent)
            return limit_n * actions.squeeze(1).float()
