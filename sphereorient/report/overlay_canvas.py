"""A picture to draw on: antialiased lines, text, panels."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sphereorient.report.frame_warnings import runs_of

Colour = tuple[int, int, int]
BACKGROUND: Colour = (18, 18, 22)
INK: Colour = (235, 235, 235)
FAINT: Colour = (165, 165, 170)
# Okabe and Ito's hues for dark pictures; the axes x, y, z as in plots.style.
OUTLINE: Colour = (240, 228, 66)
AXES: tuple[Colour, Colour, Colour] = ((255, 140, 59), (43, 224, 168), (99, 195, 255))
TRAIL: Colour = (224, 150, 195)
DOUBT: Colour = (255, 140, 59)
LOST: Colour = (130, 130, 135)
GOOD: Colour = (43, 224, 168)
SHIFT = 4  # bits of a pixel's fraction
DOT, SPACE = 3.0, 3.5  # px, of dotted lines


class Canvas:
    """An (H, W, 3) RGB picture; panels clip what is drawn in them."""

    def __init__(self, width: int, height: int) -> None:
        self.pixels = np.full((height, width, 3), BACKGROUND, np.uint8)
        self._texts: list[tuple[tuple[float, float], str, int, Colour, str]] = []

    def text(
        self, at: tuple[float, float], words: str, size: int = 15, colour: Colour = INK, anchor: str = "ls"
    ) -> None:
        """Write text at (column, row), px; `anchor` is Pillow's: ls is left and baseline, mm the middle."""
        self._texts.append((at, words, size, colour, anchor))

    def finished(self) -> NDArray[np.uint8]:
        """Return the picture with its texts."""
        from PIL import Image, ImageDraw

        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for at, words, size, colour, anchor in self._texts:
            # A dark outline keeps text readable on bright pictures.
            draw.text(at, words, fill=colour, font=_font(size), anchor=anchor, stroke_width=1, stroke_fill=(0, 0, 0))
        return np.asarray(image)


class Panel:
    """A rectangle of a canvas that shows a picture from pixel `first_px` (u, v) on; drawn in the picture's pixels."""

    def __init__(
        self, canvas: Canvas, corner: tuple[int, int], size: tuple[int, int], first_px: ArrayLike, scale: float
    ) -> None:
        (left, top), (width, height) = corner, size
        self.canvas, self.corner, self.size = canvas, corner, size
        self.pixels = canvas.pixels[top : top + height, left : left + width]
        self.pixels[:] = 0
        self.first_px, self.scale = np.asarray(first_px, np.float64), scale

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Fill the panel with a picture, (h, w) grey or (h, w, 3) RGB, resized."""
        shrinks = picture.shape[0] > self.size[1]
        fitted = cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        self.pixels[:] = fitted if fitted.ndim == 3 else fitted[..., None]

    def place(self, uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return canvas positions of pixels (..., 2) of the picture; integers are pixel centres."""
        return np.asarray((uv_px - self.first_px) * self.scale - 0.5, np.float64)

    def line(self, uv_px: NDArray[np.float64], colour: Colour, width: int = 1, dotted: bool = False) -> None:
        """Draw a line through points (n, 2) of the picture, interrupted at NaN."""
        points = self.place(uv_px)
        # Points too far away for integers interrupt it, too.
        for first, last in runs_of((np.abs(np.nan_to_num(points, nan=1e9)) < 1e5).all(-1)):
            run = points[first:last]
            for piece in _dots(run) if dotted else [run] if len(run) > 1 else []:
                ends = np.round(piece * (1 << SHIFT)).astype(np.int32)
                cv2.polylines(self.pixels, [ends], False, colour, width, cv2.LINE_AA, SHIFT)

    def text(self, uv_px: NDArray[np.float64], words: str, size: int, colour: Colour) -> None:
        """Write text around a point of the picture if it is inside the panel."""
        x, y = self.place(uv_px).tolist()
        if 0 <= x < self.size[0] and 0 <= y < self.size[1]:
            self.canvas.text((self.corner[0] + x, self.corner[1] + y), words, size, colour, "mm")

    def say(self, words: str, size: int = 13) -> None:
        """Write text in the middle of the panel."""
        (left, top), (width, height) = self.corner, self.size
        self.canvas.text((left + width / 2, top + height / 2), words, size, FAINT, "mm")

    def border(self, colour: Colour, width: int) -> None:
        """Draw a border along the edges."""
        for edge in (np.s_[:width], np.s_[-width:], np.s_[:, :width], np.s_[:, -width:]):
            self.pixels[edge] = colour


def _dots(points: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    for start in np.arange(0, along[-1], DOT + SPACE):
        ends = np.array([start, min(start + DOT, along[-1])])
        yield np.stack([np.interp(ends, along, points[:, axis]) for axis in range(2)], axis=1)


@cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)
