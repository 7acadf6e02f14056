"""The movie with the measurement drawn on it, and the re-rendered sphere beside it."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, OutputError, TrackError, refusal
from sphereorient.experiment import Experiment, open_movies
from sphereorient.experiment.recording import CameraStream, given_mask, pictures_of, spread_frames
from sphereorient.experiment.timeline import NONE, timeline
from sphereorient.files.whole_file import check_ending, put_aside
from sphereorient.files.yaml_file import refuse_unknown
from sphereorient.movies import Movie
from sphereorient.report.overlay_model import MARGIN, OverlayModel, crop, fit_light, path_of
from sphereorient.report.overlay_page import Ball, OverlayPage, OverlayView, crop_side
from sphereorient.sphere import load_texture, reduced_texture
from sphereorient.trajectory import Tracks, Trajectory
from sphereorient.trajectory.datasets import nearest_rows

SAMPLE = 16  # frames for light and brightness
DARK, BRIGHT = 0.5, 99.8  # percentiles of the sampled pictures shown as black and white
FORMATS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
Rows = NDArray[np.int64]
Advance = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class FrameSelection:
    """The frames and cameras of an overlay."""

    cameras: Sequence[str] | None = None  # names; None: those of the track
    first: int | None = None  # the experiment's number; None: from the first frame
    last: int | None = None  # + 1; None: to the last frame of the track
    every: int = 1  # show every n-th frame

    def rows(self, numbers: Rows) -> Rows:
        """Return the rows to show, from the experiment's numbers of all frames (N,); TrackError if there are none."""
        first = -np.inf if self.first is None else self.first
        last = np.inf if self.last is None else self.last
        chosen = np.flatnonzero((numbers >= first) & (numbers < last))[:: self.every]
        if not len(chosen):
            expected, do = f"frames within {numbers[0]}:{numbers[-1] + 1}", "correct --frames"
            got = f"{'' if self.first is None else self.first}:{'' if self.last is None else self.last}"
            raise TrackError(refusal("--frames", expected=expected, got=got, do=do))
        return chosen


def overlay_movie(
    tracks: Trajectory | Mapping[str, Trajectory],
    experiment: Experiment,
    path: Path,
    selection: FrameSelection | None = None,
    fps: float = 25.0,
    progress: Advance = lambda done, total: None,
) -> int:
    """Write a movie (.mp4, .mov, .mkv) of frame, crop, re-rendered sphere and residual of all spheres; return the count
    of pictures. Raises the errors of `prepared` and `write_video`, and TrackError if no frame of the track is in the
    range.
    """
    check_ending(path, "--out", FORMATS)
    selection = selection or FrameSelection()
    with ExitStack() as opened:
        page, streams = prepared(tracks, experiment, selection.cameras, opened)
        chosen = selection.rows(page.numbers)

        def drawn() -> Iterator[NDArray[np.uint8]]:
            for done, (k, pictures) in enumerate(pictures_by_row(streams, chosen), start=1):
                yield page.draw(k, pictures)
                progress(done, len(chosen))

        return write_video(path, drawn(), fps)


def prepared(
    tracks: Trajectory | Mapping[str, Trajectory],
    experiment: Experiment,
    cameras: Sequence[str] | None,
    opened: ExitStack,
) -> tuple[OverlayPage, dict[str, CameraStream]]:
    """Return the common data of all pictures (light, brightness, sizes), and the streams by camera; `opened` closes
    them. Raises ExperimentError (a camera missing in track or experiment), TrackError (track of another experiment).
    """
    known = list(Tracks.of(tracks).values())
    names = list(known[0].cameras) if cameras is None else list(cameras)
    for name in names:
        if name not in known[0].cameras:
            raise ExperimentError(refuse_unknown(name, known[0].cameras, "cameras of the track"))
    if not names:
        got, do = "none", "add e.g. --cameras cam1, or leave it out"
        raise ExperimentError(refusal("--cameras", expected="names of cameras", got=got, do=do))
    numbers, streams = streams_of(known[0], experiment, names, opened)
    balls = []
    for track in known:
        sphere = experiment.of(track.sphere)
        texture = None if sphere.texture_path is None else load_texture(sphere.texture_path)
        where = path_of(track, sphere.radius_mm)
        models = [OverlayModel(camera=experiment.cameras[name], texture=texture, path=where) for name in streams]
        views = [_view(track, *each) for each in zip(models, streams.values(), strict=True)]
        balls.append(Ball(track=track, views=views))
    return OverlayPage(numbers=numbers, balls=balls), streams


def streams_of(
    track: Trajectory, experiment: Experiment, names: Sequence[str], opened: ExitStack
) -> tuple[Rows, dict[str, CameraStream]]:
    """Find a track's frames by time: their numbers (N,), and the streams by camera; TrackError if there are none."""
    movies = {name: opened.enter_context(movie) for name, movie in open_movies(experiment, names).items()}
    known = timeline(experiment, movies)
    at, near = nearest_rows(known.time_s, track.time)
    if not near.any():
        got = "none" if not len(track) else f"times {track.time[0]:.4g} .. {track.time[-1]:.4g} s"
        expected = f"frames at {known.time_s[0]:.4g} .. {known.time_s[-1]:.4g} s as in {experiment.path}"
        do = "pass the experiment that the track was measured from"
        raise TrackError(refusal("track", expected=expected, got=got, do=do))
    streams = {
        name: CameraStream(
            name=name,
            camera=experiment.cameras[name],
            movie=movie,
            rows=np.where(near, known.rows[name][at], NONE),
            shown=given_mask(experiment, name, movie.frame_shape),
        )
        for name, movie in movies.items()
    }
    return known.number[at], streams


def pictures_by_row(
    streams: Mapping[str, CameraStream], rows: Rows, read: Callable[[Movie, Rows], Iterator[Any]] = pictures_of
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield increasing rows of a track with the picture of each camera, as `read` yields it; None: missing."""
    readers = [read(stream.movie, stream.rows[rows]) for stream in streams.values()]
    for k, *found in zip(rows.tolist(), *readers, strict=True):
        yield k, dict(zip(streams, found, strict=True))


def _view(track: Trajectory, model: OverlayModel, stream: CameraStream) -> OverlayView:
    seen = track.cameras[stream.name]
    position = torch.from_numpy(model.path.position_mm)
    radius = seen.radius_px[np.isfinite(seen.radius_px)]
    half_px = MARGIN * float(np.percentile(radius, 98)) if len(radius) else float("nan")
    readable = stream.rows != NONE
    good = np.flatnonzero(readable & track.valid & model.path.whole)
    sampled = good if len(good) else np.flatnonzero(readable)
    chosen = sampled[spread_frames(range(len(sampled)), SAMPLE)]
    pictures = [(k, found[stream.name]) for k, found in pictures_by_row({stream.name: stream}, chosen)]
    known = [(k, picture) for k, picture in pictures if picture is not None]
    greys = np.concatenate([np.zeros(0), *(picture[::3, ::3].ravel() for _, picture in known)])
    black, white = np.percentile(greys, (DARK, BRIGHT)) if len(greys) else (0.0, 1.0)
    light = None
    if len(good) and np.isfinite(half_px) and model.texture is not None:
        side = crop_side(half_px)
        model = replace(model, texture=reduced_texture(model.texture, side / MARGIN))
        windows = [(k, model.window(k, half_px, side), picture) for k, picture in known]
        light = fit_light((model.look(k, window), crop(picture, window)) for k, window, picture in windows)
    return OverlayView(
        name=stream.name,
        model=model,
        light=light,
        black=float(black),
        white=max(float(white), float(black) + 1),
        half_px=half_px,
        trail_px=model.camera.project(position).numpy(),
    )


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: float) -> int:
    """Write RGB pictures (H, W, 3), H and W even, as H.264 (yuv420p), and return their number.
    Raise OutputError for a suffix other than .mp4, .mov, .mkv, no picture, or a failure; an old file is kept.
    """
    check_ending(path, "--out", FORMATS)
    rate, count = Fraction(fps).limit_denominator(1000), 0
    kind = FORMATS[path.suffix.lower()]
    with put_aside(path, also=(av.FFmpegError,)) as aside, av.open(str(aside), "w", format=kind) as container:
        for picture in pictures:
            if not count:
                stream = container.add_stream("libx264", rate=rate, options={"crf": "19", "preset": "veryfast"})
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1
        if not count:
            raise OutputError(refusal(str(path), expected="pictures to write", got="none", do="choose more frames"))
        container.mux(stream.encode(None))
    return count
