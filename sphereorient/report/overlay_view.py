"""How one camera's pictures are shown: grey scale, residual, outline and axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.report import overlay_canvas as ink
from sphereorient.report.overlay_canvas import Canvas, Panel
from sphereorient.report.overlay_model import LightFit, Model, axes_px, outline_px
from sphereorient.trajectory import CameraTrack

LABEL_AT = 1.16  # of the ball's radius: letters of the axes
RESIDUAL_REACH = 0.5  # of the difference of white and black paint: the ends of the residual's scale
BLANK = 45  # grey of pixels without a residual


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """What is the same in all pictures of one camera; made by overlay.views, read by the page."""

    name: str
    model: Model
    light: LightFit | None  # None: no frame to match it by
    black: float  # grey level shown black
    white: float
    half_px: float  # of the crop
    trail_px: NDArray[np.float64]  # (N, 2), where the ball's centre is in the picture

    @property
    def why_unlit(self) -> str:
        """Why nothing can be rendered, where there is no light."""
        return "no map of the paint" if self.model.texture is None else "no valid frame"


def shown(grey: NDArray[np.generic], view: View) -> NDArray[np.uint8]:
    """Return grey levels as they are shown, (H, W) 0 .. 255; NaN is black."""
    share = (np.asarray(grey, np.float32) - view.black) / (view.white - view.black)
    return np.asarray(np.clip(np.nan_to_num(share), 0, 1) * 255, np.uint8)


def residual_colours(residual: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a residual in shares of the contrast as colours: blue too dark, black equal, orange too bright."""
    share = np.clip(np.nan_to_num(residual) / RESIDUAL_REACH, -1, 1)[..., None]
    ends = np.where(share < 0, np.array(ink.AXES[2], np.float32), np.array(ink.AXES[0], np.float32))
    colours: NDArray[np.uint8] = np.asarray(np.abs(share) * ends, np.uint8)
    colours[np.isnan(residual)] = BLANK
    return colours


def draw_track(panel: Panel, view: View, k: int, letters: bool = True) -> None:
    """Draw outline and body axes of frame k into a panel."""
    draw_outline(panel, view, k)
    draw_axes(panel, view, k, letters)


def draw_outline(panel: Panel, view: View, k: int) -> None:
    """Draw the outline of frame k; dotted where it is the smoother's."""
    path = view.model.path
    panel.line(outline_px(view.model.camera, path, k), ink.OUTLINE, 1, dotted=bool(path.smoothed[k]))


def draw_axes(panel: Panel, view: View, k: int, letters: bool = True) -> None:
    """Draw the body axes of frame k: solid towards the camera, dotted away; nothing without an orientation."""
    path, centre = view.model.path, view.trail_px[k]
    if not path.whole[k]:
        return
    tips, near = axes_px(view.model.camera, path, k)
    for tip, towards, colour, letter in zip(tips, near, ink.AXES, "xyz", strict=True):
        panel.line(np.stack([centre, tip]), colour, 2, dotted=not towards)
        if letters:
            panel.text(centre + LABEL_AT * (tip - centre), letter, 15, colour)


def own_distance_px(view: View, seen: CameraTrack, k: int) -> float:
    """Return how far from the track's centre a camera by itself sees the ball, px; NaN where either has none."""
    return float(np.linalg.norm(seen.centre_px[k] - view.trail_px[k]))


def draw_own(panel: Panel, seen: CameraTrack, k: int) -> None:
    """Draw the circle that a camera sees by itself."""
    angle = np.linspace(0, 2 * np.pi, 73)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    panel.line(seen.centre_px[k] + seen.radius_px[k] * around, ink.INK, 1, dotted=True)


def scale_bar(canvas: Canvas, at: tuple[int, int], width: int, light: LightFit | None) -> None:
    """Draw the residual's scale, `width` px wide."""
    bar = canvas.pixels[at[1] : at[1] + 10, at[0] : at[0] + width]
    ramp = np.linspace(-RESIDUAL_REACH, RESIDUAL_REACH, width, dtype=np.float32)
    bar[:] = residual_colours(np.broadcast_to(ramp, bar.shape[:2]))
    reach = f"{100 * RESIDUAL_REACH:.0f} %"
    for share, words, anchor in ((0, f"-{reach}", "ls"), (0.5, "filmed less model", "ms"), (1, f"+{reach}", "rs")):
        canvas.text((at[0] + share * width, at[1] + 26), words, 13, ink.FAINT, anchor)
    told = "of white less black paint" if light is None else f"of white less black paint ({light.contrast:.0f} levels)"
    canvas.text((at[0] + 0.5 * width, at[1] + 44), told, 13, ink.FAINT, "ms")
