"""A first look at movies of which nothing is known: how large the ball is, and whether it stays in its place."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import PinholeCamera
from sphereorient.cameras.model import middle_of_picture
from sphereorient.errors import ExperimentError, MovieError
from sphereorient.experiment.recording import Progress, silent
from sphereorient.experiment.stream import CameraStream
from sphereorient.files.threads import side_by_side
from sphereorient.locate import LocateSettings
from sphereorient.locate.outline import Outline
from sphereorient.locate.scene import fixed_ball
from sphereorient.movies import Movie, open_movie
from sphereorient.preflight.sample import sample_movie

STAYS = 0.15  # of the radius: a ball whose outlines scatter by less stays in its place
SEEN = 0.4  # share of the frames in which a ball that moves is found at least
PICTURES = 40  # all over the movie, for a ball that stays


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstLook:
    """What a movie shows; made by `look_at`."""

    name: str  # of its camera
    movie: Movie
    rate_hz: float | None  # by exact time stamps; None: the file has none
    diameter_px: float | None  # None: no ball was found
    stays: bool | None  # whether the ball stays in its place; None: not known
    found: int  # frames with a ball, of `looked`
    looked: int
    frame: int  # one in which the ball was found, where there is one
    picture: NDArray[Any]  # (H, W), of it
    outline: Outline | None  # of the ball in it


def look_at(
    paths: Sequence[Path | str], progress: Progress = silent, shown: NDArray[np.bool_] | None = None
) -> list[FirstLook]:
    """Look at the movies of one ball; raise MovieError for a movie that cannot be read.
    `shown` (H, W) is False where something hides the ball of the only movie.
    """
    movies = [open_movie(path) for path in paths]
    looks = []
    progress("look", 0, len(movies))
    for look in side_by_side(lambda k: look_at_movie(f"cam{k + 1}", movies[k], shown), range(len(movies))):
        looks.append(look)
        progress("look", len(looks), len(movies))
    return looks


def look_at_movie(name: str, movie: Movie, shown: NDArray[np.bool_] | None = None) -> FirstLook:
    """Look at the movie of a camera; `shown` (H, W) is False where something hides the ball."""
    settings, stream = LocateSettings(), _stream(name, movie, shown)
    sample = sample_movie(stream, None, settings)
    outlines = [outline for _, outline in sample.balls]
    with_ball = [k for k, (outline, _) in enumerate(sample.found) if outline is not None]
    readable = [k for k, picture in enumerate(sample.picture) if picture is not None]
    k, looked = with_ball[len(with_ball) // 2] if with_ball else readable[0], len(readable)
    picture, outline = sample.picture[k], sample.found[k][0]
    assert picture is not None
    seen, stays = len(outlines) >= SEEN * looked, None
    if seen:
        places = np.array([(one.u_px, one.v_px) for one in outlines])
        radius_px = float(np.median([one.radius_px for one in outlines]))
        stays = bool(np.median(np.hypot(*(places - np.median(places, axis=0)).T)) < STAYS * radius_px)
    if stays or not seen:
        try:
            outline, _ = fixed_ball(stream.spread(PICTURES), settings, shown=shown)
            seen, stays = True, True
            radius_px = outline.radius_px
        except (ExperimentError, MovieError):
            stays = None
    rate_hz = None if movie.times_s is None or len(movie) < 2 else 1 / float(np.median(np.diff(movie.times_s)))
    return FirstLook(
        name=name,
        movie=movie,
        rate_hz=rate_hz,
        diameter_px=2 * radius_px if seen else None,
        stays=stays,
        found=looked if stays else len(outlines),
        looked=looked,
        frame=int(sample.row[k]),
        picture=picture,
        outline=outline if seen else None,
    )


def _stream(name: str, movie: Movie, shown: NDArray[np.bool_] | None) -> CameraStream:
    """Return a movie with a camera that stands for one not known: a ball sought in pictures alone needs none."""
    height, width = movie.frame_shape
    pose: dict[str, Any] = {"R_cam_lab": torch.eye(3, dtype=torch.float64), "T_cam_lab_mm": (0.0,) * 3}
    lens: dict[str, Any] = {"f_px": 2.0 * height, "centre_px": middle_of_picture((width, height))}
    camera = PinholeCamera(image_size=(width, height), **lens, **pose)
    return CameraStream(name=name, camera=camera, movie=movie, rows=np.arange(len(movie)), shown=shown)
