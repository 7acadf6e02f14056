"""Pictures of the overlay: each camera's frame; crop, re-rendered picture and residual of each sphere."""

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from sphereorient.experiment.recording import Shown
from sphereorient.movies import Grey
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.report.frame_warnings import flag_words, lost_cameras, shown_flags, stated_error
from sphereorient.report.overlay_model import CropWindow, OverlayModel, axes_px, contrast, crop, lit_picture, outline_px
from sphereorient.trajectory import CameraTrack, Trajectory, runs_of

Colour = tuple[int, int, int]
Box = tuple[tuple[int, int], tuple[int, int]]  # corner (left, top) and size (width, height), px
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
HEAD, FOOT, GAP, TITLE = 62, 40, 10, 24  # px: bands above and below, between panels, titles
SIDE = 310  # px, largest side of square panels
STRIP = 16  # px, between strips
NAME = 14  # shown letters of a sphere's name
TRAIL_FRAMES = 40  # in the drawn path
OWN_PX = 1.5  # least distance of a camera's own centre to be drawn
LINE, LETTER = 18, 8  # px, height of a text line and usual width of a letter
RESIDUAL_REACH = 0.5  # of the contrast of white and black: limits of the residual's scale
BLANK = 45  # grey of pixels without a residual


class Canvas:
    """An (H, W, 3) RGB picture; panels clip their content."""

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
        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for at, words, size, colour, anchor in self._texts:
            # A dark outline keeps text readable on bright pictures.
            draw.text(at, words, fill=colour, font=_font(size), anchor=anchor, stroke_width=1, stroke_fill=(0, 0, 0))
        return np.asarray(image)


class Panel:
    """A rectangle of a canvas that shows a picture from pixel `first_px` (u, v) on, in the picture's coordinates."""

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
        # So do points beyond the range of integers.
        for first, last in runs_of(np.asarray((np.abs(np.nan_to_num(points, nan=1e9)) < 1e5).all(-1))):
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
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


@dataclass(frozen=True, kw_only=True, eq=False)
class OverlayView:
    """Common data of all pictures of one sphere by one camera; made by `overlay.prepared`, read by the page."""

    name: str
    model: OverlayModel
    light: DiskLight | None  # of this camera; None: no frame to fit it to
    black: float  # grey level shown black
    white: float
    half_px: float  # of the crop
    trail_px: NDArray[np.float64]  # (N, 2), the sphere's centre in the picture

    @property
    def why_unlit(self) -> str:
        """The reason why there is no light."""
        return "no texture map" if self.model.texture is None else "no valid frame"

    def shown(self, grey: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Return grey levels (H, W) on the scale of the display, 0 .. 255; NaN is black."""
        share = (np.asarray(grey, np.float32) - self.black) / (self.white - self.black)
        return np.asarray(np.clip(np.nan_to_num(share), 0, 1) * 255, np.uint8)

    def window(self, seen: CameraTrack, k: int) -> CropWindow:
        """Return the crop of frame k, around the centre of the track, else of the camera alone; NaN without both."""
        centre_px = np.asarray(self.trail_px[k] if self.placed(k) else seen.centre_px[k])
        return CropWindow(centre_px=centre_px, half_px=self.half_px, side=crop_side(self.half_px))

    def depth_mm(self, k: int) -> float:
        """Return the depth of the sphere in frame k, mm along the camera's axis."""
        camera = self.model.camera
        return float(camera.R_cam_lab[2].numpy() @ self.model.path.position_mm[k] + float(camera.T_cam_lab_mm[2]))

    def placed(self, k: int) -> bool:
        """Whether the track has a position in frame k."""
        return bool(np.isfinite(self.model.path.position_mm[k]).all())


@dataclass(frozen=True, kw_only=True, eq=False)
class Ball:
    """A sphere of the page: its track and its view by each camera; a single one has an empty name."""

    track: Trajectory
    views: Sequence[OverlayView]

    @property
    def name(self) -> str:
        """Its name, shortened."""
        return self.track.sphere[:NAME]

    def state(self, k: int) -> tuple[str, Colour]:
        """Return the state of a frame as text with a symbol, and its colour."""
        flags = ", ".join(flag_words(self.track, k))
        if self.track.without_ball[k]:
            return "no ball in view", FAINT
        if not self.track.valid[k]:
            return f"\u2716 not valid{': ' + flags if flags else ''}", LOST
        return (f"\u25b2 doubt: {flags}", DOUBT) if flags else ("\u25cf valid", GOOD)


@dataclass(frozen=True, kw_only=True, eq=False)
class OverlayPage:
    """Draws each camera's frame of a recording, with crop, re-rendered picture and residual of every sphere."""

    numbers: NDArray[np.int64]  # (N,), the experiment's numbers of the frames
    balls: Sequence[Ball]  # with the same times and cameras

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, from top to bottom."""
        return tuple(view.name for view in self.balls[0].views)

    def draw(self, k: int, pictures: Mapping[str, Grey | None]) -> NDArray[np.uint8]:
        """Return row k of the tracks, from the pictures (h, w) by camera, as (H, W, 3) with H and W even."""
        height, foot = 440, FOOT + STRIP * len(self.balls)  # px, of a camera's frame
        sizes = [view.model.camera.image_size for view in self.balls[0].views]
        widths = [round(min(width / rows, 1.4) * height) for width, rows in sizes]  # of a frame's height
        rows = math.ceil(math.sqrt(len(self.balls)))
        columns = math.ceil(len(self.balls) / rows)
        side = min(SIDE, height // rows - TITLE - LINE - 4)
        across = 3 * (side + GAP)
        width = max(max(widths) + columns * across + 2 * GAP, 1150)  # px, of a page: the line of the legend
        canvas = Canvas(width + width % 2, HEAD + len(sizes) * (height + GAP) + foot + foot % 2)
        self._head(canvas, k)
        for camera, name in enumerate(self.cameras):
            left, top = GAP, HEAD + camera * (height + GAP)
            self._frame(canvas, camera, k, pictures[name], ((left, top), (widths[camera], height)))
            left += widths[camera] + GAP
            for place, ball in enumerate(self.balls):
                corner = left + place // rows * across, top + place % rows * (height // rows)
                others = [other.views[camera] for other in self.balls if other is not ball]
                panels = Panels(ball=ball, view=ball.views[camera], others=others, side=side)
                panels.draw(canvas, k, pictures[name], corner, height // rows)
        self._foot(canvas, k, canvas.pixels.shape[0] - foot)
        return canvas.finished()

    def _head(self, canvas: Canvas, k: int) -> None:
        width, track = canvas.pixels.shape[1], self.balls[0].track
        segments = dict.fromkeys(int(ball.track.segment[k]) for ball in self.balls)
        places = ", ".join(f"segment {one}" if one >= 0 else "outside any segment" for one in segments)
        canvas.text((GAP, 24), f"frame {int(self.numbers[k])}    t = {track.time[k]:.4f} s    {places}", 18)
        canvas.text((width - GAP, 24), f"{track.experiment}, {track.method}", 15, FAINT, "rs")
        share = (width - 2 * GAP) // len(self.balls)
        for place, ball in enumerate(self.balls):
            state, colour = ball.state(k)
            words = textwrap.shorten(f"{ball.name} {state}", share // LETTER, placeholder=" ...")
            canvas.text((GAP + place * share, 50), words, 15, colour)

    def _frame(self, canvas: Canvas, camera: int, k: int, picture: Grey | None, box: Box) -> None:
        """Draw the frame of a camera with all spheres, the farthest first."""
        views = [ball.views[camera] for ball in self.balls]
        corner, size = box
        frame = Panel(canvas, corner, size, (-0.5, -0.5), size[1] / views[0].model.camera.image_size[1])
        if picture is not None:
            frame.show(views[0].shown(picture))
        states = [ball.state(k)[1] for ball in self.balls]
        for place in sorted(range(len(views)), key=lambda place: -np.nan_to_num(views[place].depth_mm(k))):
            view = views[place]
            if view.placed(k):
                draw_outline(frame, view, k)
                draw_axes(frame, view, k, letters=False)
                (u, v), top = view.trail_px[k], outline_px(view.model.camera, view.model.path, k)[:, 1].min()
                # Of the radius: from the outline to the name.
                frame.text(np.array([u, top - 0.25 * (v - top)]), self.balls[place].name, 15, states[place])
            frame.line(view.trail_px[max(0, k - TRAIL_FRAMES) : k + 1], TRAIL, 1)
        canvas.text((corner[0] + 8, corner[1] + 20), views[0].name, 16)
        frame.say("no picture" if picture is None else "", 16)
        if worst := [colour for colour in (LOST, DOUBT) if colour in states]:
            frame.border(worst[0], 3)

    def _foot(self, canvas: Canvas, k: int, top: int) -> None:
        width, frames = canvas.pixels.shape[1], sum(len(ball.track) for ball in self.balls)
        left = GAP
        entries = [("outline", OUTLINE), ("body axes x", AXES[0]), ("y", AXES[1]), ("z", AXES[2])]
        for words, colour in [*entries, (f"last {TRAIL_FRAMES} frames", TRAIL)]:
            canvas.text((left, top + 16), words, 13, colour)
            left += 8 * len(words) + 14
        canvas.text((left, top + 16), "axes solid: towards the camera, dotted: away", 13, FAINT)
        valid = sum(int(ball.track.valid.sum()) for ball in self.balls)
        words = f"track: green valid ({valid} of {frames}), orange in doubt, grey not valid"
        canvas.text((width - GAP, top + 16), words, 13, FAINT, "rs")
        names = max(len(ball.name) for ball in self.balls)
        left = GAP + (LETTER * names + GAP if names else 0)
        for row, ball in enumerate(self.balls):
            at = top + FOOT - 10 + STRIP * row
            canvas.text((GAP, at + 11), ball.name, 13, FAINT)
            state_strip(canvas, ball.track, k, (left, at), (width - GAP - left, 12))


@dataclass(frozen=True, kw_only=True, eq=False)
class Panels:
    """The panels of one sphere beside a camera's frame, with text below."""

    ball: Ball
    view: OverlayView
    others: Sequence[OverlayView]  # of the same camera: spheres before or behind it
    side: int  # px

    def draw(self, canvas: Canvas, k: int, picture: Grey | None, corner: tuple[int, int], height: int) -> None:
        """Draw row k of the track into a band of the canvas, `height` px high."""
        view, side = self.view, self.side
        seen = self.ball.track.cameras[view.name]
        window, panels = view.window(seen, k), []
        for column, title in enumerate((f"{self.ball.name} crop".strip(), "re-rendered", "residual")):
            left, top = corner[0] + column * (side + GAP), corner[1] + TITLE
            canvas.text((left, top - 7), title, 14, FAINT)
            panels.append(crop_panel(canvas, (left, top), side, window))
        blank = "no position"
        if window.known:
            drawn = draw_pictures(panels, view, k, picture, window, self.others)
            blank = "" if drawn else view.why_unlit if view.light is None else "no orientation"
        missing = "no picture" if picture is None else ""
        no_crop = missing or ("" if window.known else blank)
        for panel, words in zip(panels, (no_crop, blank, blank or missing), strict=True):
            panel.say(words, min(15, side // 8))
        if view.placed(k) and window.known:
            draw_outline(panels[0], view, k)
            draw_axes(panels[0], view, k)
        if own_distance_px(view, seen, k) > OWN_PX:
            angle = np.linspace(0, 2 * np.pi, 73)
            around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            panels[0].line(seen.centre_px[k] + seen.radius_px[k] * around, INK, 1, dotted=True)
        top, room = corner[1] + TITLE + side, height - side - TITLE
        letters = int(2 * (side + GAP) / 9.6)  # px, largest width of a letter below the panels
        wrapped = [(part, colour) for text, colour in self._words(k, seen) for part in textwrap.wrap(text, letters)]
        for row, (text, colour) in enumerate(wrapped[: max(1, room // LINE)]):
            canvas.text((corner[0], top + min(24, room - 6) + LINE * row), text, 14, colour)
        if room >= 3 * LINE:
            scale_bar(canvas, (corner[0] + 2 * (side + GAP), top + 12), side, view.light)

    def _words(self, k: int, seen: CameraTrack) -> Iterator[tuple[str, Colour]]:
        name, track = self.view.name, self.ball.track
        lost = lost_cameras(track, k).get(name)
        yield (f"{name}: {lost}", DOUBT) if lost else (f"{name}: measured", GOOD)
        numbers = f"score {seen.score[k]:.3f}" if np.isfinite(seen.score[k]) else "no score"
        if np.isfinite(seen.radius_px[k]):
            numbers += f", radius {seen.radius_px[k]:.1f} px"
        yield numbers, INK
        sigma = float(stated_error(track.orientation_cov[k : k + 1])[0])
        if np.isfinite(sigma):
            yield f"stated error of the orientation: {np.rad2deg(sigma):.3f}\u00b0 per axis", INK
        off_px = own_distance_px(self.view, seen, k)
        if off_px > OWN_PX:
            yield f"white circle: centre by this camera alone, {off_px:.1f} px off", DOUBT
        if self.view.model.path.smoothed[k]:
            yield "outline and axes by the smoother", DOUBT


def state_strip(canvas: Canvas, track: Trajectory, k: int, corner: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw the states of all frames side by side, with a mark at frame k; a pixel shows its worst frame."""
    (left, top), (width, height) = corner, size
    state = np.where(track.valid, shown_flags(track) != 0, 2)
    edges = np.linspace(0, len(state), width + 1)
    first = edges[:-1].astype(int)
    last = np.maximum(np.ceil(edges[1:]).astype(int), first + 1)
    worst = [int(state[a:b].max()) for a, b in zip(first, last, strict=True)]
    canvas.pixels[top : top + height, left : left + width] = np.array([GOOD, DOUBT, LOST], np.uint8)[worst]
    at = round((k + 0.5) / len(track) * width)
    canvas.pixels[top - 2 : top + height + 2, left + max(0, at - 1) : left + at + 1] = 255


def crop_side(half_px: float) -> int:
    """Return the samples along a crop's side: the picture's pixels, at most the panel's."""
    return max(48, min(SIDE, round(2 * half_px))) if np.isfinite(half_px) else SIDE


def crop_panel(canvas: Canvas, corner: tuple[int, int], side: int, window: CropWindow) -> Panel:
    """Return a square panel, `side` px wide, that shows a window."""
    return Panel(canvas, corner, (side, side), window.centre_px - window.half_px, side / (2 * window.half_px))


def draw_pictures(
    panels: Sequence[Panel],
    view: OverlayView,
    k: int,
    picture: Shown | None,
    window: CropWindow,
    others: Sequence[OverlayView] = (),
) -> bool:
    """Show crop, re-rendered sphere (with `others`) and, in a third panel, residual; return whether rendered."""
    grey = None if picture is None else crop(picture, window)
    if grey is not None:
        panels[0].show(view.shown(grey))
    if view.light is None or not view.model.path.whole[k]:
        return False
    model = rendered((view, *others), k, grey, window)
    panels[1].show(view.shown(model))
    if grey is not None:
        for panel in panels[2:]:
            panel.show(residual_colours((grey - model) / contrast(view.light)))
    return True


def rendered(
    views: Sequence[OverlayView], k: int, filmed: NDArray[np.float32] | None, window: CropWindow
) -> NDArray[np.float32]:
    """Return the spheres of one camera, nearer ones in front, (side, side); NaN outside them."""
    whole = np.full((window.side, window.side), np.nan, np.float32)
    known = [(view, view.light) for view in views if view.model.path.whole[k] and view.light is not None]
    for view, light in sorted(known, key=lambda one: one[0].depth_mm(k)):
        there = np.isnan(whole)
        shown = None if filmed is None else np.where(there, filmed, np.float32(np.nan))
        whole = np.where(there, lit_picture(light, view.model.look(k, window), shown), whole)
    return whole


def residual_colours(residual: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a residual relative to the contrast as colours: blue too dark, black equal, orange too bright."""
    share = np.clip(np.nan_to_num(residual) / RESIDUAL_REACH, -1, 1)[..., None]
    ends = np.where(share < 0, *np.array([AXES[2], AXES[0]], np.float32))
    colours = np.asarray(np.abs(share) * ends, np.uint8)
    colours[np.isnan(residual)] = BLANK
    return colours


def draw_outline(panel: Panel, view: OverlayView, k: int) -> None:
    """Draw the outline of frame k; dotted if it is the smoother's."""
    path = view.model.path
    panel.line(outline_px(view.model.camera, path, k), OUTLINE, 1, dotted=bool(path.smoothed[k]))


def draw_axes(panel: Panel, view: OverlayView, k: int, letters: bool = True) -> None:
    """Draw the body axes of frame k: solid towards the camera, dotted away; nothing without an orientation."""
    path, centre = view.model.path, view.trail_px[k]
    if not path.whole[k]:
        return
    tips, near = axes_px(view.model.camera, path, k)
    for tip, towards, colour, letter in zip(tips, near, AXES, "xyz", strict=True):
        panel.line(np.stack([centre, tip]), colour, 2, dotted=not towards)
        if letters:
            panel.text(centre + 1.16 * (tip - centre), letter, 15, colour)


def own_distance_px(view: OverlayView, seen: CameraTrack, k: int) -> float:
    """Return the distance of a camera's own centre from the track's, px; NaN if either is missing."""
    return float(np.linalg.norm(seen.centre_px[k] - view.trail_px[k]))


def scale_bar(canvas: Canvas, at: tuple[int, int], width: int, light: DiskLight | None) -> None:
    """Draw the residual's scale, `width` px wide."""
    bar = canvas.pixels[at[1] : at[1] + 10, at[0] : at[0] + width]
    ramp = np.linspace(-RESIDUAL_REACH, RESIDUAL_REACH, width, dtype=np.float32)
    bar[:] = residual_colours(np.broadcast_to(ramp, bar.shape[:2]))
    reach = f"{100 * RESIDUAL_REACH:.0f} %"
    for share, words, anchor in ((0, f"-{reach}", "ls"), (0.5, "filmed minus model", "ms"), (1, f"+{reach}", "rs")):
        canvas.text((at[0] + share * width, at[1] + 26), words, 13, FAINT, anchor)
    words = "of white minus black paint" + ("" if light is None else f" ({contrast(light):.0f} levels)")
    canvas.text((at[0] + 0.5 * width, at[1] + 44), words, 13, FAINT, "ms")
