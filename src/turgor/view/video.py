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
from turgor.recording import Recording
from turgor.view.draw import Painter, checked_size

# Beside the preset: what costs much time and saves little space on drawings (measured: half the time of
# "veryfast" alone, 1.5 times its size).
X264 = {"crf": "20", "preset": "veryfast", "x264-params": "ref=1:bframes=0:subme=1:weightp=0"}
VP9 = {"crf": "32", "b": "0", "deadline": "realtime", "cpu-used": "7"}
# suffix: encoder, its options, the container's options
FORMATS: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    ".mp4": ("libx264", X264, {"movflags": "+faststart"}),
    ".webm": ("libvpx-vp9", VP9, {}),
}
PIXELS = "bgr0" if sys.byteorder == "little" else "0rgb"  # how a 32-bit surface lies in memory
BT709 = 1  # the number of this standard's colours in H.264 and VP9: what players expect of HD video
LIMITED_RANGE = 1  # brightness from 16 to 235


def write_video(
    recording: Recording,
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] = (1280, 720),
    fps: float = 60,
    start: float = 0.0,
    stop: float | None = None,
    title: str = "",
    pressure_range: tuple[float, float] | None = None,
    crf: int | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Path:
    """Path of the video of `recording` from `start` to `stop` [s], both included; None: to the end.

    The suffix chooses the format: .mp4 (H.264) or .webm (VP9). A frame shows the step nearest to its time: at
    60 frames/s and dt = 1/60 s, one frame a step. `crf` is the encoder's constant rate factor: the higher, the smaller
    the file and the coarser the picture (None: 20 for H.264, 32 for VP9). `progress(done, total)` is called after
    each frame.
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
    steps = frame_steps(recording, fps, start, stop)
    painter = Painter(recording, size, title, pressure_range=pressure_range)
    # av knows the format by the suffix
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        _encode(painter, steps, partial, fps, crf, progress)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
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
    from av.video.reformatter import Colorspace

    codec, options, container_options = FORMATS[path.suffix.lower()]
    if crf is not None:
        options = {**options, "crf": str(crf)}
    rate = Fraction(fps).limit_denominator(1001)
    pictures = [av.VideoFrame(*painter.size, PIXELS) for _ in range(2)]
    with av.open(str(path), "w", options=container_options) as container:
        stream = _stream(container, codec, options, painter.size, rate)

        def encode(picture: Any, k: int) -> None:
            frame = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            frame.pts, frame.time_base = k, 1 / rate
            container.mux(stream.encode(frame))

        with ThreadPoolExecutor(1) as encoder:
            before = encoder.submit(int)  # nothing yet
            for k, step in enumerate(steps):
                picture = pictures[k % 2]
                _copy(painter.surface(step), picture)
                before.result()
                before = encoder.submit(encode, picture, k)
                if progress is not None:
                    progress(k + 1, len(steps))
            before.result()
        container.mux(stream.encode(None))


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
