"""The overlay of several spheres: all in each camera's frame, and beside it a column of crops of each."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies import Grey
from sphereorient.report import overlay_page as ink
from sphereorient.report.frame_warnings import lost_cameras
from sphereorient.report.overlay_model import outline_px
from sphereorient.report.overlay_page import (
    Canvas,
    Page,
    Panel,
    crop_panel,
    draw_axes,
    draw_outline,
    draw_pictures,
    legend,
    state_strip,
)

GAP, SIDE, TITLE, WORDS, STRIP = 6, 128, 24, 22, 16  # px: between panels, square panels, lines of text, a strip
FOOT = 34  # px, below the frames, without the strips
ABOVE = 0.25  # of the radius: from the outline to the name
NAME = 14  # letters of a name beside a strip


@dataclass(frozen=True, kw_only=True, eq=False)
class ScenePage:
    """Draws frames of several tracks of the same times and cameras, all in one layout; made by `overlay_movie`."""

    pages: Sequence[Page]  # of each sphere

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The experiment's numbers of the frames, (N,)."""
        return self.pages[0].numbers

    def draw(self, k: int, pictures: Mapping[str, Grey | None]) -> NDArray[np.uint8]:
        """Return row k of the tracks, from the pictures (h, w) by camera, as (H, W, 3) with H and W even."""
        cameras, height = self.pages[0].views, ink.FRAME_HEIGHT
        sizes = [view.model.camera.image_size for view in cameras]
        widths = [round(min(width / rows, ink.WIDEST) * height) for width, rows in sizes]
        width = max(widths) + len(self.pages) * (SIDE + GAP) + 3 * ink.GAP
        foot = FOOT + STRIP * len(self.pages)
        canvas = Canvas(width + width % 2, ink.HEAD + len(cameras) * (height + ink.GAP) + foot + foot % 2)
        self._head(canvas, k)
        for row, view in enumerate(cameras):
            top = ink.HEAD + row * (height + ink.GAP)
            self._camera(canvas, row, k, pictures[view.name], (ink.GAP, top), (widths[row], height))
        self._foot(canvas, k, canvas.pixels.shape[0] - foot)
        return canvas.finished()

    def _head(self, canvas: Canvas, k: int) -> None:
        width, track = canvas.pixels.shape[1], self.pages[0].track
        canvas.text((ink.GAP, 24), f"frame {int(self.numbers[k])}    t = {track.time[k]:.4f} s", 18)
        canvas.text((width - ink.GAP, 24), f"{track.experiment}, {track.method}", 15, ink.FAINT, "rs")
        share = (width - 2 * ink.GAP) // len(self.pages)
        for place, page in enumerate(self.pages):
            state, colour = page.state(k)
            words = textwrap.shorten(f"{page.track.sphere} {state}", share // ink.LETTER, placeholder=" ...")
            canvas.text((ink.GAP + place * share, 50), words, 15, colour)

    def _camera(
        self, canvas: Canvas, row: int, k: int, picture: Grey | None, corner: tuple[int, int], size: tuple[int, int]
    ) -> None:
        views = [page.views[row] for page in self.pages]
        camera = views[0].model.camera
        frame = Panel(canvas, corner, size, (-0.5, -0.5), size[1] / camera.image_size[1])
        if picture is not None:
            frame.show(views[0].shown(picture))
        placed = [place for place, view in enumerate(views) if view.placed(k)]
        for place in sorted(placed, key=lambda place: -views[place].depth_mm(k)):  # farthest first
            view = views[place]
            frame.line(view.trail_px[max(0, k - ink.TRAIL_FRAMES) : k + 1], ink.TRAIL, 1)
            draw_outline(frame, view, k)
            draw_axes(frame, view, k, letters=False)
            centre, top = view.trail_px[k], np.nanmin(outline_px(camera, view.model.path, k)[:, 1])
            above = np.array([centre[0], top - ABOVE * (centre[1] - top)])
            frame.text(above, self.pages[place].track.sphere, 15, self.pages[place].state(k)[1])
        canvas.text((corner[0] + 8, corner[1] + 20), views[0].name, 16)
        frame.say("no picture" if picture is None else "", 16)
        left = corner[0] + max(size[0], canvas.pixels.shape[1] - len(views) * (SIDE + GAP) - 3 * ink.GAP) + ink.GAP
        for place in range(len(views)):
            self._column(canvas, row, place, k, picture, (left + place * (SIDE + GAP), corner[1]))

    def _column(
        self, canvas: Canvas, row: int, place: int, k: int, picture: Grey | None, corner: tuple[int, int]
    ) -> None:
        page, views = self.pages[place], [page.views[row] for page in self.pages]
        view, (left, top) = views[place], corner
        seen = page.track.cameras[view.name]
        title = textwrap.shorten(page.track.sphere, SIDE // ink.LETTER, placeholder=" ...")
        canvas.text((left, top + TITLE - 8), title, 15, page.state(k)[1])
        window = view.window(seen, k)
        tops = [top + TITLE + line * (SIDE + GAP) for line in range(3)]
        panels = [crop_panel(canvas, (left, at), SIDE, window) for at in tops]
        others = [other for at, other in enumerate(views) if at != place]
        drawn = window.known and draw_pictures(panels, view, k, picture, window, others)
        blank = "" if drawn else view.why_unlit if view.light is None else "no orientation"
        blank = blank if window.known else "no position"
        missing = "no picture" if picture is None else ""
        no_crop = missing or ("" if window.known else blank)
        for panel, words in zip(panels, (no_crop, blank, blank or missing), strict=True):
            panel.say(words)
        if view.placed(k) and window.known:
            draw_outline(panels[0], view, k)
        if drawn:
            draw_axes(panels[1], view, k, letters=False)
        if place == 0:
            for at, words in zip(tops, ("crop", "re-rendered", "residual"), strict=True):
                canvas.text((left + 4, at + 14), words, 12, ink.FAINT)
        lost = lost_cameras(page.track, k).get(view.name)
        score = f"score {seen.score[k]:.2f}" if np.isfinite(seen.score[k]) else "no score"
        words = textwrap.shorten(lost or score, SIDE // ink.LETTER + 3, placeholder=" ...")
        canvas.text((left, tops[2] + SIDE + WORDS - 6), words, 13, ink.DOUBT if lost else ink.FAINT)

    def _foot(self, canvas: Canvas, k: int, top: int) -> None:
        width = canvas.pixels.shape[1]
        legend(canvas, (ink.GAP, top + 18), "residual: filmed less model, blue darker, orange brighter")
        name = ink.LETTER * max(len(page.track.sphere[:NAME]) for page in self.pages) + ink.GAP
        for row, page in enumerate(self.pages):
            at = top + FOOT - 8 + STRIP * row
            canvas.text((ink.GAP, at + STRIP - 6), page.track.sphere[:NAME], 13, ink.FAINT)
            state_strip(canvas, page.track, k, (ink.GAP + name, at), (width - 2 * ink.GAP - name, STRIP - 5))
