"""A trained model: all networks that drive devices in one object, as a checkpoint holds them."""

import copy
import functools
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast, compute_dtype, resolve_device
from hjepa_cli.config.checks import ANCHORS, REFLEXES
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.decoder import Decoder
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.hierarchy import Strides, build_predictors, hold, plan_stride
from hjepa_cli.core.networks.planning import Planner, Reaction
from hjepa_cli.core.networks.read_frames import read_frames
from hjepa_cli.core.networks.reflex import Decay, Reflex, read_decays
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import same_camera
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.storage.checkpoints import Checkpoint, check_tensors, load_checkpoint

ENCODE_BATCH = 64  # larger ones fall out of the caches
CHOICES = {  # of an architecture; its other values are sizes
    "kind": ("encoder", "hierarchy", "flat", "supervised", "autoencoder", "reflex"),
    "frame_input": ("difference", "pair"),
    "frames": (2, 4),
    "stride_actions": ("all", "held"),
    "centre": (True, False),
    "residual": (True, False),
    "mirror": ("exact", "augment", "none"),
}
PRECISIONS = ("auto", "bf16", "fp32")
LEVELS = {  # of each kind that has some, in the order of the checkpoint
    "encoder": ("high",),
    "hierarchy": ("high", "medium", "low", "flat"),
    "flat": ("high", "flat"),
}


def build_modules(
    architecture: Mapping[str, Any],
    action_shape: tuple[int, ...] = (),
    force_signs: tuple[float, ...] = (-1.0,),
) -> nn.ModuleDict:
    """Instantiate the networks that ``architecture`` (checkpoint metadata) describes, untrained.

    ``action_shape`` and ``force_signs`` are the plant's. By ``kind``:

    - ``encoder``: Ψ and its companion P^H;
    - ``hierarchy``: Ψ, all levels, the flat baseline and the actor;
    - ``flat``: Ψ, a predictor of stride h, the one of stride 1 and the actor;
    - ``supervised``: Ψ, of κ frames, and the actor;
    - ``autoencoder``: Ψ, the decoder, a second Ψ that reads what was decoded, and the actor;
    - ``reflex``: Ψ, the actor, one of a law that fades, and the reflexes without and with forces.
    """
    kind, embedding = architecture["kind"], architecture["embedding"]
    symmetric = architecture["mirror"] == "exact"
    mirror = force_signs if symmetric else None
    frames = architecture.get("frames", 2)

    def encoder() -> Encoder:
        frame_input, centre = architecture["frame_input"], architecture["centre"]
        return Encoder(embedding, frame_input, centre, symmetric, frames)

    modules = nn.ModuleDict({"encoder": encoder()})
    if kind in LEVELS:
        predictors = build_predictors(
            Strides(architecture["h"], architecture["m"], architecture["l"]),
            embedding,
            architecture["hidden"],
            all_actions=architecture["stride_actions"] == "all",
            residual=architecture["residual"],
            forces=math.prod(action_shape),
            mirror=mirror,
        )
        modules.update({name: predictors[name] for name in levels_of(architecture)})
    if kind == "autoencoder":
        modules["decoder"] = Decoder(embedding, frames, symmetric)
        modules["reader"] = encoder()
    if kind != "encoder":
        hidden, dropout = architecture["actor_hidden"], architecture["actor_dropout"]
        modules["actor"] = Actor(embedding, hidden, dropout, action_shape, mirror)
    if kind == "reflex":
        modules["law"] = Actor(embedding, hidden, dropout, action_shape, mirror)
        for name, forces_at_once in (
            ("chunk", architecture["forces_at_once"]),
            # What follows a force that is not the teacher's depends on the next one: one at a time.
            ("chunk_forces", 1),
        ):
            modules[name] = Reflex(
                embedding,
                hidden,
                longest_age=architecture["longest_age"],
                forces_at_once=forces_at_once,
                sees_forces=name == "chunk_forces",
                action_shape=action_shape,
                mirror=mirror,
            )
    return modules


def levels_of(architecture: Mapping[str, Any]) -> tuple[str, ...]:
    """The predictors of an architecture; a flat one of stride 1 has one for both its levels."""
    levels = LEVELS[architecture["kind"]]
    return levels[1:] if (architecture["kind"], architecture["h"]) == ("flat", 1) else levels


def offered(architecture: Mapping[str, Any], states: int = 4) -> tuple[str, ...]:
    """The methods that a model of this architecture can drive a plant of S states with."""
    kind, h = architecture["kind"], architecture.get("h")
    if kind == "encoder":
        return ()
    if kind == "reflex":
        return REFLEXES
    if kind not in LEVELS:
        return (f"{kind}-{architecture['frames']}",)
    planned = dict.fromkeys((f"ts-jepa-{h}", "ts-jepa-1"))  # once where h is 1
    anchors = [name for name in ANCHORS if name != "state-48" or states == 4]
    return (*(("hjepa",) if kind == "hierarchy" else ()), *planned, "hold", "zero", *anchors)


def load_modules(checkpoint: Checkpoint) -> nn.ModuleDict:
    """Rebuild the networks of a checkpoint, with strict names, shapes and dtypes.

    Nothing is allocated before the tensors in the file are known to be those of the architecture.

    Raises:
        DataError: there is no such architecture, the tensors do not fit it, or the camera has
            changed since.
    """
    metadata = check_metadata(checkpoint)
    architecture, kind = metadata["architecture"], plant(metadata["plant"])
    if "camera" in metadata and not same_camera(metadata["camera"], kind):
        raise DataError(
            f"checkpoint {checkpoint.path} was trained on another camera's pictures than plant "
            f"{kind.name} has now",
            hint="train it again",
        )
    largest = max((array.size for array in checkpoint.tensors.values()), default=0)
    for name, value in architecture.items():
        if isinstance(value, int) and value > largest:
            raise DataError(
                f"checkpoint {checkpoint.path}: {name} = {value}, but no tensor has so many values"
            )
    try:
        with torch.device("meta"):
            planned = build_modules(architecture, kind.action_shape, kind.force_signs).state_dict()
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError, UsageError) as error:
        reason = str(error).partition("\n")[0]
        raise DataError(
            f"checkpoint {checkpoint.path} has no valid architecture: {reason}"
        ) from None
    expected = {
        name: (str(tensor.dtype).removeprefix("torch."), tuple(tensor.shape))
        for name, tensor in planned.items()
    }
    check_tensors(checkpoint, expected)
    if architecture["kind"] == "reflex":
        try:
            read_decays(metadata, kind)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"checkpoint {checkpoint.path} does not say how its forces fade: {error}"
            ) from None
    modules = build_modules(architecture, kind.action_shape, kind.force_signs)
    modules.load_state_dict(
        {name: torch.from_numpy(array.copy()) for name, array in checkpoint.tensors.items()}
    )
    return modules.eval()


def check_metadata(checkpoint: Checkpoint) -> Mapping[str, Any]:
    """Return the metadata of a checkpoint whose fields that this program relies on are sound.

    Raises:
        DataError: one is missing or malformed.
    """
    metadata = checkpoint.metadata
    try:
        good = (
            isinstance(metadata["plant"], str)
            and isinstance(metadata["health"], dict)
            and metadata["settings"]["encoder"]["precision"] in PRECISIONS
            and metadata["architecture"]["kind"] in CHOICES["kind"]
            and all(
                value in CHOICES.get(name, (value,))
                for name, value in metadata["architecture"].items()
            )
        )
        plant(metadata["plant"])
    except (KeyError, TypeError, ValueError, UsageError):
        good = False
    if not good:
        raise DataError(f"checkpoint {checkpoint.path} lacks metadata or has malformed ones")
    return metadata


def tensors_of(modules: nn.ModuleDict) -> dict[str, NDArray[Any]]:
    """All parameters and buffers as arrays, ready for :func:`save_checkpoint`."""
    return {
        name: tensor.detach().cpu().contiguous().numpy()
        for name, tensor in modules.state_dict().items()
    }


@torch.inference_mode()
def encode_frames(
    encoder: Callable[[Tensor], Tensor],
    frames: Tensor,
    *,
    device: torch.device,
    precision: str,
) -> Tensor:
    """uint8 frames [N, κ, H, W, 3] → float32 embeddings [N, D] on the CPU, in batches."""
    parts = []
    for start in range(0, len(frames), ENCODE_BATCH):
        batch = frames[start : start + ENCODE_BATCH].to(device)
        with autocast(device, precision):
            parts.append(encoder(batch).float().cpu())
    return torch.cat(parts)


def for_inference(modules: nn.ModuleDict, device: torch.device, precision: str) -> nn.ModuleDict:
    """A copy that computes the same sooner: batch norms folded, weights cast once for all calls."""
    networks = copy.deepcopy(modules).to(device).eval()
    for name, network in networks.items():
        if isinstance(network, Encoder):
            networks[name] = network.folded()
    dtype = compute_dtype(device, precision)
    for layer in networks.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            layer.to(dtype)
    return networks


class Model:
    """Everything inference needs, from one checkpoint that drives."""

    def __init__(
        self, modules: nn.ModuleDict, metadata: Mapping[str, Any], digest: str, device: str = "auto"
    ) -> None:
        self.architecture = metadata["architecture"]
        self.metadata, self.digest = metadata, digest
        self.plant_name: str = metadata["plant"]
        self.precision: str = metadata["settings"]["encoder"]["precision"]
        kind = plant(self.plant_name)
        self.force_limit_n, self.action_shape = kind.force_limit_n, kind.action_shape
        self.frames: int = self.architecture.get("frames", 2)
        self.device = resolve_device(device)
        self.networks = for_inference(modules, self.device, self.precision)
        self._planners: dict[str, Planner] = {}
        levels = levels_of(self.architecture) if self.architecture["kind"] in LEVELS else ()
        if "medium" in levels:
            self._planners["hjepa"] = _Hierarchical(self)
        if "high" in levels:
            self._planners[f"ts-jepa-{self.strides.h}"] = _Flat(self, "high", self.strides.h)
        if "flat" in levels:
            self._planners["ts-jepa-1"] = _Flat(self, "flat", 1)
        is_reflex = self.architecture["kind"] == "reflex"
        self.decays: dict[str, Decay] = read_decays(metadata, kind) if is_reflex else {}

    @classmethod
    def load(cls, path: Path, device: str = "auto") -> "Model":
        """Read a checkpoint.

        Raises:
            MissingInputError: no such file.
            DataError: not an intact checkpoint that drives: of a lone encoder, for example.
        """
        checkpoint = load_checkpoint(path)
        architecture = checkpoint.metadata.get("architecture")
        if isinstance(architecture, dict) and architecture.get("kind") == "encoder":
            raise DataError(
                f"{path} is a checkpoint of train-encoder, not of train-hierarchy",
                hint=f"hjepa train-hierarchy --encoder {path}",
            )
        return cls(load_modules(checkpoint), checkpoint.metadata, checkpoint.digest, device)

    @property
    def methods(self) -> tuple[str, ...]:
        """What this model can drive; P^H alone is TS-JEPA of depth h."""
        return offered(self.architecture, len(plant(self.plant_name).state_names))

    @property
    def strides(self) -> Strides:
        """Of a model with predictors."""
        return Strides(*(self.architecture[name] for name in ("h", "m", "l")))

    def encode(self, frames: NDArray[np.uint8]) -> Tensor:
        """Frames uint8 [N, κ, 64, 128, 3], the current one last → embeddings float32 [N, D]."""
        return encode_frames(
            functools.partial(read_frames, self.networks),
            torch.from_numpy(frames),
            device=self.device,
            precision=self.precision,
        )

    def actor(self, z: Tensor) -> Tensor:
        """Embeddings [N, D] → forces_n [N, *A], clipped to the force limit."""
        with self.autocast():
            return self.force_limit_n * self._act(z)

    def single_step(self, z: Tensor, forces_n: Tensor) -> Tensor:
        """The level of stride 1, ``ts-jepa-1``: z [N, D], forces_n [N, *A] → embeddings [N, D]."""
        with self.autocast():
            actions = forces_n.to(self.device).unsqueeze(1) / self.force_limit_n
            return self.networks["flat"](z, actions)  # type: ignore[no-any-return]

    def planner(self, method: str) -> Planner:
        """The planner behind ``method``.

        Raises:
            UsageError: this model does not predict with that method.
        """
        if method not in self._planners:
            raise UsageError(
                f"this model has no planner '{method}'; choose from {', '.join(self._planners)}"
            )
        return self._planners[method]

    def law(self, z: Tensor) -> Tensor:
        """As :meth:`actor`, by the law that ``hold-decay-linear`` fades."""
        with self.autocast():
            action: Tensor = self.networks["law"].act(z).float()  # type: ignore[operator]
            return self.force_limit_n * action

    def reaction(self, method: str) -> Reaction:
        """The reflex behind ``chunk`` or ``chunk-forces``."""
        return _Reaction(self, method.replace("-", "_"))

    def autocast(self) -> AbstractContextManager[object]:
        """The precision that the networks were trained in."""
        return autocast(self.device, self.precision)

    def _act(self, z: Tensor) -> Tensor:
        return self.networks["actor"].act(z).float()  # type: ignore[no-any-return, operator]


class _Hierarchical:
    """H-JEPA: one coarse stride at a time, filled in by the finer levels."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self.stride = model.strides.h

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        networks = self._model.networks
        with self._model.autocast():
            actions, _, z_next = plan_stride(
                self._model._act,
                networks["high"],
                networks["medium"],
                networks["low"],
                z,
                self._model.strides,
                recompute_anchor=self._model.architecture["stride_actions"] == "all",
            )
        return self._model.force_limit_n * actions, z_next


class _Flat:
    """TS-JEPA: one predictor of a fixed depth, the action held in between."""

    def __init__(self, model: Model, name: str, stride: int) -> None:
        self._model, self._predictor, self.stride = model, model.networks[name], stride

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        with self._model.autocast():
            actions = hold(self._model._act(z), self.stride)
            return self._model.force_limit_n * actions, self._predictor(z, actions)


class _Reaction:
    """A reflex, in newton."""

    def __init__(self, model: Model, name: str) -> None:
        reflex = model.networks[name]
        assert isinstance(reflex, Reflex)
        self._model, self._reflex = model, reflex
        self.stride = reflex.shape[0]
        self.remembers = reflex.longest_age if reflex.sees_forces else 0

    def plan(self, z: Tensor, ages: Tensor, sent_n: Tensor) -> Tensor:
        limit_n, device = self._model.force_limit_n, self._model.device
        sent = (sent_n / limit_n).unsqueeze(1).to(device) if self.remembers else None
        with self._model.autocast():
            actions = self._reflex.act(z.to(device), ages.unsqueeze(1).to(device), sent)
            return limit_n * actions.squeeze(1).float()
