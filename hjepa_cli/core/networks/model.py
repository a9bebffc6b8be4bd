"""A trained model holds all networks that drive devices, as a checkpoint has them."""

import copy
import functools
import math
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast, compute_dtype, resolve_device
from hjepa_cli.config.schema import LOOK, SPACINGS, CameraSettings, SensorSettings, look_of
from hjepa_cli.core.networks.actor import Actor
from hjepa_cli.core.networks.decoder import Decoder, read_frames
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.hierarchy import Strides, build_predictors
from hjepa_cli.core.networks.outside import embeddings_from, frames_from
from hjepa_cli.core.networks.photometry import FITS
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.networks.reflex import Decay, Reflex, read_decays
from hjepa_cli.core.plants.frames import LONGEST, same_camera
from hjepa_cli.core.plants.named import camera_in, camera_of, plant_in, sensor_in
from hjepa_cli.errors import DataError, UsageError, shell
from hjepa_cli.plugins import METHODS
from hjepa_cli.storage.checkpoints import Checkpoint, check_tensors, load_checkpoint

ENCODE_VALUES = 2**22  # larger arrays go back to the system after each use: twice as slow
KINDS = ("encoder", "hierarchy", "flat", "supervised", "autoencoder", "reflex")
CHOICES = {  # of an architecture; its other values are sizes
    "frame_input": ("difference", "pair"),
    "frames": (2, 4),
    "frame_gap": tuple(range(1, LONGEST)),
    "frame_spacing": tuple(SPACINGS),
    "stride_actions": ("all", "held"),
    "centre": (True, False),
    "residual": (True, False),
    "mirror": ("exact", "augment", "none"),
    "photometric": FITS,
}
UNSAID = LOOK | {"photometric": "none"}  # of an encoder, where its architecture has no such
PRECISIONS = ("auto", "bf16", "fp32")
LEVELS = {  # of each kind that has some, in the order of the checkpoint
    "encoder": ("high",),
    "hierarchy": ("high", "medium", "low", "flat"),
    "flat": ("high", "flat"),
}
ON_EMBEDDINGS = ("hierarchy", "flat", "reflex")  # kinds whose devices send what an encoder makes


def build_modules(
    architecture: Mapping[str, Any],
    action_shape: tuple[int, ...] = (),
    force_signs: tuple[float, ...] = (-1.0,),
) -> nn.ModuleDict:
    """Instantiate the networks that ``architecture`` (checkpoint metadata) describes, untrained.

    ``action_shape`` and ``force_signs`` are the plant's. By ``kind``:

    - ``encoder``: Ψ and its companion P^H;
    - ``hierarchy``: Ψ, all levels, the flat baseline and the actor, with ``fusion`` a posterior;
    - ``flat``: Ψ, a predictor of stride h, the one of stride 1 and the actor;
    - ``supervised``: Ψ, of κ frames, and the actor;
    - ``autoencoder``: Ψ, the decoder, a second Ψ that reads what was decoded, and the actor;
    - ``reflex``: Ψ, the actor, one of a law that fades, and the reflexes without and with forces;
    - any other: what the method of a plugin that has this kind builds.

    Raises:
        UsageError: no method in force has this kind.
    """
    kind = architecture["kind"]
    if kind not in KINDS:
        built: nn.ModuleDict = _extended(kind).modules(architecture, action_shape, force_signs)
        return built
    architecture = {**UNSAID, **architecture}
    embedding, look = architecture["embedding"], look_of(architecture)
    symmetric = architecture["mirror"] == "exact"
    mirror = force_signs if symmetric else None
    frame_shape = camera_in(architecture).frame_shape

    def encoder() -> Encoder:
        frame_input, centre = architecture["frame_input"], architecture["centre"]
        fit = architecture["photometric"]
        return Encoder(embedding, frame_input, centre, symmetric, look, frame_shape, fit)

    def actor() -> Actor:
        hidden, dropout = architecture["actor_hidden"], architecture["actor_dropout"]
        return Actor(embedding, hidden, dropout, action_shape, mirror)

    def reflex(forces_at_once: int, *, sees_forces: bool) -> Reflex:
        return Reflex(
            embedding,
            architecture["actor_hidden"],
            longest_age=architecture["longest_age"],
            forces_at_once=forces_at_once,
            sees_forces=sees_forces,
            action_shape=action_shape,
            mirror=mirror,
        )

    modules = nn.ModuleDict({"encoder": encoder()})
    if kind in LEVELS:
        predictors = build_predictors(
            Strides(*(architecture[name] for name in "hml")),
            embedding,
            architecture["hidden"],
            all_actions=architecture["stride_actions"] == "all",
            residual=architecture["residual"],
            forces=math.prod(action_shape),
            mirror=mirror,
        )
        modules.update({name: predictors[name] for name in levels_of(architecture)})
    if architecture.get("fusion"):
        modules["posterior"] = Predictor(
            embedding, architecture["hidden"], 0, guided=True, mirror=mirror
        )
    if kind == "autoencoder":
        modules["decoder"] = Decoder(embedding, len(look), symmetric, frame_shape)
        modules["reader"] = encoder()
    if kind != "encoder":
        modules["actor"] = actor()
    if kind == "reflex":
        modules["law"] = actor()
        modules["chunk"] = reflex(architecture["forces_at_once"], sees_forces=False)
        # What follows a force that is not the teacher's depends on the next one: one at a time.
        modules["chunk_forces"] = reflex(1, sees_forces=True)
    return modules


def _extended(kind: str) -> Any:
    """Return the method of a plugin that builds networks of this kind.

    Raises:
        UsageError: there is none.
    """
    for method in METHODS.values():
        if getattr(method, "kind", None) == kind:
            return method
    raise UsageError(f"no method builds networks of kind '{kind}'")


def levels_of(architecture: Mapping[str, Any]) -> tuple[str, ...]:
    """Name an architecture's predictors; a flat one of stride 1 has one for both its levels."""
    levels = LEVELS[architecture["kind"]]
    return levels[1:] if (architecture["kind"], architecture["h"]) == ("flat", 1) else levels


def coarsest_of(modules: nn.ModuleDict) -> str:
    """Name the level with the longest stride: P^H, or the only one of a flat model of stride 1."""
    return "high" if "high" in modules else "flat"


def load_modules(checkpoint: Checkpoint) -> nn.ModuleDict:
    """Rebuild the networks of a checkpoint, with strict names, shapes and dtypes.

    Nothing is allocated before the tensors in the file are known to be those of the architecture.

    Raises:
        DataError: there is no such architecture, the tensors do not fit it, or the camera has
            changed since.
    """
    metadata, found = check_metadata(checkpoint), f"checkpoint {checkpoint.path}"
    architecture, kind = metadata["architecture"], plant_in(metadata["plant"], metadata["settings"])
    camera = camera_of(kind, *_seen_by(metadata))
    if "camera" in metadata and not same_camera(metadata["camera"], camera):
        raise DataError(
            f"{found} was trained on another camera's pictures than plant {kind.name} has now",
            hint="train it again",
        )
    largest = max((array.size for array in checkpoint.tensors.values()), default=0)
    for name, value in architecture.items():
        if isinstance(value, int) and value > largest:
            raise DataError(f"{found}: {name} = {value}, but no tensor has so many values")
    try:
        with torch.device("meta"):
            planned = build_modules(architecture, kind.action_shape, kind.force_signs).state_dict()
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError, UsageError) as error:
        reason = str(error).partition("\n")[0]
        raise DataError(f"{found} has no valid architecture: {reason}") from None
    expected = {
        name: (str(tensor.dtype).removeprefix("torch."), tuple(tensor.shape))
        for name, tensor in planned.items()
    }
    check_tensors(checkpoint, expected)
    if architecture["kind"] == "reflex":
        try:
            read_decays(metadata, kind)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{found} does not say how its forces fade: {error}") from None
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
            and isinstance(metadata["architecture"]["kind"], str)
            and all(
                value in CHOICES.get(name, (value,))
                for name, value in metadata["architecture"].items()
            )
        )
        camera_of(plant_in(metadata["plant"], metadata["settings"]), *_seen_by(metadata))
        good &= camera_in(metadata["architecture"]) == camera_in(metadata["settings"])
    except (KeyError, TypeError, ValueError, UsageError):
        good = False
    if not good:
        raise DataError(f"checkpoint {checkpoint.path} lacks metadata or has malformed ones")
    if (kind := metadata["architecture"]["kind"]) not in KINDS:
        try:
            _extended(kind)
        except UsageError as error:
            raise DataError(
                f"checkpoint {checkpoint.path}: {error.message}",
                hint="add --plugin with the file of the method that it was trained for",
            ) from None
    return metadata


def _seen_by(metadata: Mapping[str, Any]) -> tuple[CameraSettings, SensorSettings]:
    """Return the size of a checkpoint's pictures, and the sensor that took them."""
    return camera_in(metadata["architecture"]), sensor_in(metadata["settings"])


def tensors_of(modules: nn.ModuleDict) -> dict[str, NDArray[Any]]:
    """Return all parameters and buffers as arrays, ready for :func:`save_checkpoint`."""
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
    """Return embeddings [N, D], float32 on the CPU, of uint8 frames [N, κ, H, W, 3]."""
    parts, together = [], max(ENCODE_VALUES // math.prod(frames.shape[1:]), 1)
    for start in range(0, max(len(frames), 1), together):  # of no frames there is none, [0, D]
        batch = frames[start : start + together].to(device)
        with autocast(device, precision):
            parts.append(encoder(batch).float().cpu())
    return torch.cat(parts)


def for_inference(modules: nn.ModuleDict, device: torch.device, precision: str) -> nn.ModuleDict:
    """Copy networks to compute the same sooner: batch norms folded, weights cast once for all."""
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
    """A trained model drives devices: it is its networks and what inference must know of them."""

    def __init__(
        self, modules: nn.ModuleDict, metadata: Mapping[str, Any], digest: str, device: str = "auto"
    ) -> None:
        self.architecture = metadata["architecture"]
        self.metadata, self.digest = metadata, digest
        self.plant_name: str = metadata["plant"]
        self.precision: str = metadata["settings"]["encoder"]["precision"]
        self.plant = kind = plant_in(self.plant_name, metadata["settings"])
        self.force_limit_n, self.action_shape = kind.force_limit_n, kind.action_shape
        self.look = look_of(self.architecture)
        self.frames = len(self.look)
        self.camera = camera_of(kind, *_seen_by(metadata))
        self.device = resolve_device(device)
        self.networks = for_inference(modules, self.device, self.precision)
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
                hint=shell(["hjepa", "train-hierarchy", "--encoder", path]),
            )
        return cls(load_modules(checkpoint), checkpoint.metadata, checkpoint.digest, device)

    @property
    def strides(self) -> Strides:
        """Return the strides of a model with predictors."""
        return Strides(*(self.architecture[name] for name in "hml"))

    def encode(self, frames: NDArray[np.uint8]) -> Tensor:
        """Encode frames uint8 [N, κ, H, W, C], the current one last: float32 [N, D].

        Raises:
            ArrayError: another type or shape; the message says which, and their range.
            NumericalError: frames that are no uint8 hold what is not finite.
        """
        return encode_frames(
            functools.partial(read_frames, self.networks),
            frames_from(frames, (self.frames, *camera_in(self.architecture).frame_shape)),
            device=self.device,
            precision=self.precision,
        )

    def gaze(self, frames: NDArray[np.uint8]) -> "Gaze":
        """Return what looks at the same devices step after step, first at these frames."""
        return Gaze(self, frames)

    def act(self, z: Tensor, network: str = "actor") -> Tensor:
        """Answer embeddings [N, D] with forces ÷ force limit [N, *A], clipped to ±1.

        Raises:
            ArrayError: another type or shape.
            NumericalError: an embedding is not finite.
        """
        z = embeddings_from(z, self.architecture["embedding"])
        return self.networks[network].act(z).float()  # type: ignore[no-any-return, operator]

    def actor(self, z: Tensor) -> Tensor:
        """Answer as :meth:`act`, with forces_n [N, *A] clipped to the force limit."""
        with self.autocast():
            return self.force_limit_n * self.act(z)

    def law(self, z: Tensor) -> Tensor:
        """Answer as :meth:`actor`, by the law that ``hold-decay-linear`` fades."""
        with self.autocast():
            return self.force_limit_n * self.act(z, "law")

    def autocast(self) -> AbstractContextManager[object]:
        """Compute in the precision that the networks were trained in."""
        return autocast(self.device, self.precision)


class Gaze:
    """Devices are looked at step after step: all pictures but one are those of the steps before.

    Args:
        model: encodes, without a decoder in between.
        frames: uint8 [N, L, H, W, C] of the first step and of all before it that are seen again.
    """

    @torch.inference_mode()
    def __init__(self, model: Model, frames: NDArray[np.uint8]) -> None:
        self._model, self._look = model, model.look
        self._pictures: deque[Tensor] = deque(maxlen=self._look[0] + 1)
        for step in range(frames.shape[1]):
            self.go_on(frames[:, step : step + 1])

    @torch.inference_mode()
    def go_on(self, frames: NDArray[np.uint8]) -> None:
        """Look at the pictures of the next step, uint8 [N, 1, H, W, C]."""
        pictures = torch.from_numpy(frames).to(self._model.device)
        with self._model.autocast():
            self._pictures.append(self._encoder.fitted_one(pictures))

    @torch.inference_mode()
    def embeddings(self) -> Tensor:
        """Return what :meth:`Model.encode` does, but for rounding: float32 [N, D] on the CPU."""
        seen = [self._pictures[-1 - back] for back in reversed(self._look)]
        with self._model.autocast():
            return self._encoder.embed(self._encoder.inputs_of(seen)).float().cpu()

    @property
    def _encoder(self) -> Encoder:
        encoder = self._model.networks["encoder"]
        assert isinstance(encoder, Encoder)
        return encoder
