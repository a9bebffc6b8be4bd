"""An actuator plays forces. One of your own has ``play`` and ``close``, which leaves no force."""

import os
import termios
import tty
from pathlib import Path
from typing import Protocol

from hjepa_cli.errors import Unavailable, UsageError
from hjepa_cli.wire.runtime import Singles

BAUD = termios.B115200


class Actuator(Protocol):
    """It pushes a plant."""

    def play(self, forces_n: Singles) -> None:
        """Apply forces [m] from now on. Raises Unavailable where that is not possible any more."""

    def close(self) -> None:
        """Apply no force, and give the actuator back. It must not raise."""


class Nothing:
    """It plays no force: a device that only looks, as with a recording."""

    def play(self, forces_n: Singles) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class SerialCartPole:
    """A motor controller behind a serial port takes one line a step, as ``u +1.250\\n`` in newton.

    This is an example for the class of rigs that the open project physical-cartpole stands for: a
    microcontroller turns the number into a duty cycle, and takes silence for 0 N after its own
    watchdog. It has been tried against a pseudo-terminal, never on hardware.
    """

    def __init__(self, port: Path) -> None:
        try:
            self._port = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise Unavailable(f"serial port {port}: {error.strerror}") from None
        try:
            tty.setraw(self._port)
            settings = termios.tcgetattr(self._port)
            settings[4] = settings[5] = BAUD
            termios.tcsetattr(self._port, termios.TCSANOW, settings)
        except termios.error as error:
            os.close(self._port)
            raise Unavailable(f"{port} is no serial port: {error.args[-1]}") from None
        self._name, self._begun = port, b""

    def play(self, forces_n: Singles) -> None:
        """Write the line of a step behind the end of one that a full buffer took a part of.

        A line that it takes nothing of is left out, as it would be late.
        """
        line = f"u {forces_n[0]:+.3f}\n".encode()
        try:
            taken = os.write(self._port, self._begun + line)
        except BlockingIOError:
            return
        except OSError as error:
            raise Unavailable(f"serial port {self._name}: {error.strerror}") from None
        if taken > len(self._begun):
            self._begun += line
        self._begun = self._begun[taken:]

    def close(self) -> None:
        """Drop what waits, write 0 N on a line of its own, thrice, and close the port."""
        try:
            termios.tcflush(self._port, termios.TCOFLUSH)  # a full buffer has no room for 0 N
            os.write(self._port, b"\n" + 3 * b"u +0.000\n")
        except (OSError, termios.error):
            pass
        finally:
            os.close(self._port)


def open_actuator(name: str, axes: int) -> Actuator:
    """Return the actuator called so: ``none`` or ``serial:PORT``.

    Raises:
        UsageError: none of these, or a plant of several forces.
        Unavailable: it is not there.
    """
    if name == "none":
        return Nothing()
    kind, _, port = name.partition(":")
    if kind != "serial" or not port:
        raise UsageError(f"--actuator {name}: expected sim, none or serial:PORT")
    if axes != 1:
        raise UsageError(f"--actuator {name} drives one force; this model's plant has {axes}")
    return SerialCartPole(Path(port))
