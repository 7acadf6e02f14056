"""The movie with what was measured drawn on it, and the measured sphere re-rendered beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, TrackError, refusal
from sphereorient.experiment import Experiment, open_movies
from sphereorient.experiment.given import given_mask
from sphereorient.experiment.stream import CameraStream, pictures_of
from sphereorient.experiment.timeline import NONE, timeline
from sphereorient.files.yaml_file import refuse_unknown
from sphereorient.movies import Grey, Movie
from sphereorient.report.overlay_model import MARGIN, LightFit, Model, crop, fit_light, path_of, radius_of
from sphereorient.report.overlay_page import Page, crop_side
from sphereorient.report.overlay_video import check_video_name, write_video
from sphereorient.report.overlay_view import View
from sphereorient.sphere import load_texture, reduced_texture
from sphereorient.trajectory import Trajectory

SAMPLE = 16  # frames from which light and brightness are taken
NEAR_FRAMES = 0.5  # of the time between frames: a frame of the track further from all of the movie's has no picture
DARK, BRIGHT = 0.5, 99.8  # percentiles of the sampled pictures that are shown black and white
Rows = NDArray[np.int64]


def overlay_movie(
    track: Trajectory,
    experiment: Experiment,
    path: Path,
    *,
    cameras: Sequence[str] | None = None,
    frames: tuple[int | None, int | None] = (None, None),
    every: int = 1,
    fps: float = 25.0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write a movie with outline, body axes and trail, and beside it crop, re-rendered sphere and residual.

    Frames are read, drawn and written one by one: a long movie needs no more memory than a short one.

    Args:
        track: what was measured.
        experiment: what it was measured from; movies and texture are opened.
        path: .mp4, .mov or .mkv; an old one is replaced at the end.
        cameras: names; None: those of the track.
        frames: first, last + 1 by the experiment's numbers; None: from the first, to the last of the track.
        every: of so many frames one is shown.
        fps: frames shown a second.
        progress: called with frames done and all frames.

    Returns:
        The number of pictures written.

    Raises:
        ExperimentError: a camera that track or experiment do not have.
        TrackError: no frame of the track lies in the range.
        OutputError: a name that is no movie's, or a file that cannot be written.
    """
    check_video_name(path)
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, cameras, opened)
        chosen = _chosen(page.numbers, frames, every)
        return write_video(path, _pictures(page, streams, chosen, progress), fps)


def prepared(
    track: Trajectory, experiment: Experiment, cameras: Sequence[str] | None, opened: ExitStack
) -> tuple[Page, dict[str, CameraStream]]:
    """Open the movies and learn what all pictures share: light, brightness, sizes.

    Args:
        track: what was measured.
        experiment: what it was measured from.
        cameras: names; None: those of the track.
        opened: closes the movies.

    Returns:
        The page, and for each camera its movie with the picture of every frame of the track.
    """
    names = _names(track, experiment, cameras)
    texture = None if experiment.texture_path is None else load_texture(experiment.texture_path)
    movies = {name: opened.enter_context(movie) for name, movie in open_movies(experiment, names).items()}
    numbers, rows = frames_of(track, experiment, movies)
    where = path_of(track, radius_of(experiment))
    streams = {
        name: CameraStream(
            name=name,
            camera=experiment.cameras[name],
            movie=movies[name],
            rows=rows[name],
            shown=given_mask(experiment, name, movies[name].frame_shape),
        )
        for name in names
    }
    models = [Model(camera=experiment.cameras[name], texture=texture, path=where) for name in names]
    views = [_view(track, model, streams[name]) for name, model in zip(names, models, strict=True)]
    return Page(track=track, numbers=numbers, views=views), streams


def frames_of(track: Trajectory, experiment: Experiment, movies: Mapping[str, Movie]) -> tuple[Rows, dict[str, Rows]]:
    """Find the frames of a track, which may be of a part of the experiment, by their times.

    Returns:
        The experiment's numbers (N,), and the pictures of each camera (N,), NONE where it has none.

    Raises:
        TrackError: no frame of the track lies in the experiment.
    """
    known = timeline(experiment, movies)
    after = np.searchsorted(known.time_s, track.time).clip(1, max(len(known) - 1, 1))
    low, high = after - 1, np.minimum(after, len(known) - 1)
    nearer = np.abs(known.time_s[high] - track.time) < np.abs(known.time_s[low] - track.time)
    at = np.where(nearer, high, low)
    step = known.frame_s if len(known) > 1 else np.inf
    near = np.abs(known.time_s[at] - track.time) <= NEAR_FRAMES * step
    if not near.any():
        got = "none" if not len(track) else f"times {track.time[0]:.4g} .. {track.time[-1]:.4g} s"
        expected = f"frames at {known.time_s[0]:.4g} .. {known.time_s[-1]:.4g} s as in {experiment.path}"
        do = "pass the experiment that the track was measured from"
        raise TrackError(refusal("track", expected=expected, got=got, do=do))
    rows = {name: np.where(near, row[at], NONE) for name, row in known.rows.items()}
    return known.number[at], rows


def _names(track: Trajectory, experiment: Experiment, cameras: Sequence[str] | None) -> list[str]:
    names = list(track.cameras) if cameras is None else list(cameras)
    for name in names:
        if name not in track.cameras:
            raise ExperimentError(refuse_unknown(name, track.cameras, "cameras of the track"))
        if name not in experiment.cameras:
            raise ExperimentError(refuse_unknown(name, experiment.cameras, f"{experiment.path}, movies"))
    if not names:
        got, do = "none", "write --cameras cam1, or leave it out"
        raise ExperimentError(refusal("--cameras", expected="names of cameras", got=got, do=do))
    return names


def _chosen(numbers: Rows, frames: tuple[int | None, int | None], every: int) -> Rows:
    first, last = frames
    wanted = np.ones(len(numbers), bool)
    if first is not None:
        wanted &= numbers >= first
    if last is not None:
        wanted &= numbers < last
    chosen = np.flatnonzero(wanted)[::every]
    if not len(chosen):
        expected, do = f"frames within {numbers[0]}:{numbers[-1] + 1}", "correct --frames"
        got = f"{'' if first is None else first}:{'' if last is None else last}"
        raise TrackError(refusal("--frames", expected=expected, got=got, do=do))
    return chosen


def _pictures(
    page: Page, streams: Mapping[str, CameraStream], chosen: Rows, progress: Callable[[int, int], None]
) -> Iterator[NDArray[np.uint8]]:
    readers = [pictures_at(stream, chosen) for stream in streams.values()]
    for done, (k, *pictures) in enumerate(zip(chosen.tolist(), *readers, strict=True), start=1):
        yield page.draw(k, dict(zip(streams, pictures, strict=True)))
        progress(done, len(chosen))


def pictures_at(stream: CameraStream, chosen: Rows) -> Iterator[Grey | None]:
    """Return a camera's pictures of some frames of the track, in increasing order; None where there is none."""
    return pictures_of(stream.movie, stream.rows[chosen])


def _view(track: Trajectory, model: Model, stream: CameraStream) -> View:
    """Learn light and brightness from frames spread over the track."""
    seen = track.cameras[stream.name]
    position = torch.from_numpy(model.path.position_mm)
    radius = seen.radius_px[np.isfinite(seen.radius_px)]
    half_px = MARGIN * float(np.percentile(radius, 98)) if len(radius) else float("nan")
    readable = stream.rows != NONE
    good = np.flatnonzero(readable & track.valid & model.path.whole)
    sampled = good if len(good) else np.flatnonzero(readable)
    sampled = np.unique(sampled[np.linspace(0, len(sampled) - 1, min(SAMPLE, len(sampled))).round().astype(int)])
    pictures = [(int(k), p) for k, p in zip(sampled, pictures_at(stream, sampled), strict=True) if p is not None]
    greys = np.concatenate([np.zeros(0), *(p[::3, ::3].ravel() for _, p in pictures)])
    black, white = np.percentile(greys, (DARK, BRIGHT)) if len(greys) else (0.0, 1.0)
    light: LightFit | None = None
    if len(good) and np.isfinite(half_px) and model.texture is not None:
        side = crop_side(half_px)
        model = replace(model, texture=reduced_texture(model.texture, side / MARGIN))
        windows = [(k, model.window(k, half_px, side), picture) for k, picture in pictures]
        light = fit_light([(model.look(k, window), crop(picture, window)) for k, window, picture in windows])
    return View(
        name=stream.name,
        model=model,
        light=light,
        black=float(black),
        white=max(float(white), float(black) + 1),
        half_px=half_px,
        trail_px=model.camera.project(position).numpy(),
    )
