"""Tags prove that a datagram comes from somebody with the key, unchanged, and in this session.

A tag is the first 16 bytes of HMAC-SHA256 (RFC 2104) over all bytes before it. Hellos and their
answers are tagged with the shared key. All else is tagged with a key of the session, which both
sides' nonces make: a recording of an earlier session proves nothing in a later one.
"""

import hmac
import os
import secrets
import stat
from pathlib import Path

from hjepa_cli.errors import DataError, MissingInputError, shell
from hjepa_cli.storage import files
from hjepa_cli.wire.protocol import TAG_BYTES

NO_KEY = bytes(32)  # on loopback without a key file: tags are then checksums, and prove nothing
KEY_BYTES = (16, 4096)
WINDOW = 64  # steps before the newest of which a session remembers whether they came


def tagged(key: bytes, body: bytes) -> bytes:
    """Return a datagram: its bytes and their tag."""
    return body + hmac.digest(key, body, "sha256")[:TAG_BYTES]


def is_tagged(key: bytes, datagram: bytes) -> bool:
    """Say whether a datagram has the tag of this key, in a time that depends on no byte of it."""
    expected = hmac.digest(key, datagram[:-TAG_BYTES], "sha256")[:TAG_BYTES]
    return hmac.compare_digest(expected, datagram[-TAG_BYTES:])


def session_key(key: bytes, device: int, nonce: bytes, server_nonce: bytes) -> bytes:
    """Return the key of a session [32 bytes]."""
    label = b"hjepa wire 1 session"
    return hmac.digest(key, label + device.to_bytes(4, "little") + nonce + server_nonce, "sha256")


def read_key(path: Path) -> bytes:
    """Return the shared key that a file holds.

    Raises:
        MissingInputError: there is no such file.
        DataError: others may read it, or it is too short or too long for a key.
    """
    data = files.read_bytes(path, limit=KEY_BYTES[1])
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise DataError(
            f"key file {path} has mode {mode:04o}: others may read or change it",
            hint=f"{shell(['chmod', 600, path])}; and make a new one if others may have read it",
        )
    if len(data) < KEY_BYTES[0]:
        raise DataError(
            f"key file {path} has {len(data)} bytes; a key has at least {KEY_BYTES[0]}",
            hint=f"{shell(['rm', path])}; a new one is made by: {_made_by(path)}",
        )
    return data


def _made_by(path: Path) -> str:
    return shell(["hjepa", "serve", "--model", "DIR", "--key", path])


def make_key(path: Path) -> bytes:
    """Write a new key of 32 random bytes that its owner alone may read, and return it."""
    key = secrets.token_bytes(32)
    files.make_directory(path.parent)
    files.create_private(path, key)
    return key


def key_of(path: Path | None, *, make: bool = False) -> bytes:
    """Return the key in a file, :data:`NO_KEY` without one; ``make`` it where it is not there.

    Raises as :func:`read_key`.
    """
    if path is None:
        return NO_KEY
    if make and not os.path.lexists(path):
        return make_key(path)
    try:
        return read_key(path)
    except MissingInputError:
        raise MissingInputError(
            f"key file {path} does not exist",
            hint=f"copy the server's and keep its mode; it is made by: {_made_by(path)}",
        ) from None


class ReplayWindow:
    """It remembers which steps of a session have come, for :data:`WINDOW` steps (RFC 6479)."""

    def __init__(self) -> None:
        self.newest = -1
        self._seen = 0  # bit i: newest − i has come

    def judge(self, step: int) -> str:
        """Take a step once: ``"new"``, ``"late"`` (overtaken by a newer one) or ``"doubled"``."""
        if step > self.newest:
            self._seen = (self._seen << min(step - self.newest, WINDOW)) | 1
            self._seen &= 2**WINDOW - 1
            self.newest = step
            return "new"
        bit = 1 << (self.newest - step) if self.newest - step < WINDOW else 0
        if not bit or self._seen & bit:
            return "doubled"
        self._seen |= bit
        return "late"
