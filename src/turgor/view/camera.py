"""The camera: where each frame of a recording lies in the world, and which pixel a point falls on."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from turgor.recording import Recording

BODY_SHARE = 1 / 3  # [1], the body's size at rest / the frame's height
BODY_HEIGHT = 0.6  # [1], where the camera's centre lies, from the top of the frame
CAMERA_SMOOTHING = (0.4, 0.7)  # [s], standard deviation of the Gaussian over the path in x and y
SUBPIXELS = 3  # the frame moves over the world in steps of 1 / SUBPIXELS pixel: what stands still has 3 x 3 looks
CAMERA_SLACK = 0.22  # [1], furthest that the body's centre gets from the camera's / the frame's size


class Camera(msgspec.Struct, frozen=True, eq=False):
    """Where the frame lies in the world at every step."""

    centre: np.ndarray  # [m], shape [step + 1, 2], what stands at BODY_HEIGHT in the middle of the frame
    scale: float  # [px/m]
    size: tuple[int, int]  # [px], width and height

    def pixels(self, step: int, points: np.ndarray) -> np.ndarray:
        """Pixels from the top left of the frame, shape [..., 2], for `points` [m] [..., 2]."""
        return np.array(self.origin(step)) / SUBPIXELS + points * (self.scale, -self.scale)

    def origin(self, step: int) -> tuple[int, int]:
        """Where the world's origin lies, from the top left of the frame [px / SUBPIXELS]."""
        (x, y), (width, height) = self.centre[step].tolist(), self.size
        return (
            round(SUBPIXELS * (0.5 * width - x * self.scale)),
            round(SUBPIXELS * (BODY_HEIGHT * height + y * self.scale)),
        )

    @property
    def spacing(self) -> float:
        """Distance of the labelled marks [m]: 10 m for the bodies of the paper."""
        least = 0.155 * min(self.size) / self.scale
        power = 10.0 ** math.floor(math.log10(least))
        return next(m * power for m in (1, 2, 5, 10) if m * power >= least)


def follow(recording: Recording, com: np.ndarray, size: tuple[int, int]) -> Camera:
    """The `Camera` that follows the centre of mass `com` [m] [step + 1, 2], smoothly in x and y."""
    body = recording.body
    extent = max(float((np.ptp(body.position, axis=0) + body.side.max()).max()), 3.0)  # [m]
    scale = BODY_SHARE * min(size) / extent
    centre = np.stack(
        [smoothed(com[:, k], deviation / recording.dt) for k, deviation in enumerate(CAMERA_SMOOTHING)],
        axis=1,
    )
    slack = CAMERA_SLACK * np.array(size) / scale
    return Camera(com + np.clip(centre - com, -slack, slack), scale, size)


def smoothed(values: np.ndarray, deviation: float) -> np.ndarray:
    """`values` [step] under a Gaussian of that standard deviation [steps], the ends held."""
    reach = math.ceil(3 * deviation)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation, 1e-9)) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid")
