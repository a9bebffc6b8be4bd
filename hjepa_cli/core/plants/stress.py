"""Conditions have names and severities: pictures, plants and links that nobody was trained for.

They are written ``light=0.7``, or several together ``light=0.7+noise=8``, and take effect in the
order of :data:`CONDITIONS`: things before the camera first, then its place, its optics, the light,
the sensor, what is sent. Controllers, teachers and the oracle's equations stay the nominal ones.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.plants import corruptions
from hjepa_cli.core.plants.corruptions import Corrupt
from hjepa_cli.errors import UsageError, choices

AUDIT, ALL = "audit", "all"
SETS = f", or {AUDIT} or {ALL}"  # beside the names, where several are asked for


@dataclasses.dataclass(frozen=True)
class Condition:
    """Describes a condition.

    Attributes:
        name: as users write it.
        help: what a severity means, with its unit.
        low, high: bounds of the severity.
        ladder: severities that a bare name stands for, ascending.
        apply: what it does to pictures; ``None`` of plants and links.
        setting: the setting that it changes; ``None`` of pictures and actuators.
        nominal: the severity that changes nothing.
        whole: only whole severities are possible.
        of_colours: grey pictures do not have it.
    """

    name: str
    help: str
    low: float
    high: float
    ladder: tuple[float, ...]
    apply: Corrupt | None = None
    setting: str | None = None
    nominal: float = 0.0
    whole: bool = False
    of_colours: bool = False

    def check(self, severity: float) -> float:
        """Return a severity; raise UsageError for one out of bounds."""
        if not self.low <= severity <= self.high or (self.whole and severity != int(severity)):
            number = "a whole number" if self.whole else "a number"
            raise UsageError(
                f"condition {self.name}={severity:g}; expected {number} from {self.low:g} to "
                f"{self.high:g}: {self.help}"
            )
        return severity


def _pictures(
    name: str, help: str, low: float, high: float, *ladder: float, nominal: float = 0.0,
    whole: bool = False, of_colours: bool = False,
) -> Condition:  # fmt: skip
    apply = getattr(corruptions, name)
    return Condition(
        *(name, help, low, high, ladder, apply),
        nominal=nominal,
        whole=whole,
        of_colours=of_colours,
    )


CONDITIONS: dict[str, Condition] = {
    one.name: one
    for one in (
        _pictures("texture", "depth of stains on all of the scene, grey levels", 0, 255, 10, 30),
        _pictures("rotation", "of the camera, degrees", -45, 45, 1, 2, 3),
        _pictures("lens", "barrel distortion at the corners, share", 0, 0.5, 0.02, 0.05),
        _pictures("shift", "to the right, px", -32, 32, 2, 4, 8),
        _pictures("shift_down", "down, px", -32, 32, 2, 4, 8),
        _pictures("jitter", "of the camera in every frame, std in px", 0, 8, 0.05, 0.1, 0.2),
        _pictures("rectangle", "side of a square anywhere, px", 0, 64, 4, 8, 16, whole=True),
        _pictures("corner", "side of a grey square in a corner, px", 0, 64, 4, 8, 16, whole=True),
        _pictures("dark_object", "side of a dark square at the tip, px", 0, 64, 4, 8, whole=True),
        _pictures("bar", "height of a bar before part of the pole, px", 0, 64, 2, 3, 4, whole=True),
        _pictures("post", "width of an upright post in the middle, px", 0, 64, 2, 4, whole=True),
        _pictures("top", "hidden from above, share", 0, 1, 0.1, 0.2, 1 / 3),
        _pictures("blur", "std in px", 0, 8, 0.5, 1, 1.5, 2),
        _pictures("pixelate", "side of a square, px", 1, 16, 2, 4, nominal=1, whole=True),
        _pictures("light", "factor", 0, 4, 0.7, 0.8, 0.9, 1.1, 1.2, 1.3, nominal=1),
        _pictures("colour", "warmer by, share", -0.5, 1, 0.05, 0.1, 0.2, of_colours=True),
        _pictures("gradient", "fall of light across, share", 0, 1, 0.1, 0.2, 0.4),
        _pictures("vignette", "fall of light to the corners, share", 0, 1, 0.1, 0.3),
        _pictures("flicker", "less light in every second frame or so, share", 0, 1, 0.01, 0.02),
        _pictures("shot", "noise at white, std in grey levels", 0, 128, 2, 4, 8),
        _pictures("noise", "std in grey levels", 0, 128, 2, 4, 8, 16),
        _pictures(
            *("bayer", "noise under a colour mosaic, std in grey levels", 0, 128, 1, 4),
            of_colours=True,
        ),
        _pictures("dead_pixels", "share", 0, 1, 0.001, 0.01),
        _pictures("gamma", "exponent", 0.1, 10, 0.8, 0.9, 1.1, 1.25, nominal=1),
        _pictures("contrast", "factor", 0, 4, 0.6, 0.8, 1.2, nominal=1),
        _pictures("brightness", "added grey levels", -255, 255, -40, -20, 20),
        _pictures("jpeg", "quality", 1, 100, 50, 75, 95, nominal=101),
        _pictures("black", "black packets, share", 0, 1, 0.1, 0.5),
        _pictures("saturated", "white packets, share", 0, 1, 0.1, 0.5),
        _pictures("frozen", "packets of equal frames, share", 0, 1, 0.1, 0.5),
        _pictures("torn", "torn packets, share", 0, 1, 0.1, 0.5),
        Condition("mass", "factor on all masses", 0.2, 5, (0.8, 0.9, 1.1, 1.2), nominal=1),
        Condition(
            *("mass_spread", "of masses between devices, share", 0, 0.9, (0.1, 0.2, 0.4)),
            setting="protocol.plant_spread",
        ),
        Condition(
            *("length", "factor on the pole's length", 0.2, 5, (0.8, 0.9, 1.1, 1.2)),
            setting="conditions.pole_length",
            nominal=1,
        ),
        Condition("viscous", "friction of the cart, N s/m", 0, 1000, (0.5, 1, 2, 4)),
        Condition("coulomb", "dry friction of the cart, N", 0, 1000, (0.1, 0.3, 1)),
        Condition("dead_zone", "forces below it do nothing, N", 0, 1000, (0.2, 0.5, 1)),
        Condition("actuation", "delay of forces, steps", 0, 256, (1, 5, 10, 20), whole=True),
        Condition(
            *("downlink", "lost datagrams with forces, share", 0, 0.99, (0.5, 0.9)),
            setting="protocol.downlink_loss",
        ),
        Condition(
            *("late", "age of packets when they arrive, steps", 0, 256, (10, 20, 30)),
            setting="protocol.delay_steps",
            whole=True,
        ),
    )
}

# The rows of the audit of November 2026, in its order; its mean is one number of robustness.
AUDIT_ROWS = (
    *("light=0.8", "light=0.9", "light=1.2", "noise=2", "noise=4", "noise=8", "blur=1", "blur=2"),
    *("shift=4", "shift_down=4", "rotation=1", "rotation=3", "gradient=0.1", "flicker=0.01"),
    *("corner=8", "dark_object=8", "post=4", "top=0.3333", "jitter=0.05", "jitter=0.2"),
    *("jpeg=95", "jpeg=75", "mass_spread=0.2", "mass=1.2", "mass=0.8", "length=0.9", "length=1.1"),
    *("viscous=2", "coulomb=0.3", "coulomb=1", "actuation=1", "actuation=5", "actuation=10"),
    *("actuation=20", "downlink=0.5", "downlink=0.9", "dead_zone=0.2", "dead_zone=0.5"),
    *("dead_zone=1", "late=10", "late=20", "late=30"),
)

Parts = Mapping[Condition, float]


def parse(text: str) -> dict[Condition, float]:
    """Return the conditions and severities of ``"light=0.7+noise=8"``, in the order of effect.

    Raises:
        UsageError: an unknown condition, one that is there twice, no number, or out of bounds.
    """
    found: dict[Condition, float] = {}
    for part in filter(None, text.split("+")):
        name, _, number = part.partition("=")
        condition = _named(name.strip())
        try:
            severity = float(number)
        except ValueError:
            ladder = ", ".join(f"{condition.name}={value:g}" for value in condition.ladder)
            raise UsageError(
                f"condition '{part}': '{number}' is no number; {condition.help}: {ladder}"
            ) from None
        if condition in found:
            raise UsageError(f"condition '{text}' has {condition.name} twice")
        found[condition] = condition.check(severity)
    return {one: found[one] for one in CONDITIONS.values() if one in found}


def written(parts: Parts) -> str:
    """Return what :func:`parse` reads."""
    return "+".join(f"{one.name}={severity:.12g}" for one, severity in parts.items())


def rows(asked: Sequence[str], fits: Callable[[Condition], bool] = lambda one: True) -> list[str]:
    """Return the rows of ``--stress``: ``audit``, ``all``, bare names and composed conditions.

    Of the sets ``audit`` and ``all`` they are those that ``fits`` takes.

    Raises:
        UsageError: as of :func:`parse`.
    """
    found: list[str] = []
    for text in asked:
        if text == AUDIT:
            found += [row for row in AUDIT_ROWS if all(map(fits, parse(row)))]
        elif "=" in text:
            parse(text)
            found.append(text)
        else:
            named = [_named(text, SETS)] if text != ALL else [*filter(fits, CONDITIONS.values())]
            found += [f"{one.name}={value:.4g}" for one in named for value in one.ladder]
    return list(dict.fromkeys(found))


def under(settings: Settings, text: str) -> Settings:
    """Return settings under the conditions of ``text`` besides their own.

    Raises:
        UsageError: as of :func:`parse`.
    """
    parts = parse(text)
    kept = "+".join(filter(None, (settings.conditions.stress, written(of_devices(parts)))))
    written_there = {"conditions.stress": written(parse(kept))}
    changes = written_there | {one.setting: v for one, v in parts.items() if one.setting}
    for key, value in changes.items():
        section, _, name = str(key).partition(".")
        part = getattr(settings, section)
        cast = type(getattr(part, name))
        settings = dataclasses.replace(
            settings, **{section: dataclasses.replace(part, **{name: cast(value)})}
        )
    return settings


def of_devices(parts: Parts) -> dict[Condition, float]:
    """Return those of pictures and actuators, which no other setting has."""
    return {one: value for one, value in parts.items() if one.setting is None}


def of_pictures(parts: Parts) -> dict[Condition, float]:
    """Return those of pictures."""
    return {one: value for one, value in parts.items() if one.apply is not None}


def of_actuators(parts: Parts) -> dict[str, float]:
    """Return the severities of what happens to masses and forces, by name."""
    return {o.name: v for o, v in parts.items() if o.apply is None and o.setting is None}


def own_of(text: str) -> dict[Condition, float]:
    """Return the conditions of the setting ``conditions.stress``.

    Raises:
        UsageError: as of :func:`parse`, or one that has a setting of its own.
    """
    key = "conditions.stress"
    try:
        parts = parse(text)
    except UsageError as error:
        raise UsageError(f"{key}: {error.message}", hint=error.hint, key=key) from None
    for one, severity in parts.items():
        if one.setting is not None:
            raise UsageError(
                f"{key} = '{text}': {one.name} is the setting {one.setting} = {severity:g}",
                key=key,
            )
    return parts


def _named(name: str, sets: str = "") -> Condition:
    if name not in CONDITIONS:
        raise UsageError(f"unknown condition '{name}'; {choices(name, CONDITIONS)}{sets}")
    return CONDITIONS[name]
