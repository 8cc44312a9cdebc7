"""Pictures of an episode while it happens: the frames of the videos, with a camera that does not know what comes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from turgor.recording import Recording
from turgor.simulate import Step
from turgor.task import Task
from turgor.view.camera import CAMERA_SLACK, CAMERA_SMOOTHING
from turgor.view.draw import Painter


class Canvas:
    """Draws one episode of `task`, which grows by `add`."""

    def __init__(self, task: Task, size: tuple[int, int]) -> None:
        self.task, self.size = task, size
        body, rows = task.body, task.steps + 1
        self.recording = Recording(
            body=body,
            scene=task.scene,
            dt=task.physics.dt,
            position=np.zeros((rows, body.mass_count, 2), np.float32),
            velocity=np.zeros((rows, body.mass_count, 2), np.float32),
            pressure=np.zeros((rows, body.chamber_count), np.float32),
            rest_length=np.broadcast_to(body.rest_length, (rows, body.spring_count)),
            touch=np.zeros((rows, body.mass_count), dtype=bool),
        )
        self.painter = self._painter()
        self.last = -1  # the step that was added last

    def _painter(self) -> Painter:
        limits = self.task.pressure_range
        span = (float(limits[:, 0].min()), float(limits[:, 1].max())) if np.ptp(limits) > 0 else None
        return Painter(self.recording, self.size, pressure_range=span)

    def add(self, stand: Step, agent: int = 0) -> None:
        """Takes in where the agent stands after the next step."""
        self.last += 1
        t, recording, painter = self.last, self.recording, self.painter
        recording.position[t], recording.velocity[t] = stand.position[agent], stand.velocity[agent]
        recording.pressure[t], recording.touch[t] = stand.pressure[agent], stand.touch[agent] > 0
        com = np.average(recording.position[t].astype(np.float64), axis=0, weights=recording.body.mass)
        painter.com[t] = com
        painter.camera.centre[t] = self._aim(com)

    def frame(self) -> np.ndarray:
        """The picture after the last step, uint8 [height, width, 3]."""
        return self.painter.frame(self.last)

    def surface(self) -> Any:
        """The same as a pygame surface, which the next one draws over."""
        return self.painter.surface(self.last)

    def _aim(self, com: np.ndarray) -> np.ndarray:
        """The camera's centre [m]: it closes in on the centre of mass with the time constants of `CAMERA_SMOOTHING`,
        and never leaves it behind."""
        if self.last == 0:
            return com
        camera = self.painter.camera
        before = camera.centre[self.last - 1]
        share = [1 - math.exp(-self.recording.dt / constant) for constant in CAMERA_SMOOTHING]
        slack = CAMERA_SLACK * np.array(camera.size) / camera.scale
        return com + np.clip(before + share * (com - before) - com, -slack, slack)

    # pygame's surfaces cannot be copied; what they are drawn from can

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in vars(self).items() if name != "painter"}
        return state | {"com": self.painter.com, "centre": self.painter.camera.centre}

    def __setstate__(self, state: dict[str, Any]) -> None:
        com, centre = state.pop("com"), state.pop("centre")
        vars(self).update(state)
        self.painter = self._painter()
        self.painter.com[:], self.painter.camera.centre[:] = com, centre


class Window:
    """A window on the screen."""

    def __init__(self, size: tuple[int, int], title: str, rate: float) -> None:
        """`rate` [frames/s]: `show` waits so as not to be faster."""
        import pygame

        pygame.display.init()
        self._screen = pygame.display.set_mode(size)
        pygame.display.set_caption(title)
        self._clock, self._rate = pygame.time.Clock(), rate

    def show(self, surface: Any) -> None:
        import pygame

        self._screen.blit(surface, (0, 0))
        pygame.event.pump()
        self._clock.tick(self._rate)
        pygame.display.flip()

    def close(self) -> None:
        import pygame

        pygame.display.quit()
