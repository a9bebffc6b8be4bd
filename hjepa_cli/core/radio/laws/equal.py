"""The law ``equal``: all N devices send in every slot, each on its part of the band.

The parts are equal, links fade, and at a mean SNR of γ̄ packets get through with probability p; N is
the largest number with p ≥ p*, the least that the loop survives.
"""

from hjepa_cli.core.radio.cell import Link
from hjepa_cli.core.radio.laws.closed_form import ClosedFormLaw
from hjepa_cli.core.radio.laws.requirement import DELIVERY, LinkRequirement


def _why_nobody(p: float, loop: LinkRequirement, link: Link) -> str:
    alone = link.phy.delivery_alone(link.payload_bits, link.snr_db)
    wanted = f"measured down to {p:.3g} only" if loop.at_least else f"but needs {p:.3g}"
    separator = ";" if loop.at_least else ","
    return f"one device alone delivers with p = {alone:.3g}{separator} {wanted}"


EQUAL = ClosedFormLaw(
    name="equal",
    help="all at once in equal parts",
    uses=("radio.noise", "remeasure", "dataset"),
    snr_label="Mean SNR (dB)",
    axis=DELIVERY,
    devices=lambda p, loop, link: link.phy.shared_by(p, link.payload_bits, link.snr_db, link.noise),
    why_nobody=_why_nobody,
)
