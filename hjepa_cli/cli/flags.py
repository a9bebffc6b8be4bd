"""These are flags and arguments of the command line, as Typer takes them.

Those that override a setting follow from its declaration in :mod:`hjepa_cli.config.schema`; all
others are declared here. A flag that is not given is ``None`` and changes nothing.
"""

import contextlib
import dataclasses
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import typer
from msgspec import Meta

from hjepa_cli.cli import completion
from hjepa_cli.config.schema import (
    LARGEST,
    LONGEST_GAP_STEPS,
    Count,
    CountFromTwo,
    CountOrNone,
    Number,
    Positive,
    bare,
    choices_of,
    declared,
    flag_of,
    must_be,
)
from hjepa_cli.config.settings import PRESETS, PROTOCOLS
from hjepa_cli.errors import MissingInputError
from hjepa_cli.plugins import LAWS, METHODS, PHYS, PLANTS, SCHEDULERS

DATA, MODEL, LOOP, RADIO = "Data", "Model", "Closed loop", "Radio cell"
WIRE, UPLINK, DOWNLINK = "Wire", "Uplink", "Downlink"
SETTINGS, FILES, FIGURES, SCREEN = "Settings", "Files", "Figures", "Screen"
PANELS = {  # of help, by section
    "collect": DATA, "encoder": MODEL, "hierarchy": MODEL, "protocol": LOOP, "conditions": LOOP,
    "radio": RADIO, "nr": RADIO, "survival": LOOP,
    "": SETTINGS,
}  # fmt: skip

# Names that plugins may add to, looked up where help or the shell shows them.
NAMES: Mapping[str, Iterable[str]] = {
    "plant": PLANTS,
    "methods": METHODS,
    "radio.schedulers": SCHEDULERS,
    "radio.law": LAWS,
    "radio.phy": PHYS,
}


@dataclasses.dataclass(frozen=True)
class Input:
    """Describes a flag or an argument of a command.

    Attributes:
        kind: its type, with bounds; a list of one may be repeated.
        name, help, metavar, unit: as of a setting's flag; one without a name is an argument.
        default: what it is when it is not given.
        shown: the default in help where that is not ``default`` itself.
        complete: what the shell offers.
        parse: reads it, where its type alone would not do.
        panel: where help lists it.
    """

    kind: Any
    name: str
    help: str
    metavar: str = ""
    unit: float = 1.0
    default: Any = None
    shown: str = ""
    complete: Callable[..., list[str]] | None = None
    parse: Callable[[str], Any] | None = None
    panel: str = ""


def written_path(text: str | Path) -> Path:
    """Parse a path to write to; an empty one, of an unset variable, would be this directory."""
    if not str(text).strip():
        raise typer.BadParameter("an empty path; leave the flag out, or name a place")
    return Path(text)


def _read_path(text: str | Path) -> Path:
    if not str(text).strip() or not Path(text).exists():
        raise MissingInputError(f"'{text}' does not exist")
    return Path(text)


def _switch(name: str, text: str) -> Input:
    return Input(bool, name, text, default=False)


def _output(text: str, metavar: str, default: Path | None = None, name: str = "--out") -> Input:
    return Input(Path, name, text, metavar, default=default, parse=written_path)


def _model(name: str, text: str) -> Input:
    return Input(str, name, text, "NAME|PATH", complete=completion.models)


def _argument(
    kind: Any, text: str, metavar: str, complete: Any = None, default: Any = None
) -> Input:
    return Input(kind, "", text, metavar, default=default, complete=complete)


def _paths(text: str, metavar: str, complete: Any) -> Input:
    return _argument(list[Path], text, metavar, complete, [])


# By the name of the argument that a stage takes; what follows a colon tells apart those of
# commands that call different things alike.
_FILES = {
    "out": _output(
        "Directory to write to (new, empty, or an earlier run to take up). "
        "Without it: the next free number below runs/ (collect: data/).",
        "DIR",
    ),
    "out:file": _output("File to write; one that is there is replaced.", "FILE"),
    "out:report": _output(
        "HTML file to write; one that is there is replaced.", "FILE", Path("report.html")
    ),
    "out:animation": _output(
        "File to write, .gif or .mp4; one that is there is replaced.",
        "FILE",
        Path("hjepa-view.gif"),
    ),
    "figures": _output("Also write every figure into this directory.", "DIR", name="--figures"),
    "figures:compare": _output(
        "Draw the paper's Fig. 3 into this directory.", "DIR", name="--figures"
    ),
    "formats": Input(
        tuple[Literal["pdf", "svg", "png"], ...],
        "--format",
        "Format of the figure files: pdf, svg, png, or several separated by commas.",
        "A,B",
        default="pdf",
    ),
    "dataset": Input(
        Path,
        "--dataset",
        "Dataset to read. Without it: the newest in data/.",
        "DIR",
        complete=completion.datasets,
    ),
    "dataset:clean": Input(
        Path,
        "--dataset",
        "Dataset whose clean rollouts to predict. Without it: simulated again from the seed.",
        "DIR",
        complete=completion.datasets,
    ),
    "encoder": _model(
        "--encoder",
        "Encoder to build on: a zoo name or a path. Without it: the newest run's, else the zoo's.",
    ),
    "checkpoint": _model(
        "--checkpoint",
        "Model to use: a zoo name or a path. Without it: the newest run's, else the zoo's.",
    ),
}
_FIGURES = {
    "film": Input(Path, "--film", "Film to show on the page: a GIF of hjepa view.", "FILE"),
    "title": Input(str, "--title", "Title above the figures; an empty one leaves it out.", "TEXT"),
    "labels": Input(
        tuple[str, ...],
        "--labels",
        "What lines are called, as hjepa=H-JEPA, separated by commas. Without it: by their names.",
        "NAME=TEXT,…",
    ),
    "log": Input(
        bool,
        "--log/--linear",
        "Scale of the axis that may span decades: devices, errors, gaps. Without it: errors are "
        "logarithmic.",
    ),
}
_ARGUMENTS = {
    "directory": _argument(Path, "The run's directory.", "RUN", completion.resumable, default=...),
    "name_or_path": _argument(
        str, "A zoo name or a path.", "NAME|PATH", completion.models, default=...
    ),
    "names": _argument(list[str], "Zoo names or paths.", "[NAME|PATH]...", completion.models, []),
    "path": _argument(
        Path, "Dataset to look at. Without it: the newest in data/.", "[DIR]", completion.datasets
    ),
    "paths:datasets": _paths(
        "Datasets to check. Without one: all in data/.", "[DIR]...", completion.datasets
    ),
    "paths:runs": _paths(
        "Run directories, or directories that hold some. Without one: the newest run of each "
        "stage.",
        "[RUN]...",
        completion.runs,
    ),
    "paths:evaluations": _paths(
        "Runs of eval, or directories that hold some. Without one: all in runs/eval.",
        "[RUN]...",
        completion.runs,
    ),
    "key": _argument(
        str,
        "Only this section or value, as protocol or protocol.steps.",
        "[KEY]",
        completion.settings,
        "",
    ),
}
_DATA = {
    "split": Input(
        Literal["train", "test", "clean"], "--split", "Which trajectories.", default="train"
    ),
    "rows": Input(Count, "--rows", "Trajectories shown, one per row.", default=6),
    "columns": Input(Count, "--columns", "Frames per trajectory.", default=8),
    "kind": Input(
        Literal["hdf5", "npz"],
        "--format",
        "hdf5: the layout of stable-worldmodel (needs h5py); npz: the same columns for numpy. "
        "Without it: by the suffix of --out.",
    ),
    "pixels": Input(
        bool,
        "--pixels/--no-pixels",
        "With the camera frames (rendered now unless they are stored), or states only.",
        default=True,
    ),
}
_IMPORT = {
    "source": _argument(
        Path,
        "What was recorded: a folder of pictures with a CSV, a film with a CSV beside it (or a "
        "folder of those), NPZ, HDF5, a LeRobotDataset, or a dataset of Minari.",
        "SOURCE",
        default=...,
    ),
    "test": Input(
        Path, "--test", "Recording for the split test. Without it: episodes held out.", "SOURCE"
    ),
    "clean": Input(
        Path,
        "--clean",
        "Recording of the expert alone, to compare forces with. Without it: the split test.",
        "SOURCE",
    ),
    "kind:import": Input(
        Literal["folder", "video", "npz", "hdf5", "lerobot", "minari"],
        "--format",
        "Its format. Without it: by what lies there.",
    ),
    "size": Input(
        tuple[int, int],
        "--size",
        "Height and width of the frames in the dataset, resized by area.",
        "H W",
        default=(64, 128),
    ),
    "grey": _switch("--grey", "Keep one channel: grey."),
    "limit": Input(
        tuple[Positive, ...],
        "--limit",
        "Limit of the actions, or of each of them separated by commas: they are stored divided by "
        "it. Without it: what the source says.",
        "L,…",
    ),
    "fps:import": Input(
        Positive, "--fps", "Pictures per second. Without it: what the source says.", "RATE"
    ),
    "action_offset": Input(
        Annotated[int, Meta(ge=-1000, le=1000)],
        "--action-offset",
        "Action row j + N leads from picture j to picture j + 1.",
        default=0,
    ),
    "steps:import": Input(
        CountFromTwo,
        "--steps",
        "Steps of the trajectories that episodes are cut into. Without it: as many as the shortest "
        "episode has.",
    ),
    "held_out": Input(
        Annotated[float, Meta(gt=0, lt=1)],
        "--held-out",
        "Share of the episodes for the split test; of a single one its end.",
        "SHARE",
        default=0.2,
    ),
    "mirror_signs": Input(
        tuple[Number, ...],
        "--mirror-signs",
        "What mirrored pictures do to each action, 1 or -1 separated by commas, where that is true "
        "of the plant; networks then obey it.",
        "S,…",
    ),
    "actions": Input(
        tuple[str, ...], "--actions", "Columns of actions. Without it: those called action….", "A,B"
    ),
    "states": Input(
        tuple[str, ...], "--states", "Columns of states. Without it: those called state….", "A,B"
    ),
    "expert": Input(
        tuple[str, ...],
        "--expert",
        "Columns of what an expert would do. Without it: those called expert…, else the actions.",
        "A,B",
    ),
    "camera": Input(str, "--camera", "Which camera of a LeRobotDataset.", "NAME"),
    "skip_bad": _switch("--skip-bad", "Leave unsound episodes out, and list them."),
}
_LOOP = {
    "protocol": Input(
        str,
        "--protocol",
        "Score steady state, after a warm-up, or from the start on, as for the paper's Fig. 3 "
        "and 4.",
        "|".join(PROTOCOLS),
        shown=PROTOCOLS[0],
        complete=lambda: list(PROTOCOLS),
    ),
    "remeasure": _switch("--remeasure", "Measure the closed-loop curves again, cached or not."),
    "figure": _switch(
        "--figure",
        "Draw the paper's Fig. 3: error, bits and score of all its methods, or of --methods.",
    ),
    "verify": _switch(
        "--verify",
        "Simulate again at 0.9 and 1.1 of each tolerance or load: is the limit in between?",
    ),
    "methods:compare": Input(
        tuple[str, ...],
        "--methods",
        "Only these, separated by commas: the first against the others. Without it: all found.",
        "A,B,C",
        complete=completion.several(lambda: METHODS),
    ),
    "methods:view": Input(
        tuple[str, ...],
        "--methods",
        "Methods on embeddings, one row each, separated by commas.",
        "A,B,C",
        default="hjepa,hold",
        complete=completion.several(lambda: METHODS),
    ),
    "devices": Input(Count, "--devices", "Devices side by side.", default=3),
    "every": Input(
        Count,
        "--every",
        "Control steps between pictures. Without it: a hundred pictures in all.",
        "STEPS",
    ),
    "fps": Input(
        Count,
        "--fps",
        "Pictures per second; at most 50 in a GIF, which shows each for whole 10 ms.",
        default=20,
    ),
    "live": _switch("--live", "Play in this terminal; write nothing."),
}
_RADIO = {
    "tolerance_steps": Input(
        Annotated[float, Meta(ge=1, le=LONGEST_GAP_STEPS)],
        "--tolerance-steps",
        "Count devices whose packets may come so many control steps apart, and measure nothing: "
        "where no closed loop exists.",
        "STEPS",
    ),
    "snr_db": Input(
        Annotated[float, Meta(ge=-100, le=100)],
        "--snr",
        "Mean signal-to-noise ratio in dB.",
        "DB",
        default=20.0,
    ),
    "delivery": Input(
        Annotated[float, Meta(ge=1e-6, le=1 - 1e-6)],
        "--delivery",
        "Share of packets that arrive over the fading link.",
        "P",
        shown="0.05",
    ),
    "gap_steps": Input(
        Annotated[float, Meta(ge=1, le=LARGEST)],
        "--gap-steps",
        "Instead of fading: a packet every so many steps.",
        "STEPS",
    ),
}
_Milliseconds = Annotated[float, Meta(ge=0, le=1e6)]
_Seconds = Annotated[float, Meta(gt=0, le=1e9)]
_Share = Annotated[float, Meta(ge=0, lt=1)]


def _address(name: str, text: str, default: Any = None) -> Input:
    return Input(str, name, text, "HOST:PORT", default=default)


_WIRE = {
    "name_or_path:export": _argument(
        str, "Model to export: a zoo name or a path.", "[MODEL]", completion.models
    ),
    "to": _output("Directory to write the exported model to.", "DIR", name="--to"),
    "check": _output("Compare what is in this directory with torch again.", "DIR", name="--check"),
    "method": Input(
        str, "--method", "What plans the strides. Without it: the model's first method.", "NAME"
    ),
    "model": Input(
        Path, "--model", "Exported model, of hjepa export MODEL --to DIR.", "DIR", default=...
    ),
    "backend": Input(
        Literal["onnxruntime", "openvino"],
        "--backend",
        "What computes the networks; openvino is fast in batches (extra openvino).",
        default="onnxruntime",
    ),
    "precision": Input(Literal["fp32", "int8"], "--precision", "Of the encoder.", default="fp32"),
    "bind": _address("--bind", "Address to serve on; port 0 takes any.", "127.0.0.1:4747"),
    "server": _address("--server", "Address of hjepa serve, or of a relay.", "127.0.0.1:4747"),
    "key:wire": Input(
        Path,
        "--key",
        "File with the key that server and devices share; serve makes it where there is none. "
        "Needed but on loopback.",
        "FILE",
    ),
    "metrics": _address("--metrics", "Also answer Prometheus here, under /metrics."),
    "websocket": _address("--websocket", "Also serve slow clients here, in openpi's wire format."),
    "max_devices": Input(Count, "--max-devices", "Devices at a time.", default=1024),
    "timeout_s": Input(
        _Seconds, "--timeout", "A device silent for so long is forgotten.", "SECONDS", default=10.0
    ),
    "for_s": Input(
        _Seconds, "--for", "End after so long. Without it: when interrupted.", "SECONDS"
    ),
    "number": Input(
        Annotated[int, Meta(ge=0, le=2**32 - 1)],
        "--number",
        "The device's own number; without it a random one.",
    ),
    "camera:wire": Input(
        str,
        "--camera",
        "sim, a camera's number, a directory of pictures, or a video file.",
        "NAME",
        default="sim",
    ),
    "crop": Input(
        str, "--crop", "Part of the camera's picture that the model sees, in pixels.", "X,Y,W,H"
    ),
    "actuator": Input(
        str, "--actuator", "sim, none, or serial:PORT. Without it: sim where the camera is.", "NAME"
    ),
    "period_ms": Input(
        Annotated[float, Meta(ge=0.1, le=1e5)],
        "--period-ms",
        "Wall time of a control step. Without it: the plant's own.",
        "MS",
    ),
    "gap_steps:wire": Input(
        Count, "--gap-steps", "Send an embedding every so many control steps.", "STEPS", default=80
    ),
    "innovation": Input(
        Annotated[float, Meta(gt=0, le=1)],
        "--innovation",
        "Instead of --gap-steps: send when the controller's force is wrong by this share of its "
        "range.",
        "SHARE",
    ),
    "longest_steps": Input(
        Count, "--longest", "With --innovation: send at least so often.", "STEPS", default=320
    ),
    "watchdog_ms": Input(
        Annotated[float, Meta(ge=0, le=80)],
        "--watchdog-ms",
        "Silence after which the actor on the device drives, in the plant's time; at most 80.",
        "MS",
        default=40.0,
    ),
    "local": Input(
        bool,
        "--local/--no-local",
        "When the controller is silent the actor on the device drives, or it stops at 0 N.",
        default=True,
    ),
    "stop_after_s": Input(
        _Seconds, "--stop-after", "End when the controller has been silent for so long.", "SECONDS"
    ),
    "steps:wire": Input(Count, "--steps", "Control steps. Without it: until interrupted."),
    "listen": _address("--listen", "Address for devices; port 0 takes any.", "127.0.0.1:4748"),
    "to:link": _address("--to", "Address of the server.", "127.0.0.1:4747"),
    "seed:link": Input(CountOrNone, "--seed", "Seed of what happens to datagrams.", default=0),
    "lockstep": _switch(
        "--lockstep", "No deadlines: compare with the simulator step by step, in one process."
    ),
    "devices:bench": Input(Count, "--devices", "Devices at a time.", default=64),
    "steps:bench": Input(Annotated[int, Meta(ge=20)], "--steps", "Control steps.", default=1000),
    "delivery:bench": Input(
        Annotated[float, Meta(gt=0, le=1)],
        "--delivery",
        "Instead of --gap-steps: share of packets that arrive, one being sent in every step.",
        "P",
    ),
    "trace": Input(
        Path,
        "--trace",
        "Losses of a recorded link, and delays, for both; a line per datagram: MS or lost.",
        "FILE",
    ),
    "checkpoint:bench": _model(
        "--checkpoint", "The model that was exported. Without it: the zoo's of the same digest."
    ),
    "harm": Input(
        Literal["kill", "stop"],
        "--harm",
        "In the middle kill the server and start it again after 500 ms, or stop it for 2 s.",
    ),
}
_LINKS = {
    f"{way}_{name}": Input(
        *(kind, f"--{way}link-{name.replace('_', '-')}", text, metavar),
        default=default,
        panel=panel,
    )
    for way, panel in (("up", UPLINK), ("down", DOWNLINK))
    for name, kind, text, metavar, default in (
        ("loss", _Share, "Share of datagrams that are lost.", "SHARE", 0.0),
        (
            *("burst", Annotated[float, Meta(ge=1, le=1e6)]),
            *("Mean length of a burst of losses; 1: independent.", "DATAGRAMS", 1.0),
        ),
        ("delay_ms", _Milliseconds, "What every datagram takes.", "MS", 0.0),
        ("jitter_ms", _Milliseconds, "Up to so much more.", "MS", 0.0),
        ("reorder", _Share, "Share that overtakes the others.", "SHARE", 0.0),
        ("duplicate", _Share, "Share that comes twice.", "SHARE", 0.0),
        (
            *("rate_kbps", Annotated[float, Meta(ge=0, le=1e9)]),
            *("What passes in a second; 0: all.", "KBPS", 0.0),
        ),
        ("trace", Path, "A recorded link; a line per datagram: MS or lost.", "FILE", None),
    )
}
_SETTINGS = {
    "preset": Input(
        str,
        "--preset",
        f"Named set of values to start from: {', '.join(PRESETS)}.",
        "NAME",
        shown="default",
        complete=lambda: list(PRESETS),
    ),
    "config": Input(
        Path,
        "--config",
        "TOML file whose values override the preset's (flags override both).",
        "FILE.toml",
    ),
    "as_toml": _switch("--toml", "As TOML that --config accepts, without origins."),
    "workers": Input(
        CountOrNone,
        "--workers",
        "Processes to work in; 0: this one alone. Without it: as many cores as are worth it. "
        "Results are the same.",
    ),
    "cluster": Input(
        str,
        "--cluster",
        "Work on a Dask cluster: the scheduler's address, its JSON file, or local to start one.",
        "ADDRESS|FILE|local",
    ),
    "plugin": Input(
        list[Path],
        "--plugin",
        "Python file that adds plants, codecs, schedulers, methods, laws, physical layers or "
        "stages; may be repeated.",
        "FILE.py",
        default=[],
    ),
}
_SCREEN = {
    "json": _switch("--json", "One JSON document on stdout, everything else on stderr."),
    "quiet": _switch("--quiet", "Results and errors only."),
    "dry_run": _switch("--dry-run", "Show what would be read, done and written; write nothing."),
    "debug": _switch("--debug", "Show the traceback of an error (also: HJEPA_DEBUG=1)."),
}
INPUTS = {
    name: dataclasses.replace(one, panel=one.panel or panel)
    for panel, listed in (
        *((FILES, _FILES), (FIGURES, _FIGURES), ("", _ARGUMENTS), (DATA, _DATA)),
        *((DATA, _IMPORT), (LOOP, _LOOP), (RADIO, _RADIO), (WIRE, _WIRE), (WIRE, _LINKS)),
        *((SETTINGS, _SETTINGS), (SCREEN, _SCREEN)),
    )
    for name, one in listed.items()
}


def taken(name: str) -> Input:
    """Return what a command takes by the dotted key of a setting, or by a name of INPUTS."""
    if name in INPUTS:
        return INPUTS[name]
    hint = declared()[name]
    flag = flag_of(hint)
    assert flag is not None, f"{name} has no flag"
    offered: Callable[..., list[str]] | None = None
    if name in NAMES:
        listed = typing.get_origin(bare(hint)) is tuple
        named = lambda: list(NAMES[name])  # noqa: E731
        offered = completion.several(named) if listed else named
    elif name == "protocol.payload":
        offered = completion.payloads
    panel = LOOP if name in ("methods", "stress") else PANELS[name.rpartition(".")[0]]
    return Input(hint, **vars(flag), complete=offered, panel=panel)


def stage_input(word: str, default: Any) -> Input:
    """Return the flag of an input of a plugin's stage: a switch, or a path that is there."""
    flag, text = f"--{word.replace('_', '-')}", word.replace("_", " ").capitalize()
    if default is False:
        one = _switch(flag, f"{text}.")
    else:
        one = Input(Path, flag, f"{text} to read.", "PATH", default=default, parse=_read_path)
    return dataclasses.replace(one, panel=FILES)


def annotation(one: Input) -> Any:
    """Return the annotated type by which Typer knows an input."""
    plain = bare(one.kind)
    words = choices_of(one.kind)
    if plain == tuple[int, int]:  # two words of the command line
        return Annotated[
            plain,
            typer.Option(one.name, help=one.help, metavar=one.metavar, rich_help_panel=one.panel),
        ]
    how: dict[str, Any] = {
        "help": one.help,
        "metavar": one.metavar or "|".join(words) or ("N" if plain is int else None),
        "show_default": one.shown or one.default not in (None, False, "", [], ...),
        "autocompletion": one.complete or ((lambda: list(words)) if words else None),
        "parser": one.parse or parser(one.kind, one.unit),
    }
    kind = plain if plain in (bool, Path, list[str], list[Path]) else str
    if one.default is None:
        kind = kind | None
    if not one.name:
        return Annotated[kind, typer.Argument(**how)]
    return Annotated[kind, typer.Option(one.name, rich_help_panel=one.panel, **how)]


def parser(kind: Any, unit: float = 1.0) -> Callable[[Any], Any] | None:
    """Return what reads a value of an annotated type from the command line, where that is needed.

    Numbers are read in ``unit`` and returned in the setting's, names between commas as a list.
    """
    plain = bare(kind)
    if typing.get_origin(plain) is tuple:
        item = typing.get_args(plain)[0]
        read, needed = parser(item) or str, [""] if choices_of(item) else []
        return lambda text: [read(name) for name in split_names(text) or needed]
    if plain not in (int, float) and not choices_of(kind):
        return None

    def parse(text: Any) -> Any:
        try:
            value = float(text) * unit if plain is float else int(text) if plain is int else text
            return msgspec.convert(value, kind)
        except (ValueError, OverflowError, msgspec.ValidationError):
            wrong = f"'{text}' is not {must_be(kind, unit)}"
            if unit != 1.0 and _fits(text, kind):  # in the setting's own unit, not in the flag's
                wrong += f"; did you mean {float(text) / unit:g}?"
            raise typer.BadParameter(wrong) from None

    return parse


def _fits(text: Any, kind: Any) -> bool:
    with contextlib.suppress(ValueError, OverflowError, msgspec.ValidationError):
        msgspec.convert(float(text), kind)
        return True
    return False


def split_names(text: str) -> list[str]:
    """Return ``["a", "b"]`` of ``"a, b"``, each name once."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
