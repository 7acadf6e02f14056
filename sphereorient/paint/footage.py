"""The ball in every frame of the movies: where it is, and its surroundings cut out, so that movies are read once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.errors import PaintError, refusal
from sphereorient.experiment import Experiment
from sphereorient.locate import (
    Background,
    LocateSettings,
    Shot,
    Sightings,
    check_seen,
    expected_diameter_px,
    find_ball,
    find_positions,
    learn_background,
    repair,
    sightings_of,
)
from sphereorient.locate.given import given_scene
from sphereorient.orient.eye import Eye
from sphereorient.orient.pixels import LinesOfSight
from sphereorient.paint.fixed import fixed_ball
from sphereorient.paint.settings import PaintSettings

Picture = NDArray[Any]
Progress = Any  # (stage, frames done, frames in all); recording.Progress comes later in the order of rooms
REACH = 1.35  # half the side of what is cut out, in radii of the disk
GAP_SHARE = 0.3  # of the radius: lines of sight that usually pass at a greater distance see different balls


class Strip(Protocol):
    """One camera's pictures, as `reel.Reel` has them."""

    @property
    def name(self) -> str:
        """Of the camera."""

    @property
    def camera(self) -> Camera:
        """With its calibration."""

    @property
    def shown(self) -> NDArray[np.bool_] | None:
        """Where nothing hides the ball, (H, W); None: everywhere."""

    def spread(self, count: int) -> Picture:
        """Return at most `count` pictures spread evenly, (n, H, W)."""

    def shots(self, background: Background, first: int = 0, last: int | None = None) -> Iterator[Shot]:
        """Yield all pictures, those that cannot show the ball marked."""


class Source(Protocol):
    """Movies that are open, as `recording.Recording` has them."""

    @property
    def experiment(self) -> Experiment:
        """What is filmed."""

    @property
    def reels(self) -> Sequence[Strip]:
        """One a camera."""

    @property
    def radius_mm(self) -> float:
        """Of the sphere; 1 where lengths are in radii."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A piece of a picture."""

    grey: Picture
    top: int
    left: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Footage:
    """N frames of C cameras; made by `take_footage`, read by `learn_map`."""

    eyes: Sequence[Eye]
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
        window, scene = self.windows[camera][frame], self.eyes[camera].background.mean
        whole: Picture = scene.astype(np.float32)
        if window is not None:
            whole[window.top : window.top + len(window.grey), window.left : window.left + window.grey.shape[1]] = (
                window.grey
            )
        return whole

    def pictures(self, frames: Tensor) -> list[list[Picture]]:
        """Return all cameras' whole pictures of some frames (M,)."""
        return [[self.picture(k, c) for c in range(len(self.eyes))] for k in frames.tolist()]


def take_footage(source: Source, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> Footage:
    """Read the movies, find the ball, and cut it out.

    Raises:
        ExperimentError: the ball is not found.
        PaintError: one frame only, or cameras that see different balls.
    """
    take = _fixed if source.experiment.fixed else _moving
    eyes, sightings, windows = take(source, settings, locating, progress)
    check_seen(sightings)
    cameras = {eye.name: eye.camera for eye in eyes}
    diameter_mm = source.experiment.diameter_mm
    places = find_positions(sightings, cameras, diameter_mm)
    X = places.position_lab_mm
    if source.experiment.fixed:
        X = X.nanmedian(0).values.expand(len(X), 3).clone()
    elif len(eyes) > 1:
        gap = places.gap_mm[torch.isfinite(places.gap_mm)]
        if len(gap) and float(gap.median()) > GAP_SHARE * source.radius_mm:
            got = f"lines of sight that usually pass {float(gap.median()):.3g} mm from each other"
            do = "check the cameras, or learn from one of them"
            raise PaintError(refusal("movies", expected="one ball in both movies", got=got, do=do))
    there = torch.tensor([[window is not None for window in row] for row in windows]).T
    return Footage(
        eyes=eyes,
        windows=windows,
        position_lab_mm=X,
        seen=there & torch.isfinite(X).all(1)[:, None],
        radius_mm=source.radius_mm,
        fixed=source.experiment.fixed,
    )


Taken = tuple[list[Eye], Mapping[str, Sightings], list[list[Window | None]]]


def _moving(source: Source, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> Taken:
    """Take a ball that moves."""
    eyes, sightings, windows = [], {}, []
    cameras = {reel.name: reel.camera for reel in source.reels}
    for reel in source.reels:
        given = locating.diameter_px
        diameter_px = given or expected_diameter_px(reel.name, cameras, source.experiment.diameter_mm)
        empty = given_scene(source.experiment, reel.name, reel.camera.image_size[::-1])
        background = learn_background(reel.spread(settings.background_frames), diameter_px, locating, empty, reel.shown)
        eye = _eye(reel, background, diameter_px)
        found, row = [], []
        for k, shot in enumerate(reel.shots(background)):
            one = find_ball(shot.picture, background, diameter_px, locating) if shot.usable else (None, shot.reason)
            found.append(one)
            outline = one[0]
            row.append(None if outline is None else _cut(shot.picture, outline.u_px, outline.v_px, outline.radius_px))
            progress(f"{reel.name}: ball", k + 1, 0)
        eyes.append(eye)
        windows.append(row)
        sightings[reel.name] = repair(sightings_of(found), locating)
    return eyes, sightings, windows


def _fixed(source: Source, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> Taken:
    """Take a ball that stays in its place: what changes in the pictures is the ball."""
    eyes, sightings, windows = [], {}, []
    for reel in source.reels:
        pictures = reel.spread(4 * settings.background_frames)
        empty = given_scene(source.experiment, reel.name, reel.camera.image_size[::-1])
        where = fixed_ball(pictures, locating, empty, reel.shown)
        outline = where.outline
        eye = _eye(reel, where.scene, 2 * outline.radius_px)
        row: list[Window | None] = []
        found = []
        for k, shot in enumerate(reel.shots(where.scene)):
            cut = _cut(shot.picture, outline.u_px, outline.v_px, outline.radius_px) if shot.usable else None
            row.append(cut)
            found.append((outline if shot.usable else None, shot.reason))
            progress(f"{reel.name}: ball", k + 1, 0)
        eyes.append(eye)
        windows.append(row)
        sightings[reel.name] = sightings_of(found)
    return eyes, sightings, windows


def _eye(reel: Strip, background: Background, diameter_px: float) -> Eye:
    sight = LinesOfSight(reel.camera)
    return Eye(name=reel.name, camera=reel.camera, background=background, diameter_px=diameter_px, sight=sight)


def _cut(picture: Picture, u_px: float, v_px: float, radius_px: float) -> Window:
    reach = int(np.ceil(REACH * radius_px)) + 3
    top, left = max(0, round(v_px) - reach), max(0, round(u_px) - reach)
    grey = picture[top : round(v_px) + reach + 1, left : round(u_px) + reach + 1].copy()
    return Window(grey=grey, top=top, left=left)


def too_few(count: int) -> PaintError:
    """Word that one picture teaches nothing of how the ball turns."""
    do = "learn from a movie in which the ball turns"
    return PaintError(refusal("movies", expected="the ball in 2 frames at least", got=f"{count}", do=do))
