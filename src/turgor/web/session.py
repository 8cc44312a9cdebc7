"""A session: one agent that is driven by hand, and the messages that say how.

It knows neither sockets nor clocks, so that the same messages between the same steps give the same bits. A frame is,
little-endian: float32 t [s], pressure [Pa], area / (pi r^2), x, y of each mass [m]; uint8 touch of each mass.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from turgor.control import output_count
from turgor.errors import InvalidInput, describe
from turgor.scene import LARGEST_COORDINATE
from turgor.simulate import Simulator
from turgor.task import Leave, Task, make_task

CROSSING = 0.5  # [s], from p_min to p_max
HAND_FREQUENCY, HAND_DAMPING = 1.5, 1.0  # [Hz], [1], of the spring between the pointer and a whole body on it
HAND_STRENGTH = 40.0  # [m/s^2], of a whole body: four times its weight on Earth
DEEPEST = 60.0  # [m] below the lowest ground: an agent there has left the world
LARGEST_GRAVITY, LARGEST_SPRING = 30.0, 30.0  # [m/s^2], [Hz]
LARGEST_WAVE, LARGEST_LENGTH = 4.0, 5.0  # [Hz], [1]
LARGEST_MESSAGE = 4096  # characters


# --- messages -----------------------------------------------------------------------------------------------------


class Message(msgspec.Struct, frozen=True, tag_field="type", tag=str.lower, forbid_unknown_fields=True):
    """What a browser says. Numbers beyond what is possible are cut."""


class Start(Message, frozen=True):
    """A new agent on a new scene."""

    task: Literal["flat", "hilly", "escape"] = "hilly"
    body: Literal["small", "medium", "large"] = "small"
    seed: int = 0  # of the terrain
    gravity: float = 10.0  # [m/s^2]
    frequency: float = 8.0  # [Hz], of the springs


class Wave(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contractions that run around the ring: spring j is told a sin(2 pi (f t - d l j / n))."""

    amplitude: float = 0.0  # a [1]
    frequency: float = 1.0  # f [Hz]
    length: float = 1.0  # l, waves around the ring [1]
    direction: Literal[1, -1] = 1  # d, 1: counter-clockwise


class Control(Message, frozen=True):
    """What the agent is to do from now on."""

    pressure: float  # share of the way from p_min to p_max
    wave: Wave = Wave()


class Drag(Message, frozen=True):
    """A hand that pulls a mass towards a place."""

    mass: int
    x: float  # [m]
    y: float  # [m]


class Drop(Message, frozen=True):
    """The hand lets go."""


class Pause(Message, frozen=True):
    on: bool


class Reset(Message, frozen=True):
    """Back to the start."""


class Seen(Message, frozen=True):
    """The frames so far have arrived. Said a few times a second, or no more come."""


_decode = msgspec.json.Decoder(Start | Control | Drag | Drop | Pause | Reset | Seen).decode


def read(message: Mapping[str, Any]) -> Message:
    """The `Message` in one event of a socket; raises `InvalidInput` for anything else."""
    text = message.get("text")
    if text is None:
        raise InvalidInput("message: expected JSON text", "bytes")
    if len(text) > LARGEST_MESSAGE:
        raise InvalidInput(f"message: expected at most {LARGEST_MESSAGE} characters", str(len(text)))
    try:
        return _decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:  # a ValidationError is a DecodeError
        raise InvalidInput(f"message: {describe(error)}") from None


# --- the agent ----------------------------------------------------------------------------------------------------


def task_of(start: Start) -> Task:
    """The `Task` that `start` asks for; a pressure command of 1 crosses [p_min, p_max] in `CROSSING`."""
    if not 0 <= start.seed < 2**31:
        raise InvalidInput(f"seed: expected 0 to {2**31 - 1}", describe(start.seed))
    task = make_task(start.task, body=start.body, seed=start.seed, gravity=start.gravity, frequency=start.frequency)
    span = np.ptp(task.pressure_range, axis=1).max()
    return msgspec.structs.replace(task, pressure_unit=float(span * task.physics.dt / CROSSING))


class Session:
    """One agent, and what it is told. The same calls in the same order give the same bits."""

    def __init__(self, start: Start) -> None:
        """Raises `InvalidInput` for a start that cannot be."""
        self.start = msgspec.structs.replace(
            start, gravity=_cut(start.gravity, 0, LARGEST_GRAVITY), frequency=_cut(start.frequency, 1, LARGEST_SPRING)
        )
        self.task = task = task_of(self.start)
        low, high = task.pressure_range[0]
        self.control = Control(float((task.pressure_start[0] - low) / (high - low)))
        self._simulator = Simulator(task, threads=1)
        self._commands = np.zeros((1, output_count(task.body, task.condition)), dtype=np.float32)
        self._springs = np.arange(task.body.spring_count) / task.body.spring_count
        self._share = task.body.mass / task.body.mass.sum()
        ground = task.scene.segments[task.scene.depth > 0]
        self._bottom = float(ground[:, 1::2].min()) - DEEPEST
        self.restart()

    def restart(self) -> None:
        """Puts the agent back to the start; what it was told stays."""
        self.stand = self._simulator.reset(1)
        self.steps = 0
        self.phase = 0.0  # of the wave [turn]: its frequency may change without a jump
        self.hand: Drag | None = None

    def tell(self, control: Control) -> None:
        """Sets pressure and wave."""
        wave = control.wave
        self.control = Control(
            _cut(control.pressure, 0, 1),
            Wave(
                _cut(wave.amplitude, 0, 1),
                _cut(wave.frequency, 0, LARGEST_WAVE),
                _cut(wave.length, 0, LARGEST_LENGTH),
                wave.direction,
            ),
        )

    def drag(self, drag: Drag | None) -> None:
        """Pulls a mass from now on; None lets go. Raises `InvalidInput` for a mass that there is not."""
        if drag is not None and not 0 <= drag.mass < self.task.body.mass_count:
            raise InvalidInput(f"mass: expected 0 to {self.task.body.mass_count - 1}", describe(drag.mass))
        self.hand = drag

    @property
    def time(self) -> float:
        """[s] since the start."""
        return self.steps * self.task.physics.dt

    @property
    def com(self) -> np.ndarray:
        """The centre of mass [m], shape [2]."""
        return self._share @ self.stand.position[0].astype(np.float64)

    @property
    def lost(self) -> bool:
        """Whether the agent has left the world."""
        x, y = self.com.tolist()
        return not (abs(x) < LARGEST_COORDINATE and self._bottom < y < LARGEST_COORDINATE)

    def step(self) -> None:
        """One step of the kernel."""
        task, springs, wave = self.task, self.task.body.spring_count, self.control.wave
        turns = self.phase - wave.direction * wave.length * self._springs
        self._commands[0, :springs] = wave.amplitude * np.sin(2 * math.pi * turns)
        low, high = task.pressure_range[0]
        missing = low + self.control.pressure * (high - low) - self.stand.pressure[0]
        self._commands[0, springs:] = np.clip(missing / task.pressure_step, -1, 1)
        if self.hand is not None:
            self._simulator.push(self._pull(self.hand))
        self._simulator.step(self._commands, out=self.stand)
        self.phase = (self.phase + wave.frequency * task.physics.dt) % 1.0
        self.steps += 1

    def _pull(self, hand: Drag) -> np.ndarray:
        """The change of velocities by the hand in one step [m/s], shape [1, mass, 2].

        A soft spring from the mass m to the pointer, as stiff as a body of mass M on it needs, implicit in time:
        v' = (v - h k/m C) / (1 + h c/m + h^2 k/m), C = x - pointer, k = M w^2, c = 2 zeta M w. Source: Catto, Soft
        Constraints (GDC 2011); his b2MouseJoint.
        """
        h, body, i = self.task.physics.dt, self.task.body, hand.mass
        whole = body.mass.sum() / body.mass[i]  # M / m
        w = 2 * math.pi * HAND_FREQUENCY
        k, c = whole * w**2, 2 * HAND_DAMPING * whole * w  # per unit of m
        v = self.stand.velocity[0, i].astype(np.float64)
        C = self.stand.position[0, i] - np.clip([hand.x, hand.y], -LARGEST_COORDINATE, LARGEST_COORDINATE)
        change = (v - h * k * C) / (1 + h * c + h * h * k) - v
        change *= min(1.0, h * HAND_STRENGTH * whole / max(math.hypot(*change), 1e-9))
        out = np.zeros((1, body.mass_count, 2))
        out[0, i] = np.nan_to_num(change, posinf=0, neginf=0)  # an agent that is lost needs no hand
        return out

    def frame(self) -> bytes:
        """What a frame holds."""
        stand, ratio = self.stand, self.stand.area[0, 0] / self.task.area_reference[0]
        head = struct.pack("<3f", self.time, stand.pressure[0, 0], ratio)
        return head + stand.position[0].astype("<f4").tobytes() + (stand.touch[0] > 0).tobytes()

    def scene(self) -> bytes:
        """What a browser needs to know before the frames, as JSON: the header of a replay without its arrays, the
        `start` as it was made, and the `control` at present."""
        task, body, end = self.task, self.task.body, self.task.end
        header = {
            "type": "scene",
            "format": 1,
            "title": f"{task.name}, {self.start.body}",
            "name": task.name,
            "body": self.start.body,
            "condition": task.condition,
            "seed": self.start.seed,
            "dt": task.physics.dt,
            "masses": body.mass_count,
            "springs": body.springs.tolist(),
            "chambers": [list(loop) for loop in body.chambers],
            "angle": body.angle.tolist(),
            "side": body.side.tolist(),
            "mass": body.mass.tolist(),
            "rest": body.rest_length.tolist(),
            "spring_range": [float(body.shortest.min()), float(body.longest.max())],
            "pressure_range": task.pressure_range[0].tolist(),
            "area_reference": task.area_reference.tolist(),
            "radius": body.radius,
            "scene": {"segments": task.scene.segments.tolist(), "depth": task.scene.depth.tolist()},
            "end": end.half_width if isinstance(end, Leave) else None,
            "start": msgspec.to_builtins(self.start),
            "control": msgspec.to_builtins(self.control),
        }
        return msgspec.json.encode(header)


def _cut(value: float, low: float, high: float) -> float:
    """`value` within [low, high]; low for NaN."""
    return max(low, min(value, high))
