"""The ball in every frame of the movies: where it is, and its surroundings cut out, so that movies are read once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.given import given_scene
from sphereorient.experiment.recording import Progress, Recording
from sphereorient.locate import (
    CameraScene,
    Found,
    LocateSettings,
    Sightings,
    check_seen,
    fill_gaps,
    find_ball,
    find_positions,
    find_scene,
    screened_frames,
    sightings_of,
)
from sphereorient.locate.scene import fixed_ball
from sphereorient.mapping.settings import PaintSettings
from sphereorient.pose.fitter import CameraView

Picture = NDArray[Any]
REACH = 1.35  # half the side of what is cut out, in radii of the disk
GAP_SHARE = 0.3  # of the radius: lines of sight that usually pass at a greater distance see different balls


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A piece of a picture."""

    grey: Picture
    top: int
    left: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Footage:
    """N frames of C cameras; made by `take_footage`, read by `learn_map`."""

    views: Sequence[CameraView]
    windows: Sequence[Sequence[Window | None]]  # C times N, the ball's surroundings; None where it was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN where unknown
    seen: Tensor  # (N, C) bool, frames with a position and a picture
    radius_mm: float
    fixed: bool  # whether all positions are one

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.position_lab_mm)

    def picture(self, frame: int, camera: int) -> Picture:
        """Return a whole picture: what was cut out, on the empty scene."""
        window, scene = self.windows[camera][frame], self.views[camera].background.mean
        whole: Picture = scene.astype(np.float32)
        if window is not None:
            whole[window.top : window.top + len(window.grey), window.left : window.left + window.grey.shape[1]] = (
                window.grey
            )
        return whole

    def pictures(self, frames: Tensor) -> list[list[Picture]]:
        """Return all cameras' whole pictures of some frames (M,)."""
        return [[self.picture(k, c) for c in range(len(self.views))] for k in frames.tolist()]


def take_footage(
    recording: Recording, settings: PaintSettings, locating: LocateSettings, progress: Progress
) -> Footage:
    """Read the movies, find the ball, and cut it out.

    Raises:
        ExperimentError: the ball is not found.
        PaintError: one frame only, or cameras that see different balls.
    """
    take = _fixed if recording.experiment.fixed else _moving
    views, sightings, windows = take(recording, settings, locating, progress)
    check_seen(sightings)
    cameras = {view.name: view.camera for view in views}
    diameter_mm = recording.experiment.diameter_mm
    places = find_positions(sightings, cameras, diameter_mm)
    X = places.position_lab_mm
    if recording.experiment.fixed:
        X = X.nanmedian(0).values.expand(len(X), 3).clone()
    elif len(views) > 1:
        gap = places.gap_mm[torch.isfinite(places.gap_mm)]
        if len(gap) and float(gap.median()) > GAP_SHARE * recording.radius_mm:
            got = f"lines of sight that usually pass {float(gap.median()):.3g} mm from each other"
            do = "check the cameras, or learn from one of them"
            raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))
    there = torch.tensor([[window is not None for window in row] for row in windows]).T
    return Footage(
        views=views,
        windows=windows,
        position_lab_mm=X,
        seen=there & torch.isfinite(X).all(1)[:, None],
        radius_mm=recording.radius_mm,
        fixed=recording.experiment.fixed,
    )


Taken = tuple[list[CameraView], Mapping[str, Sightings], list[list[Window | None]]]


def _moving(recording: Recording, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> Taken:
    """Take a ball that moves."""
    views, sightings, windows = [], {}, []
    for stream in recording.streams:
        scene = find_scene(recording, stream, settings.background_frames, locating)
        found: list[Found] = []
        row: list[Window | None] = []
        for k, shot in enumerate(screened_frames(stream, scene.background)):
            one: Found = (None, shot.reason)
            if shot.usable:
                one = find_ball(shot.picture, scene.background, scene.diameter_px, locating)
            found.append(one)
            outline = one[0]
            row.append(None if outline is None else _cut(shot.picture, outline.u_px, outline.v_px, outline.radius_px))
            progress(f"{stream.name}: ball", k + 1, 0)
        views.append(CameraView.of(stream.name, stream.camera, scene))
        windows.append(row)
        sightings[stream.name] = fill_gaps(sightings_of(found), locating)
    return views, sightings, windows


def _fixed(recording: Recording, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> Taken:
    """Take a ball that stays in its place: what changes in the pictures is the ball."""
    views, sightings, windows = [], {}, []
    for stream in recording.streams:
        pictures = stream.spread(4 * settings.background_frames)
        empty = given_scene(recording.experiment, stream.name, stream.movie.frame_shape)
        where = fixed_ball(pictures, locating, empty, stream.shown)
        outline = where.outline
        row: list[Window | None] = []
        found: list[Found] = []
        for k, shot in enumerate(screened_frames(stream, where.scene)):
            cut = _cut(shot.picture, outline.u_px, outline.v_px, outline.radius_px) if shot.usable else None
            row.append(cut)
            found.append((outline if shot.usable else None, shot.reason))
            progress(f"{stream.name}: ball", k + 1, 0)
        views.append(
            CameraView.of(
                stream.name, stream.camera, CameraScene(background=where.scene, diameter_px=2 * outline.radius_px)
            )
        )
        windows.append(row)
        sightings[stream.name] = sightings_of(found)
    return views, sightings, windows


def _cut(picture: Picture, u_px: float, v_px: float, radius_px: float) -> Window:
    reach = int(np.ceil(REACH * radius_px)) + 3
    top, left = max(0, round(v_px) - reach), max(0, round(u_px) - reach)
    grey = picture[top : round(v_px) + reach + 1, left : round(u_px) + reach + 1].copy()
    return Window(grey=grey, top=top, left=left)


def too_few(count: int) -> PaintError:
    """Word that one picture teaches nothing of how the ball turns."""
    do = "learn from a movie in which the ball turns"
    return PaintError(refusal("movies", expected="the ball in 2 frames at least", got=f"{count}", do=do))
