"""The flags of the command line, one type each, so that a flag means the same everywhere.

A flag that overrides a setting defaults to ``None``: not given. Its default is in the preset.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from hjepa_cli.cli import completion
from hjepa_cli.config.checks import LARGEST_BANDWIDTH_HZ, METHODS, SCHEDULERS
from hjepa_cli.config.settings import PRESETS, PROTOCOLS
from hjepa_cli.plugins import PLANTS

FILES, DATA, MODEL, LOOP, RADIO = "Files", "Data", "Model", "Closed loop", "Radio cell"
SETTINGS, SCREEN = "Settings", "Screen"


def whole_number(minimum: int) -> Callable[[str], int]:
    """Return a parser of whole numbers of at least ``minimum``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise typer.BadParameter(f"'{text}' is not a whole number of at least {minimum}")
        return value

    return parse


def number(minimum: float, maximum: float = math.inf) -> Callable[[str], float]:
    """Return a parser of finite numbers of at least ``minimum``; NaN is refused."""
    most = f" and at most {maximum:g}" if maximum < math.inf else ""
    expected = f"of at least {minimum:g}{most}"
    return _finite(expected, lambda value: minimum <= value <= maximum)


def positive_number(maximum: float) -> Callable[[str], float]:
    """Return a parser of numbers of more than 0 and at most ``maximum``."""
    expected = f"of more than 0 and at most {maximum:g}"
    return _finite(expected, lambda value: 0 < value <= maximum)


def number_below_one() -> Callable[[str], float]:
    """Return a parser of numbers of at least 0 and less than 1."""
    return _finite("of at least 0 and less than 1", lambda value: 0 <= value < 1)


def _finite(expected: str, accepts: Callable[[float], bool]) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and accepts(value)):
            raise typer.BadParameter(f"'{text}' is not a finite number {expected}")
        return value

    return parse


def written_path(text: str | Path) -> Path:
    """Parse a path to write to; an empty one, of an unset variable, would be this directory."""
    if not str(text).strip():
        raise typer.BadParameter("an empty path; leave the flag out, or name a place")
    return Path(text)


def one_of(*choices: str) -> Callable[[str], str]:
    """Return a parser that takes one of a few words."""

    def parse(text: str) -> str:
        if text not in choices:
            raise typer.BadParameter(f"'{text}' is not one of {', '.join(choices)}")
        return text

    return parse


def some_of(*choices: str) -> Callable[[str], str]:
    """Return a parser that takes some of a few words, separated by commas."""

    def parse(text: str) -> str:
        for name in split_names(text) or [""]:
            one_of(*choices)(name)
        return text

    return parse


def split_names(text: str | None) -> list[str] | None:
    """``"a, b"`` → ``["a", "b"]``, each once."""
    if text is None:
        return None
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _setting(panel: str, flag: str, help_text: str, metavar: str, **more: Any) -> Any:
    """A flag that overrides one value of the preset."""
    return typer.Option(
        flag,
        help=help_text,
        metavar=metavar,
        rich_help_panel=panel,
        show_default="from the preset",
        **more,
    )


def _count(panel: str, flag: str, help_text: str, minimum: int = 1) -> Any:
    return _setting(panel, flag, help_text, "N", parser=whole_number(minimum))


def _one_of(panel: str, flag: str, help_text: str, *choices: str) -> Any:
    """A flag with few values; settings.py refuses others, this offers and completes them."""
    return _setting(panel, flag, help_text, "|".join(choices), autocompletion=lambda: list(choices))


def _plain(panel: str, flag: str, help_text: str, **more: Any) -> Any:
    """A flag that is no setting."""
    return typer.Option(flag, help=help_text, rich_help_panel=panel, show_default=False, **more)


# --- files

Out = Annotated[
    Path | None,
    _plain(
        FILES,
        "--out",
        "Directory to write to (new, empty, or an earlier run to take up). "
        "Without it: the next free number below runs/ (collect: data/).",
        metavar="DIR",
        parser=written_path,
    ),
]
Dataset = Annotated[
    Path | None,
    _plain(FILES, "--dataset", "Dataset to read. Without it: the newest in data/.", metavar="DIR"),
]
CleanDataset = Annotated[
    Path | None,
    _plain(
        FILES,
        "--dataset",
        "Dataset whose clean rollouts to predict. Without it: simulated again from the seed.",
        metavar="DIR",
    ),
]
Encoder = Annotated[
    str | None,
    _plain(
        FILES,
        "--encoder",
        "Encoder to build on: a zoo name or a path. Without it: the newest run's, else the zoo's.",
        metavar="NAME|PATH",
        autocompletion=completion.models,
    ),
]
Checkpoint = Annotated[
    str | None,
    _plain(
        FILES,
        "--checkpoint",
        "Model to use: a zoo name or a path. Without it: the newest run's, else the zoo's.",
        metavar="NAME|PATH",
        autocompletion=completion.models,
    ),
]

RunDirectory = Annotated[
    Path, typer.Argument(help="The run's directory.", metavar="RUN", show_default=False)
]
ModelName = Annotated[
    str,
    typer.Argument(
        help="A zoo name or a path.",
        metavar="NAME|PATH",
        show_default=False,
        autocompletion=completion.models,
    ),
]
ModelNames = Annotated[
    list[str] | None,
    typer.Argument(
        help="Zoo names or paths.",
        metavar="[NAME|PATH]...",
        show_default=False,
        autocompletion=completion.models,
    ),
]
DatasetPath = Annotated[
    Path | None,
    typer.Argument(
        help="Dataset to look at. Without it: the newest in data/.",
        metavar="[DIR]",
        show_default=False,
        autocompletion=completion.datasets,
    ),
]
DatasetPaths = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Datasets to check. Without one: all in data/.",
        metavar="[DIR]...",
        show_default=False,
        autocompletion=completion.datasets,
    ),
]

# --- data

TrajectoryCount = Annotated[int | None, _count(DATA, "--trajectories", "Training trajectories.")]
TestTrajectoryCount = Annotated[
    int | None, _count(DATA, "--test-trajectories", "Held-out trajectories.")
]
TrajectorySteps = Annotated[
    int | None, _count(DATA, "--steps", "Control steps per trajectory.", minimum=2)
]
Frames = Annotated[
    str | None,
    _one_of(
        DATA,
        "--frames",
        "Render camera frames when they are read, or store them with the states.",
        "rendered",
        "stored",
    ),
]

Split = Annotated[
    str,
    typer.Option(
        "--split",
        help="Which trajectories.",
        metavar="train|test|clean",
        parser=one_of("train", "test", "clean"),
        rich_help_panel=DATA,
        autocompletion=lambda: ["train", "test", "clean"],
    ),
]
SheetRows = Annotated[
    int,
    typer.Option(
        "--rows",
        help="Trajectories shown, one per row.",
        metavar="N",
        parser=whole_number(1),
        rich_help_panel=DATA,
    ),
]
SheetColumns = Annotated[
    int,
    typer.Option(
        "--columns",
        help="Frames per trajectory.",
        metavar="N",
        parser=whole_number(1),
        rich_help_panel=DATA,
    ),
]
ExportFormat = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="hdf5: the layout of stable-worldmodel (needs h5py); npz: the same columns for numpy. "
        "Without it: by the suffix of --out.",
        metavar="hdf5|npz",
        parser=one_of("hdf5", "npz"),
        rich_help_panel=DATA,
        show_default=False,
        autocompletion=lambda: ["hdf5", "npz"],
    ),
]
Pixels = Annotated[
    bool,
    typer.Option(
        "--pixels/--no-pixels",
        help="With the camera frames (rendered now unless they are stored), or states only.",
        rich_help_panel=DATA,
    ),
]
FileOut = Annotated[
    Path | None,
    _plain(
        FILES,
        "--out",
        "File to write; one that is there is replaced.",
        metavar="FILE",
        parser=written_path,
    ),
]

# --- model

EncoderMethod = Annotated[
    str | None,
    _one_of(
        MODEL,
        "--method",
        "What to train: the joint-embedding encoder, or a baseline that acts on raw frames.",
        "jepa",
        "supervised",
        "autoencoder",
    ),
]
InputFrames = Annotated[
    int | None,
    _count(MODEL, "--frames", "Consecutive frames of the input: 2, or 4 with --method supervised."),
]
TrainingSteps = Annotated[int | None, _count(MODEL, "--steps", "Training steps of the encoder.")]
StrideH = Annotated[
    int | None, _count(MODEL, "--h", "Stride of the high level in control steps, a multiple of m.")
]
StrideM = Annotated[
    int | None, _count(MODEL, "--m", "Stride of the medium level, a multiple of l.")
]
StrideL = Annotated[int | None, _count(MODEL, "--l", "Stride of the low level.")]
Gate = Annotated[
    bool | None,
    typer.Option(
        "--gate/--no-gate",
        help="Stop with exit code 70 when the health of the encoder misses a gate, or keep it.",
        rich_help_panel=MODEL,
        show_default="from the preset",
    ),
]

# --- closed loop

Methods = Annotated[
    str | None,
    _setting(
        LOOP,
        "--methods",
        f"Methods to compare, separated by commas: {', '.join(METHODS)}.",
        "A,B,C",
    ),
]
ProcessNoise = Annotated[
    str | None,
    _one_of(
        LOOP,
        "--process-noise",
        "Noise on the two velocities, or on all four states (the paper).",
        "velocity",
        "isotropic",
    ),
]
Protocol = Annotated[
    str | None,
    typer.Option(
        "--protocol",
        help="Score steady state, after a warm-up, or as the paper does from the start on, for "
        "its Fig. 3 and 4.",
        metavar="|".join(PROTOCOLS),
        rich_help_panel=LOOP,
        show_default=PROTOCOLS[0],
        autocompletion=lambda: list(PROTOCOLS),
    ),
]
PlantSpread = Annotated[
    float | None,
    _setting(
        LOOP,
        "--plant-spread",
        "Relative spread of the masses between devices; 0: all are equal.",
        "FRACTION",
        parser=number_below_one(),
    ),
]
Payload = Annotated[
    str | None,
    _setting(
        LOOP,
        "--payload",
        "How an embedding is sent: float32, float16, int2 to int16, or pca-NxB for N principal "
        "components of B bits.",
        "NAME",
    ),
]
Remeasure = Annotated[
    bool, _plain(LOOP, "--remeasure", "Measure the closed-loop curves again, cached or not.")
]
Figure = Annotated[
    bool,
    _plain(
        LOOP,
        "--figure",
        "Draw the paper's Fig. 3: error, bits and score of all its methods, or of --methods.",
    ),
]
Verify = Annotated[
    bool,
    _plain(
        LOOP,
        "--verify",
        "Simulate again at 0.9 and 1.1 of each tolerance or load: is the limit in between?",
    ),
]

# --- radio cell

Snr = Annotated[
    str | None,
    _setting(
        RADIO,
        "--snr",
        "Signal-to-noise ratios in dB, both ends included; step 5 unless given (10:30 is "
        "10, 15, 20, 25, 30), or a comma list.",
        "START:STOP[:STEP]",
    ),
]
Law = Annotated[
    str | None,
    _one_of(
        RADIO,
        "--law",
        "How devices share the band: by turns at controlled power, all at once in equal parts, or "
        "as a scheduler decides.",
        "duty",
        "equal",
        "scheduled",
    ),
]
BandwidthMhz = Annotated[
    float | None,
    _setting(
        RADIO,
        "--bandwidth-mhz",
        "Bandwidth of the cell.",
        "MHZ",
        parser=positive_number(LARGEST_BANDWIDTH_HZ / 1e6),
    ),
]
Noise = Annotated[
    str | None,
    _one_of(
        RADIO,
        "--noise",
        "Noise power fixed (the paper), or scaled with each device's bandwidth (law equal).",
        "fixed",
        "scaled",
    ),
]

Schedulers = Annotated[
    str | None,
    _setting(
        RADIO,
        "--scheduler",
        f"Schedulers of the law scheduled, separated by commas: {', '.join(SCHEDULERS)}.",
        "A,B",
    ),
]
Uncertainty = Annotated[
    str | None,
    _one_of(
        RADIO,
        "--uncertainty",
        "Law scheduled: of a prediction by its age, or also by how far a hierarchy's levels "
        "disagree; for the schedulers whittle and innovation.",
        "age",
        "levels",
    ),
]
Topology = Annotated[
    str | None,
    _one_of(
        RADIO,
        "--topology",
        "Law scheduled: one power margin for all, or devices dropped into a factory hall.",
        "target",
        "hall",
    ),
]
PowerMarginDb = Annotated[
    float | None,
    _setting(
        RADIO,
        "--power-margin-db",
        "Law scheduled: deepest fade that power control makes up for.",
        "DB",
        parser=number(0.0),
    ),
]
CoherenceSlots = Annotated[
    float | None,
    _setting(
        RADIO,
        "--coherence-slots",
        "Law scheduled: mean number of slots that a fade lasts; 1: independent.",
        "SLOTS",
        parser=number(1.0),
    ),
]
Seeds = Annotated[
    int | None,
    _count(RADIO, "--seeds", "Law scheduled: seeds to average over, counted up from --seed."),
]

# --- report

RunPaths = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Run directories, or directories that hold some. Without one: the newest run of "
        "each stage.",
        metavar="[RUN]...",
        show_default=False,
        autocompletion=completion.runs,
    ),
]
EvaluationPaths = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Runs of eval, or directories that hold some. Without one: all in runs/eval.",
        metavar="[RUN]...",
        show_default=False,
        autocompletion=completion.runs,
    ),
]
ComparedMethods = Annotated[
    str | None,
    _plain(
        LOOP,
        "--methods",
        "Only these, separated by commas: the first against the others. Without it: all found.",
        metavar="A,B,C",
    ),
]
ComparisonDirectory = Annotated[
    Path | None,
    _plain(
        FILES,
        "--figures",
        "Draw the paper's Fig. 3 into this directory.",
        metavar="DIR",
        parser=written_path,
    ),
]
ReportOut = Annotated[
    Path,
    typer.Option(
        "--out",
        help="HTML file to write; one that is there is replaced.",
        metavar="FILE",
        parser=written_path,
        rich_help_panel=FILES,
    ),
]
FigureDirectory = Annotated[
    Path | None,
    _plain(
        FILES,
        "--figures",
        "Also write every figure into this directory.",
        metavar="DIR",
        parser=written_path,
    ),
]
FigureFormats = Annotated[
    str,
    typer.Option(
        "--format",
        help="Format of the figure files: pdf, svg, png, or several separated by commas.",
        metavar="A,B",
        parser=some_of("pdf", "svg", "png"),
        rich_help_panel=FILES,
    ),
]

# --- view

ViewMethods = Annotated[
    str,
    typer.Option(
        "--methods",
        help="Methods on embeddings, one row each, separated by commas.",
        metavar="A,B,C",
        rich_help_panel=LOOP,
    ),
]
ViewDevices = Annotated[
    int,
    typer.Option(
        "--devices",
        help="Devices side by side.",
        metavar="N",
        parser=whole_number(1),
        rich_help_panel=LOOP,
    ),
]
ViewSnr = Annotated[
    float,
    typer.Option(
        "--snr",
        help="Mean signal-to-noise ratio in dB.",
        metavar="DB",
        parser=number(-100.0, 100.0),
        rich_help_panel=RADIO,
    ),
]
Delivery = Annotated[
    float | None,
    typer.Option(
        "--delivery",
        help="Share of packets that arrive over the fading link.",
        metavar="P",
        parser=number(1e-6, 1 - 1e-6),
        rich_help_panel=RADIO,
        show_default="0.05",
    ),
]
Gap = Annotated[
    float | None,
    _plain(
        RADIO,
        "--gap",
        "Instead of fading: a packet every so many steps.",
        metavar="STEPS",
        parser=number(1.0),
    ),
]
Every = Annotated[
    int | None,
    _plain(
        LOOP,
        "--every",
        "Control steps between pictures. Without it: a hundred pictures in all.",
        metavar="STEPS",
        parser=whole_number(1),
    ),
]
Fps = Annotated[
    int,
    typer.Option(
        "--fps",
        help="Pictures per second; at most 50 in a GIF, which shows each for whole 10 ms.",
        metavar="N",
        parser=whole_number(1),
        rich_help_panel=LOOP,
    ),
]
AnimationOut = Annotated[
    Path,
    typer.Option(
        "--out",
        help="File to write, .gif or .mp4; one that is there is replaced.",
        metavar="FILE",
        parser=written_path,
        rich_help_panel=FILES,
    ),
]
Live = Annotated[bool, _plain(LOOP, "--live", "Play in this terminal; write nothing.")]

# --- settings

Preset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help=f"Named set of values to start from: {', '.join(PRESETS)}.",
        metavar="NAME",
        rich_help_panel=SETTINGS,
        show_default="default",
        autocompletion=lambda: list(PRESETS),
    ),
]
Config = Annotated[
    Path | None,
    _plain(
        SETTINGS,
        "--config",
        "TOML file whose values override the preset's (flags override both).",
        metavar="FILE.toml",
    ),
]
PlantName = Annotated[
    str | None,
    _one_of(SETTINGS, "--plant", "What to control.", *PLANTS),
]
Seed = Annotated[int | None, _count(SETTINGS, "--seed", "Seed of everything random.", minimum=0)]
SettingPrefix = Annotated[
    str,
    typer.Argument(
        help="Only this section or value, as protocol or protocol.steps.",
        metavar="[KEY]",
        show_default=False,
        autocompletion=completion.settings,
    ),
]
Toml = Annotated[
    bool, _plain(SETTINGS, "--toml", "As TOML that --config accepts, without origins.")
]
Device = Annotated[
    str | None,
    _one_of(SETTINGS, "--device", "Where to compute; auto: cuda if there.", "auto", "cpu", "cuda"),
]

Workers = Annotated[
    int | None,
    _plain(
        SETTINGS,
        "--workers",
        "Processes to work in; 0: this one alone. Without it: as many cores as are worth it. "
        "Results are the same.",
        metavar="N",
        parser=whole_number(0),
    ),
]
Cluster = Annotated[
    str | None,
    _plain(
        SETTINGS,
        "--cluster",
        "Work on a Dask cluster: the scheduler's address, its JSON file, or local to start one.",
        metavar="ADDRESS|FILE|local",
    ),
]

# --- screen

Json = Annotated[
    bool,
    _plain(SCREEN, "--json", "One JSON document on stdout, everything else on stderr."),
]
Quiet = Annotated[bool, _plain(SCREEN, "--quiet", "Results and errors only.")]
DryRun = Annotated[
    bool,
    _plain(SCREEN, "--dry-run", "Show what would be read, done and written; write nothing."),
]
Debug = Annotated[
    bool,
    _plain(SCREEN, "--debug", "Show the traceback of an error (also: HJEPA_DEBUG=1)."),
]
