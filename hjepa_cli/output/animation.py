"""Animations show closed loops in pictures of all devices, as GIF or MP4.

One row per method, one panel per device: the camera's picture of the true cart-pole, over it the
pole that the controller believes in (dashed, black), the age of its last packet and the SNR, and a
strip with one column per slot: a full bar is a packet that arrived, a tick one that was lost.
"""

import contextlib
import io
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.system import Camera, System
from hjepa_cli.errors import StorageError, UsageError, require
from hjepa_cli.output.film import Film, Link
from hjepa_cli.output.pictures import FAINT, INK, PAPER, font
from hjepa_cli.storage import files

MOST_PX = {".gif": 2**16 - 1, ".mp4": 2**14}  # each way: of the format, of the encoder
FORMATS = tuple(MOST_PX)
SCALE = 2  # a frame's pixel is so many of the picture
PANEL_PX = (WIDTH_PX * SCALE, HEIGHT_PX * SCALE + 16 + 14)  # text above, strip below
MARGIN_PX, TITLE_PX, HEADER_PX = 8, 20, 34
LEAST_WIDTH_PX = 600  # for the notes at the top
TEXT, NAME = font(12), font(14)  # below 12 px, Pillow's letters swallow the blanks
ARRIVED, LOST = (0, 158, 115), (213, 94, 0)  # safe for colour-blind readers
FLAGGED = (204, 121, 167)
DASH_PX = 7
COLOURS = 48  # of a GIF
MOST_GIF_FPS = 50  # viewers take a single hundredth of a second for ten


class Pictures:
    """It draws the pictures of an animation when asked for them.

    Args:
        films: one per method, of the same devices and steps.
        link, kind, camera: the radio, the plant, and what looks at it.
        every: control steps between pictures.
    """

    def __init__(
        self, films: Sequence[Film], link: Link, kind: System, camera: Camera, every: int
    ) -> None:
        self.films, self.link, self.kind = films, link, kind
        self.every = every
        self.steps = list(range(0, len(link.delivered), every))
        self._camera = camera
        self.devices = link.delivered.shape[1]
        self._legend = "dashed: what the controller believes; bar: packet arrived"
        self._legend += "; tick: lost" * link.sends_always + link.late.replace(",", ";", 1)
        if any(shot.flagged is not None and shot.flagged.any() for shot in films):
            self._legend += "; pink: unfamiliar"
        self.size_px = size_px(self.devices, len(films), self._legend)

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[Image.Image]:
        return map(self.draw, self.steps)

    def draw(self, k: int) -> Image.Image:
        """Draw the picture of control step ``k``."""
        picture = Image.new("RGB", self.size_px, PAPER)
        draw = ImageDraw.Draw(picture)
        clock = f"t = {1e3 * k * self.kind.step_s:.0f} ms   {self.link.label}"
        draw.text((MARGIN_PX, 3), clock, FAINT, TEXT)
        draw.text((MARGIN_PX, 19), self._legend, FAINT, TEXT)
        for row, shot in enumerate(self.films):
            top = HEADER_PX + MARGIN_PX + row * (PANEL_PX[1] + TITLE_PX + MARGIN_PX)
            score = shot.score[: k + 1].mean()
            draw.text((MARGIN_PX, top), shot.method, INK, NAME)
            said = f"{score:.0%} of the time inside the band"
            draw.text((MARGIN_PX + NAME.getlength(shot.method) + 16, top + 2), said, FAINT, TEXT)
            for device in range(self.devices):
                left = MARGIN_PX + device * (PANEL_PX[0] + MARGIN_PX)
                picture.paste(self._panel(shot, device, k), (left, top + TITLE_PX))
        return picture

    def frame(self, shot: Film, device: int, k: int) -> Pixels:
        """Return what the camera sees, uint8 [64, 128, 3]."""
        (frame,) = self._camera.render(shot.states[k, device][None])
        return frame

    def age(self, device: int, k: int) -> str:
        """Say how long ago the newest packet was sent that the controller has of a device."""
        steps = self.link.age_steps[k, device]
        return "no packet" if steps < 0 else f"packet {1e3 * steps * self.kind.step_s:.0f} ms old"

    def sketch(self, shot: Film, device: int, k: int) -> list[Floats]:
        """Return the believed state as lines over a frame, in its pixels."""
        return self._camera.sketch_px(shot.believed[k, device])

    def error(self, shot: Film, device: int, k: int) -> str:
        """Say how far off the belief is in the first angle, else in the first state."""
        names, units = self.kind.state_names, self.kind.state_units
        which = units.index("rad") if "rad" in units else 0
        error = shot.believed[k, device, which] - shot.states[k, device, which]
        if units[which] == "rad":
            return f"{names[which]} off by {np.degrees(error):+.1f}°"
        return f"{names[which]} off by {error:+.2g} {units[which]}"

    def _panel(self, shot: Film, device: int, k: int) -> Image.Image:
        panel = Image.new("RGB", PANEL_PX, PAPER)
        draw = ImageDraw.Draw(panel)
        age, snr_db = self.age(device, k), self.link.snr_db[k, device]
        caption = f"device {device}   {age}   SNR {snr_db:.0f} dB"
        draw.text((0, 0), caption, INK, TEXT)
        scene = Image.fromarray(self.frame(shot, device, k))
        scene = scene.resize((WIDTH_PX * SCALE, HEIGHT_PX * SCALE), Image.Resampling.BOX)
        self._draw_belief(ImageDraw.Draw(scene), self.sketch(shot, device, k))
        panel.paste(scene, (0, 16))
        self._draw_slots(draw, shot, device, k, 16 + HEIGHT_PX * SCALE + 2, PANEL_PX[1] - 1)
        return panel

    def _draw_belief(self, draw: ImageDraw.ImageDraw, sketch: list[Floats]) -> None:
        """Draw the axis of the believed state as a dashed line, the rest of it as an outline."""
        (start, end), *outlines = (line * SCALE for line in sketch)
        for line in outlines:
            draw.line([tuple(point) for point in line], fill=(0, 0, 0))
        way = end - start
        dashes = max(int(np.hypot(*way) / DASH_PX), 1)
        for dash in range(dashes):  # black shows on the paper, white on the pole
            ends = (start + way * dash / dashes, start + way * (dash + 1) / dashes)
            colour = (0, 0, 0) if dash % 2 == 0 else (255, 255, 255)
            draw.line([tuple(end) for end in ends], fill=colour, width=3)

    def _draw_slots(
        self, draw: ImageDraw.ImageDraw, shot: Film, device: int, k: int, top: int, bottom: int
    ) -> None:
        """Draw the last slots, one column each, the newest at the right."""
        draw.rectangle([0, top, PANEL_PX[0] - 1, bottom], fill=(228, 228, 228))
        first = max(k + 1 - PANEL_PX[0], 0)
        for slot, arrived in enumerate(self.link.delivered[first : k + 1, device], start=first):
            column = PANEL_PX[0] - 1 - (k - slot)
            if arrived:
                strange = shot.flagged is not None and shot.flagged[slot, device]
                colour = FLAGGED if strange else ARRIVED
                draw.rectangle([column - 1, top, column, bottom], fill=colour)
            elif self.link.sends_always:
                draw.line([(column, bottom - 2), (column, bottom)], fill=LOST)


def size_px(devices: int, methods: int, legend: str = "") -> tuple[int, int]:
    """Return width and height of a picture: even numbers, as MP4 wants."""
    panels, words = devices * (PANEL_PX[0] + MARGIN_PX), int(TEXT.getlength(legend)) + MARGIN_PX
    width = max(panels + MARGIN_PX, LEAST_WIDTH_PX, words + MARGIN_PX)
    height = methods * (PANEL_PX[1] + TITLE_PX + MARGIN_PX) + MARGIN_PX + HEADER_PX
    return width + width % 2, height + height % 2


def check_target(path: Path, fps: int, devices: int, methods: int) -> None:
    """Raise UsageError or MissingInputError for a file that we could not write, in good time."""
    if path.suffix not in FORMATS:
        raise UsageError(f"no animation format '{path.suffix}'; --out FILE.gif or FILE.mp4")
    most = MOST_PX[path.suffix]
    for what, count, across in (("devices", devices, 0), ("methods", methods, 1)):
        if size_px(devices, methods)[across] > most:
            fitting = max(n for n in range(count) if size_px(n, n)[across] <= most)
            raise UsageError(
                f"{count} {what}: a {path.suffix[1:].upper()} has room for {fitting}",
                hint=f"--{what} with at most {fitting}; eval measures any number",
            )
    if path.suffix == ".gif" and fps > MOST_GIF_FPS:
        raise UsageError(
            f"--fps {fps}: a GIF holds at most {MOST_GIF_FPS} pictures per second",
            hint=f"--fps {MOST_GIF_FPS}, or --out FILE.mp4",
        )
    if path.suffix == ".mp4":
        require("imageio_ffmpeg", "MP4 needs imageio-ffmpeg", "video", ", or --out FILE.gif")


def true_fps(path: Path, fps: int) -> float:
    """Return how many pictures per second the file holds."""
    return 1000 / _gif_ms(fps) if path.suffix == ".gif" else fps


def write(pictures: Pictures, path: Path, fps: int, tick: Callable[[], None]) -> None:
    """Write .gif or .mp4, atomically. Raises StorageError."""
    encode = _gif if path.suffix == ".gif" else _mp4
    files.write_bytes(path, encode(pictures, fps, tick))


def _gif(pictures: Pictures, fps: int, tick: Callable[[], None]) -> bytes:
    palette = _palette(pictures.draw(pictures.steps[-1]))  # one for all: no flicker
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


def _palette(picture: Image.Image) -> Image.Image:
    """Return the commonest colours of a picture, and those of the strips however rare."""
    kept = (*ARRIVED, *LOST, *FLAGGED)
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
