"""Loops driven now, a little inside and outside what was found, confirm it or not."""

from collections.abc import Mapping
from typing import Any

from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.errors import NumericalError
from hjepa_cli.output.screen import Screen, span

VERIFY_AT = (0.9, 1.1)  # times the tolerance or the load


def verdict(what: str, share: float, point: Row, acceptable: float, *, inside: bool) -> Row:
    """Judge a driven point: its score's interval lies above the acceptable one inside, else below.

    ``share`` is that of the tolerance or the load; the point has ``score``, ``ci95`` and its place.
    """
    low, high = point["ci95"]
    return {
        "method": what,
        "share_of_tolerance": share,
        **point,
        "expected": "above" if inside else "below",
        "passed": low > acceptable if inside else high < acceptable,
    }


def show_verdicts(
    result: Mapping[str, Any], screen: Screen, title: str, what: str, key: str, label: str,
    digits: int,
) -> None:  # fmt: skip
    """Print the verdicts of a result that has some: what was driven, where, and its score."""
    if "verify" not in result:
        return
    screen.table(
        title,
        [what, label, "score (95 % CI)", "expected", "verdict"],
        [
            [
                check["method"],
                f"{check[key]:.{digits}f}",
                span(check["score"], check["ci95"], 3),
                f"{check['expected']} {result['acceptable_score']:g}",
                "verified" if check["passed"] else "NOT VERIFIED",
            ]
            for check in result["verify"]
        ],
    )


def enforce(result: Mapping[str, Any]) -> None:
    """Raise NumericalError where driven loops do not confirm what was found."""
    failed = [
        f"{check['method']} at {check['share_of_tolerance']} x its tolerance scores "
        f"{span(check['score'], check['ci95'], 3)}, not clearly {check['expected']} "
        f"{result['acceptable_score']:g}"
        for check in result.get("verify", [])
        if not check["passed"]
    ]
    if failed:
        raise NumericalError(
            f"not verified: {'; '.join(failed)}",
            hint="measure with more devices: protocol.bracket_devices in --config FILE.toml",
        )
