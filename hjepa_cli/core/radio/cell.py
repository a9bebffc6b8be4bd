"""A radio cell has links and slots, as all laws see them, and a physical layer."""

import dataclasses

from hjepa_cli.config.schema import NrSettings, RadioSettings, Settings
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.radio.phy.phy import Carried, Noise, PhysicalLayer
from hjepa_cli.core.radio.phy.shannon import Shannon
from hjepa_cli.plugins import PHYS


@dataclasses.dataclass(frozen=True)
class Link:
    """Carries the packets of one device in a cell.

    Attributes:
        payload_bits: b.
        snr_db: γ̄.
        phy: what it is sent with.
        noise: its power is fixed, or scaled with a device's own share of the band.
    """

    payload_bits: int
    snr_db: float
    phy: PhysicalLayer
    noise: Noise = "fixed"

    @property
    def carried(self) -> Carried:
        """Return what slots of the whole band carry of such packets."""
        return self.phy.carries(self.payload_bits, self.snr_db)

    @property
    def packets_per_slot(self) -> float:
        """Return c: the packets that get through in a slot."""
        return self.carried.packets_per_slot


@dataclasses.dataclass(frozen=True)
class Cell:
    """Holds loops, in slots of a control step of the plants.

    Attributes:
        bandwidth_hz: W.
        slot_s: τ_o.
        limit_bits_per_s: λ/ln 2, what stabilising one plant takes at least; 0 if it is stable.
        noise: as of :class:`Link`.
        phy: the physical layer; capacity where none is given.
    """

    bandwidth_hz: float
    slot_s: float
    limit_bits_per_s: float
    noise: Noise = "fixed"
    phy: PhysicalLayer = None  # type: ignore[assignment]  # set below, never None

    def __post_init__(self) -> None:
        if self.phy is None:
            object.__setattr__(self, "phy", Shannon(self.bandwidth_hz, self.slot_s))

    @classmethod
    def of(cls, settings: Settings, plant: System) -> "Cell":
        """Return the cell of the settings with such plants."""
        radio, limit = settings.radio, plant.data_rate_limit_bits_per_s
        phy = physical_layer(radio, settings.nr, plant.step_s)
        return cls(radio.bandwidth_hz, plant.step_s, limit, radio.noise, phy)

    def link(self, payload_bits: int, snr_db: float) -> Link:
        """Return the link of a device whose packets have ``payload_bits``."""
        return Link(payload_bits, snr_db, self.phy, self.noise)


def physical_layer(radio: RadioSettings, nr: NrSettings, slot_s: float) -> PhysicalLayer:
    """Return the physical layer of a cell's settings, in slots of so many seconds."""
    layer: PhysicalLayer = PHYS[radio.phy].layer(radio, nr, slot_s)
    return layer
