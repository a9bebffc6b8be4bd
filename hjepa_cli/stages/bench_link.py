"""``hjepa bench-link`` drives simulated devices through the wire, and the same in the simulator.

Exported model → devices with the draws of the closed-loop protocol → scores over the wire → the
simulator's on the same draws → differences, paired by device. In lockstep nothing is ever late and
the difference is one of code; in real time ``hjepa serve`` runs in a process of its own and has to
keep up.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hjepa_cli.compute import memory
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.controllers import StrideController
from hjepa_cli.core.control.drivers import planner_of
from hjepa_cli.core.control.loop import Draws, LinkDraws, delivery_schedule, gap_schedule, simulate
from hjepa_cli.core.networks.planning import Planner
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.plants.frames import FRAME_SHAPE, Camera, frames_back, frames_of
from hjepa_cli.core.plants.named import plant_of, seen_as_trained
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.statistics import bootstrap_weights, mean_interval
from hjepa_cli.errors import DataError, NumericalError, Unavailable, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import results
from hjepa_cli.stages.device import check_plant
from hjepa_cli.stages.export import checkpoint_of
from hjepa_cli.stages.plan import Plan, run_directory
from hjepa_cli.storage import zoo
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.files import JSON_LIMIT_BYTES, read_bytes
from hjepa_cli.storage.runs import Run, describe_input
from hjepa_cli.wire import bench, protocol
from hjepa_cli.wire.auth import NO_KEY
from hjepa_cli.wire.bench import LOST_THETA_RAD, MOST_MISSING, BenchOutcome, Fleet
from hjepa_cli.wire.bundle import Bundle, open_bundle
from hjepa_cli.wire.controller import Controller
from hjepa_cli.wire.export import load_fp32
from hjepa_cli.wire.relay import Trace
from hjepa_cli.wire.runtime import Runtime
from hjepa_cli.wire.server import open_socket, parse_address

PERIOD_MS = 5.0
STARTS_S = 20.0  # that a server may take
KILLED_S, STOPPED_S = 0.5, 2.0  # how long harm lasts
THETA = "theta"
START_STEPS = 16  # of real time in which all devices send at once: none counts as missed
COMPARED = (1, 20, 50, 100, 300, 1000)  # steps after which angles are compared


@dataclasses.dataclass(frozen=True)
class Asked:
    """It is asked for as the run records it; see :func:`run`."""

    devices: int
    steps: int
    lockstep: bool
    period_ms: float | None
    gap_steps: int
    delivery: float | None
    harm: str | None
    backend: str

    def period_s(self, step_s: float) -> float:
        """Return what a step takes: in lockstep time is the plant's own."""
        return step_s if self.lockstep else wall_s(self.period_ms)

    def silence(self, period_s: float) -> range:
        """Return the steps in which a harmed server says nothing, from the middle on."""
        if self.harm is None:
            return range(0)
        middle, lasts_s = self.steps // 2, KILLED_S if self.harm == "kill" else STOPPED_S
        return range(middle, middle + round(lasts_s / period_s))

    def check(self, step_s: float) -> None:
        """Raise UsageError for a harm that lasts longer than the run."""
        silent = self.silence(self.period_s(step_s))
        if silent and silent.stop >= self.steps:
            raise UsageError(
                f"--harm {self.harm} keeps the server silent from step {silent.start} to "
                f"{silent.stop} of {self.steps}",
                hint=f"--steps {2 * len(silent) + 1} or more, to see devices driven again",
            )


def run(
    settings: Settings,
    screen: Screen,
    *,
    out: Path | None = None,
    model: Path = Path("exported"),
    devices: int = 64,
    steps: int = 1000,
    lockstep: bool = False,
    period_ms: float | None = None,
    gap_steps: int = 80,
    delivery: float | None = None,
    trace: Path | None = None,
    harm: str | None = None,
    checkpoint: str | None = None,
    backend: str = "onnxruntime",
) -> dict[str, Any]:
    """Drive both ways and compare; return the document of ``--json``.

    Args:
        settings: plant, seed, and the protocol's starts, gusts, delay, jitter and lost downlinks.
        screen: shows progress and results.
        out: run directory.
        model: exported model.
        devices, steps: how many, all steps scored.
        lockstep: without deadlines, in one process; only so datagrams can be delayed.
        period_ms: wall time of a step otherwise.
        gap_steps, delivery: a packet every so many steps, or with this probability.
        trace: of a recorded link, up.
        harm: done to the server in the middle: ``kill`` or ``stop``.
        checkpoint: what was exported.
        backend: of the runtime.

    Raises:
        UsageError: delays in real time, or harm that lasts longer than the run.
        NumericalError: more than 0.1 % of steps had no force in time.
        Unavailable: the server does not start.
        DataError, MissingInputError: no such model or trace, or of another plant.
        OutOfMemory: what is measured of so many devices and steps does not fit.
    """
    kind = plant_of(settings)
    bundle, path, recorded = opened(settings, model, checkpoint, trace, lockstep=lockstep)
    asked = Asked(devices, steps, lockstep, period_ms, gap_steps, delivery, harm, backend)
    asked.check(kind.step_s)
    memory.check(memory_bytes(kind, bundle, devices, steps), f"{devices} devices, {steps} steps")
    inputs = {
        "model": describe_input(model, bundle.digest.hex()),
        "checkpoint": describe_input(path, load_checkpoint(path).digest),
        **({"trace": describe_input(trace, digest_of(trace))} if trace else {}),
    }
    with Run.create("bench-link", out, settings.as_dict(), {**inputs, **vars(asked)}) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            with results.showing("bench-link", record.result, record.directory):
                show(screen, record.result)
            return record.result
        result, skipped = measured(settings, screen, asked, bundle, path, recorded)
        result |= {
            "model": model,
            "checkpoint": path,
            "method": bundle.manifest["method"],
            "plant": bundle.plant,
            "seed": settings.seed,
            **vars(asked),
            "period_ms": None if lockstep else 1e3 * wall_s(period_ms),
            "skipped_strides": skipped,
            "downlink_loss": settings.protocol.downlink_loss,
            "delay_steps": settings.protocol.delay_steps,
            "jitter_steps": settings.protocol.jitter_steps,
            "trace": trace,
        }
        show(screen, result)
        screen.say(f"written: {record.directory}")
        return record.finish(result)


def plan(
    settings: Settings,
    *,
    out: Path | None = None,
    model: Path = Path("exported"),
    devices: int = 64,
    steps: int = 1000,
    lockstep: bool = False,
    period_ms: float | None = None,
    gap_steps: int = 80,
    delivery: float | None = None,
    trace: Path | None = None,
    harm: str | None = None,
    checkpoint: str | None = None,
    backend: str = "onnxruntime",
) -> Plan:
    """Plan a drive; arguments as of :func:`run`."""
    bundle, *_ = opened(settings, model, checkpoint, trace, lockstep=lockstep)
    asked = Asked(devices, steps, lockstep, period_ms, gap_steps, delivery, harm, backend)
    asked.check(plant_of(settings).step_s)
    return Plan(
        command="bench-link",
        reads=[f"exported model {model}"],
        work=[f"drive {devices} devices for {steps} steps over the wire, and in the simulator"],
        writes=[run_directory("bench-link", out)],
        writes_bytes=20_000,
        seconds=10 + (0 if lockstep else steps * wall_s(period_ms)) + devices * steps / 20_000,
        memory_bytes=memory_bytes(plant_of(settings), bundle, devices, steps),
    )


def wall_s(period_ms: float | None) -> float:
    """Return what a step in real time takes."""
    return (period_ms or PERIOD_MS) / 1e3


def opened(
    settings: Settings, model: Path, checkpoint: str | None, trace: Path | None, *, lockstep: bool
) -> tuple[Bundle, Path, Trace | None]:
    """Open the exported model, find what it was exported from, and read a trace; as :func:`run`."""
    bundle = open_bundle(model)
    check_plant(bundle, settings)
    path = zoo.resolve_model(checkpoint) if checkpoint else checkpoint_of(bundle)
    if load_checkpoint(path).digest != bundle.manifest["checkpoint"]["sha256"]:
        raise DataError(
            f"{path} is not what {model} was exported from: a difference would be of models, not "
            "of the wire",
            hint=f"{shell(['hjepa', 'export', checkpoint or path])} --to DIR, and --model DIR here",
        )
    recorded = None if trace is None else Trace.read(trace)
    protocol_ = settings.protocol
    late = {
        "--delay-steps": protocol_.delay_steps,
        "--jitter-steps": protocol_.jitter_steps,
        "--trace": recorded and recorded.latest_steps(1e3 * plant_of(settings).step_s),
    }
    delays = [flag for flag, steps in late.items() if steps]
    if recorded and {*delays} - {"--trace"}:
        raise UsageError(f"--trace has delays of its own: leave {delays[0]} out")
    if delays and not lockstep:  # they would be in the simulation and not on the wire
        raise UsageError(
            f"{delays[0]} delays datagrams, which bench-link does in lockstep only; in real time "
            "they take what they take",
            hint="add --lockstep; in real time hjepa link --uplink-delay-ms 5",
        )
    return bundle, path, recorded


def memory_bytes(kind: System, bundle: Bundle, devices: int, steps: int) -> float:
    """Return what draws, states of both loops, schedules and one picture of each device take."""
    values = 3 * len(kind.state_names) + 1
    return devices * (steps * (8 * values + 3) + bundle.frames * math.prod(FRAME_SHAPE))


def measured(
    settings: Settings,
    screen: Screen,
    asked: Asked,
    bundle: Bundle,
    checkpoint: Path,
    recorded: Trace | None,
) -> tuple[dict[str, Any], int]:
    """Drive over the wire and in the simulator; return the comparison, and strides skipped."""
    torch.set_num_threads(1)
    kind, steps = plant_of(settings), asked.steps
    draws, sent = drawn(settings, asked, recorded)
    runtime = Runtime(bundle, asked.backend)
    runtime.warm_up("encoder", "actor")
    moved = actual_plant(settings.plant, settings.conditions)
    camera = actual_camera(seen_as_trained(settings, bundle.manifest["camera"]))
    late = latest_steps(draws.link)
    late += -late % bundle.stride  # the controller takes packets up whole strides old
    fleet = Fleet(
        *(bundle, runtime, moved, camera, draws, sent, NO_KEY, asked.period_s(kind.step_s)),
        local=asked.harm is not None,
        grace_steps=late + (0 if asked.lockstep else START_STEPS),
        lost=draws.link.lost,
    )
    with screen.progress("wire", steps, "steps") as bar:
        if asked.lockstep:
            wired, skipped = drive_in_lockstep(fleet, runtime, draws.link, asked, bar.advance)
        else:
            wired, skipped = drive(fleet, asked, bar.advance)
    if wired.missing > MOST_MISSING and asked.harm is None:
        raise NumericalError(
            f"overrun: {100 * wired.missing:.2f} % of steps had no force in time (at most "
            f"{100 * MOST_MISSING:g} %); a score would be of this machine, not of the wire",
            hint="fewer --devices, a longer --period-ms, or a machine with less else to do",
        )
    states = np.empty_like(wired.states)
    with screen.progress("simulate", steps, "steps") as bar:
        exported = Exported(runtime, kind.action_shape)
        planner = exported if asked.lockstep else in_torch(bundle, checkpoint)
        score = simulated(runtime, planner, moved, camera, draws, sent, states, bar.advance)
    result = compared(settings, wired, score, states, kind.state_names)
    if asked.harm is not None:
        silent = asked.silence(asked.period_s(kind.step_s))
        result["taken_up_after_s"] = wired.driven_again_s(silent.stop)
    return result, skipped


def drawn(settings: Settings, asked: Asked, recorded: Trace | None) -> tuple[Draws, Bools]:
    """Return the draws of both loops, and when each device sends what is not lost [K, N]."""
    steps, devices = asked.steps, asked.devices
    protocol_ = dataclasses.replace(settings.protocol, warmup_steps=0, steps=steps)
    draws = Draws.make(protocol_, devices, settings.seed)
    if asked.delivery is None:
        sent = gap_schedule(asked.gap_steps, steps, devices)
    else:
        sent = delivery_schedule(asked.delivery, draws.delivery)
    link = draws.link
    if recorded is not None:
        link, lost = recorded.draws(steps, devices, 1e3 * plant_of(settings).step_s)
        link = dataclasses.replace(link, lost=draws.link.lost)
        sent &= ~lost
    # The wire answers at once, and sends each force several times instead of deciding it early.
    return dataclasses.replace(draws, link=dataclasses.replace(link, lead_steps=0)), sent


def compared(
    settings: Settings,
    wired: BenchOutcome,
    score: Floats,
    states: Floats,
    names: tuple[str, ...],
) -> dict[str, Any]:
    """Return scores, their paired difference with its interval, and how far apart angles are."""
    weights = bootstrap_weights(len(score), settings.protocol.bootstrap, settings.seed)
    difference, steps = wired.score - score, len(states)
    answers, late = sum(wired.ages.values()), wired.late_answers
    found: dict[str, Any] = {
        "score_link": float(wired.score.mean()),
        "score_link_ci95": mean_interval(wired.score, weights).tolist(),
        "score_simulated": float(score.mean()),
        "score_simulated_ci95": mean_interval(score, weights).tolist(),
        "score_difference": float(difference.mean()),
        "score_difference_ci95": mean_interval(difference, weights).tolist(),
        "missing_share": wired.missing,
        "answers": answers,
        "late_answers_share": late,
        "ages": {str(age): count for age, count in wired.ages.items()},
        "sources": wired.sources,
        "seconds": wired.seconds,
        "n_devices": len(score),
        "n_steps": steps,
    }
    if THETA in names:
        at = names.index(THETA)
        apart = np.abs(wired.states[..., at] - states[..., at]).max(axis=1)
        found["theta_difference_rad"] = {
            str(k): float(apart[:k].max()) for k in COMPARED if k <= steps
        }
        fallen = np.abs(wired.states[..., at]) > LOST_THETA_RAD
        found["fallen_share"] = float(fallen.any(axis=0).mean())
    return found


class Exported:
    """The exported networks as the simulator's controller takes a planner."""

    def __init__(self, runtime: Runtime, action_shape: tuple[int, ...]) -> None:
        self._runtime, self._shape = runtime, action_shape
        self.stride = runtime.bundle.stride

    def plan(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Plan a stride, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        forces_n, z_next = map(torch.from_numpy, self._runtime.plan(z.numpy()))
        return forces_n.reshape(len(z), self.stride, *self._shape), z_next

    def follow(self, z: torch.Tensor, forces_n: torch.Tensor, ages: Integers) -> torch.Tensor:
        """Move embeddings on, likewise."""
        flat_n = forces_n.reshape(*forces_n.shape[:2], -1).numpy()
        return torch.from_numpy(self._runtime.follow(z.numpy(), flat_n, ages))


def in_torch(bundle: Bundle, path: Path) -> Planner:
    """Return the planner of the checkpoint itself, in float32."""
    return planner_of(load_fp32(path), bundle.manifest["method"])


def simulated(
    runtime: Runtime,
    planner: Planner,
    plant: System,
    camera: Camera,
    draws: Draws,
    sent: Bools,
    states: Floats,
    tick: Callable[[], None],
) -> Floats:
    """Return the simulator's scores [N] on the same draws, and fill states [K, N, S].

    Pictures are encoded by what devices run. In lockstep the planner is the exported one too: what
    is compared is the wire, and two sums in another order would sooner or later make another grey
    level, another code, and two loops that have little to do with each other.
    """

    back = frames_back(runtime.bundle.look)

    def sense(seen: Floats) -> torch.Tensor:
        frames = frames_of(camera, seen[:, back])
        coded = (protocol.encode_int8(runtime.encode(one[None])[0]) for one in frames)
        received: list[NDArray[np.float32]] = [protocol.decode_int8(*pair) for pair in coded]
        return torch.from_numpy(np.stack(received))

    def watch(k: int, now: Floats, forces_n: Floats) -> None:
        states[k] = now

    controller = StrideController(planner, draws.devices, action_shape=plant.action_shape)
    outcome = simulate(
        plant, draws, sent[None], controller, sense, ends=False, tick=tick, watch=watch
    )  # as on the wire, where nobody takes a device that fell away
    return outcome.score[0]


def digest_of(trace: Path) -> str:
    """Return the sha256 of a trace's file."""
    return hashlib.sha256(read_bytes(trace, limit=JSON_LIMIT_BYTES)).hexdigest()


def latest_steps(link: LinkDraws) -> int:
    """Return the steps that a datagram up takes at most."""
    extra = 0 if link.extra_steps is None else int(link.extra_steps.max(initial=0))
    return link.delay_steps + extra


def drive_in_lockstep(
    fleet: Fleet, runtime: Runtime, link: LinkDraws, asked: Asked, tick: Callable[[], None]
) -> tuple[BenchOutcome, int]:
    """Drive a fleet without deadlines; return also the strides that its servers skipped."""
    servers = [
        Controller(fleet.bundle, runtime, NO_KEY, most_devices=asked.devices) for _ in range(2)
    ]
    outcome = bench.lockstep(
        *(fleet, servers[0], link, tick),
        silent=asked.silence(fleet.devices[0].period_s),
        restarted=servers[1] if asked.harm == "kill" else None,
    )
    return outcome, sum(one.counts["skipped_strides"] for one in servers)


def drive(fleet: Fleet, asked: Asked, tick: Callable[[], None]) -> tuple[BenchOutcome, int]:
    """Drive a fleet in real time with a server of its own; return also the strides it skipped."""
    model, backend, harm = fleet.bundle.directory, asked.backend, asked.harm
    with contextlib.ExitStack() as things:
        opened = things.enter_context(
            contextlib.closing(open_socket(("127.0.0.1", 0), "the bench's own socket"))
        )
        servers = [things.enter_context(serving(model, backend, "127.0.0.1:0"))]
        address = servers[0].address
        silent = asked.silence(fleet.devices[0].period_s)
        middle, again = silent.start, silent.stop

        def at_step(k: int) -> None:
            if harm == "kill" and k == middle:
                servers[0].process.kill()
            elif harm == "stop" and k == middle:
                servers[0].process.send_signal(signal.SIGSTOP)
            elif harm == "kill" and k == again:
                where = f"{address[0]}:{address[1]}"
                servers.append(things.enter_context(serving(model, backend, where, wait=False)))
            elif harm == "stop" and k == again:
                servers[0].process.send_signal(signal.SIGCONT)

        outcome = bench.real_time(fleet, opened, address, tick=tick, at_step=at_step)
        return outcome, servers[-1].skipped()


class Serving:
    """A server in a process of its own, and what it prints."""

    def __init__(self, process: "subprocess.Popen[bytes]", wait: bool) -> None:
        self.process = process
        self.address = ("", 0)
        self._last: dict[str, Any] = {}
        if wait:
            self.address = parse_address(self._first()["serving"], "serving")
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _first(self) -> dict[str, Any]:
        stdout = self.process.stdout
        assert stdout is not None
        if not select.select([stdout], [], [], STARTS_S)[0]:
            raise Unavailable("hjepa serve did not start")
        line = stdout.readline()
        found = json.loads(line) if line else {}
        if "serving" not in found:
            raise Unavailable(f"hjepa serve did not start: {found.get('error', found)}")
        return dict(found)

    def skipped(self) -> int:
        """End the server; return the strides that it skipped."""
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(timeout=STARTS_S)
        self._reader.join()
        return int(self._last.get("counts", {}).get("skipped_strides", 0))

    def _read(self) -> None:
        """Keep the newest snapshot; a pipe that nobody reads would stop the server."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(b'{"devices"'):
                self._last = json.loads(line)


@contextlib.contextmanager
def serving(model: Path, backend: str, bind: str, *, wait: bool = True) -> Iterator[Serving]:
    """Run ``hjepa serve`` until the end of the block."""
    command = [sys.executable, "-m", "hjepa_cli", "serve", "--model", str(model), "--bind", bind]
    process = subprocess.Popen(
        [*command, "--backend", backend, "--json", "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    try:
        yield Serving(process, wait)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


def show(screen: Screen, result: dict[str, Any]) -> None:
    """Print a comparison."""
    low, high = result["score_difference_ci95"]
    after_s = result.get("taken_up_after_s")
    screen.table(
        f"{result['n_devices']} devices, {result['n_steps']} steps, "
        + ("lockstep" if result["lockstep"] else f"{result['period_ms']:g} ms a step"),
        ["what", "value"],
        [
            ["score over the wire", f"{result['score_link']:.4f}"],
            ["score simulated", f"{result['score_simulated']:.4f}"],
            ["difference, paired", f"{result['score_difference']:+.4f} ({low:+.4f} … {high:+.4f})"],
            ["steps without a force", f"{100 * result['missing_share']:.3f} %"],
            ["answers after their step", f"{100 * result['late_answers_share']:.1f} %"],
            ["strides skipped", result["skipped_strides"]],
            *(
                [["all driven again after [s]", "never" if after_s is None else f"{after_s:.3f}"]]
                if "taken_up_after_s" in result
                else []
            ),
            ["devices that fell", f"{100 * result.get('fallen_share', float('nan')):.1f} %"],
            *(
                [f"angles apart by, first {k} steps [rad]", f"{apart:.1e}"]
                for k, apart in result.get("theta_difference_rad", {}).items()
            ),
        ],
    )
