"""Pictures of single frames of a track: small ones for the page, and the contact sheet of the worst frames."""

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sphereorient.experiment import Experiment
from sphereorient.experiment.recording import Shown, parts_of
from sphereorient.files.whole_file import check_ending, put_aside
from sphereorient.report import frame_warnings as quality
from sphereorient.report import overlay_page as ink
from sphereorient.report.overlay import pictures_by_row, prepared
from sphereorient.report.overlay_page import Canvas, OverlayPage, crop_panel, draw_axes, draw_outline, draw_pictures
from sphereorient.trajectory import Trajectory

BAD_SHARE = 2 / 3  # largest share of bad frames if there are good ones
TO_COMPARE = "good; to compare with"
TILE, GAP, HEAD, TITLE, LINE, LINES = 152, 6, 54, 22, 17, 3  # px; lines of text under a frame
BETWEEN = 18  # px, between frames
PICTURES = 12  # most in a row
SUFFIXES = (".png", ".pdf", ".jpg")
Advance = Callable[[int, int], None]
Rows = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class GalleryFrame:
    """The picture of one frame; a part of `Gallery`."""

    k: int  # row of the track
    words: tuple[str, ...]  # why it was chosen
    jpeg: bytes

    @property
    def plain(self) -> bool:
        """Whether it is a good frame for comparison."""
        return self.words == (TO_COMPARE,)

    @property
    def data_uri(self) -> str:
        """The picture as a data URI of a page."""
        return "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode("ascii")


@dataclass(frozen=True, kw_only=True, eq=False)
class Gallery:
    """Pictures of some frames; made by `gallery`, read by the page."""

    frames: tuple[GalleryFrame, ...]  # in order of choice, the worst first
    numbers: Rows  # (N,), the experiment's numbers of all frames of the track
    cameras: tuple[str, ...]  # from left to right
    size: tuple[int, int]  # width and height of every picture, px


def gallery(
    track: Trajectory, experiment: Experiment, count: int, progress: Advance = lambda done, total: None
) -> Gallery:
    """Draw crop and re-rendered sphere of at most `count` frames: the worst ones, and good ones for comparison.
    Raise the errors of `overlay.prepared`.
    """
    why = chosen_frames(track, count)
    rows, frames = np.array(sorted(why), dtype=np.int64), {}
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, None, opened)
        parts = partial(parts_of, opened.enter_context(ThreadPoolExecutor(1)))
        for done, (k, pictures) in enumerate(pictures_by_row(streams, rows, parts), start=1):
            canvas, jpeg = Canvas(*_pairs_size(page)), io.BytesIO()
            _draw_pairs(canvas, page, k, pictures, (0, 0))
            # No subsampling, which blurs thin coloured lines.
            Image.fromarray(canvas.finished()).save(jpeg, "JPEG", quality=85, subsampling=0, optimize=True)
            frames[k] = GalleryFrame(k=k, words=why[k], jpeg=jpeg.getvalue())
            progress(done, len(rows))
    chosen = tuple(frames[k] for k in why)
    return Gallery(frames=chosen, numbers=page.numbers, cameras=page.cameras, size=_pairs_size(page))


def chosen_frames(track: Trajectory, count: int) -> dict[int, tuple[str, ...]]:
    """Choose at most `count` frames to show; return the reasons by row, in order of choice: the worst frame, middles of
    the longest stretches, other bad frames, together two thirds; then evenly spread good ones.
    """
    status = quality.status_of(track)
    good, bad = np.flatnonzero(status == quality.GOOD), np.flatnonzero(status >= quality.DOUBTFUL)
    room = min(count, len(track))
    bad_room = room - min(len(good), room - round(BAD_SHARE * room))
    worst = quality.choose_worst(track, max(bad_room, min(room, 1)))
    why = dict(list(worst.items())[:1])

    def fill(more: dict[int, tuple[str, ...]], upto: int) -> None:
        for k, words in more.items():
            if k not in why and len(why) < upto:
                why[k] = words

    # At most half are middles, to leave room for frames of `choose_worst`.
    fill(dict(_middles(track, bad)), -(-bad_room // 2))
    fill({k: words for k, words in worst.items() if not words[0].startswith("not in doubt")}, bad_room)
    left = np.setdiff1d(bad, list(why))
    fill({k: tuple(quality.frame_warnings(track, k)) for k in _spread(left, bad_room - len(why))}, bad_room)
    left = np.setdiff1d(good, list(why))
    fill(dict.fromkeys(_spread(left, room - len(why)), (TO_COMPARE,)), room)
    return why


def _middles(track: Trajectory, bad: Rows) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield the bad frame nearest the middle of each stretch."""
    for stretch in quality.bad_stretches(track):
        inside = bad[np.searchsorted(bad, stretch.first) : np.searchsorted(bad, stretch.last, "right")]
        k = int(inside[np.abs(inside - (stretch.first + stretch.last) / 2).argmin()])
        place = "alone among good ones" if stretch.frames == 1 else f"in a stretch of {stretch.frames} frames"
        yield k, (place, *quality.frame_warnings(track, k))


def _spread(rows: Rows, count: int) -> list[int]:
    count = max(0, min(count, len(rows)))
    at = (np.arange(count) + 0.5) * len(rows) / max(count, 1)
    return [int(k) for k in rows[at.astype(np.int64)]]


def worst_frames(
    track: Trajectory,
    experiment: Experiment,
    path: Path,
    count: int = 24,
    *,
    cameras: Sequence[str] | None = None,
    progress: Advance = lambda done, total: None,
) -> dict[int, tuple[str, ...]]:
    """Draw at most `count` of the worst frames, worst first, into a .png, .pdf or .jpg; return the reasons by row.
    Raise the errors of `overlay.prepared`, and OutputError for another suffix or a file that cannot be written.
    """
    check_ending(path, "--worst", SUFFIXES)
    bad = quality.choose_worst(track, count)
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, cameras, opened)
        width, height = _pairs_size(page)
        across, down = width + BETWEEN, TITLE + height + LINES * LINE + 10 + BETWEEN  # from tile to tile
        columns = max(1, PICTURES // (2 * len(page.cameras)))
        canvas = Canvas(columns * across + BETWEEN, HEAD + max(1, math.ceil(len(bad) / columns)) * down)
        title = f"{track.title}, {track.method}: the {len(bad)} worst of {len(track)} frames"
        canvas.text((BETWEEN, 24), f"{title}, worst first; {int(track.valid.sum())} are valid", 17)
        about = f"of each camera ({', '.join(page.cameras)}): the crop with the outline, and the sphere re-rendered at "
        about += "the measured pose with body axes (x orange, y green, z blue; dotted: away)"
        canvas.text((BETWEEN, 44), about, 13, ink.FAINT)
        corner = {k: (BETWEEN + i % columns * across, HEAD + i // columns * down) for i, k in enumerate(bad)}
        chosen, parts = np.array(sorted(bad), np.int64), partial(parts_of, opened.enter_context(ThreadPoolExecutor(1)))
        for done, (k, pictures) in enumerate(pictures_by_row(streams, chosen, parts), start=1):
            left, top = corner[k]
            canvas.text((left, top + 15), f"frame {int(page.numbers[k])}, {track.time[k]:.4f} s", 14)
            _draw_pairs(canvas, page, k, pictures, (left, top + TITLE))
            lines = [line for words in bad[k] for line in textwrap.wrap(words, int(width / 7.4))]  # usual width
            if len(lines) > LINES:
                lines = [*lines[: LINES - 1], f"{lines[LINES - 1]} ..."]
            colour = ink.INK if bad[k][0].startswith("not in doubt") else ink.DOUBT
            for row, line in enumerate(lines):
                canvas.text((left, top + TITLE + TILE + 17 + row * LINE), line, 13, colour)
            progress(done, len(bad))
    with put_aside(path) as aside:
        Image.fromarray(canvas.finished()).save(aside)
    return bad


def _pairs_size(page: OverlayPage) -> tuple[int, int]:
    return 2 * len(page.cameras) * (TILE + GAP) - GAP, TILE


def _draw_pairs(
    canvas: Canvas, page: OverlayPage, k: int, pictures: Mapping[str, Shown | None], corner: tuple[int, int]
) -> None:
    """Draw crop and re-rendered sphere of each camera; the whole frame if the centre is unknown."""
    (ball,) = page.balls
    for column, view in enumerate(ball.views):
        left, top = corner[0] + 2 * column * (TILE + GAP), corner[1]
        window, size = view.window(ball.track.cameras[view.name], k), view.model.camera.image_size
        if not (here := window.known):
            window = replace(window, centre_px=np.asarray(size, np.float64) / 2 - 0.5, half_px=max(size) / 2)
        window = replace(window, side=max(48, min(2 * TILE, round(2 * window.half_px))))
        panels = [crop_panel(canvas, (at, top), TILE, window) for at in (left, left + TILE + GAP)]
        rendered = draw_pictures(panels, view, k, pictures[view.name], window)
        if pictures[view.name] is None:
            panels[0].say("no picture")
        if view.placed(k) and here:
            draw_outline(panels[0], view, k)
        if rendered:
            draw_axes(panels[1], view, k, letters=False)
        else:
            panels[1].say(view.why_unlit if view.model.path.whole[k] else "no orientation")
        canvas.text((left + 5, top + 15), view.name if here else f"{view.name}, whole", 12)
