"""One picture of the overlay: for each camera the frame, the crop, the re-rendered sphere and the residual."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies import Grey
from sphereorient.report import overlay_canvas as ink
from sphereorient.report.doubts import flag_words, lost_cameras
from sphereorient.report.overlay_canvas import Canvas, Panel
from sphereorient.report.overlay_model import Window, crop
from sphereorient.report.overlay_view import (
    View,
    draw_own,
    draw_track,
    own_distance_px,
    residual_colours,
    scale_bar,
    shown,
)
from sphereorient.trajectory import Trajectory

HEAD, FOOT, GAP, TITLE, SIDE = 62, 56, 10, 24, 310  # px: bands above and below, between panels, titles, square panels
FRAME_HEIGHT = 440  # px, of a camera's frame
WIDEST = 1.4  # of a frame's height
TRAIL_FRAMES = 40
OWN_PX = 1.5  # a camera that by itself sees the centre further off than this is shown
LINE, LETTER = 18, 8  # px, of text: from line to line, and a letter's usual width


@dataclass(frozen=True, kw_only=True, eq=False)
class Page:
    """Draws frames of a track, all in one layout; made by overlay.views and the command."""

    track: Trajectory
    numbers: NDArray[np.int64]  # (N,), the experiment's numbers of the frames
    views: Sequence[View]

    def draw(self, k: int, pictures: Mapping[str, Grey | None]) -> NDArray[np.uint8]:
        """Return frame k of the track, (H, W, 3) with H and W even.

        Args:
            k: row of the track.
            pictures: (h, w) of each camera; None where it has none.
        """
        height, widths = FRAME_HEIGHT, [_frame_width(view, FRAME_HEIGHT) for view in self.views]
        width = max(widths) + 3 * (SIDE + GAP) + 2 * GAP
        canvas = Canvas(width + width % 2, HEAD + len(self.views) * (height + GAP) + FOOT)
        self._head(canvas, k)
        for row, view in enumerate(self.views):
            top = HEAD + row * (height + GAP)
            self._camera(canvas, view, k, pictures[view.name], (GAP, top), (widths[row], height))
        self._foot(canvas, k)
        return canvas.finished()

    def _head(self, canvas: Canvas, k: int) -> None:
        segment = int(self.track.segment[k])
        place = f"segment {segment}" if segment >= 0 else "outside any segment"
        words = f"frame {int(self.numbers[k])}    t = {self.track.time[k]:.4f} s    {place}"
        canvas.text((GAP, 24), words, 18)
        about = f"{self.track.experiment}, {self.track.method}"
        canvas.text((canvas.pixels.shape[1] - GAP, 24), about, 15, ink.FAINT, "rs")
        told, colour = self.state(k)
        canvas.text(
            (GAP, 50),
            textwrap.shorten(told, (canvas.pixels.shape[1] - 2 * GAP) // LETTER, placeholder=" ..."),
            15,
            colour,
        )

    def state(self, k: int) -> tuple[str, ink.Colour]:
        """Return in words what a frame is, with a mark that needs no colour, and its colour."""
        flags = ", ".join(flag_words(self.track, k))
        if not self.track.valid[k]:
            return f"\u2716 not valid{': ' + flags if flags else ''}", ink.LOST
        return (f"\u25b2 doubt: {flags}", ink.DOUBT) if flags else ("\u25cf valid", ink.GOOD)

    def _camera(
        self, canvas: Canvas, view: View, k: int, picture: Grey | None, corner: tuple[int, int], size: tuple[int, int]
    ) -> None:
        path, camera = view.model.path, view.model.camera
        grey = None if picture is None else shown(picture, view)
        frame = Panel(canvas, corner, size, (-0.5, -0.5), size[1] / camera.image_size[1])
        placed = bool(np.isfinite(path.position_mm[k]).all())
        centre = view.trail_px[k] if placed else self.track.cameras[view.name].centre_px[k]
        left = corner[0] + size[0] + GAP
        titles = ("crop", "re-rendered", "residual")
        panels = []
        window = Window(centre_px=centre, half_px=view.half_px, side=crop_side(view.half_px))
        scale = SIDE / (2 * view.half_px)
        for column, title in enumerate(titles):
            at = (left + column * (SIDE + GAP), corner[1] + TITLE)
            canvas.text((at[0], at[1] - 7), title, 14, ink.FAINT)
            panels.append(Panel(canvas, at, (SIDE, SIDE), centre - view.half_px, scale))
            panels[-1].pixels[:] = 0
        frame.pixels[:] = 0
        if grey is not None:
            frame.show(grey)
        here = bool(np.isfinite(centre).all()) and np.isfinite(view.half_px)
        blank = _fill(panels, view, k, picture, window) if here else "no position"
        for panel, words in zip(panels, _why_blank(blank, here, picture is not None), strict=True):
            canvas.text((panel.corner[0] + SIDE / 2, panel.corner[1] + SIDE / 2), words, 15, ink.FAINT, "mm")
        for panel, letters in ((frame, False), (panels[0], True)):
            if placed and np.isfinite(panel.first_px).all():
                draw_track(panel, view, k, letters)
        if own_distance_px(view, self.track.cameras[view.name], k) > OWN_PX:
            draw_own(panels[0], self.track.cameras[view.name], k)
        frame.line(view.trail_px[max(0, k - TRAIL_FRAMES) : k + 1], ink.TRAIL, 1)
        canvas.text((corner[0] + 8, corner[1] + 20), view.name, 16)
        if picture is None:
            canvas.text((corner[0] + size[0] / 2, corner[1] + size[1] / 2), "no picture", 16, ink.FAINT, "mm")
        mark = self.state(k)[1]
        if mark != ink.GOOD:
            frame.border(mark, 3)
        self._words(canvas, view, k, (left, corner[1] + TITLE + SIDE + 24), size[1] - SIDE - TITLE)

    def _words(self, canvas: Canvas, view: View, k: int, at: tuple[int, int], room: int) -> None:
        """What this camera says of the frame, and the scale of the residual."""
        seen = self.track.cameras[view.name]
        lost = lost_cameras(self.track, k).get(view.name)
        lines = [(f"{view.name}: {lost}", ink.DOUBT) if lost else (f"{view.name}: measured", ink.GOOD)]
        lines.append((_numbers(seen.score[k], seen.radius_px[k]), ink.INK))
        sigma = np.sqrt(np.trace(self.track.orientation_cov[k]) / 3)
        if np.isfinite(sigma):
            lines.append((f"error of the orientation, stated: {np.rad2deg(sigma):.3f}\u00b0 an axis", ink.INK))
        off_px = own_distance_px(view, seen, k)
        if off_px > OWN_PX:
            lines.append((f"white circle: what it sees by itself, {off_px:.1f} px off", ink.DOUBT))
        if view.model.path.smoothed[k]:
            lines.append(("outline and axes: of the smoother", ink.DOUBT))
        wrapped = [(part, colour) for text, colour in lines for part in textwrap.wrap(text, 66)]
        for row, (text, colour) in enumerate(wrapped[: max(1, room // LINE)]):
            canvas.text((at[0], at[1] + LINE * row), text, 14, colour)
        scale_bar(canvas, (at[0] + 2 * (SIDE + GAP), at[1] - 12), SIDE, view.light)

    def _foot(self, canvas: Canvas, k: int) -> None:
        height, width = canvas.pixels.shape[:2]
        left, top = GAP, height - FOOT
        entries = [("outline", ink.OUTLINE), ("body axes x", ink.AXES[0]), ("y", ink.AXES[1]), ("z", ink.AXES[2])]
        entries += [(f"last {TRAIL_FRAMES} frames", ink.TRAIL)]
        for words, colour in entries:
            canvas.text((left, top + 16), words, 13, colour)
            left += 8 * len(words) + 14
        canvas.text((left, top + 16), "axes solid: towards the camera, dotted: away", 13, ink.FAINT)
        strip = canvas.pixels[height - 26 : height - 14, GAP : width - GAP]
        strip[:] = self._strip(strip.shape[1])
        at = round((k + 0.5) / len(self.track) * strip.shape[1])
        canvas.pixels[height - 31 : height - 9, GAP + max(0, at - 1) : GAP + at + 1] = 255
        words = f"whole track: green valid, orange in doubt, grey not valid ({int(self.track.valid.sum())} of "
        canvas.text((width - GAP, top + 16), f"{words}{len(self.track)} valid)", 13, ink.FAINT, "rs")

    def _strip(self, width: int) -> NDArray[np.uint8]:
        """The states of all frames side by side, (width, 3); of the frames of one pixel the worst."""
        flags = self.track.flags if len(self.track.cameras) > 1 else self.track.flags & ~np.uint32(4)
        state = np.where(self.track.valid, np.where(flags != 0, 1, 0), 2)
        edges = np.linspace(0, len(state), width + 1)
        first = edges[:-1].astype(int)
        last = np.maximum(np.ceil(edges[1:]).astype(int), first + 1)
        worst = [int(state[a:b].max()) for a, b in zip(first, last, strict=True)]
        return np.array([ink.GOOD, ink.DOUBT, ink.LOST], np.uint8)[worst]


def crop_side(half_px: float) -> int:
    """Return how many samples a crop has along each side: the picture's own pixels, as far as they can be shown."""
    return max(48, min(SIDE, round(2 * half_px))) if np.isfinite(half_px) else SIDE


def _fill(panels: Sequence[Panel], view: View, k: int, picture: Grey | None, window: Window) -> str:
    """Crop, re-rendered sphere, residual; say why the sphere is not rendered, where it is not."""
    grey = None if picture is None else crop(picture, window)
    if grey is not None:
        panels[0].show(shown(grey, view))
    if view.light is None or not view.model.path.whole[k]:
        return "no orientation" if view.light is not None else view.why_unlit
    model = view.light.picture(view.model.look(k, window), grey)
    panels[1].show(shown(model, view))
    if grey is not None:
        panels[2].show(residual_colours((grey - model) / view.light.contrast))
    return ""


def _why_blank(blank: str, here: bool, filmed: bool) -> tuple[str, str, str]:
    """What is written into the crop, the re-rendered sphere and the residual where they are empty."""
    no_crop = "no picture" if not filmed else "" if here else blank
    return no_crop, blank, blank or ("" if filmed else "no picture")


def _numbers(score: float, radius_px: float) -> str:
    told = [f"score {score:.3f}"] if np.isfinite(score) else ["no score"]
    return ", ".join([*told, *([f"radius {radius_px:.1f} px"] if np.isfinite(radius_px) else [])])


def _frame_width(view: View, height: int) -> int:
    width, rows = view.model.camera.image_size
    return round(min(width / rows, WIDEST) * height)
