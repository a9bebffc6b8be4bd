"""A camera gives a device its pictures; three kinds, and a check that every one goes through.

A camera of your own has ``read`` and ``close``. What the encoder has not been trained on it must
not see: pictures of another size or type are refused, a picture that never changes is a camera that
hangs, and empty or torn ones are not sent.
"""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from hjepa_cli.config.schema import Look
from hjepa_cli.core.arrays import Pixels
from hjepa_cli.core.control.spoilt import changed, empty
from hjepa_cli.core.plants.frames import FRAME_SHAPE, HEIGHT_PX, WIDTH_PX, frames_back
from hjepa_cli.errors import DataError, MissingInputError, Unavailable, UsageError, require

FROZEN = 1000  # pictures in a row that are equal, empty or torn
MOST_TORN = 3  # in a row
PICTURES = (".png", ".jpg", ".jpeg", ".bmp")

Crop = tuple[int, int, int, int]


class Camera(Protocol):
    """It looks at a plant."""

    def read(self) -> Pixels | None:
        """Return the newest picture, RGB uint8 [64, 128, 3]; ``None`` at the end of a recording.

        Raises:
            Unavailable: there is none.
        """

    def close(self) -> None:
        """Give the camera back."""


class Watched:
    """It keeps the newest pictures of a camera for an encoder, after looking at each.

    Args:
        camera: to read from.
        look: how many pictures back the κ lie that the encoder sees, the oldest first.
        most_changed: the largest share of pixels that a motion changes between the two newest;
            ``None`` looks for nothing.

    Attributes:
        good: whether the newest picture is worth sending. In place of one that is not, the last
            good one is kept; after :data:`MOST_TORN` torn ones in a row the scene is another one.
        spoilt: how many were not.
    """

    def __init__(self, camera: Camera, look: Look, most_changed: float | None = None) -> None:
        self._camera, self._back, self._most = camera, frames_back(look), most_changed
        self._seen: deque[Pixels] = deque(maxlen=look[0] + 1)
        self._newest: Pixels | None = None  # as it came
        self._useless = self._torn = self.spoilt = 0
        self._begun = False  # with a good one: those before it are forgotten
        self.good = True

    def read(self) -> bool:
        """Take a picture; say whether there was one.

        Raises:
            DataError: it has another size or type.
            Unavailable: there is none, or it has been the same, or spoilt, for too long.
        """
        picture = self._camera.read()
        if picture is None:
            return False
        shape, dtype = getattr(picture, "shape", None), getattr(picture, "dtype", None)
        if shape != FRAME_SHAPE or dtype != np.uint8:
            raise DataError(
                f"the camera gives {shape} of {dtype}; the model sees {FRAME_SHAPE} of uint8, RGB",
                hint="--crop X,Y,WIDTH,HEIGHT with a part twice as wide as high",
            )
        same = self._newest is not None and np.array_equal(picture, self._newest)
        self._newest = picture
        self.good = self._most is None or self._is_good(picture, self._most)
        self.spoilt += not self.good
        self._useless = self._useless + 1 if same or not self.good else 0
        if self._useless >= FROZEN:
            what = "is frozen" if same else "shows nothing"
            raise Unavailable(
                f"the camera {what}: {FROZEN} equal, empty or torn pictures in a row",
                hint="look at its cable and its driver, then start the device again",
            )
        if self.good and not self._begun:
            self._seen.clear()
            self._begun = True
        elif self._begun and not self.good:
            picture = self._seen[-1]
        while len(self._seen) < self._seen.maxlen - 1:  # type: ignore[operator]
            self._seen.append(picture)  # of before it was switched on: copies of the first
        self._seen.append(picture)
        return True

    def _is_good(self, picture: Pixels, most: float) -> bool:
        if empty(picture[None])[0]:
            return False
        before = self._seen[self._back[-2] + 1] if self._begun else picture
        torn = changed(np.stack([before, picture])[None])[0] > most
        self._torn = self._torn + 1 if torn else 0
        return not 0 < self._torn <= MOST_TORN

    @property
    def frames(self) -> Pixels:
        """Return the pictures [1, κ, 64, 128, 3], the newest last."""
        return np.stack([self._seen[at] for at in self._back])[None]

    def close(self) -> None:
        """Give the camera back."""
        self._camera.close()


class Replay:
    """It reads a directory of pictures, once and in the order of their names."""

    def __init__(self, directory: Path, crop: Crop | None = None) -> None:
        require("PIL", "replaying pictures needs Pillow", "plot")
        names = sorted(path for path in directory.iterdir() if path.suffix.lower() in PICTURES)
        if not names:
            raise MissingInputError(
                f"{directory} holds no pictures ({', '.join(PICTURES)})",
                hint="name a directory of pictures, a video file, a camera's number, or sim",
            )
        self._paths: Iterator[Path] = iter(names)
        self._crop = crop

    def read(self) -> Pixels | None:
        """Return the next picture."""
        from PIL import Image

        path = next(self._paths, None)
        if path is None:
            return None
        try:
            with Image.open(path) as file:
                return fitted(np.asarray(file.convert("RGB")), self._crop)
        except (OSError, ValueError) as error:
            raise DataError(f"{path} is no picture: {error}") from None

    def close(self) -> None:
        """Do nothing."""


class OpenCv:
    """It reads a camera or a video file through OpenCV; ``source`` is its number or the file."""

    def __init__(self, source: int | str, crop: Crop | None = None) -> None:
        require("cv2", "a camera or a video needs OpenCV", "camera")
        import cv2

        self._video, self._source, self._crop = cv2.VideoCapture(source), source, crop
        if not self._video.isOpened():
            raise Unavailable(
                f"camera {source} cannot be opened",
                hint="name a camera's number, a video file, a directory of pictures, or sim",
            )
        self._some = False

    def read(self) -> Pixels | None:
        """Return the next picture, which the camera has to finish first."""
        import cv2

        good, picture = self._video.read()
        if not good:
            if self._some and isinstance(self._source, str):
                return None
            raise Unavailable(f"camera {self._source} gives no picture")
        self._some = True
        colours = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
        return fitted(colours, self._crop)

    def close(self) -> None:
        """Give the camera back."""
        self._video.release()


def fitted(picture: Pixels, crop: Crop | None) -> Pixels:
    """Cut a part (x, y, width, height) out of a picture, and shrink it to the encoder's size.

    Pixels are averaged over areas, as the simulated camera does. Without a crop the picture stays.

    Raises:
        DataError: the part is not in the picture, or not a whole multiple of 128 × 64.
    """
    if crop is None:
        return picture
    x, y, width, height = crop
    part = picture[y : y + height, x : x + width]
    scale = width // WIDTH_PX
    whole = (height, width) == (scale * HEIGHT_PX, scale * WIDTH_PX)
    if part.shape[:2] != (height, width) or not whole:
        raise DataError(
            f"crop {x},{y},{width},{height} of pictures of {picture.shape[1]} × "
            f"{picture.shape[0]}: it must lie inside, with a width of 128, 256, 384 … and half "
            "that height"
        )
    blocks = part.reshape(HEIGHT_PX, scale, WIDTH_PX, scale, 3).astype(np.float32)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)


def parse_crop(text: str | None) -> Crop | None:
    """Return the numbers of ``"X,Y,WIDTH,HEIGHT"``. Raises UsageError."""
    if text is None:
        return None
    numbers = [int(part) for part in text.split(",") if part.strip().isdigit()]
    if len(numbers) != 4 or text.count(",") != 3 or numbers[2] < WIDTH_PX:
        raise UsageError(f"--crop {text}: expected X,Y,WIDTH,HEIGHT in pixels, as 0,0,256,128")
    x, y, width, height = numbers
    return x, y, width, height


def open_camera(name: str, crop: Crop | None) -> Camera:
    """Return the camera called so: a number, a directory of pictures, or a video file.

    Raises:
        UsageError: none of these.
        MissingInputError, Unavailable: it is not there.
    """
    if name.isascii() and name.isdigit():
        return OpenCv(int(name), crop)
    path = Path(name)
    if path.is_dir():
        return Replay(path, crop)
    if path.is_file():
        return OpenCv(str(path), crop)
    raise UsageError(
        f"--camera {name}: expected sim, a camera's number, a directory of pictures or a video file"
    )
