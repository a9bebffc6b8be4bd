"""Animations show closed loops in pictures of all devices, as GIF or MP4.

A row or more per method (methods of a single device lie beside each other), a panel per device:
what the camera sees of the true plant, beside it, pale, what the controller believes; the age of
its last packet and the SNR; and a strip with one column per slot: a full bar is a packet that
arrived, a tick one that was lost.
"""

import contextlib
import dataclasses
import io
import math
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX, Camera
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import StorageError, UsageError, require
from hjepa_cli.output.film import Film, Link
from hjepa_cli.output.pictures import FAINT, INK, PAPER, font
from hjepa_cli.storage import files

FORMATS = (".gif", ".mp4")
MOST_PX = (1920, 1440)  # of a picture, however many devices there are
SCALES = (8, 6, 5, 4, 3)  # a frame's pixel is so many of the picture: the largest that fits
VIEW_PX = (38, 56)  # width and height of what is shown of a frame: around the plant
SKY_PX = 2  # of a frame, above what is shown
MARGIN_PX, TITLE_PX, HEADER_PX = 8, 22, 42
CAPTION_PX, STRIP_PX = 18, 18
LEAST_WIDTH_PX = 640  # for the notes at the top
TEXT, NAME = font(12), font(15)  # below 12 px, Pillow's letters swallow the blanks
ARRIVED, LOST = (0, 158, 115), (213, 94, 0)  # safe for colour-blind readers
FLAGGED = (204, 121, 167)
NOTHING = (228, 228, 228)
PALE = 0.55  # share of white in what is only believed
COLOURS = 48  # of a GIF
MOST_GIF_FPS = 50  # viewers take a single hundredth of a second for ten


@dataclasses.dataclass(frozen=True)
class Grid:
    """Panels lie so: ``rows`` of ``columns`` devices per method, ``beside`` methods in a line."""

    scale: int
    columns: int
    rows: int
    methods: int
    beside: int = 1

    @property
    def panel_px(self) -> tuple[int, int]:
        """Return width and height of a panel: truth and belief beside each other, text, strip."""
        width, height = VIEW_PX
        return 2 * width * self.scale + 2, height * self.scale + CAPTION_PX + STRIP_PX

    @property
    def size_px(self) -> tuple[int, int]:
        """Return width and height of a picture: even numbers, as MP4 wants."""
        across, down = self.method_px
        width = max(self.beside * across + MARGIN_PX, LEAST_WIDTH_PX)
        height = math.ceil(self.methods / self.beside) * down + MARGIN_PX + HEADER_PX
        return width + width % 2, height + height % 2

    @property
    def method_px(self) -> tuple[int, int]:
        """Return width and height of all that is shown of a method, with a margin."""
        across, down = self.panel_px
        return self.columns * (across + MARGIN_PX), TITLE_PX + self.rows * (down + MARGIN_PX)


def grid(devices: int, methods: int, scales: Sequence[int] = SCALES) -> Grid | None:
    """Return how panels lie, at the largest scale at which all have room; ``None``: at none."""
    for scale in scales:
        for columns in range(devices, 0, -1):
            beside = methods if devices == 1 else 1
            found = Grid(scale, columns, math.ceil(devices / columns), methods, beside)
            if all(size <= most for size, most in zip(found.size_px, MOST_PX, strict=True)):
                return found
    return None


class Pictures:
    """It draws the pictures of an animation when asked for them.

    Args:
        films: one per method, of the same devices and steps.
        link, kind, camera: the radio, the plant, and what looks at it.
        every: control steps between pictures.
        scales: of panels, the largest that fits.
    """

    def __init__(
        self,
        films: Sequence[Film],
        link: Link,
        kind: System,
        camera: Camera,
        every: int,
        scales: Sequence[int] = SCALES,
    ) -> None:
        self.films, self.link, self.kind = films, link, kind
        self.every = every
        self.steps = list(range(0, len(link.delivered), every))
        self._camera = camera
        self.devices = link.delivered.shape[1]
        self._grid = grid(self.devices, len(films), scales)

    @property
    def grid(self) -> Grid:
        """Return how panels lie in a file's pictures. Raises UsageError where there is no room."""
        if self._grid is None:
            raise too_many(self.devices, len(self.films), "picture")
        return self._grid

    @property
    def size_px(self) -> tuple[int, int]:
        """Return width and height of a picture."""
        return self.grid.size_px

    @property
    def flags(self) -> bool:
        """Return whether any packet looked like nothing in training."""
        return any(shot.flagged is not None and shot.flagged.any() for shot in self.films)

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[Image.Image]:
        return map(self.draw, self.steps)

    def draw(self, k: int) -> Image.Image:
        """Draw the picture of control step ``k``."""
        across, down = self.grid.panel_px
        picture = Image.new("RGB", self.size_px, PAPER)
        draw = ImageDraw.Draw(picture)
        clock = f"t = {1e3 * k * self.kind.step_s:.0f} ms   {self.link.label}"
        draw.text((MARGIN_PX, 4), clock, FAINT, TEXT)
        self._draw_legend(draw, 22)
        for number, shot in enumerate(self.films):
            below, aside = divmod(number, self.grid.beside)
            left = MARGIN_PX + aside * self.grid.method_px[0]
            top = HEADER_PX + MARGIN_PX + below * self.grid.method_px[1]
            score = shot.score[: k + 1].mean()
            draw.text((left, top), shot.method, INK, NAME)
            said = f"{score:.0%} of the time inside the band"
            draw.text((left + NAME.getlength(shot.method) + 16, top + 3), said, FAINT, TEXT)
            for device in range(self.devices):
                row, column = divmod(device, self.grid.columns)
                place = left + column * (across + MARGIN_PX), top + row * (down + MARGIN_PX)
                picture.paste(self._panel(shot, device, k), (place[0], place[1] + TITLE_PX))
        return picture

    def _draw_legend(self, draw: ImageDraw.ImageDraw, top: int) -> None:
        """Say what is drawn where, and what the marks of packets mean, each beside its mark."""
        left = float(MARGIN_PX)
        said = "each panel: left the truth, right what the controller believes"
        parts = [(said, None, 0), ("packet arrived", ARRIVED, 12)]
        if self.link.sends_always:
            parts.append(("lost", LOST, 4))
        if self.flags:
            parts.append(("arrived, unfamiliar", FLAGGED, 12))
        if self.link.late:
            parts.append((self.link.late.removeprefix(", "), None, 0))
        for text, colour, height in parts:
            if colour is not None:
                draw.rectangle([left, top + 13 - height, left + 2, top + 13], fill=colour)
                left += 8
            draw.text((left, top), text, FAINT, TEXT)
            left += TEXT.getlength(text) + 18

    def scenes(self, shot: Film, device: int, k: int) -> tuple[Image.Image, Image.Image]:
        """Return what is shown of the true and of the believed plant, in a frame's pixels.

        Both show the same part of the world, around the true plant; the belief is paler.
        """
        middle = self._middle(shot.states[k, device])
        shown = []
        for states in (shot.states, shot.believed):
            (frame,) = self._camera.render(states[k, device][None])
            colours = np.broadcast_to(frame, (*frame.shape[:2], 3))
            width, height = VIEW_PX
            left = int(np.clip(round(middle - width / 2), -WIDTH_PX, 2 * WIDTH_PX))
            scene = Image.new("RGB", VIEW_PX, NOTHING)  # beyond what the camera sees
            whole = Image.fromarray(np.ascontiguousarray(colours)).resize((WIDTH_PX, HEIGHT_PX))
            scene.paste(whole.crop((0, SKY_PX, WIDTH_PX, SKY_PX + height)), (-left, 0))
            shown.append(scene)
        return shown[0], Image.blend(shown[1], Image.new("RGB", VIEW_PX, (255, 255, 255)), PALE)

    def in_sight(self, shot: Film, device: int, k: int) -> bool:
        """Return whether the camera sees the plant."""
        return 0 <= self._middle(shot.states[k, device]) <= WIDTH_PX

    def _middle(self, state: Floats) -> float:
        """Return the column of a frame around which the plant is."""
        _, *outlines = sketch = self._camera.sketch_px(state)
        columns = (outlines or sketch)[-1][:, 0]
        column = float(columns.min() + columns.max()) / 2
        return column if math.isfinite(column) else WIDTH_PX / 2

    def age(self, device: int, k: int) -> str:
        """Say how long ago the newest packet was sent that the controller has of a device."""
        steps = self.link.age_steps[k, device]
        return "no packet" if steps < 0 else f"packet {1e3 * steps * self.kind.step_s:.0f} ms old"

    def error(self, shot: Film, device: int, k: int) -> str:
        """Say how far off the belief is in the first angle, else in the first state."""
        names, units = self.kind.state_names, self.kind.state_units
        which = units.index("rad") if "rad" in units else 0
        error = shot.believed[k, device, which] - shot.states[k, device, which]
        if units[which] == "rad":
            return f"{names[which]} off by {np.degrees(error):+.1f}°"
        return f"{names[which]} off by {error:+.2g} {units[which]}"

    def _panel(self, shot: Film, device: int, k: int) -> Image.Image:
        across, down = self.grid.panel_px
        panel = Image.new("RGB", (across, down), PAPER)
        draw = ImageDraw.Draw(panel)
        age, snr_db = self.age(device, k), self.link.snr_db[k, device]
        parts = [f"device {device}", age, f"SNR {snr_db:.0f} dB"]
        for caption in ("   ".join(parts), "  ".join([str(device), *parts[1:]])):
            if TEXT.getlength(caption) <= across:
                break
        draw.text((0, 1), caption, INK, TEXT)
        size = VIEW_PX[0] * self.grid.scale, VIEW_PX[1] * self.grid.scale
        for place, scene in enumerate(self.scenes(shot, device, k)):
            panel.paste(
                scene.resize(size, Image.Resampling.BOX), (place * (size[0] + 2), CAPTION_PX)
            )
        if not self.in_sight(shot, device, k):
            draw.text((6, CAPTION_PX + 4), "out of sight", FAINT, TEXT)
        self._draw_slots(draw, shot, device, k, down - STRIP_PX + 3, down - 1)
        return panel

    def _draw_slots(
        self, draw: ImageDraw.ImageDraw, shot: Film, device: int, k: int, top: int, bottom: int
    ) -> None:
        """Draw the last slots, one column each, the newest at the right."""
        width = self.grid.panel_px[0]
        draw.rectangle([0, top, width - 1, bottom], fill=NOTHING)
        first = max(k + 1 - width, 0)
        for slot, arrived in enumerate(self.link.delivered[first : k + 1, device], start=first):
            column = width - 1 - (k - slot)
            if arrived:
                strange = shot.flagged is not None and shot.flagged[slot, device]
                colour = FLAGGED if strange else ARRIVED
                draw.rectangle([column - 1, top, column, bottom], fill=colour)
            elif self.link.sends_always:
                draw.line([(column, bottom - 3), (column, bottom)], fill=LOST)


def check_target(path: Path, fps: int, devices: int, methods: int) -> None:
    """Raise UsageError or MissingInputError for a file that we could not write, in good time."""
    if path.suffix not in FORMATS:
        raise UsageError(f"no animation format '{path.suffix}'; --out FILE.gif or FILE.mp4")
    if grid(devices, methods) is None:
        raise too_many(devices, methods, path.suffix[1:].upper())
    if path.suffix == ".gif" and fps > MOST_GIF_FPS:
        raise UsageError(
            f"--fps {fps}: a GIF holds at most {MOST_GIF_FPS} pictures per second",
            hint=f"--fps {MOST_GIF_FPS}, or --out FILE.mp4",
        )
    if path.suffix == ".mp4":
        require("imageio_ffmpeg", "MP4 needs imageio-ffmpeg", "video", ", or --out FILE.gif")


def too_many(devices: int, methods: int, what: str) -> UsageError:
    """Return the error for more than a picture has room for, with how much that is."""
    fewer, of, count = "devices", devices, 0
    while count < devices and grid(count + 1, methods):
        count += 1
    if not count:
        fewer, of = "methods", methods
        while grid(1, count + 1):
            count += 1
    return UsageError(
        f"{of} {fewer}: a {what} of {MOST_PX[0]} × {MOST_PX[1]} has room for {count}",
        hint=f"--{fewer} with at most {count}; eval measures any number",
    )


def true_fps(path: Path, fps: int) -> float:
    """Return how many pictures per second the file holds."""
    return 1000 / _gif_ms(fps) if path.suffix == ".gif" else fps


def write(pictures: Pictures, path: Path, fps: int, tick: Callable[[], None]) -> None:
    """Write .gif or .mp4, atomically. Raises StorageError."""
    encode = _gif if path.suffix == ".gif" else _mp4
    files.write_bytes(path, encode(pictures, fps, tick))


def _gif(pictures: Pictures, fps: int, tick: Callable[[], None]) -> bytes:
    palette = _palette(pictures)  # one for all: no flicker
    shots = []
    for picture in pictures:
        shots.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
        tick()
    encoded = io.BytesIO()
    shots[0].save(
        encoded, "GIF", save_all=True, append_images=shots[1:], duration=_gif_ms(fps), loop=0
    )
    return encoded.getvalue()


def _gif_ms(fps: int) -> int:
    """Return how long a GIF shows a picture: whole hundredths of a second."""
    return 10 * round(100 / fps)


def _palette(pictures: Pictures) -> Image.Image:
    """Return the commonest colours of some pictures, and those of the strips however rare."""
    steps = [pictures.steps[place] for place in (0, len(pictures) // 2, -1)]
    width, height = pictures.size_px
    picture = Image.new("RGB", (width, len(steps) * height))
    for place, k in enumerate(steps):
        picture.paste(pictures.draw(k), (0, place * height))
    kept = (*ARRIVED, *LOST, *FLAGGED, *PAPER, 255, 255, 255)
    common = picture.quantize(COLOURS - len(kept) // 3).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*common[: 3 * COLOURS - len(kept)], *kept])
    return palette


def _mp4(pictures: Pictures, fps: int, tick: Callable[[], None]) -> bytes:
    import imageio_ffmpeg

    width, height = pictures.size_px
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps)]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *raw, "-i", "-"]
    with tempfile.TemporaryDirectory() as folder:  # ffmpeg seeks in what it writes
        film = Path(folder, "film.mp4")
        command += ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", str(film)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as encoder:
            assert encoder.stdin is not None and encoder.stderr is not None
            with contextlib.suppress(BrokenPipeError):  # it says below why it has gone
                for picture in pictures:
                    encoder.stdin.write(picture.tobytes())
                    tick()
                encoder.stdin.close()
            complaint = encoder.stderr.read().decode(errors="replace")
        if encoder.returncode:
            raise StorageError(f"ffmpeg failed: {complaint}", hint="--out FILE.gif")
        return film.read_bytes()
