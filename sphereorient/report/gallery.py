"""Small pictures of a track's frames for a page: those in doubt, and good ones to compare them with."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.experiment import Experiment
from sphereorient.report.doubts import doubts
from sphereorient.report.overlay import pictures_at, prepared
from sphereorient.report.overlay_canvas import Canvas
from sphereorient.report.strip import GOOD, Stretch, status_of, stretches
from sphereorient.report.worst import draw_pairs, pairs_size
from sphereorient.report.worst_choice import choose_worst
from sphereorient.trajectory import Trajectory

COUNT = 120
BAD_SHARE = 2 / 3  # of the pictures, at most, where there are good frames too
QUALITY = 85  # of the JPEG
TO_COMPARE = "good; to compare with"


@dataclass(frozen=True, kw_only=True)
class GalleryFrame:
    """The picture of one frame; a part of `Gallery`."""

    k: int  # row of the track
    number: int  # the experiment's
    time_s: float
    status: int  # place in strip.STATUS_WORDS
    rank: int  # 0: chosen first, the most in doubt
    words: tuple[str, ...]  # why it was chosen
    jpeg: bytes

    @property
    def plain(self) -> bool:
        """Whether it is only there to compare with."""
        return self.words == (TO_COMPARE,)

    @property
    def data_uri(self) -> str:
        """The picture as an address that a page can hold."""
        return "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode("ascii")


@dataclass(frozen=True, kw_only=True, eq=False)
class Gallery:
    """Pictures of some frames; made by `gallery`, read by the page."""

    frames: tuple[GalleryFrame, ...]  # k increasing
    numbers: NDArray[np.int64]  # (N,), the experiment's numbers of all frames of the track
    cameras: tuple[str, ...]  # from left to right
    size: tuple[int, int]  # width and height of every picture, px


def gallery(
    track: Trajectory,
    experiment: Experiment,
    count: int = COUNT,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Gallery:
    """Draw small pictures of the frames that are worth a look and of good ones spread over the track.

    Args:
        track: what was measured.
        experiment: what it was measured from; movies and texture are opened.
        count: frames at most.
        progress: called with frames done and all frames.

    Returns:
        The pictures: of each camera the crop with the outline and, beside it, the re-rendered sphere with body axes.

    Raises:
        ExperimentError: a camera that track or experiment do not have.
        TrackError: the track is of another experiment.
        MovieError: a movie that cannot be opened.
    """
    why = chosen_frames(track, count)
    rows = np.array(sorted(why), dtype=np.int64)
    rank = {k: place for place, k in enumerate(why)}
    status = status_of(track)
    frames = []
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, None, opened)
        readers = [pictures_at(stream, rows) for stream in streams.values()]
        for done, (k, *pictures) in enumerate(zip(rows.tolist(), *readers, strict=True), start=1):
            canvas = Canvas(*pairs_size(page))
            draw_pairs(canvas, page, k, dict(zip(streams, pictures, strict=True)), (0, 0))
            frame = GalleryFrame(
                k=k,
                number=int(page.numbers[k]),
                time_s=float(track.time[k]),
                status=int(status[k]),
                rank=rank[k],
                words=why[k],
                jpeg=_jpeg(canvas.finished()),
            )
            frames.append(frame)
            progress(done, len(rows))
    names = tuple(view.name for view in page.views)
    return Gallery(frames=tuple(frames), numbers=page.numbers, cameras=names, size=pairs_size(page))


def chosen_frames(track: Trajectory, count: int) -> dict[int, tuple[str, ...]]:
    """Choose the frames to show, and say why.

    First the middle of every stretch that is not good, longest first; then the worst frames, all kinds of trouble
    taking turns; then frames spread over the stretches. A third of the places is kept for good frames, spread evenly,
    so that there is always a near one to compare with.

    Args:
        track: what was measured.
        count: frames at most.

    Returns:
        By row of the track, why, in words; what was chosen first comes first.
    """
    status = status_of(track)
    good, bad = np.flatnonzero(status == GOOD), np.flatnonzero(status != GOOD)
    room = min(count, len(track))
    bad_room = room - min(len(good), room - round(BAD_SHARE * room))
    found = stretches(track)
    # The middles may take half of the room: what `choose_worst` finds in good frames has a place too.
    why = dict(list(_middles(track, bad, found))[: -(-bad_room // 2)])
    worst = {one.k: one.words for one in choose_worst(track, bad_room)}
    _fill(why, {k: words for k, words in worst.items() if not words[0].startswith("not in doubt")}, bad_room)
    left = np.setdiff1d(bad, list(why))
    _fill(why, {k: tuple(doubts(track, k)) for k in _spread(left, bad_room - len(why))}, bad_room)
    left = np.setdiff1d(good, list(why))
    _fill(why, dict.fromkeys(_spread(left, room - len(why)), (TO_COMPARE,)), room)
    return why


def _fill(why: dict[int, tuple[str, ...]], more: dict[int, tuple[str, ...]], room: int) -> None:
    """Put in what is not there yet, as long as there is room."""
    for k, words in more.items():
        if k not in why and len(why) < room:
            why[k] = words


def _middles(track: Trajectory, bad: NDArray[np.int64], found: list[Stretch]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield the frame in doubt that is nearest to the middle of each stretch."""
    for stretch in found:
        inside = bad[np.searchsorted(bad, stretch.first) : np.searchsorted(bad, stretch.last, "right")]
        k = int(inside[np.abs(inside - (stretch.first + stretch.last) / 2).argmin()])
        place = "alone among good ones" if stretch.frames == 1 else f"in a stretch of {stretch.frames} frames"
        yield k, (place, *doubts(track, k))


def _spread(rows: NDArray[np.int64], count: int) -> list[int]:
    """Return at most `count` of the rows, evenly spread."""
    if count <= 0 or not len(rows):
        return []
    at = (np.arange(min(count, len(rows))) + 0.5) * len(rows) / min(count, len(rows))
    return [int(k) for k in rows[at.astype(np.int64)]]


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (H, W, 3) as JPEG, thin coloured lines kept."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(picture).save(out, "JPEG", quality=QUALITY, subsampling=0, optimize=True)
    return out.getvalue()
