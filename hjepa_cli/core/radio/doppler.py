"""Devices that move have fades with a Doppler: gains that change smoothly from slot to slot.

Sums of sinusoids after Clarke and Jakes: the autocorrelation of a complex gain over a time t is
J0(2π f_D t). With a tapped delay line of TR 38.901 each tap fades so, and the gain of a link is the
mean power over its part of the band.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.special import j0

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.loop import GOLDEN
from hjepa_cli.errors import UsageError

LIGHT_M_S = 299_792_458.0
SINUSOIDS, TAP_SINUSOIDS = 64, 16  # of a tap
COHERENCE = 0.423  # coherence time · f_D, where the autocorrelation has come down to a half
SIGHT_DOPPLER = 0.7  # of the line of sight, in f_D (TR 38.901, clause 7.7.2)
SAMPLE_HZ = 720e3  # two PRBs at 30 kHz: between samples of the band at most
_DOPPLER_KEY = 0xD0B


@dataclasses.dataclass(frozen=True)
class Taps:
    """Is a tapped delay line: delays [P] and mean powers [P], which sum to 1.

    ``sight`` is the power of the line of sight within the first tap's, 0 where there is none.
    """

    delay_s: Floats
    power: Floats
    sight: float = 0.0


FLAT = Taps(np.zeros(1), np.ones(1))


@dataclasses.dataclass(frozen=True)
class Motion:
    """Says how fast links change, and over which part of which band they are.

    Attributes:
        doppler_hz: f_D.
        slot_s: from one gain to the next.
        taps: of all links.
        bandwidth_hz, allocation_hz: of the band, and of the part of it that a link has.

    Raises:
        UsageError: the fade would not last a slot.
    """

    doppler_hz: float
    slot_s: float
    taps: Taps = FLAT
    bandwidth_hz: float = 0.0
    allocation_hz: float = 0.0

    def __post_init__(self) -> None:
        if self.doppler_hz * self.slot_s > COHERENCE:
            raise UsageError(
                f"at a Doppler of {self.doppler_hz:.3g} Hz a fade lasts "
                f"{COHERENCE / self.doppler_hz * 1e3:.3g} ms, less than a slot of "
                f"{self.slot_s * 1e3:g} ms",
                hint="a lower --speed-m-s, or a lower carrier_ghz in --config FILE.toml",
            )


def doppler_hz(speed_m_s: float, carrier_ghz: float) -> float:
    """Return the largest Doppler shift f_D = v f_c / c."""
    return speed_m_s * carrier_ghz * 1e9 / LIGHT_M_S


def check_speed(speed_m_s: float, carrier_ghz: float, slot_s: float) -> None:
    """Raise UsageError, naming the fastest that goes, for fades that do not last a slot."""
    fastest = COHERENCE / slot_s * LIGHT_M_S / (carrier_ghz * 1e9)
    if speed_m_s > fastest:
        raise UsageError(
            f"--speed-m-s {speed_m_s:g}: at {carrier_ghz:g} GHz a fade then does not last a slot "
            f"of {slot_s * 1e3:g} ms; expected at most {fastest:.3g} m/s"
        )


def power_correlation(doppler_hz: float, apart_s: float) -> float:
    """Return the correlation J0(2π f_D t)² of power gains that lie a time apart."""
    return float(j0(2 * np.pi * doppler_hz * apart_s) ** 2)


def moving_fading(
    seed: int, links: int, motion: Motion, *, k_factor_db: npt.ArrayLike = -np.inf
) -> Iterator[Floats]:
    """Yield the power gains [links] of one slot after the other, forever; their mean is 1.

    Two iterators of one seed give the same gains; link i of n is link i of any m > i. The Rician K
    is that of each link [links] or of all, and of links with a single tap only.
    """
    taps = motion.taps
    flat = len(taps.power) == 1
    count = SINUSOIDS if flat else TAP_SINUSOIDS
    drawn = np.stack(  # for each sinusoid an angle and a phase, and the phase of the line of sight
        [generator(seed, _DOPPLER_KEY, i).random((len(taps.power), count, 2)) for i in range(links)]
    )
    sight_turn = np.stack([generator(seed, _DOPPLER_KEY, i, 1).random() for i in range(links)])
    # Evenly spread angles of arrival, turned together at random: ensemble averages are exact.
    angles = 2 * np.pi * (np.arange(count) + drawn[..., :1, 0]) / count
    shifts_hz, phases = np.cos(angles) * motion.doppler_hz, drawn[..., 1]
    sight = np.full(links, taps.sight)
    if flat:
        ratio = 10.0 ** (np.broadcast_to(np.asarray(k_factor_db, np.float64), links) / 10.0)
        sight = ratio / (ratio + 1.0)
    scattered = np.tile(taps.power, (links, 1))
    scattered[:, 0] -= sight
    amplitudes = np.sqrt(scattered / count)
    response = np.exp(-2j * np.pi * _frequencies(links, motion)[:, :, None] * taps.delay_s)
    for slot in itertools.count():
        time_s = slot * motion.slot_s
        tap = amplitudes * np.exp(2j * np.pi * (shifts_hz * time_s + phases)).sum(axis=-1)
        turn = SIGHT_DOPPLER * motion.doppler_hz * time_s + sight_turn
        tap[:, 0] += np.sqrt(sight) * np.exp(2j * np.pi * turn)
        across = np.einsum("lfp,lp->lf", response, tap)
        yield np.mean(across.real**2 + across.imag**2, axis=1)


def tapped_delay_line(name: str, delay_spread_s: float, carrier_ghz: float) -> Taps:
    """Return Sionna's profile ``"a"`` … ``"e"`` of TR 38.901, clause 7.7.2.

    Raises:
        UsageError: Sionna is not installed.
    """
    try:
        from sionna.phy.channel.tr38901 import TDL
    except ModuleNotFoundError:
        raise UsageError(
            f"--fading tdl-{name} needs sionna, which is not installed",
            hint='pip install "hjepa[nr]", or --fading jakes',
        ) from None
    line = TDL(name.upper(), delay_spread_s, carrier_ghz * 1e9, device="cpu")
    power = line.mean_powers.double().numpy().ravel()
    sight = float(line.mean_power_los.double().numpy().ravel()[0]) if line.los else 0.0
    delays = line.delays.double().numpy().ravel()
    return Taps(delays, power / power.sum(), sight / power.sum())


def _frequencies(links: int, motion: Motion) -> Floats:
    """Return the frequencies [links, F] that a link's gain is averaged over, its own part each."""
    width = min(motion.allocation_hz, motion.bandwidth_hz)
    count = 1 if len(motion.taps.power) == 1 else max(1, int(np.ceil(width / SAMPLE_HZ)))
    within = (np.arange(count) + 0.5) / count * width
    places = np.fmod(np.arange(links) * GOLDEN, 1.0) * (motion.bandwidth_hz - width)
    return np.asarray(places[:, None] + within)
