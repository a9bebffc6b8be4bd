"""Every setting is declared once: its type, bounds, default, and the flag that overrides it.

The command line builds its flags and their help from these declarations, and
:mod:`hjepa_cli.config.settings` checks files and flags against them. Units are in the names. Values
that the paper gives are those of preset ``paper`` and ``--protocol paper``; where defaults differ,
docs/explanation/paper_map.md says why.
"""

import dataclasses
import functools
import sys
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from msgspec import Meta

LONGEST_GAP_STEPS = 1e8  # that somebody may state: with the widest band counts stay in range
LARGEST = sys.float_info.max  # bounds what is not bounded otherwise: no infinity, no NaN
LARGEST_SEED = 2**63 - 1
RECORDED = "recorded"  # the plant of imported datasets
CARRIER_GHZ = (0.5, 100.0)  # validity of TR 38.901, clause 7.4

MOST = 10**9  # of anything: beyond what any machine holds or any program counts
WIDEST = 2**16  # values of an embedding or a layer

Count = Annotated[int, Meta(ge=1, le=MOST)]
CountFromTwo = Annotated[int, Meta(ge=2, le=MOST)]  # nothing is learned without a next one
CountOrNone = Annotated[int, Meta(ge=0, le=MOST)]
Width = Annotated[int, Meta(ge=1, le=WIDEST)]
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
GreyLevels = Annotated[float, Meta(ge=0, le=255)]
BelowOne = Annotated[float, Meta(ge=0, lt=1)]
SidePx = Annotated[int, Meta(ge=16, le=1024)]  # of a picture
Sign = Annotated[float, Meta(ge=-1, le=1)]
Candidates = Annotated[int, Meta(ge=4, le=10_000)]  # of a round of CMA-ES
Delay = Annotated[int, Meta(ge=0, le=256)]  # a controller remembers what it sent in 512 steps


@dataclasses.dataclass(frozen=True)
class Flag:
    """The command line calls a value so.

    Attributes:
        name: ``"--steps"``, or ``"--gate/--no-gate"`` of a switch that has two.
        help: what it means, as a sentence; ``{choices}`` stands for the names that there are.
        metavar: placeholder of the value; empty: ``N`` of a count, the choices of a few words.
        unit: how much of the setting's unit one of the flag's is, as in ``--bandwidth-mhz``.
    """

    name: str
    help: str
    metavar: str = ""
    unit: float = 1.0


STRIDE_H = Flag("--h", "Stride of the high level in control steps, a multiple of m.")


@dataclasses.dataclass(frozen=True)
class CameraSettings:
    """Frames have this size in datasets and networks; a dataset brings its own along.

    Simulated cameras take 64 × 128 and are resized by area.
    """

    height_px: SidePx = 64
    width_px: SidePx = 128
    grey: bool = False

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Return (H, W, C), with one channel for grey and three for colours."""
        return self.height_px, self.width_px, 1 if self.grey else 3


@dataclasses.dataclass(frozen=True)
class SensorSettings:
    """What a simulated camera's lens and sensor do to its ideal pictures; nothing unless set.

    A dataset brings its own along, and so does a model; ``eval``, ``view`` and devices of the wire
    take any that is set here instead. Grey levels are of 255, pixels those of [camera].
    """

    white: Annotated[float, Meta(gt=0, le=255)] = 255.0  # grey level of a white background
    texture: GreyLevels = 0.0  # depth of stains on the background
    distortion: Annotated[float, Meta(ge=-0.3, le=0.5)] = 0.0  # of a lens, share at the corners
    vignette: Annotated[float, Meta(ge=0, le=1)] = 0.0  # fall of light to the corners, share
    exposure_ms: NotNegative = 0.0  # at most a control step
    bayer: bool = False  # one colour per pixel, the others are filled in
    shot_noise: Annotated[float, Meta(ge=0, le=128)] = 0.0  # standard deviation at 255
    read_noise: Annotated[float, Meta(ge=0, le=128)] = 0.0  # standard deviation
    ideal: bool = False  # none of these, whatever a model brings along

    @property
    def works(self) -> bool:
        """Return whether pictures are others than the ideal ones."""
        return not self.ideal and self != SensorSettings()


@dataclasses.dataclass(frozen=True)
class RecordedSettings:
    """A plant that only recordings are known of is what their dataset says of it.

    Actions are stored ÷ ``limits``; ``mirror`` has a factor for each, 1 or −1, where mirrored
    pictures show a plant that mirrored actions move alike, and is empty where they do not.
    """

    step_s: Positive = 0.02
    limits: tuple[Positive, ...] = (1.0,)
    states: tuple[str, ...] = ()
    mirror: tuple[Sign, ...] = ()


@dataclasses.dataclass(frozen=True)
class CollectSettings:
    """These settings say how ``collect`` makes the dataset."""

    trajectories: Annotated[
        Count,
        Flag(
            "--trajectories",
            "Training trajectories by the teacher, and as many by a tuned law.",
        ),
    ] = 200
    test_trajectories: Annotated[Count, Flag("--test-trajectories", "Held-out trajectories.")] = 40
    clean_trajectories: Count = 40
    steps: Annotated[CountFromTwo, Flag("--steps", "Control steps per trajectory.")] = 160
    clean_steps: Count = 120
    # Initial states are uniform in ± these; none: the next four, a cart-pole's.
    start: tuple[NotNegative, ...] = ()
    x_m: NotNegative = 0.1
    x_dot_m_s: NotNegative = 0.5
    theta_rad: NotNegative = 0.35
    theta_dot_rad_s: NotNegative = 5.0
    exploration_n: NotNegative = 4.0
    exploration_hold_steps: Count = 10
    belief_steps: Count = 128  # that a tuned law is left with a wrong belief, at most
    frames: Annotated[
        Literal["rendered", "stored"],
        Flag("--frames", "Render camera frames when they are read, or store them with the states."),
    ] = "rendered"

    @property
    def half_widths(self) -> tuple[float, ...]:
        """Return how far initial states lie from zero at most, one per state."""
        return self.start or (self.x_m, self.x_dot_m_s, self.theta_rad, self.theta_dot_rad_s)


Look = tuple[int, ...]
"""How many control steps back the frames lie that an encoder sees: the oldest first, 0 last."""
LOOK: dict[str, Any] = {"frames": 2, "frame_gap": 1, "frame_spacing": "even"}  # unless it is said
SPACINGS = {"even": 1, "square": 2}  # a power of the number of frames back


def look_of(architecture: Mapping[str, Any]) -> Look:
    """Return the look of an encoder, from what its architecture, or its settings, say of it."""
    frames, gap, spacing = (architecture.get(name, usual) for name, usual in LOOK.items())
    return tuple(gap * i ** SPACINGS[spacing] for i in reversed(range(frames)))


@dataclasses.dataclass(frozen=True)
class EncoderSettings:
    """``train-encoder`` trains the JEPA with its P^H, then the probe actor; or a baseline."""

    method: Annotated[
        Literal["jepa", "supervised", "autoencoder"],
        Flag(
            "--method",
            "What to train: the joint-embedding encoder, or a baseline that acts on raw frames.",
        ),
    ] = "jepa"
    frames: Annotated[  # κ
        Count,
        Flag("--frames", "Frames of the input: 2 or 4; 2 with --method autoencoder."),
    ] = 4
    frame_gap: Count = 1  # control steps between them
    embedding: Width = 256
    hidden: Width = 1024
    h: Annotated[Count, STRIDE_H] = 4
    frame_input: Literal["difference", "pair"] = "difference"
    # Each frame is fitted to its background: not, by a gain, or by gain and offset.
    photometric: Literal["none", "gain", "affine"] = "affine"
    stride_actions: Literal["all", "held"] = "all"
    residual: bool = True
    centre: bool = True
    steps: Annotated[Count, Flag("--steps", "Training steps of the encoder.")] = 1200
    batch_trajectories: Count = 10
    batch_frames: CountFromTwo = 25  # of a trajectory, h steps apart; rollouts end where they do
    rollout_steps: Count = 80
    optimizer: Literal["adamw", "sgd"] = "adamw"
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    learning_rate: NotNegative = 1e-3
    weight_decay: NotNegative = 1e-2
    gradient_clip: NotNegative = 1.0  # 0 does not clip, here and below
    ema_decay: BelowOne = 0.99
    inverse_dynamics: NotNegative = 1.0
    regulariser: Literal["none", "vicreg", "sigreg"] = "none"  # against collapse, for comparison
    regulariser_weight: NotNegative = 0.1
    # "exact": networks that commute with a mirror; "augment" flips at random.
    mirror: Literal["exact", "augment", "none"] = "exact"
    shift_px: CountOrNone = 8  # sideways; no further than every cart stays in the picture
    light_spread: BelowOne = 0.0  # training pictures: each trajectory in a light of 1 ± this
    camera_noise: GreyLevels = 0.0  # and with noise of up to this standard deviation, of 255
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    gate: Annotated[
        bool,
        Flag(
            "--gate/--no-gate",
            "Stop with exit code 70 when the health of the encoder misses a gate, or keep it.",
        ),
    ] = True
    gate_r2: tuple[Number, ...] = ()  # of every state; none: the next four, a cart-pole's
    gate_r2_x: Number = 0.95
    gate_r2_x_dot: Number = 0.90
    gate_r2_theta: Number = 0.80
    gate_r2_theta_dot: Number = 0.90
    gate_rank: Number = 4.0
    gate_sensitivity: Number = 0.1
    gate_actor_nrmse: Number = 0.35

    @property
    def least_r2(self) -> tuple[float, ...]:
        """Return the gates of the linear probes, one per state."""
        four = (self.gate_r2_x, self.gate_r2_x_dot, self.gate_r2_theta, self.gate_r2_theta_dot)
        return self.gate_r2 or four

    @property
    def look(self) -> Look:
        """Return how many control steps back the frames of the input lie, the oldest first."""
        return look_of(vars(self))


@dataclasses.dataclass(frozen=True)
class AugmentSettings:
    """Networks are trained on worse pictures, with the labels and targets of clean ones.

    Baselines on raw frames see them from the beginning; the encoder of a JEPA for some more steps,
    in which it learns to see what it has seen in clean ones. ``strength`` multiplies all from
    ``gain`` on, each the most that a training picture gets; 0 is off.

    From then on its frames lie i² · ``encoder.frame_gap`` steps back instead of i, where that is
    ``frames_within_s`` at most: a velocity of one step, and others that noise spares. Embeddings
    that are of such frames from the beginning are harder to predict (docs/LOG.md).

    The forces of ``force_steps`` that are planned from a worse picture are to be those of the clean
    one: their squared error counts ``force_weight`` times beside 1 − cos of the embeddings.
    """

    strength: NotNegative = 1.0
    steps: Count = 1500
    learning_rate: NotNegative = 7e-4
    frames_within_s: NotNegative = 0.01  # 0 leaves them where they are
    force_weight: NotNegative = 0.2  # 0 plans none
    force_steps: Count = 60
    clean: Annotated[float, Meta(ge=0, le=1)] = 0.3  # share of pictures that stay as they are
    share: Annotated[float, Meta(ge=0, le=1)] = 0.35  # of the others, for each effect by itself
    rotation_share: Annotated[float, Meta(ge=0, le=1)] = 0.85  # it is the hardest to see through
    gain: BelowOne = 0.35  # ± of 1
    gamma: NotNegative = 0.3  # exponents from 1/(1 + this) to 1 + this
    colour: BelowOne = 0.1  # ± of each channel
    gradient: BelowOne = 0.25  # fall of light from edge to edge, in any direction
    flicker: BelowOne = 0.02  # less light in a frame
    shot_noise: NotNegative = 4.0  # standard deviation at white, of 255
    read_noise: NotNegative = 14.0
    blur_px: NotNegative = 1.75  # standard deviation
    jitter_px: NotNegative = 0.12  # standard deviation, anew in every frame
    rotation_deg: NotNegative = 4.0
    shift_down_px: NotNegative = 5.0  # or up, of few pictures; 0 takes no draw
    rectangles: Count = 3  # at most
    rectangle_px: NotNegative = 16.0  # side, of any grey


@dataclasses.dataclass(frozen=True)
class ActorSettings:
    """Both training stages fit the semantic actor."""

    hidden: Width = 1024
    dropout: BelowOne = 0.2
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    learning_rate: NotNegative = 1e-3
    weight_decay: NotNegative = 1e-2
    gradient_clip: NotNegative = 1.0
    batch: Count = 200
    epochs: Count = 12


@dataclasses.dataclass(frozen=True)
class HierarchySettings:
    """``train-hierarchy`` trains P^H, P^M, P^L and ts-jepa-1 on frozen embeddings."""

    h: Annotated[Count, STRIDE_H] = 4
    m: Annotated[Count, Flag("--m", "Stride of the medium level, a multiple of l.")] = 2
    l: Annotated[Count, Flag("--l", "Stride of the low level.")] = 1
    # Of the pictures, sideways by up to encoder.shift_px, for actor and levels.
    shifted_copies: CountOrNone = 2
    rollout_steps: Count = 80  # longer ones predict worse in closed loops (docs/LOG.md)
    batch_trajectories: Count = 16
    coarse_starts: Count = 8
    flat_starts: Count = 2
    fine_trajectories: Count = 80
    optimizer: Literal["adamw", "sgd"] = "adamw"
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    gradient_clip: NotNegative = 1.0
    coarse_steps: Count = 1600
    coarse_learning_rate: NotNegative = 1e-3
    coarse_weight_decay: NotNegative = 1e-3
    flat_steps: Count = 1600
    medium_steps: Count = 1000
    medium_learning_rate: NotNegative = 1e-3
    medium_weight_decay: NotNegative = 2e-4
    low_steps: Count = 1000
    low_learning_rate: NotNegative = 1e-3
    low_weight_decay: NotNegative = 4e-4


@dataclasses.dataclass(frozen=True)
class ReflexSettings:
    """``train-reflex`` trains answers to a packet by its age, and searches for decaying holds."""

    forces_at_once: Count = 4  # of the chunk; as many as P^H plans
    steps: Count = 1600
    batch_packets: Count = 64  # as many as ts-jepa-1 has rollouts
    batch_ages: Count = 32  # of each packet
    learning_rate: NotNegative = 1e-3
    weight_decay: NotNegative = 1e-3
    gradient_clip: NotNegative = 1.0
    search_devices: Count = 32  # on the true state, of gains and decay together
    search_steps: Count = 1000
    search_candidates: Candidates = 48
    search_rounds: Count = 10
    fit_devices: Count = 24  # on embeddings, of a factor and the decay
    fit_candidates: Candidates = 12
    fit_rounds: Count = 3
    gap_steps: CountOrNone = 0  # decays are made for this gap; 0: for the longest one


@dataclasses.dataclass(frozen=True)
class FusionSettings:
    """``train-fusion`` learns what to make of packets that are not quite right.

    They are those of devices in the settings' [conditions], quantised as [protocol] says.
    """

    rounds: Count = 12  # of loops, then training on them
    devices: Count = 32  # in the conditions, and as many in none
    loop_steps: Count = 700
    steps: Count = 300  # of training in a round
    batch: Count = 256
    learning_rate: NotNegative = 1e-3
    weight_decay: NotNegative = 1e-2
    gradient_clip: NotNegative = 1.0


@dataclasses.dataclass(frozen=True)
class ProtocolSettings:
    """``eval`` and ``scale`` follow this closed-loop protocol."""

    warmup_steps: CountOrNone = 1000  # not scored: they remember the start
    steps: Count = 3000  # scored
    curve_devices: Count = 64
    bracket_devices: Count = 64
    start: tuple[NotNegative, ...] = ()  # as in [collect]
    x_m: NotNegative = 0.03
    x_dot_m_s: NotNegative = 0.1
    theta_rad: NotNegative = 0.08
    theta_dot_rad_s: NotNegative = 0.5
    # Standard deviation of every state and control step; none: the next two, a cart-pole's.
    noise: tuple[NotNegative, ...] = ()
    noise_x_dot_m_s: NotNegative = 0.002
    noise_theta_dot_rad_s: NotNegative = 0.03
    process_noise: Annotated[
        Literal["velocity", "isotropic"],
        Flag("--process-noise", "Noise on the two velocities, or on all four states (the paper)."),
    ] = "velocity"
    plant_spread: Annotated[
        BelowOne,
        Flag(
            "--plant-spread",
            "Relative spread of the masses between devices; 0: all are equal.",
            "FRACTION",
        ),
    ] = 0.0
    delay_steps: Annotated[
        Delay, Flag("--delay-steps", "Steps from a packet's capture to the force that answers it.")
    ] = 0
    jitter_steps: Annotated[
        Delay, Flag("--jitter-steps", "Up to so many steps more, anew for every packet.")
    ] = 0
    downlink_loss: Annotated[
        BelowOne,
        Flag("--downlink-loss", "Share of datagrams with forces that are lost.", "FRACTION"),
    ] = 0.0
    false_alarm: Annotated[
        BelowOne,
        Flag(
            "--false-alarm",
            "Flag packets that look like nothing in training, and go on predicting; so many "
            "familiar ones may be flagged too. 0: look at none.",
            "FRACTION",
        ),
    ] = 0.0
    flagged_in_row: Count = 3  # as many are kept back; the next one counts, whatever it is
    payload: Annotated[
        str,
        Flag(
            "--payload",
            "How an embedding is sent: float32, float16, int2 to int16, or pca-NxB for N principal "
            "components of B bits.",
            "NAME",
        ),
    ] = "int8"
    gaps: tuple[Count, ...] = (1, 20, 40, 80, 120, 160, 240, 320)
    acceptable_score: Positive = 0.62
    acceptable_lq_ratio: NotNegative = 0.5
    bracket: Annotated[float, Meta(gt=0, lt=1)] = 0.03  # around D* at last; around p* twice that
    horizon: Count = 100
    bootstrap: Count = 1000

    @property
    def half_widths(self) -> tuple[float, ...]:
        """Return how far initial states lie from zero at most, one per state."""
        return self.start or (self.x_m, self.x_dot_m_s, self.theta_rad, self.theta_dot_rad_s)

    @property
    def total_steps(self) -> int:
        """Return the steps of a simulation: the warm-up, then those that are scored."""
        return self.warmup_steps + self.steps

    @property
    def ideal_link(self) -> bool:
        """Return whether packets come at once and every force arrives, as in the paper."""
        return not any(getattr(self, key) for key in IDEAL_LINK)

    @property
    def velocity_noise(self) -> tuple[float, ...]:
        """Return the standard deviation of what disturbs a step, one per state."""
        return self.noise or (0.0, self.noise_x_dot_m_s, 0.0, self.noise_theta_dot_rad_s)


IDEAL_LINK = ("delay_steps", "jitter_steps", "downlink_loss")  # all 0 in the paper

# Where these are so, nothing is stored of them: all else says the same as before there were such
# settings, and so do digests.
UNSAID: dict[str, Any] = {
    **dict.fromkeys((f"protocol.{key}" for key in IDEAL_LINK), 0),
    "protocol.false_alarm": 0.0,
    "protocol.flagged_in_row": 3,
    "encoder.photometric": "none",
    "encoder.frame_gap": 1,
    "augment.frames_within_s": 0.0,
    "augment.force_weight": 0.0,
    "augment.force_steps": 60,
    "augment.shift_down_px": 0.0,
    "augment.rotation_share": 0.25,
    "augment.rectangles": 1,
    "conditions.stress": "",
}
# Some of it, and two sections of which nothing is stored either, are on by default, or tuned.
TURNED_OFF: dict[str, Any] = {
    "encoder.photometric": "none",
    "augment.strength": 0.0,
    "control.gains_n": [],
    "control.ceiling_gains_n": [],
}
OFF = UNSAID | TURNED_OFF

# What --protocol paper sets over these: scored from the start on.
PAPER_PROTOCOL = {"warmup_steps": 0, "steps": 1000, "bracket_devices": 256}


@dataclasses.dataclass(frozen=True)
class ControlSettings:
    """``collect`` and all after it: the law that models learn and that their rivals play.

    Without gains it is the plant's own teacher. The law is u = −K x; K is given row by row, one
    row per force. ``hjepa tune-law`` finds both.
    """

    gains_n: tuple[Number, ...] = ()  # N per unit of state
    ceiling_gains_n: tuple[Number, ...] = ()  # of method ceiling, which no actor has to learn


@dataclasses.dataclass(frozen=True)
class TuneSettings:
    """``tune-law`` searches both laws on the true state."""

    devices: Count = 24
    steps: Count = 2000  # scored, after the protocol's warm-up
    candidates: Candidates = 12
    rounds: Count = 24
    # Standard deviation of what a packet tells, ÷ that of states under the teacher.
    packet_error: NotNegative = 0.05
    # What an actor has to learn is charged: so much score for root mean square forces at the limit.
    force_price: NotNegative = 0.4


@dataclasses.dataclass(frozen=True)
class ConditionSettings:
    """Devices of ``eval`` and ``scale`` may differ so from those that models were trained on.

    Beside ``protocol.plant_spread``; controllers do not know.
    """

    light: Annotated[float, Meta(gt=0, le=255)] = 1.0  # factor on what the camera sees
    camera_noise: GreyLevels = 0.0  # standard deviation in every pixel, of 255
    pole_length: Annotated[float, Meta(ge=0.01, le=100)] = 1.0  # ÷ the nominal one
    stress: Annotated[
        str,
        Flag(
            "--condition",
            "Conditions of devices and pictures that no model was trained for, as "
            "light=0.7+noise=8; ? is answered with all names.",
            "NAME=VALUE+…",
        ),
    ] = ""


@dataclasses.dataclass(frozen=True)
class RadioSettings:
    """``scale`` counts devices in this radio cell."""

    law: Annotated[
        str,
        Flag(
            "--law",
            "How devices share the band: by turns at controlled power, all at once in equal parts, "
            "or as a scheduler decides.",
        ),
    ] = "duty"
    phy: Annotated[
        str,
        Flag(
            "--phy",
            "What a slot carries: Shannon's capacity, or a 5G NR uplink with what it costs "
            "(extra nr).",
        ),
    ] = "shannon"
    snr_db: Annotated[
        str,
        Flag(
            "--snr",
            "Signal-to-noise ratios in dB, both ends included; step 5 unless given (10:30 is "
            "10, 15, 20, 25, 30), or a comma list.",
            "START:STOP[:STEP]",
        ),
    ] = "10:30"
    bandwidth_hz: Annotated[  # at most: beyond any radio band; keeps device counts in range
        float,
        Meta(gt=0, le=1e11),
        Flag("--bandwidth-mhz", "Bandwidth of the cell.", "MHZ", unit=1e6),
    ] = 20e6
    noise: Annotated[
        Literal["fixed", "scaled"],
        Flag(
            "--noise",
            "Noise power fixed (the paper), or scaled with each device's bandwidth (law equal).",
        ),
    ] = "fixed"
    # The rest is for the law "scheduled".
    schedulers: Annotated[
        tuple[str, ...],
        Flag(
            "--scheduler", "Schedulers of the law scheduled, separated by commas: {choices}.", "A,B"
        ),
    ] = ("round-robin", "max-aoi", "innovation")
    uncertainty: Annotated[
        Literal["age", "levels"],
        Flag(
            "--uncertainty",
            "Law scheduled: of a prediction by its age, or also by how far a hierarchy's levels "
            "disagree; for the schedulers whittle and innovation.",
        ),
    ] = "age"
    seeds: Annotated[
        Count, Flag("--seeds", "Law scheduled: seeds to average over, counted up from --seed.")
    ] = 1
    power_margin_db: Annotated[
        NotNegative,
        Flag(
            "--power-margin-db",
            "Law scheduled: deepest fade that power control makes up for.",
            "DB",
        ),
    ] = 10.0
    fading: Annotated[
        Literal["block", "jakes", "tdl-a", "tdl-b", "tdl-c", "tdl-d", "tdl-e"],
        Flag(
            "--fading",
            "A new fade every so many slots, or one with a Doppler: flat, or a tapped delay line "
            "of TR 38.901 (extra nr).",
        ),
    ] = "block"
    speed_m_s: Annotated[
        Positive, Flag("--speed-m-s", "Speed of a device, of fading with a Doppler.", "M/S")
    ] = 1.0
    delay_spread_s: Annotated[float, Meta(gt=0, le=1e-5)] = 50e-9  # rms, of a tapped delay line
    coherence_slots: Annotated[
        float,
        Meta(ge=1, le=LARGEST),
        Flag(
            "--coherence-slots",
            "Law scheduled: mean number of slots that a fade lasts; 1: independent.",
            "SLOTS",
        ),
    ] = 1.0
    overhead_bits: CountOrNone = 0  # CRC and header of a packet
    # 0: capacity; else the normal approximation at this error rate.
    block_error: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    # Copies of a sample that may be combined; 1: always send the newest.
    harq_rounds: Annotated[int, Meta(ge=1, le=16)] = 1
    topology: Annotated[  # "hall": margins from geometry instead of power_margin_db
        Literal["target", "hall"],
        Flag(
            "--topology",
            "Law scheduled: one power margin for all, or devices dropped into a factory hall.",
        ),
    ] = "target"
    scenario: Literal["InF-LOS", "InF-SL", "InF-DL", "InF-SH", "InF-DH"] = "InF-SH"
    # Carrier, power and noise figure: TS-JEPA's, its -95 dBm over 20 MHz.
    carrier_ghz: Annotated[float, Meta(ge=CARRIER_GHZ[0], le=CARRIER_GHZ[1])] = 3.75
    power_dbm: Number = 23.0
    noise_figure_db: NotNegative = 6.0

    @property
    def load_depends_on_snr(self) -> bool:
        """Return whether it does under law scheduled: by margins in a hall, or by block errors."""
        by_errors = self.phy != "shannon" or (self.harq_rounds > 1 and self.block_error > 0)
        return self.topology == "hall" or by_errors


@dataclasses.dataclass(frozen=True)
class NrSettings:
    """The uplink of ``--phy nr`` is configured so: one layer of PUSCH, DFT-s-OFDM, FR1."""

    spacing_khz: Annotated[
        int,
        Meta(ge=15, le=60),
        Flag("--scs", "PHY nr: subcarrier spacing in kHz: 15, 30, 60.", "KHZ"),
    ] = 30
    duplex: Annotated[
        str,
        Flag(
            "--duplex",
            "PHY nr: FDD, or a TDD pattern of slots D, S and U like DDDSU.",
            "FDD|PATTERN",
        ),
    ] = "FDD"
    pusch_symbols: Annotated[
        int,
        Meta(ge=4, le=14),
        Flag("--pusch-symbols", "PHY nr: symbols of a packet's PUSCH (mapping type B)."),
    ] = 14
    dmrs_additional: Annotated[int, Meta(ge=0, le=3)] = 1  # positions besides the first symbol
    mcs_table: Annotated[
        int,
        Meta(ge=1, le=2),
        Flag("--mcs-table", "PHY nr: table 6.1.4.1-1 or -2 (low rates) of TS 38.214."),
    ] = 1
    mcs: Annotated[
        int,
        Meta(ge=-1, le=27),
        Flag("--mcs", "PHY nr: this MCS whatever the SNR; -1 adapts it to the link."),
    ] = -1
    bler_target: Annotated[
        float,
        Meta(ge=1e-5, le=0.5),
        Flag("--bler-target", "PHY nr: block error rate that link adaptation may come to.", "P"),
    ] = 0.1
    # "outer": the mean error rate meets the target although the channel knowledge has aged.
    link_adaptation: Annotated[
        Literal["inner", "outer"],
        Flag(
            "--link-adaptation",
            "PHY nr: by the SNR that was reported, or corrected by what really gets lost.",
        ),
    ] = "inner"
    cqi_age_slots: Annotated[
        float,
        Meta(ge=0, le=1e4),
        Flag(
            "--cqi-age-slots",
            "PHY nr: age of the channel knowledge, in slots of the carrier; needs a Doppler.",
            "SLOTS",
        ),
    ] = 0.0
    # Copies of a transport block that are combined; 1: a lost packet is replaced by the newest.
    harq_rounds: Annotated[
        int,
        Meta(ge=1, le=16),
        Flag("--harq-rounds", "PHY nr: transmissions of a block that are combined; 1: none."),
    ] = 1
    harq_rtt_slots: Annotated[int, Meta(ge=1, le=32)] = 4  # from one of them to the next
    grants: Annotated[
        Literal["configured", "dynamic"],
        Flag(
            "--grants",
            "PHY nr: grants configured in advance where devices take turns, or each signalled.",
        ),
    ] = "configured"
    grants_per_slot: Annotated[
        Count, Flag("--grants-per-slot", "PHY nr: dynamic grants that a slot can signal.")
    ] = 16
    reports: Annotated[
        Literal["sr", "pucch", "grant", "free"],
        Flag(
            "--reports",
            "PHY nr: what innovation reports go by: scheduling requests, 2 bits of PUCCH, small "
            "configured grants that devices contend for, or free of cost.",
        ),
    ] = "sr"
    header_bits: CountOrNone = 40  # MAC subheader 16, RLC UM 8, PDCP 16


@dataclasses.dataclass(frozen=True)
class SurvivalSettings:
    """``survive`` silences loops so, and asks so much of links."""

    intervals_steps: Annotated[
        tuple[Count, ...],
        Flag("--intervals", "Control steps between packets in time, separated by commas.", "N,N"),
    ] = (10, 40)
    loops: Annotated[Count, Flag("--loops", "Loops through each silence.")] = 256
    splitting_paths: Annotated[
        CountOrNone,
        Flag("--splitting", "Paths for losses of 1 in 10,000; 0: a bound from what was counted."),
    ] = 128
    loss: Annotated[
        float,
        Meta(gt=0, lt=0.5),
        Flag(
            "--loss", "Share of transfers that a link loses, to tell how long control lasts.", "P"
        ),
    ] = 1e-3
    burst_transfers: Annotated[
        float,
        Meta(ge=1, le=1e4),
        Flag(
            "--burst-transfers",
            "Mean transfers in a run of losses, where they come in bursts.",
            "N",
        ),
    ] = 4.0
    mean_time_h: Annotated[
        Positive,
        Flag("--mean-time-hours", "Mean time between losses of control to be reached.", "HOURS"),
    ] = 8760.0


@dataclasses.dataclass(frozen=True)
class Settings:
    """All of these define a run, besides the paths it reads and writes."""

    preset: str = "default"
    plant: Annotated[str, Flag("--plant", "What to control.")] = "desktop"
    seed: Annotated[
        int, Meta(ge=0, le=LARGEST_SEED), Flag("--seed", "Seed of everything random.")
    ] = 0
    device: Annotated[
        Literal["auto", "cpu", "cuda"], Flag("--device", "Where to compute; auto: cuda if there.")
    ] = "auto"
    methods: Annotated[
        tuple[str, ...],
        Flag("--methods", "Methods to compare, separated by commas: {choices}.", "A,B,C"),
    ] = (
        *("hjepa", "ts-jepa-1", "ts-jepa-4", "chunk", "hold-decay-linear"),
        *("hold", "optimal", "oracle"),
    )
    stress: Annotated[
        tuple[str, ...],
        Flag(
            "--stress",
            "Measure, instead of curves, how scores hold under conditions: audit (a fixed set), "
            "all, or names with or without a value, separated by commas, several joined by +: "
            "light,noise=8,light=0.7+noise=8; ? is answered with all names.",
            "A,B|audit|all",
        ),
    ] = ()
    control: ControlSettings = ControlSettings()
    tune: TuneSettings = TuneSettings()
    fusion: FusionSettings = FusionSettings()
    camera: CameraSettings = CameraSettings()
    sensor: SensorSettings = SensorSettings()
    recorded: RecordedSettings = RecordedSettings()
    collect: CollectSettings = CollectSettings()
    encoder: EncoderSettings = EncoderSettings()
    augment: AugmentSettings = AugmentSettings()
    actor: ActorSettings = ActorSettings()
    hierarchy: HierarchySettings = HierarchySettings()
    reflex: ReflexSettings = ReflexSettings()
    protocol: ProtocolSettings = ProtocolSettings()
    conditions: ConditionSettings = ConditionSettings()
    radio: RadioSettings = RadioSettings()
    nr: NrSettings = NrSettings()
    survival: SurvivalSettings = SurvivalSettings()

    def as_dict(self, *, complete: bool = False) -> dict[str, Any]:
        """Return nested plain data, ready for JSON (tuples become lists).

        Empty lists are left out, what only recorded plants have, and unless it shall be
        ``complete`` what is off and the usual camera: they stand for values that say the same, and
        digests of settings stay what they were before there were such settings.
        """
        values = _without_empty(plain(dataclasses.asdict(self)))
        if complete:  # also that there is no law: else that is what the plant's tuned one is
            values["control"] = plain(dataclasses.asdict(self.control))
        usual = {
            "augment": not self.augment.strength,
            "camera": self.camera == CameraSettings(),
            "sensor": self.sensor == SensorSettings(),
        }
        left_out = [name for name, is_so in usual.items() if is_so and not complete]
        for key, value in UNSAID.items():
            section, _, name = key.partition(".")
            if values[section][name] == value and not complete:
                del values[section][name]
        if not values["control"]:
            left_out.append("control")
        if self.plant != RECORDED:
            left_out.append("recorded")
        for name in left_out:
            del values[name]
        return values


@functools.cache
def declared() -> dict[str, Any]:
    """Return the annotated type of every setting by its dotted key."""
    found: dict[str, Any] = {}
    for name, kind in typing.get_type_hints(Settings, include_extras=True).items():
        if dataclasses.is_dataclass(kind):
            fields = typing.get_type_hints(kind, include_extras=True)
            found |= {f"{name}.{field}": hint for field, hint in fields.items()}
        else:
            found[name] = kind
    return found


def flag_of(hint: Any) -> Flag | None:
    """Return the flag in an annotated type, if it has one."""
    return next((one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Flag)), None)


def choices_of(hint: Any) -> tuple[str, ...]:
    """Return the words that a type allows; none of them of one that allows others."""
    plain = bare(hint)
    return typing.get_args(plain) if typing.get_origin(plain) is Literal else ()


def bare(hint: Any) -> Any:
    """Return a type without what is annotated to it."""
    return hint.__origin__ if hasattr(hint, "__metadata__") else hint


def must_be(hint: Any, unit: float = 1.0) -> str:
    """Say what values a type allows, in a flag's unit: ``"a whole number of at least 1"``."""
    plain = bare(hint)
    if choices := choices_of(hint):
        return f"one of {', '.join(choices)}"
    if typing.get_origin(plain) is tuple:
        return "a list"
    if plain not in (int, float):
        return {bool: "true or false", str: "text"}[plain]
    noun = "a whole number" if plain is int else "a finite number"
    bounds = {
        side: f"{value / unit:g}" if plain is float else str(value)
        for meta in hint.__metadata__
        if isinstance(meta, Meta)
        for side in ("ge", "gt", "le", "lt")
        if (value := getattr(meta, side)) is not None and abs(value) != LARGEST
    }
    if "ge" in bounds and "le" in bounds:
        return f"{noun} from {bounds['ge']} to {bounds['le']}"
    words = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
    parts = " and ".join(f"{words[side]} {value}" for side, value in bounds.items())
    return f"{noun} of {parts}" if parts else noun


def dotted(values: Mapping[str, Any], separator: str = ".") -> dict[str, Any]:
    """Return nested values by the path to them: ``{"a": {"b": 1}}`` → ``{"a.b": 1}``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            below = dotted(value, separator)
            flat |= {f"{key}{separator}{name}": entry for name, entry in below.items()}
        else:
            flat[key] = value
    return flat


def unsaid(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a record of settings leaves out because it is off, by dotted key."""
    said = dotted(recorded)
    return {key: value for key, value in OFF.items() if key not in said}


def spelled_out(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with what was turned off, as a file must say it that defaults lie below."""
    values = {key: dict(of) if isinstance(of, Mapping) else of for key, of in recorded.items()}
    missing = unsaid(recorded)
    for key, off in TURNED_OFF.items():
        if key in missing:
            section, _, name = key.partition(".")
            values.setdefault(section, {})[name] = off
    return values


def left_unsaid(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record that :func:`spelled_out` was given."""
    record = dict(values)
    for key, off in TURNED_OFF.items():
        section, _, name = key.partition(".")
        if isinstance(of := record.get(section), Mapping) and of.get(name) == off:
            record[section] = {other: of[other] for other in of if other != name}
            if not record[section]:
                del record[section]
    return record


def plain(value: Any) -> Any:
    """Return nested values with lists for tuples, and Python's numbers for those of numpy."""
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [plain(entry) for entry in value] if isinstance(value, tuple | list) else value


def _without_empty(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_empty(entry) if isinstance(entry, dict) else entry
        for key, entry in values.items()
        if entry != []
    }
