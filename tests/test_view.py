"""Frames, videos and figures, from made-up recordings: no simulator, no display."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pygame
import pytest

from turgor import body as bodies
from turgor import scene as scenes
from turgor.body import GAS_CONSTANT, Body
from turgor.errors import InvalidInput
from turgor.recording import Recording
from turgor.scene import Scene, highest_ground
from turgor.view import scenery
from turgor.view.colours import put_planes, ycbcr
from turgor.view.draw import Painter, draw_frame
from turgor.view.figures import fitness_figure
from turgor.view.shapes import PRESSURE_MAP, SOLID, STRAIN_MAP, closed_loops, span, wall_shapes
from turgor.view.video import frame_steps, write_video


def rolling(
    body: Body = bodies.SMALL,
    scene: Scene | None = None,
    *,
    seconds: float = 4.0,
    dt: float = 1 / 60,
    speed: float = 2.5,
    bounce: float = 1.0,
) -> Recording:
    """A recording of a ring that rolls, breathes and hops over the ground: made up, not simulated."""
    scene = scenes.hills(0) if scene is None else scene
    time = np.arange(round(seconds / dt) + 1) * dt  # [s]
    x = speed * time
    r = body.radius * (0.95 + 0.08 * np.sin(2 * np.pi * time / 1.7))
    ground = np.array([highest_ground(scene, a - 1, a + 1) for a in x])
    y = ground + r + 0.5 + bounce * np.abs(np.sin(np.pi * time / 1.3))
    turn = np.arctan2(body.position[:, 1], body.position[:, 0]) - x[:, None] / body.radius
    wobble = 1 + 0.06 * np.sin(3 * turn + 2 * time[:, None])
    squash = 0.1 * np.cos(2 * np.pi * time / 1.3)[:, None]
    position = np.stack(
        [
            x[:, None] + (1 + squash) * r[:, None] * wobble * np.cos(turn),
            y[:, None] + (1 - squash) * r[:, None] * wobble * np.sin(turn),
        ],
        axis=-1,
    )
    full = body.gas_amount.sum() * GAS_CONSTANT * 288.15 / (np.pi * body.radius**2)  # [Pa]
    pressure = full * (0.7 + 0.45 * np.sin(2 * np.pi * time / 3.1))
    lowest = position[..., 1] < ground[:, None] + 0.9
    return Recording(
        body=body,
        scene=scene,
        dt=dt,
        position=position.astype(np.float32),
        velocity=np.gradient(position, dt, axis=0),
        pressure=np.repeat(pressure[:, None], body.chamber_count, axis=1),
        rest_length=np.broadcast_to(body.rest_length, (len(time), body.spring_count)),
        touch=lowest,
    )


def changed(recording: Recording, **fields: object) -> Recording:
    """The recording with other fields."""
    names = recording.__struct_fields__
    return Recording(**({name: getattr(recording, name) for name in names} | fields))


CAGE = scenes.cage(width=15, roof=11, aperture=3.67)
SMALL_FRAME = (320, 180)


def colour_at(painter: Painter, step: int, point: np.ndarray) -> np.ndarray:
    """The frame's colour at a point of the world [m]."""
    x, y = painter.camera.pixels(step, np.asarray(point)).astype(int)
    return painter.frame(step)[y, x]


def assert_colour(got: np.ndarray, expected: tuple[int, ...]) -> None:
    np.testing.assert_allclose(got.astype(int), expected, atol=3)  # smoothing rounds


# --- frames ---


@pytest.mark.parametrize("size", [(1280, 720), (640, 360), (333, 201), (120, 400)])
def test_frame_has_the_size_asked_for(size: tuple[int, int]) -> None:
    frame = draw_frame(rolling(seconds=0.5), 3, size, "a title")
    assert frame.shape == (size[1], size[0], 3)
    assert frame.dtype == np.uint8
    assert frame.flags.writeable


def test_frames_change_from_step_to_step_and_are_reproducible() -> None:
    recording = rolling(seconds=1)
    painter = Painter(recording, SMALL_FRAME)
    first, later = painter.frame(10), painter.frame(11)
    assert (first != later).any()
    np.testing.assert_array_equal(first, painter.frame(10))
    np.testing.assert_array_equal(first, draw_frame(recording, 10, SMALL_FRAME))


@pytest.mark.parametrize("body", [bodies.SMALL, bodies.LARGE], ids=["small", "large"])
@pytest.mark.parametrize("scene", [scenes.hills(0), scenes.flat(), CAGE], ids=["hills", "flat", "cage"])
def test_camera_keeps_the_body_in_the_frame(body: Body, scene: Scene) -> None:
    recording = rolling(body, scene, seconds=10, speed=12.0, bounce=6.0)
    painter = Painter(recording)
    for step in range(0, recording.steps, 17):
        pixels = painter.camera.pixels(step, recording.position[step])
        assert (pixels > 0).all()
        assert (pixels < painter.size).all()


def test_camera_does_not_jitter() -> None:
    recording = rolling(seconds=10)
    noise = np.random.default_rng(0).normal(0, 0.05, recording.position.shape[:1])[:, None, None]
    camera = Painter(changed(recording, position=recording.position + noise), SMALL_FRAME).camera
    jump = np.diff(camera.centre, n=2, axis=0)  # [m], change of the move per step
    assert np.abs(jump).max() < 0.01


def test_body_fills_a_third_of_the_height() -> None:
    for body in (bodies.SMALL, bodies.LARGE):
        camera = Painter(rolling(body, seconds=0.1)).camera
        assert 2 * body.radius * camera.scale == pytest.approx(720 / 3, rel=0.15)
        assert camera.spacing == 10


def test_gas_takes_the_colour_of_its_pressure() -> None:
    recording = rolling(seconds=1, scene=scenes.flat())
    away = recording.com[30] + [-0.0, 2.5]  # [m], in the gas, off the centre and the trail
    for share, expected in ((0.0, PRESSURE_MAP[0]), (0.5, PRESSURE_MAP[2]), (1.0, PRESSURE_MAP[-1])):
        pressure = np.full_like(recording.pressure, 1e4 + 3e4 * share)
        painter = Painter(changed(recording, pressure=pressure), pressure_range=(1e4, 4e4))
        assert_colour(colour_at(painter, 30, away), expected)


def test_springs_take_the_colour_of_their_strain() -> None:
    rest = rolling(seconds=0.1, scene=scenes.flat())
    for stretch, expected in ((0.7, STRAIN_MAP[0]), (1.0, STRAIN_MAP[2]), (1.3, STRAIN_MAP[-1])):
        position = np.tile(stretch * rest.body.position + [0, 10], (rest.steps + 1, 1, 1))
        painter = Painter(changed(rest, position=position))
        middle = position[0, [0, 1]].mean(axis=0)
        assert_colour(colour_at(painter, 0, middle), expected)


def test_touching_masses_look_different() -> None:
    recording = rolling(seconds=0.1)
    touch = np.zeros_like(recording.touch)
    apart = Painter(changed(recording, touch=touch))
    together = Painter(changed(recording, touch=~touch))
    place = recording.position[2, 4]
    assert colour_at(together, 2, place).sum() < colour_at(apart, 2, place).sum()


def test_ground_is_filled_and_sky_is_not() -> None:
    painter = Painter(rolling(seconds=0.1))
    for x in (-15.0, 3.3, 17.7):
        height = highest_ground(painter.recording.scene, x, x)
        assert_colour(colour_at(painter, 0, [x, height - 3.5]), SOLID)
        assert colour_at(painter, 0, [x, height + 0.5]).min() > 150
    assert_colour(colour_at(painter, 0, [-22.0, 5.0]), SOLID)  # behind the wall


def test_cage_is_solid_and_open_inside() -> None:
    painter = Painter(rolling(scene=CAGE, seconds=0.1, bounce=0))
    for solid in ([-8.0, 8.0], [8.0, 8.0], [0.0, 11.5]):
        assert_colour(colour_at(painter, 0, solid), SOLID)
    for free in ([-8.0, 2.0], [8.0, 2.0], [-6.5, 10.0], [0.0, 13.0]):
        assert colour_at(painter, 0, free).min() > 150


def test_walls_are_blocks_or_lines() -> None:
    walls = CAGE.segments[CAGE.depth == 0]
    assert [sorted(loop) for loop in closed_loops(walls)] == [list(range(8))]
    lines = wall_shapes(Scene([[0, 0, 0, 5], [3, 0, 3, 5]]))  # the free side is on the right: x > 0, x > 3
    solid = [corners[:, 0] for colour, corners in lines if colour == SOLID]
    assert solid[0].max() == 0
    assert (solid[1].min(), solid[1].max()) == (2, 3)


@pytest.mark.parametrize("scene", [Scene(np.zeros((0, 4))), scenes.flat().two_sided(), CAGE.two_sided()])
def test_other_scenes_and_bodies_can_be_drawn(scene: Scene) -> None:
    single = Body(position=[[0.0, 0.0]])
    steps = 3
    recording = Recording(
        body=single,
        scene=scene,
        dt=0.1,
        position=np.zeros((steps, 1, 2)),
        velocity=np.zeros((steps, 1, 2)),
        pressure=np.zeros((steps, 0)),
        rest_length=np.zeros((steps, 0)),
        touch=np.zeros((steps, 1), dtype=bool),
    )
    assert draw_frame(recording, 2).shape == (720, 1280, 3)
    assert draw_frame(rolling(scene=scene, seconds=0.1), 1).shape == (720, 1280, 3)


def test_constant_pressure_has_a_range() -> None:
    low, high = span(np.full((5, 1), 3e4))
    assert low < 3e4 < high
    assert span(np.zeros((5, 1))) == (-0.5, 0.5)


def test_what_cannot_be_drawn_is_refused() -> None:
    recording = rolling(seconds=0.1)
    for size in ((10, 10), (640.5, 360), 640, (640, 360, 3), ("a", "b"), (100, 10_000)):
        with pytest.raises(InvalidInput, match="size: expected"):
            draw_frame(recording, 0, size)
    for step in (-1, recording.steps + 1):
        with pytest.raises(InvalidInput, match="step: expected 0 to 6"):
            draw_frame(recording, step)
    position = recording.position.copy()
    position[3, 2] = np.nan
    with pytest.raises(InvalidInput, match="finite"):
        draw_frame(changed(recording, position=position), 0)


def test_drawing_needs_no_display_and_starts_none() -> None:
    code = (
        "import sys, turgor.view, turgor.view.draw, turgor.view.video, turgor.view.figures\n"
        "assert not {'pygame', 'av', 'matplotlib'} & set(sys.modules)\n"
        "sys.path.insert(0, sys.argv[1])\n"
        "from test_view import draw_frame, rolling\n"
        "draw_frame(rolling(seconds=0.1), 0)\n"
        "import pygame\n"
        "assert not pygame.display.get_init()\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(Path(__file__).parent)],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# --- what frames share ---


@pytest.mark.parametrize("scene", [scenes.hills(0), CAGE], ids=["hills", "cage"])
def test_scenery_moves_with_the_camera_and_keeps_its_looks(scene: Scene) -> None:
    """Moved by whole pixels, the world is the same picture, moved: no part of it shivers."""
    recording = rolling(scene=scene, seconds=0.1)
    painter = Painter(recording)
    surface, seen = pygame.Surface(painter.size, 0, 32), []
    for move in ((0, 0), (7, 4), (0, 0)):
        painter.camera.centre[1] = painter.camera.centre[0] + np.array(move) / painter.camera.scale
        surface.fill((0, 0, 255))
        painter._scenery.draw(surface, 1)
        seen.append(pygame.surfarray.array3d(surface))
    np.testing.assert_array_equal(seen[0], seen[2])
    np.testing.assert_array_equal(seen[1][:-7, 4:], seen[0][7:, :-4])


def test_scenery_far_away_is_drawn_as_if_it_came_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenery, "MOST_TILES", 10)
    recording = rolling(seconds=2, speed=40)
    painter = Painter(recording, SMALL_FRAME)
    for step in range(recording.steps):
        painter.surface(step)
    assert len(painter._scenery._tiles) <= 10 + 2 * 5
    for step in (recording.steps, 0):
        np.testing.assert_array_equal(painter.frame(step), draw_frame(recording, step, SMALL_FRAME))


@pytest.mark.parametrize("size", [(640, 360), (322, 182)])
def test_colours_of_videos_are_those_of_frames(size: tuple[int, int]) -> None:
    """A picture drawn in Cr, Y, Cb is the picture drawn in RGB and converted (BT.709), up to rounding."""
    recording = rolling(seconds=1)
    width, height = size
    luma, cb, cr = (np.empty((height // n, width // n), np.uint8) for n in (1, 2, 2))
    put_planes(Painter(recording, size, "a title", colours=ycbcr).surface(40), luma, cb, cr)
    red, green, blue = np.moveaxis(draw_frame(recording, 40, size, "a title") / 255, -1, 0)
    bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    np.testing.assert_allclose(luma, 16 + 219 * bright, atol=3)
    for plane, colour, reach in ((cb, blue, 1.8556), (cr, red, 1.5748)):
        difference = (colour - bright) / reach
        mean = difference.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(plane, 128 + 224 * mean, atol=3)


# --- videos ---


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "h264"), (".webm", "vp9")])
def test_video_has_a_frame_a_step(tmp_path: Path, suffix: str, codec: str) -> None:
    recording, told = rolling(seconds=0.5), []
    path = write_video(
        recording,
        tmp_path / f"video{suffix}",
        size=SMALL_FRAME,
        title="a title",
        progress=lambda done, total: told.append((done, total)),
    )
    assert [p.name for p in tmp_path.iterdir()] == [f"video{suffix}"]
    assert told == [(k + 1, 31) for k in range(31)]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name.endswith(codec) or codec in stream.codec_context.name
        assert stream.average_rate == 60
        frames = list(container.decode(stream))
    assert len(frames) == 31
    assert (frames[0].width, frames[0].height) == SMALL_FRAME
    expected = draw_frame(recording, 20, SMALL_FRAME, "a title").astype(int)
    assert np.abs(frames[20].to_ndarray(format="rgb24") - expected).mean() < 6


def test_video_of_a_width_that_is_padded_in_memory(tmp_path: Path) -> None:
    recording = rolling(seconds=0.1)
    path = write_video(recording, tmp_path / "video.mp4", size=(322, 182))
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    expected = draw_frame(recording, 0, (322, 182)).astype(int)
    assert np.abs(frame.to_ndarray(format="rgb24") - expected).mean() < 6


def test_gif_has_25_frames_a_second_and_plays_again(tmp_path: Path) -> None:
    recording = rolling(seconds=1)
    path = write_video(recording, tmp_path / "video.gif", size=SMALL_FRAME, start=0.2)
    assert path.read_bytes()[:6] == b"GIF89a"
    assert b"NETSCAPE2.0" in path.read_bytes()  # again and again
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    assert [frame.pts for frame in frames] == list(range(0, 84, 4))  # [1/100 s]
    expected = draw_frame(recording, 12 + 24, SMALL_FRAME).astype(int)
    assert np.abs(frames[10].to_ndarray(format="rgb24") - expected).mean() < 6


def test_frames_show_the_nearest_step() -> None:
    recording = rolling(seconds=1)
    assert frame_steps(recording, 60, 0.0, None) == list(range(61))
    assert frame_steps(recording, 30, 0.0, None) == list(range(0, 61, 2))
    assert frame_steps(recording, 60, 0.5, 0.6) == list(range(30, 37))
    assert frame_steps(changed(recording, dt=1 / 30), 60, 0.0, 0.1) == [0, 0, 1, 2, 2, 2, 3]
    assert frame_steps(recording, 60, 1.0, 1.0) == [60]


def test_videos_that_cannot_be_made_are_refused(tmp_path: Path) -> None:
    recording, path = rolling(seconds=0.5), tmp_path / "video.mp4"
    cases = (
        (path.with_suffix(".avi"), {}, r"expected one of \.mp4, \.webm, \.gif"),
        (path.with_suffix(".gif"), {"fps": 60}, "fps: expected at most 50"),
        (path, {"size": (321, 180)}, "even width and height"),
        (path, {"fps": 0}, "fps: expected"),
        (path, {"fps": float("nan")}, "fps: expected"),
        (path, {"start": 0.4, "stop": 0.3}, "start <= stop"),
        (path, {"stop": 3.0}, "start <= stop <= 0.5 s"),
        (tmp_path / "nowhere" / "video.mp4", {}, "folder that exists"),
    )
    for where, settings, message in cases:
        with pytest.raises(InvalidInput, match=message):
            write_video(recording, where, **({"size": SMALL_FRAME} | settings))
    assert not list(tmp_path.iterdir())


def test_broken_off_video_leaves_nothing_and_keeps_the_old(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"old")

    def stop(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(rolling(seconds=0.5), path, size=SMALL_FRAME, progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["video.mp4"]
    assert path.read_bytes() == b"old"


# --- figures ---


@pytest.mark.parametrize("generations", [1, 40])
def test_fitness_figure(tmp_path: Path, generations: int) -> None:
    k = np.arange(generations)
    history = {"evaluations": 40 * (k + 1), "best": np.sqrt(k), "median": np.sqrt(k) - 1, "sigma": 0.9**k}
    path = fitness_figure(history, tmp_path / "fitness.png", title="hilly, small, pressure")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir()] == ["fitness.png"]


def test_fitness_figure_names_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no median, sigma"):
        fitness_figure({"evaluations": [1], "best": [1]}, tmp_path / "fitness.png")
    columns = {"evaluations": [1, 2], "best": [1], "median": [1], "sigma": [1]}
    with pytest.raises(InvalidInput, match="one number a generation"):
        fitness_figure(columns, tmp_path / "fitness.png")
