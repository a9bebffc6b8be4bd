"""D*, p* and devices against the speed of devices: what slow fading costs.

    python benchmarks/doppler.py [--method oracle] [--checkpoint NAME|PATH] [--speeds 0.3,1,3,10]
        [--fading jakes] [--margin-db 10] [--devices 64] [--phy nr]

p*: a packet is sent in every slot and arrives where the gain is in the upper share p of its
distribution. D*: one is sent every D slots and arrives unless the gain is below the power margin.
Both are where the normalised score falls to the acceptable one, speed 0 standing for gains that are
independent from slot to slot. Devices are those of the law duty at D* and 20 dB.
"""

import argparse
import itertools
import math

import numpy as np
from lists import numbers

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.loop import Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.cell import physical_layer
from hjepa_cli.core.radio.doppler import (
    FLAT,
    Motion,
    check_speed,
    doppler_hz,
    moving_fading,
    tapped_delay_line,
)
from hjepa_cli.core.radio.fading import block_fading
from hjepa_cli.core.radio.laws.duty import duty_devices
from hjepa_cli.core.statistics import bootstrap_weights, first_crossing, interval, ratio
from hjepa_cli.storage import zoo

SNR_DB = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="oracle")
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument("--plant", default="desktop")
    parser.add_argument("--speeds", type=numbers, default="0,0.3,1,3,10,30", help="m/s, a list")
    parser.add_argument("--fading", default="jakes", help="jakes, tdl-a … tdl-e")
    parser.add_argument("--margin-db", type=float, default=10.0)
    parser.add_argument("--gaps", type=numbers, default="1,2,5,10,20,40,60,80,100,120,140,160,200")
    parser.add_argument("--devices", type=int, default=64)
    parser.add_argument("--phy", default="shannon")
    options = parser.parse_args()
    settings = load_settings(flags={"plant": options.plant, "radio.phy": options.phy})
    protocol, kind, radio = settings.protocol, plant(settings.plant), settings.radio
    speeds = options.speeds
    for speed in speeds:
        check_speed(speed, radio.carrier_ghz, kind.step_s)
    model = Model.load(zoo.resolve_model(options.checkpoint)) if options.checkpoint else None
    method = build_driver(options.method, settings, model)
    carried = physical_layer(radio, settings.nr, kind.step_s).carries(
        method.bits_per_transmission, SNR_DB
    )
    draws = Draws.make(protocol, options.devices, settings.seed)
    everything = every_step(protocol.total_steps, options.devices)[None]
    reference = scores(kind, draws, everything, build_driver("optimal", settings, None))[0]
    weights = bootstrap_weights(options.devices, protocol.bootstrap, settings.seed)
    grid = np.array(options.gaps)
    taps = FLAT
    if options.fading != "jakes":
        profile = options.fading.removeprefix("tdl-")
        taps = tapped_delay_line(profile, radio.delay_spread_s, radio.carrier_ghz)
    print(
        f"{options.method}, {options.fading}, {options.devices} devices, {protocol.steps} steps "
        f"after {protocol.warmup_steps}, seed {settings.seed}, {options.phy} at {SNR_DB:g} dB, "
        f"margin {options.margin_db:g} dB, {radio.carrier_ghz:g} GHz\n"
    )
    print("| speed [m/s] | p* (95 % CI) | D* [steps] (95 % CI) | devices |\n|---|---|---|---|")
    for speed in speeds:
        motion = Motion(
            doppler_hz(speed, radio.carrier_ghz),
            kind.step_s,
            taps,
            radio.bandwidth_hz,
            carried.allocation_hz,
        )
        fading = (
            moving_fading(settings.seed, options.devices, motion)
            if speed
            else block_fading(settings.seed, options.devices)
        )
        gains = np.stack(list(itertools.islice(fading, protocol.total_steps)))
        ordered = np.sort(gains.ravel())
        thresholds = ordered[
            np.minimum(((1 - 1 / grid) * ordered.size).astype(int), ordered.size - 1)
        ]
        shared = gains[None] >= thresholds[:, None, None]
        margin = 10 ** (-options.margin_db / 10)
        sent = np.stack([gap_schedule(gap, *gains.shape) for gap in grid]) & (gains >= margin)
        found = []
        for schedules, log in ((shared, True), (sent, False)):
            schedules[:, 0] = True
            achieved = scores(kind, draws, schedules, method)
            level = protocol.acceptable_score
            crossing = float(first_crossing(grid, ratio(achieved, reference), level, log=log))
            drawn = first_crossing(grid, ratio(achieved, reference, weights), level, log=log)
            found.append((crossing, *map(float, interval(drawn))))
        (g, g_low, g_high), gap = found
        p = [math.nan if math.isinf(end) else 1 / end for end in (g, g_high, g_low)]
        devices = [
            int(duty_devices(end, carried.packets_per_slot)) if math.isfinite(end) else math.nan
            for end in gap
        ]
        print(
            f"| {'independent' if not speed else f'{speed:g}'} "
            f"| {p[0]:.4f} ({p[1]:.4f}–{p[2]:.4f}) "
            f"| {gap[0]:.1f} ({gap[1]:.1f}–{gap[2]:.1f}) "
            f"| {devices[0]:,} ({devices[1]:,}–{devices[2]:,}) |",
            flush=True,
        )


def scores(kind, draws, schedules, which):
    """The share of steps in the band of each curve point and device."""
    controller = which.controller(len(schedules) * draws.devices)
    return simulate(kind, draws, schedules, controller, which.sensor).score


if __name__ == "__main__":
    main()
