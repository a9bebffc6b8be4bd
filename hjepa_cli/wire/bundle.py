"""A bundle is what ``hjepa export`` writes: networks for a runtime without torch, and a manifest.

``manifest.json`` is canonical JSON and says all that a device and a controller must agree on; its
sha256 is the model's digest in every hello. Networks are checked against the manifest's digests
before a runtime sees a byte of them.
"""

import dataclasses
import hashlib
import math
import re
from pathlib import Path
from typing import Any

from hjepa_cli.config.schema import SPACINGS, Look, look_of
from hjepa_cli.core.plants.frames import LONGEST
from hjepa_cli.errors import DataError, MissingInputError, shell
from hjepa_cli.storage import files
from hjepa_cli.wire import protocol

SCHEMA = 1
MANIFEST = "manifest.json"
CHECK = "check.json"
NETWORKS = ("encoder", "encoder-int8", "planner", "coarse", "fine", "actor")
BUCKETS = (1, 4, 16, 64)  # batches that runtimes with fixed shapes compile
_LIMIT_BYTES = 512 * 2**20
_NAME = re.compile("[!-~]{1,16}")  # of a plant, as a hello holds it


@dataclasses.dataclass(frozen=True)
class Bundle:
    """A verified bundle.

    Attributes:
        directory: where it lies.
        manifest: as written.
        digest: sha256 of the manifest, 32 bytes.
    """

    directory: Path
    manifest: dict[str, Any]
    digest: bytes

    @property
    def plant(self) -> str:
        """Return the name of the plant that the model was trained on."""
        return str(self.manifest["plant"])

    @property
    def embedding(self) -> int:
        """Return D."""
        return int(self.manifest["embedding"])

    @property
    def frames(self) -> int:
        """Return κ, the pictures that the encoder sees at once."""
        return int(self.manifest["frames"])

    @property
    def look(self) -> Look:
        """Return how many steps back the κ pictures lie, the oldest first."""
        return look_of(self.manifest)

    @property
    def most_changed(self) -> float | None:
        """Return the largest share of pixels that a motion changes; bundles of old say none."""
        share = self.manifest.get("most_changed")
        return None if share is None else float(share)

    @property
    def axes(self) -> int:
        """Return m, the forces of a step."""
        return math.prod(self.manifest["action_shape"])

    @property
    def stride(self) -> int:
        """Return the control steps that the planner plans at a time."""
        return int(self.manifest["stride"])

    @property
    def force_limit_n(self) -> float:
        """Return the limit that forces lie within."""
        return float(self.manifest["force_limit_n"])

    @property
    def step_s(self) -> float:
        """Return the plant's control step."""
        return float(self.manifest["step_s"])

    def network(self, name: str) -> Path:
        """Return the file of a network's graph, after checking graph and weights.

        Raises:
            DataError: they are others, or there is no such network.
        """
        entry = self.manifest["networks"].get(name)
        if entry is None:
            raise DataError(f"{self.directory} holds no network '{name}'", hint=_again(self))
        for file, digest in entry["files"].items():
            path = self.directory / file
            data = files.read_bytes(path, limit=_LIMIT_BYTES)
            if hashlib.sha256(data).hexdigest() != digest:
                raise DataError(f"{path} is not the file that {MANIFEST} names", hint=_again(self))
        return self.directory / f"{name}.onnx"

    def verify(self) -> None:
        """Check every network. Raises as :meth:`network`."""
        for name in self.manifest["networks"]:
            self.network(name)


def files_of(name: str) -> tuple[str, str]:
    """Return the files of a network: its graph, and its weights, which a runtime maps."""
    return f"{name}.onnx", f"{name}.bin"


def _again(bundle: Bundle) -> str:
    return f"copy the bundle again, or: {exported_by(bundle.directory)}"


def exported_by(directory: Path) -> str:
    """Return the command that writes a bundle."""
    return shell(["hjepa", "export", "MODEL", "--to", directory])


def open_bundle(directory: Path) -> Bundle:
    """Read and check the manifest of a bundle.

    Raises:
        MissingInputError: there is no bundle.
        DataError: it is damaged, or of a newer version.
    """
    path = directory / MANIFEST
    if not path.is_file():
        raise MissingInputError(f"{directory} holds no exported model", hint=exported_by(directory))
    data = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES)
    try:
        manifest = files.parse_json(data)
    except ValueError as error:
        raise DataError(f"{path} is not valid JSON: {error}") from None
    files.check_schema(manifest.get("schema"), SCHEMA, str(path))
    bundle = Bundle(directory, manifest, hashlib.sha256(data).digest())
    try:
        networks, shape = manifest["networks"], manifest["action_shape"]
        sizes = [manifest[name] for name in ("embedding", "frames", "stride")]
        good = (
            all(type(size) is int and 0 < size <= 65_535 for size in sizes)
            and all(isinstance(axis, int) and axis > 0 for axis in shape)
            and type(gap := manifest.get("frame_gap", 1)) is int
            and gap > 0
            and manifest.get("frame_spacing", "even") in SPACINGS
            and bundle.look[0] < LONGEST
            and 0 < manifest.get("most_changed", 1.0) <= 1
            and bundle.force_limit_n > 0
            and bundle.step_s > 0
            and isinstance(manifest["plant"], str)
            and isinstance(manifest["camera"], dict)
            and set(networks) <= set(NETWORKS)
            and all(set(entry["files"]) == set(files_of(name)) for name, entry in networks.items())
        )
    except (KeyError, TypeError, ValueError):
        good = False
    if not good:
        raise DataError(f"{path} lacks entries or has malformed ones", hint=_again(bundle))
    if why := too_large(bundle.plant, bundle.embedding, bundle.axes, bundle.stride):
        raise DataError(f"{path}: {why}", hint=_again(bundle))
    return bundle


def too_large(plant: str, embedding: int, axes: int, stride: int) -> str | None:
    """Return why datagrams do not hold what a model of D values and h · m forces sends, if so.

    The other side would drop them as malformed, and nobody would hear of it.
    """
    if not _NAME.fullmatch(plant):
        return f"plant {plant!r}; on the wire a name has 1 to 16 ASCII characters and no spaces"
    if stride * axes > protocol.MOST_FORCES:
        return (
            f"strides of {stride} steps of {axes} forces; a datagram holds {protocol.MOST_FORCES} "
            "forces"
        )
    if (excess := protocol.embedding_bytes(embedding, axes) - protocol.LARGEST_BYTES) > 0:
        return f"embeddings of {embedding} values; a datagram holds {embedding - excess}"
    return None
