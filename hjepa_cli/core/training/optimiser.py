"""All training loops share an optimiser with its schedule."""

import functools
import math
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.config.schema import ActorSettings
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.errors import NumericalError

WARM_UP = 0.3  # share of a one-cycle schedule spent rising
NAMED = 20  # samples of a batch in a message
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # what AdamW keeps of a parameter


def learning_rate_factor(step: int, steps: int, schedule: str) -> float:
    """Return the learning rate at ``step`` ÷ its peak: ``constant``, or ``one-cycle`` in cosines.

    A closed form of the step: there is no scheduler state to keep.
    """
    if schedule == "constant":
        return 1.0
    progress = step / max(steps - 1, 1)
    if progress < WARM_UP:
        return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * progress / WARM_UP))
    return 0.5 * (1.0 + math.cos(math.pi * (progress - WARM_UP) / (1.0 - WARM_UP))) + 1e-4


class Optimiser:
    """AdamW or SGD (``name`` is ``adamw`` or ``sgd``) refuses losses that are not finite.

    Args:
        schedule, steps: see :func:`learning_rate_factor`.
        gradient_clip: largest gradient norm; 0 does not clip.
        ranks: the processes whose losses and gradients are summed.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        *,
        name: str,
        schedule: str,
        steps: int,
        learning_rate: float,
        weight_decay: float,
        gradient_clip: float,
        ranks: Ranks = ALONE,
    ) -> None:
        self.parameters = list(parameters)
        kind = torch.optim.AdamW if name == "adamw" else torch.optim.SGD
        self.inner = kind(self.parameters, lr=learning_rate, weight_decay=weight_decay)
        self.schedule, self.steps, self.peak = schedule, steps, learning_rate
        self.gradient_clip, self.ranks = gradient_clip, ranks

    def step(self, loss: Tensor, step: int, batch: Callable[[], str] = lambda: "unnamed") -> float:
        """Update at ``step`` by this process's part of a loss; return that of all processes.

        ``batch`` names what the loss was taken on, for messages.

        Raises:
            NumericalError: the loss or its gradient is not finite.
        """
        rate = self.peak * learning_rate_factor(step, self.steps, self.schedule)
        for group in self.inner.param_groups:
            group["lr"] = rate
        self.inner.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        total = loss.detach().clone()
        gradients = [value.grad for value in self.parameters if value.grad is not None]
        self.ranks.add_up([total, *gradients])
        norm = nn.utils.clip_grad_norm_(self.parameters, self.gradient_clip or math.inf)
        if not torch.isfinite(norm) or not torch.isfinite(total):
            raise NumericalError(
                f"training diverged at step {step} (loss {total.item():.4g}, "
                f"gradient norm {norm.item():.4g}, learning rate {rate:.3g}, batch: {batch()})",
                hint="pass --config FILE.toml with a lower learning_rate, "
                'or with precision = "fp32" in [encoder]',
            )
        self.inner.step()
        return total.item()

    def state_dict(self) -> dict[str, Tensor]:
        """Return its moments and step counts, flat: ``<parameter's number>.<name>``."""
        return {
            f"{number}.{name}": value
            for number, parameter in enumerate(self.parameters)
            for name, value in self.inner.state[parameter].items()
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Put back what :meth:`state_dict` returned; no state is that before the first step.

        Raises:
            ValueError: it belongs to other parameters.
        """
        for key, value in state.items():
            number, _, name = key.partition(".")
            known = number.isdecimal() and int(number) < len(self.parameters) and name in MOMENTS
            parameter = self.parameters[int(number)] if known else None
            shape = () if name == "step" or parameter is None else parameter.shape
            if parameter is None or value.shape != shape or (name == "step" and value < 1):
                raise ValueError(f"optimiser state {key} of shape {tuple(value.shape)}")
            if value.dim():  # in the parameter's memory layout, or the last bits come out otherwise
                value = torch.empty_like(parameter).copy_(value)
            self.inner.state[parameter][name] = value
        if any(kept and len(kept) < len(MOMENTS) for kept in self.inner.state.values()):
            raise ValueError("optimiser state is incomplete")


def name_samples(kind: str, indices: Tensor) -> str:
    """Name a batch in a message, ``embeddings 3, 17, 4``: its beginning if it is long."""
    shown = ", ".join(str(index) for index in indices[:NAMED].tolist())
    return f"{kind} {shown}" + (f" and {len(indices) - NAMED} more" * (len(indices) > NAMED))


def fit_actor(
    z: Tensor,
    actions: Tensor,
    settings: ActorSettings,
    *,
    seed: int,
    epochs: int | None = None,
    mirror: Sequence[float] | None = None,
) -> Actor:
    """Fit the semantic actor on frozen embeddings by AdamW on the mean squared error.

    Embeddings [N, D] have the teacher's labels ``actions`` [N, *A] in units of the force limit;
    ``epochs`` are ``settings.epochs`` by default. The actor comes back in evaluation mode, on the
    device of ``z``.
    """
    torch.manual_seed(seed)
    actions = actions.to(z.device)
    shape = tuple(actions.shape[1:])
    actor = Actor(z.shape[1], settings.hidden, settings.dropout, shape, mirror).to(z.device)
    batches = max(len(z) // settings.batch, 1)
    total = batches * (epochs or settings.epochs)
    optimiser = Optimiser(
        actor.parameters(),
        name="adamw",
        schedule=settings.schedule,
        steps=total,
        learning_rate=settings.learning_rate,
        weight_decay=settings.weight_decay,
        gradient_clip=settings.gradient_clip,
    )
    actor.train()
    order = torch.empty(0, dtype=torch.long)
    for step in range(total):
        index = step % batches
        if index == 0:
            order = torch.randperm(len(z)).to(z.device)
        chosen = order[index * settings.batch : (index + 1) * settings.batch]
        loss = nn.functional.mse_loss(actor(z[chosen]), actions[chosen])
        optimiser.step(loss, step, functools.partial(name_samples, "embeddings", chosen))
    return actor.eval()
