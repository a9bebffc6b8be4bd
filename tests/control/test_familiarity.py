"""Packets that look like nothing in training are flagged as often as they should, and kept back."""

import numpy as np
import pytest
import torch
from scipy import stats

from hjepa_cli.api import load_model
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control import drivers
from hjepa_cli.core.control.controllers import StrideController
from hjepa_cli.core.control.drivers import build_driver, check_of
from hjepa_cli.core.control.familiarity import PacketCheck, fit_familiarity
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.plants.stress import under
from hjepa_cli.stages.model_set import under_law_of


def normal(count: int, seed: int) -> torch.Tensor:
    """Embeddings of two wide directions, and a little beside them."""
    random = torch.Generator().manual_seed(seed)
    widths = torch.tensor([3.0, 1.0, 0.01, 0.01, 0.01])
    return 2.0 + widths * torch.randn(count, 5, generator=random)


def test_statistics_are_those_of_a_normal_distribution() -> None:
    fitted = fit_familiarity(normal(20_000, 0), normal(20_000, 1), 0.02)
    assert fitted.components.shape == (2, 5)
    among, beside = fitted.statistics(normal(20_000, 2))
    # T² of two components is χ² of two degrees of freedom, Q/σ² of three.
    for values, freedom in ((among, 2), (beside / 0.01**2, 3)):
        assert stats.kstest(values.numpy(), stats.chi2(freedom).cdf).statistic < 0.02
    assert fitted.limits[0] == pytest.approx(stats.chi2(2).ppf(0.99), rel=0.05)
    share = fitted.strange(normal(20_000, 3)).mean()
    assert abs(share - 0.02) < 4 * np.sqrt(0.02 / 20_000) * 2**0.5  # limits are drawn as well
    far, aside = torch.full((1, 5), 2.0), torch.full((1, 5), 2.0)
    far[0, 0] += 20
    aside[0, 4] += 0.1
    lost = torch.full((1, 5), torch.nan)
    assert fitted.strange(torch.cat([far, aside, lost])).all()


class Standing:
    """A planner that plays what it starts from."""

    stride = 2

    def plan(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return z[:, :1].expand(-1, 2), z


def test_flagged_packets_are_kept_back_but_no_more_than_the_limit_in_a_row() -> None:
    fitted = fit_familiarity(normal(5000, 0), normal(5000, 1), 0.01)
    controller = StrideController(
        Standing(), 2, check=lambda devices: PacketCheck(fitted, 2, devices)
    )
    good, bad = torch.full((1, 5), 2.0), torch.full((1, 5), 99.0)
    heard = np.array([True, False])

    def act(packet: torch.Tensor | None) -> float:
        return float(controller.act(heard if packet is not None else ~heard & heard, packet)[0])

    assert act(bad) == 99.0, "the first packet counts, whatever it is"
    assert act(good) == 2.0
    assert [act(packet) for packet in (bad, None, bad, None, bad + 1)] == [2.0] * 4 + [100.0]
    assert [act(packet) for packet in (bad, good + 0.001)] == [99.0, pytest.approx(2.001)]
    assert act(bad) == pytest.approx(2.001), "a good one starts the count anew"
    assert controller.check is not None
    assert controller.check.flagged.tolist() == [6, 0] and controller.check.received[0] == 8
    assert controller.check.now.tolist() == [True, False]


def test_a_packet_that_holds_nothing_is_never_acted_on() -> None:
    """Neither the first one, nor one after many: NaN forces would be played."""
    fitted = fit_familiarity(normal(5000, 0), normal(5000, 1), 0.01)
    check, good = PacketCheck(fitted, 1, 2), torch.full((2, 5), 2.0)
    both = np.ones(2, bool)
    spoilt = good.clone()
    spoilt[0] = torch.nan
    for _ in range(3):
        passed, packets, _ = check.pass_on(both, spoilt, None)
        assert passed.tolist() == [False, True] and packets is not None and len(packets) == 1
    assert check.flagged.tolist() == [3, 0]
    passed, packets, _ = check.pass_on(both, torch.cat([good[:1] + 97, good[1:]]), None)
    assert passed.all(), "what comes after them is a device's first one"


def test_a_camera_that_shows_the_same_for_long_is_flagged() -> None:
    fitted = fit_familiarity(normal(5000, 0), normal(5000, 1), 0.01)
    check, one = PacketCheck(fitted, 3, 1), torch.full((1, 5), 2.0)
    every, nobody = np.ones(1, bool), np.zeros(1, bool)
    check.pass_on(every, one, None)
    check.pass_on(every, one, None)
    assert not check.now.any(), "a device at rest looks the same a moment later"
    for _ in range(10):
        check.pass_on(nobody, None, None)
    check.pass_on(every, one, np.array([0]))
    assert check.now.all()
    for _ in range(10):
        check.pass_on(nobody, None, None)
    passed, packets, ages = check.pass_on(every, one + 1e-3, np.array([4]))
    assert passed.all() and packets is not None and ages.tolist() == [4]


SMALL = {
    "protocol.warmup_steps": 200, "protocol.steps": 800, "protocol.curve_devices": 6,
    "protocol.bracket_devices": 6, "protocol.false_alarm": 0.01,
}  # fmt: skip


@pytest.fixture(scope="module")
def model():
    return load_model("desktop-h4m2l1")


def measured(model, condition: str, **changes: float):
    settings = under_law_of(model, load_settings(flags=SMALL | changes))
    simulator = Simulator(under(settings, condition), model)
    return Block("hjepa", (Point("gap", 20.0),), 0, 6).compute(simulator, lambda steps: None)


def test_garbage_is_flagged_and_ordinary_packets_are_not(model) -> None:
    nominal = measured(model, "")
    assert nominal.flagged.mean() < 0.03 and nominal.score.mean() > 0.8
    gained = {}
    for fault in ("black", "saturated", "torn", "frozen"):
        found = measured(model, f"{fault}=0.3")
        # Of 6 × 50 packets 30 % ± 4 σ, and the false alarms.
        assert abs(found.flagged.mean() - 0.3) < 4 * np.sqrt(0.21 / 300) + 0.03, fault
        acted_on = measured(model, f"{fault}=0.3", **{"protocol.false_alarm": 0.0})
        assert acted_on.flagged is None
        assert found.score.mean() > 0.85 * nominal.score.mean()
        gained[fault] = found.score.mean() - acted_on.score.mean()
    # Without anything to see, black or white, the model plans hardly any force: no loss either way.
    assert min(gained.values()) > -0.03 and gained["torn"] > 0.3 and gained["frozen"] > 0, gained


def test_off_no_coder_is_fitted(model, monkeypatch) -> None:
    monkeypatch.setattr(drivers, "coder_of", lambda *ignored: pytest.fail("fitted in vain"))
    plain = load_settings(flags={"protocol.payload": "pca-16x3"})
    assert check_of(plain, model) is None


def test_off_there_is_no_check_and_digests_know_what_it_is_fitted_to(model) -> None:
    plain = load_settings()
    assert check_of(plain, model) is None
    assert build_driver("hjepa", plain, model).controller(2).check is None
    assert "false_alarm" not in plain.as_dict()["protocol"]
    checked = load_settings(flags={"protocol.false_alarm": 0.01})
    other = load_settings(flags={"protocol.false_alarm": 0.01, "collect.trajectories": 100})
    digests = {Digest.of("x", settings).protocol for settings in (plain, checked, other)}
    assert len(digests) == 3
