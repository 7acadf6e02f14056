"""The few frames that the check looks at: a spread sample, neighbours, two stretches; and the ball in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.cameras import Camera
from sphereorient.errors import MovieError, refusal
from sphereorient.experiment import Experiment
from sphereorient.experiment.given import given_mask, given_scene
from sphereorient.experiment.stream import pictures_of, spread_frames, uniform
from sphereorient.experiment.timeline import NONE, Timeline
from sphereorient.locate import (
    Background,
    LocateSettings,
    Sightings,
    find_ball,
    learn_background,
    screened,
    sightings_of,
)
from sphereorient.locate.background import measure_background
from sphereorient.locate.find import Found
from sphereorient.locate.outline import Outline
from sphereorient.movies import Movie
from sphereorient.trajectory import Reason

SPREAD = 25  # frames all over the movie: enough for a background
EVERY = 3  # of them is looked at with the frame after: where does the ball move, which frames are repeated
FEW = 0.2  # share of the frames; a ball that is found in fewer is looked for in other sizes
BALLS = 12  # frames in which a ball of unknown size is looked for
SIZES = 1.4  # ratio of the diameters tried where the size is unknown: the tolerance of the outline covers it
SMALLEST_PX = 30.0  # of these diameters: paint on a smaller ball is not read

Grey = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Pictures of one camera and the ball in them, n frames; made by `look_at`, read by the findings."""

    name: str
    camera: Camera
    movie: Movie
    frame: NDArray[np.int64]  # (n,), places in the timeline, increasing
    row: NDArray[np.int64]  # (n,), in the movie's own counting; NONE where there is no picture
    picture: tuple[Grey | None, ...]  # n; None where there is none, or none that can be decoded
    background: Background
    diameter_px: float  # looked for
    expected_px: float | None  # what cameras and diameter say of it; None where they do not
    screen: tuple[Reason, ...]  # n, whether the picture as a whole may show a ball
    found: tuple[Found, ...]  # n

    @cached_property
    def sightings(self) -> Sightings:
        """The outlines as arrays."""
        return sightings_of(self.found)

    @property
    def shown(self) -> list[tuple[int, Grey]]:
        """Places in this record and pictures of the frames that have one."""
        return [(k, picture) for k, picture in enumerate(self.picture) if picture is not None]

    @property
    def balls(self) -> list[tuple[Grey, Outline]]:
        """Picture and outline of the frames with a ball."""
        return [
            (picture, outline)
            for picture, (outline, _) in zip(self.picture, self.found, strict=True)
            if picture is not None and outline is not None
        ]

    def at(self, frames: Sequence[int]) -> Look:
        """Return the part with some of the frames."""
        place = np.searchsorted(self.frame, frames).tolist()
        return replace(
            self,
            frame=self.frame[place],
            row=self.row[place],
            picture=tuple(self.picture[k] for k in place),
            screen=tuple(self.screen[k] for k in place),
            found=tuple(self.found[k] for k in place),
        )


def pair_starts(count: int) -> list[int]:
    """Return the frames of `sample_frames` that are looked at with the frame after."""
    return [k for k in spread_frames(range(count), SPREAD)[::EVERY] if k + 1 < count]


def sample_frames(count: int) -> list[int]:
    """Return places in a timeline of `count` frames to look at first: evenly spread ones, some with their neighbour."""
    return sorted({*spread_frames(range(count), SPREAD), *(k + 1 for k in pair_starts(count))})


def look_at(
    name: str,
    experiment: Experiment,
    movie: Movie,
    timeline: Timeline,
    diameter_px: float | None,
    settings: LocateSettings,
) -> Look:
    """Read a spread sample of one camera's frames, learn the empty scene, and find the ball.

    Args:
        name: of the camera.
        experiment: its background pictures and whether the ball is fixed.
        movie: of the camera.
        timeline: of the experiment.
        diameter_px: expected diameter; None: taken from the pictures.
        settings: of the room locate.

    Raises:
        MovieError: not one of the frames looked at can be decoded.
        ExperimentError: a background picture that is none.
    """
    frame = np.asarray(sample_frames(len(timeline)), np.int64)
    row = timeline.rows[name][frame]
    picture = tuple(pictures_of(movie, row))
    shown = [one for one in picture if one is not None and not uniform(one)]
    shown = shown or [one for one in picture if one is not None]
    if not shown:
        do = "check that it plays; export it again if not"
        raise MovieError(refusal(str(movie.path), expected="pictures", got="none that can be decoded", do=do))

    def tried(size_px: float) -> Look:
        background = _empty_scene(name, experiment, movie, shown, size_px, settings)
        screen = _screen(row, picture, background)
        return Look(
            name=name,
            camera=experiment.cameras[name],
            movie=movie,
            frame=frame,
            row=row,
            picture=picture,
            background=background,
            diameter_px=size_px,
            expected_px=diameter_px,
            screen=screen,
            found=_found(picture, screen, background, size_px, settings),
        )

    first = tried(diameter_px if diameter_px is not None and diameter_px >= SMALLEST_PX else largest_px(movie) / 4)
    if diameter_px is not None and len(first.balls) > FEW * len(shown):
        return first
    # Unknown, or not of that size: whatever is as round as a ball.
    size_px = _size_in(shown, first.background, settings)
    return first if size_px is None else tried(size_px)


def largest_px(movie: Movie) -> float:
    """Return the diameter of the largest ball that is looked for in a movie, px."""
    return 0.9 * min(movie.frame_shape)


def look_closer(look: Look, timeline: Timeline, frames: Sequence[int], settings: LocateSettings) -> Look:
    """Look at other frames of the same camera: the same background, the same size of ball."""
    frame = np.asarray(frames, np.int64)
    row = timeline.rows[look.name][frame]
    picture = tuple(pictures_of(look.movie, row))
    screen = _screen(row, picture, look.background)
    found = _found(picture, screen, look.background, look.diameter_px, settings)
    return replace(look, frame=frame, row=row, picture=picture, screen=screen, found=found)


def _screen(row: NDArray[np.int64], picture: Sequence[Grey | None], background: Background) -> tuple[Reason, ...]:
    """Tell which pictures show nothing, as the tracker does; repeated are only those whose neighbour is here too."""
    told = []
    for k, one in enumerate(picture):
        if one is None:
            told.append(Reason.MISSING if row[k] == NONE else Reason.UNDECODABLE)
            continue
        neighbour = k > 0 and row[k] == row[k - 1] + 1
        told.append(screened(one, picture[k - 1] if neighbour else None, background).reason)
    return tuple(told)


def _found(
    picture: Sequence[Grey | None],
    screen: Sequence[Reason],
    background: Background,
    diameter_px: float,
    settings: LocateSettings,
) -> tuple[Found, ...]:
    return tuple(
        (None, reason)
        if one is None or reason not in (Reason.OK, Reason.REPEATED)
        else find_ball(one, background, diameter_px, settings)
        for one, reason in zip(picture, screen, strict=True)
    )


def _empty_scene(
    name: str,
    experiment: Experiment,
    movie: Movie,
    shown: Sequence[Grey],
    diameter_px: float,
    settings: LocateSettings,
) -> Background:
    """Learn what the camera shows without the ball, from frames that show something."""
    some = np.stack([shown[k] for k in spread_frames(range(len(shown)), SPREAD)])
    empty = given_scene(experiment, name, movie.frame_shape)
    if empty is None and experiment.fixed:
        return replace(_around(some), shown=given_mask(experiment, name, movie.frame_shape))
    return learn_background(some, diameter_px, settings, empty, given_mask(experiment, name, movie.frame_shape))


def _around(pictures: Grey) -> Background:
    """Guess the scene without a ball that never moves: what lies around it mostly is of one grey."""
    measured = measure_background(pictures)
    middle = np.full(measured.mean.shape, np.median(measured.mean), np.float32)
    noise = np.full(middle.shape, measured.typical_noise, np.float32)
    return Background(mean=middle, noise=noise, full_scale=measured.full_scale)


def _size_in(pictures: Sequence[Grey], background: Background, settings: LocateSettings) -> float | None:
    """Return the diameter of the ball, px, at which outlines are found best; None where none are."""
    largest = 0.9 * min(background.mean.shape)
    chosen = [pictures[k] for k in spread_frames(range(len(pictures)), BALLS)]
    best, size = 0.0, None
    while largest > SMALLEST_PX:
        outlines = [find_ball(picture, background, largest, settings)[0] for picture in chosen]
        seen = [outline for outline in outlines if outline is not None]
        merit = sum(outline.coverage for outline in seen)
        if merit > 1.05 * best:  # circles through paint are smaller than the ball's: of equals, the larger
            best, size = merit, 2 * float(np.median([outline.radius_px for outline in seen]))
        largest /= SIZES
    return size
