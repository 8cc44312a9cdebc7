"""The colours that a `Painter` mixes its pictures in: those of a screen, or those of a video."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pygame

Colour = tuple[int, ...]  # red, green, blue (, alpha), 0 to 255

Colours = Callable[[Colour], Colour]  # how a colour is written into a picture

BT709 = 1  # the number of this standard's colours in H.264 and VP9: what players expect of HD video
LIMITED_RANGE = 1  # brightness from 16 to 235


def rgb(colour: Colour) -> Colour:
    """The colour as it is."""
    return colour


@functools.cache
def ycbcr(colour: Colour) -> Colour:
    """The colour as a video holds it: its Cr, Y, Cb in place of red, green, blue (BT.709, limited range).

    Both mix alike, because one is a linear function of the other: a picture that is drawn in these colours is, up to
    rounding, the picture drawn in RGB and then converted, in less time.
    """
    red, green, blue, *alpha = colour
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    cb, cr = (blue - luma) / 1.8556, (red - luma) / 1.5748
    return (round(128 + cr * 224 / 255), round(16 + luma * 219 / 255), round(128 + cb * 224 / 255), *alpha)


@functools.cache
def premultiplied(colour: Colour) -> Colour:
    """The colour times its alpha, if it has one: what an average over a transparent ground is made of."""
    parts, alpha = colour[:3], colour[3:]
    return (*(round(part * alpha[0] / 255) for part in parts), *alpha) if alpha else colour


def put_planes(surface: pygame.Surface, luma: np.ndarray, cb: np.ndarray, cr: np.ndarray) -> None:
    """Puts a picture drawn in `ycbcr` into the planes of a 4:2:0 video frame.

    `luma` is uint8 [height, width]; `cb` and `cr` uint8 [height / 2, width / 2] take the mean of 2 x 2 pixels each.
    """
    width, height = surface.get_size()
    buffer: Any = surface.get_buffer()
    pixels = np.frombuffer(buffer, np.uint32).reshape(height, width)  # 0x00RRGGBB
    np.copyto(luma, pixels >> 8, casting="unsafe")  # the low byte
    # red and blue, with room for sums between them; two pixels of a line in each number
    pair = (pixels[::2] & 0x00FF00FF).view(np.uint64)
    pair += (pixels[1::2] & 0x00FF00FF).view(np.uint64)
    pair += pair >> 32
    mean = pair.astype(np.uint32)  # the low half: the sum of both
    mean += 0x00020002
    mean >>= 2
    np.copyto(cb, mean, casting="unsafe")
    np.copyto(cr, mean >> 16, casting="unsafe")
