"""Videos: the frames of a `Recording`, encoded in process."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from turgor.errors import InvalidInput, describe, one_of
from turgor.files import whole
from turgor.recording import Recording
from turgor.view.colours import BT709, LIMITED_RANGE, put_planes, rgb, ycbcr
from turgor.view.draw import Painter, checked_size

# Without a look ahead and without motion of less than a pixel: as true to the drawing as "veryfast" at 20, and truer
# in the sky, for two thirds of its time and 1.4 times its size (ARCHITECTURE.md, Speed).
X264 = {
    "crf": "24",
    "preset": "superfast",
    "x264-params": "ref=1:bframes=0:weightp=0:subme=0:8x8dct=0:rc-lookahead=0:sync-lookahead=0:mbtree=0:scenecut=0",
}
VP9 = {"crf": "32", "b": "0", "deadline": "realtime", "cpu-used": "7"}
# suffix: encoder, its options, the container's options
FORMATS: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    ".mp4": ("libx264", X264, {"movflags": "+faststart"}),
    ".webm": ("libvpx-vp9", VP9, {}),
    ".gif": ("gif", {}, {}),
}
GIF_SAMPLES = 40  # frames that a GIF's 256 colours are chosen from
PIXELS = "bgr0" if sys.byteorder == "little" else "0rgb"  # how a 32-bit surface lies in memory


def write_video(
    recording: Recording,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] = (1280, 720),
    fps: float | None = None,
    start: float = 0.0,
    stop: float | None = None,
    title: str = "",
    pressure_range: tuple[float, float] | None = None,
    crf: int | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Path of the video of `recording` from `start` to `stop` [s], both included; None: to the end.

    The suffix chooses the format: .mp4 (H.264), .webm (VP9) or .gif (256 colours, played again and again). A frame
    shows the step nearest to its time: at 60 frames/s and dt = 1/60 s, one frame a step. `fps` None: 60, of a GIF 25;
    a GIF tells times in 1/100 s, and players slow down more than 50 frames/s. `crf` is the encoder's constant rate
    factor: the higher, the smaller the file and the coarser the picture (None: 24 for H.264, 32 for VP9).
    `progress(done, total)` is called after each frame.
    The file appears under its name once it is whole. Raises `InvalidInput`.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise one_of("format of the video", FORMATS, path.suffix)
    if not path.parent.is_dir():
        raise InvalidInput("path: expected a file in a folder that exists", describe(path))
    if any(n % 2 for n in checked_size(size)):
        raise InvalidInput("size: expected an even width and height for video", describe(size))
    if crf is not None and not (isinstance(crf, int) and 0 <= crf <= 51):
        raise InvalidInput("crf: expected a whole number from 0 to 51", describe(crf))
    gif = path.suffix.lower() == ".gif"
    fps = (25 if gif else 60) if fps is None else fps
    steps = frame_steps(recording, fps, start, stop)
    if gif and fps > 50:
        raise InvalidInput("fps: expected at most 50 frames/s for a GIF", describe(fps))
    painter = Painter(recording, size, title, pressure_range=pressure_range, colours=rgb if gif else ycbcr)
    with whole(path) as partial:  # with the suffix of `path`: av knows the format by it
        if gif:
            _encode_gif(painter, steps, partial, fps, progress)
        else:
            _encode(painter, steps, partial, fps, crf, progress)
    return path


def frame_steps(recording: Recording, fps: float, start: float, stop: float | None) -> list[int]:
    """The step that each frame shows, from `start` to `stop` [s]."""
    duration = recording.steps * recording.dt
    if not (isinstance(fps, int | float | Fraction) and math.isfinite(fps) and 1 <= fps <= 1000):
        raise InvalidInput("fps: expected 1 to 1000 frames/s", describe(fps))
    stop = duration if stop is None else stop
    slack = 0.5 * recording.dt
    if not 0 <= start <= stop <= duration + slack:
        raise InvalidInput(f"start, stop: expected 0 <= start <= stop <= {duration:g} s", f"{start} and {stop}")
    count = math.floor((stop - start) * float(fps) + 1e-6) + 1
    times = start + np.arange(count) / float(fps)
    return np.minimum(np.rint(times / recording.dt), recording.steps).astype(int).tolist()


def _encode(
    painter: Painter,
    steps: list[int],
    path: Path,
    fps: float,
    crf: int | None,
    progress: Callable[[int, int], object] | None,
) -> None:
    """Draws in this thread while another encodes the picture before."""
    import av

    codec, options, container_options = FORMATS[path.suffix.lower()]
    if crf is not None:
        options = {**options, "crf": str(crf)}
    rate = Fraction(fps).limit_denominator(1001)
    pictures = [av.VideoFrame(*painter.size, "yuv420p") for _ in range(2)]
    with av.open(str(path), "w", options=container_options) as container:
        stream = _stream(container, codec, options, painter.size, rate)

        def encode(picture: Any, k: int) -> None:
            picture.pts, picture.time_base = k, 1 / rate
            container.mux(stream.encode(picture))

        with ThreadPoolExecutor(1) as encoder:
            before = encoder.submit(int)  # nothing yet
            for k, step in enumerate(steps):
                picture = pictures[k % 2]
                picture.make_writable()  # a copy, should the encoder still read it
                put_planes(painter.surface(step), *map(_plane, picture.planes))
                before.result()
                before = encoder.submit(encode, picture, k)
                if progress is not None:
                    progress(k + 1, len(steps))
            before.result()
        container.mux(stream.encode(None))


def _encode_gif(
    painter: Painter, steps: list[int], path: Path, fps: float, progress: Callable[[int, int], object] | None
) -> None:
    """Chooses the colours from some of the frames, then draws them all: what is in memory does not grow with them."""
    import av
    import av.filter

    def picture(step: int, k: int = 0) -> Any:
        frame = av.VideoFrame(*painter.size, PIXELS)
        _copy(painter.surface(step), frame)
        frame.pts, frame.time_base = k, Fraction(1, 100)
        return frame

    first = picture(steps[0])
    choose = av.filter.Graph()
    choose.link_nodes(
        choose.add_buffer(width=first.width, height=first.height, format=first.format, time_base=Fraction(1, 100)),
        choose.add("palettegen", "reserve_transparent=0"),
        choose.add("buffersink"),
    ).configure()
    for step in steps[:: -(-len(steps) // GIF_SAMPLES)]:
        choose.push(picture(step))
    choose.push(None)
    palette: Any = choose.pull()
    palette.time_base = Fraction(1, 100)

    paint = av.filter.Graph()
    frames, colours = (
        paint.add_buffer(width=f.width, height=f.height, format=f.format, time_base=Fraction(1, 100))
        for f in (first, palette)
    )
    # no dithering: flat colours stay flat, and small
    use, sink = paint.add("paletteuse", "dither=none:diff_mode=rectangle"), paint.add("buffersink")
    frames.link_to(use, 0, 0)
    colours.link_to(use, 0, 1)
    use.link_to(sink)
    paint.configure()
    colours.push(palette)
    colours.push(None)

    with av.open(str(path), "w") as container:
        stream = container.add_stream("gif", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = *painter.size, "pal8"
        stream.codec_context.time_base = Fraction(1, 100)
        for k, step in enumerate(steps):
            frames.push(picture(step, round(100 * k / fps)))
            _drain(paint, stream, container)
            if progress is not None:
                progress(k + 1, len(steps))
        frames.push(None)
        _drain(paint, stream, container)
        container.mux(stream.encode(None))


def _drain(graph: Any, stream: Any, container: Any) -> None:
    import av

    while True:
        try:
            container.mux(stream.encode(graph.pull()))
        except (av.BlockingIOError, av.EOFError):
            return


def _stream(container: Any, codec: str, options: dict[str, str], size: tuple[int, int], rate: Fraction) -> Any:
    stream = container.add_stream(codec, rate=rate, options=options)
    stream.width, stream.height = size
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.time_base = 1 / rate
    context.thread_type = "AUTO"  # whole frames side by side
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED_RANGE
    return stream


def _plane(plane: Any) -> np.ndarray:
    """The plane's numbers to read and write, uint8 [height, width]."""
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]


def _copy(surface: Any, picture: Any) -> None:
    """Puts the surface's pixels into the picture, line by line where their lines differ in length."""
    plane = picture.planes[0]
    width, height = surface.get_size()
    if plane.line_size == surface.get_pitch() == 4 * width:
        plane.update(surface.get_buffer())
        return
    lines = np.zeros((height, plane.line_size), np.uint8)
    source = np.frombuffer(surface.get_buffer(), np.uint8).reshape(height, -1)
    lines[:, : 4 * width] = source[:, : 4 * width]
    plane.update(lines)
