"""Closed loops show what a posterior will meet: predictions, wrong packets and the truth.

What a filter sees depends on the filter, since it drives the devices. So it learns from loops that
it drives itself, round after round (data-set aggregation, Ross et al., AISTATS 2011).
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ConditionSettings, Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.controllers import FusingController
from hjepa_cli.core.control.drivers import coder_of
from hjepa_cli.core.control.loop import Draws, simulate
from hjepa_cli.core.control.planners import Hierarchy, corrected
from hjepa_cli.core.control.sensors import embedding_sensor
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.training.decay_fit import SEARCH_SEED

GAP_KEY = 0xF05E


@dataclasses.dataclass(frozen=True, eq=False)
class Heard:
    """Holds what a controller knew and heard at n packets [n, D] each.

    Attributes:
        predicted: the embeddings that it took the devices to be at.
        packets: those that came.
        true: those of the same moments in clean pictures, as the encoder makes them.
    """

    predicted: Tensor
    packets: Tensor
    true: Tensor


def listen(model: Model, posterior: nn.Module, settings: Settings, number: int) -> Heard:
    """Drive devices over a link, a half of them in the settings' conditions, the others in none.

    Packets of the first half are also quantised as the settings say. The loops of each ``number``
    are others; gaps differ from device to device and packet to packet. Packets come on time, even
    where the settings' are late: each is paired with the truth of its own moment.
    """
    halves = [_listen(model, posterior, settings, number, exact=exact) for exact in (False, True)]
    names = [field.name for field in dataclasses.fields(Heard)]
    return Heard(*(torch.cat([getattr(half, name) for half in halves]) for name in names))


def ends_of_gaps(gaps: Sequence[int]) -> tuple[float, float]:
    """Return the mean gaps, in steps, between which devices lie: short ones, and of the middle."""
    return max(gaps[min(1, len(gaps) - 1)] / 2, 1.0), gaps[len(gaps) // 2]


def _listen(
    model: Model, posterior: nn.Module, settings: Settings, number: int, *, exact: bool
) -> Heard:
    options = settings.fusion
    protocol = dataclasses.replace(settings.protocol, warmup_steps=0, steps=options.loop_steps)
    seed = settings.seed + SEARCH_SEED + 2 * number + exact
    draws = Draws.make(protocol, options.devices, seed).on_device
    # A device's mean gap lies, by its logarithm, evenly between the ends.
    shortest, longest = ends_of_gaps(settings.protocol.gaps)
    share = generator(seed, GAP_KEY).uniform(size=options.devices)
    rates = 1 / (shortest * (longest / shortest) ** share)
    delivered = draws.delivery < rates
    delivered[0] = True

    conditions = ConditionSettings() if exact else settings.conditions
    camera = actual_camera(dataclasses.replace(settings, conditions=conditions, seed=seed))
    send = None if exact else coder_of(settings, model).send
    sense, clean = embedding_sensor(model, send, camera), embedding_sensor(model)
    heard: list[tuple[Tensor, Tensor, Tensor]] = []
    seen: list[Floats] = []

    def sensor(states: Floats) -> Tensor:
        seen.append(states)
        return sense(states)

    def correct(predicted: Tensor, packets: Tensor) -> Tensor:
        heard.append((predicted, packets, clean(seen.pop())))
        return corrected(posterior, predicted, packets)

    shape = model.action_shape
    controller = FusingController(
        Hierarchy(model), options.devices, action_shape=shape, correct=correct
    )
    plant = actual_plant(settings.plant, conditions)
    simulate(plant, draws, delivered[None], controller, sensor)
    return Heard(*(torch.cat(column).clone() for column in zip(*heard, strict=True)))
