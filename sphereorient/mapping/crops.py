"""The sphere cut out of every frame, so that movies are read once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.recording import Progress, Recording
from sphereorient.experiment.stream import given_scene
from sphereorient.locate import (
    CameraScene,
    Found,
    LocateSettings,
    check_seen,
    fill_gaps,
    find_ball,
    find_positions,
    find_scene,
    screened_frames,
    sightings_of,
)
from sphereorient.locate.scene import fixed_ball
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.fitter import CameraView, Fitter
from sphereorient.pose.pixels import Pixels, stacked

Picture = NDArray[Any]
REACH = 1.35  # half the side of a crop, in radii of the disk
GAP_SHARE = 0.3  # of the radius: a larger median distance between lines of sight means two different balls


@dataclass(frozen=True, kw_only=True, eq=False)
class Crop:
    """A piece of a picture."""

    grey: Picture
    top: int
    left: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Crops:
    """The sphere's surroundings in N frames of C cameras."""

    views: Sequence[CameraView]
    crops: Sequence[Sequence[Crop | None]]  # C times N; None where the ball was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN where unknown
    seen: Tensor  # (N, C) bool, frames with a position and a picture
    radius_mm: float
    fixed: bool  # whether all positions are the same

    def __len__(self) -> int:
        return len(self.position_lab_mm)

    def picture(self, frame: int, camera: int) -> Picture:
        """Return a whole picture: the crop pasted on the background."""
        crop, scene = self.crops[camera][frame], self.views[camera].background.mean
        whole: Picture = scene.astype(np.float32)
        if crop is not None:
            height, width = crop.grey.shape
            whole[crop.top : crop.top + height, crop.left : crop.left + width] = crop.grey
        return whole

    def pictures(self, frames: Tensor) -> list[list[Picture]]:
        """Return all cameras' whole pictures of some frames (M,)."""
        return [[self.picture(k, c) for c in range(len(self.views))] for k in frames.tolist()]

    def frames_with_ball(self) -> Tensor:
        """Return the frames (M,) int64 in which a camera sees the sphere; raise PaintError if fewer than two."""
        frames = torch.nonzero(self.seen.any(1))[:, 0]
        if len(frames) < 2:
            raise too_few(len(frames))
        return frames


def too_few(count: int) -> PaintError:
    """Return the error about a movie with one frame."""
    do = "use a movie in which the ball turns"
    return PaintError(refusal("movies", expected="the ball in 2 frames at least", got=f"{count}", do=do))


def take_crops(recording: Recording, settings: MapSettings, locating: LocateSettings, progress: Progress) -> Crops:
    """Crop the sphere in every frame; raise ExperimentError if it is not found, PaintError if cameras disagree."""
    experiment = recording.experiment
    views, rows, sightings = [], [], {}
    for stream in recording.streams:
        outline = None
        if experiment.fixed:  # what changes in the pictures is the ball
            pictures = stream.spread(4 * settings.background_frames)
            empty = given_scene(experiment, stream.name, stream.movie.frame_shape)
            outline, background = fixed_ball(pictures, locating, empty, stream.shown)
            scene = CameraScene(background=background, diameter_px=2 * outline.radius_px)
        else:
            scene = find_scene(recording, stream, settings.background_frames, locating)
        found: list[Found] = []
        row: list[Crop | None] = []
        for k, shot in enumerate(screened_frames(stream, scene.background)):
            one: Found = (outline if shot.usable else None, shot.reason)
            if shot.usable and outline is None:
                one = find_ball(shot.picture, scene.background, scene.diameter_px, locating)
            found.append(one)
            ball = one[0]
            row.append(None if ball is None else _cut(shot.picture, ball.u_px, ball.v_px, ball.radius_px))
            progress(f"{stream.name}: ball", k + 1, 0)
        views.append(CameraView.of(stream.name, stream.camera, scene))
        rows.append(row)
        seen = sightings_of(found)
        sightings[stream.name] = seen if experiment.fixed else fill_gaps(seen, locating)
    check_seen(sightings)
    positions = find_positions(sightings, {view.name: view.camera for view in views}, experiment.diameter_mm)
    X = positions.position_lab_mm
    if experiment.fixed:
        X = X.nanmedian(0).values.expand(len(X), 3).clone()
    elif len(views) > 1:
        gap = positions.gap_mm[torch.isfinite(positions.gap_mm)]
        if len(gap) and float(gap.median()) > GAP_SHARE * recording.experiment.radius_mm:
            got = f"lines of sight with a median distance of {float(gap.median()):.3g} mm"
            do = "check the cameras, or use one of them"
            raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))
    there = torch.tensor([[crop is not None for crop in row] for row in rows]).T
    return Crops(
        views=views,
        crops=rows,
        position_lab_mm=X,
        seen=there & torch.isfinite(X).all(1)[:, None],
        radius_mm=recording.experiment.radius_mm,
        fixed=experiment.fixed,
    )


def evenly_spread(rows: Tensor, count: int) -> Tensor:
    """Return at most `count` of the rows, evenly spread, ends included."""
    if len(rows) <= count:
        return rows
    return rows[torch.linspace(0, len(rows) - 1, count).round().long()]


def _cut(picture: Picture, u_px: float, v_px: float, radius_px: float) -> Crop:
    reach = int(np.ceil(REACH * radius_px)) + 3
    top, left = max(0, round(v_px) - reach), max(0, round(u_px) - reach)
    grey = picture[top : round(v_px) + reach + 1, left : round(u_px) + reach + 1].copy()
    return Crop(grey=grey, top=top, left=left)


def pixels_of(crops: Crops, fitter: Fitter, frames: Tensor, wanted: int, extra_px: float = 0.0) -> Pixels:
    """Return about `wanted` pixels of each disk, after a blur of the picture by `extra_px`."""
    level = replace(fitter.optics.fine, extra_px=extra_px)
    X = crops.position_lab_mm[frames]
    radius_px = float(fitter.largest_px(X).max())
    parts = []
    for k in range(len(frames)):
        whole = fitter.pixels(crops.pictures(frames[k : k + 1]), X[k : k + 1], level, radius_px)
        parts.append(whole.thinned(max(1, round(whole.grey.shape[1] / wanted))))
    return stacked(parts)
