"""Pictures of single frames of a track: small ones for the page, and the contact sheet of the worst frames."""

import base64
import io
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sphereorient.errors import OutputError, refusal
from sphereorient.experiment import Experiment
from sphereorient.files.outputs import put_aside
from sphereorient.movies import Grey
from sphereorient.report import overlay_canvas as ink
from sphereorient.report.frame_warnings import BadFrame, choose_worst, frame_warnings
from sphereorient.report.overlay import pictures_by_row, prepared
from sphereorient.report.overlay_canvas import Canvas, Panel
from sphereorient.report.overlay_model import CropWindow, crop
from sphereorient.report.overlay_page import OverlayView, Page, draw_axes, draw_outline
from sphereorient.report.strip import GOOD, BadStretch, bad_stretches, status_of
from sphereorient.trajectory import Trajectory

COUNT = 120
BAD_SHARE = 2 / 3  # largest share of bad frames if there are good ones
QUALITY = 85  # of the JPEG
TO_COMPARE = "good; to compare with"
TILE, GAP, HEAD, TITLE, LINE, LINES = 152, 6, 54, 22, 17, 3  # px; lines of text under a frame
BETWEEN = 18  # px, between frames
PICTURES = 12  # side by side in a row, at most
SUFFIXES = (".png", ".pdf", ".jpg")
LETTER_PX = 7.4  # usual width
Progress = Callable[[int, int], None]
Rows = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class GalleryFrame:
    """The picture of one frame; a part of `Gallery`."""

    k: int  # row of the track
    number: int  # the experiment's
    time_s: float
    status: int  # index in strip.STATUS_WORDS
    rank: int  # 0: chosen first, the worst
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

    frames: tuple[GalleryFrame, ...]  # k increasing
    numbers: Rows  # (N,), the experiment's numbers of all frames of the track
    cameras: tuple[str, ...]  # from left to right
    size: tuple[int, int]  # width and height of every picture, px


def gallery(
    track: Trajectory, experiment: Experiment, count: int = COUNT, progress: Progress = lambda done, total: None
) -> Gallery:
    """Draw crop and re-rendered sphere of at most `count` frames: the worst ones, and good ones for comparison.

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
        for done, (k, pictures) in enumerate(pictures_by_row(streams, rows), start=1):
            canvas, jpeg = Canvas(*_pairs_size(page)), io.BytesIO()
            _draw_pairs(canvas, page, k, pictures, (0, 0))
            # No subsampling: it blurs thin coloured lines.
            Image.fromarray(canvas.finished()).save(jpeg, "JPEG", quality=QUALITY, subsampling=0, optimize=True)
            frame = GalleryFrame(
                k=k,
                number=int(page.numbers[k]),
                time_s=float(track.time[k]),
                status=int(status[k]),
                rank=rank[k],
                words=why[k],
                jpeg=jpeg.getvalue(),
            )
            frames.append(frame)
            progress(done, len(rows))
    names = tuple(view.name for view in page.views)
    return Gallery(frames=tuple(frames), numbers=page.numbers, cameras=names, size=_pairs_size(page))


def chosen_frames(track: Trajectory, count: int) -> dict[int, tuple[str, ...]]:
    """Choose at most `count` frames to show; return the reasons by row of the track, in the order of the choice.

    Two thirds are bad frames, the middles of the longest stretches first; good frames, spread evenly, serve to compare.
    """
    status = status_of(track)
    good, bad = np.flatnonzero(status == GOOD), np.flatnonzero(status != GOOD)
    room = min(count, len(track))
    bad_room = room - min(len(good), room - round(BAD_SHARE * room))
    # At most half are middles, so that frames of `choose_worst` are shown too.
    why = dict(list(_middles(track, bad, bad_stretches(track)))[: -(-bad_room // 2)])

    def fill(more: dict[int, tuple[str, ...]], upto: int) -> None:
        for k, words in more.items():
            if k not in why and len(why) < upto:
                why[k] = words

    fill({f.k: f.words for f in choose_worst(track, bad_room) if not f.words[0].startswith("not in doubt")}, bad_room)
    left = np.setdiff1d(bad, list(why))
    fill({k: tuple(frame_warnings(track, k)) for k in _spread(left, bad_room - len(why))}, bad_room)
    left = np.setdiff1d(good, list(why))
    fill(dict.fromkeys(_spread(left, room - len(why)), (TO_COMPARE,)), room)
    return why


def _middles(track: Trajectory, bad: Rows, found: list[BadStretch]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield the bad frame nearest to the middle of each stretch."""
    for stretch in found:
        inside = bad[np.searchsorted(bad, stretch.first) : np.searchsorted(bad, stretch.last, "right")]
        k = int(inside[np.abs(inside - (stretch.first + stretch.last) / 2).argmin()])
        place = "alone among good ones" if stretch.frames == 1 else f"in a stretch of {stretch.frames} frames"
        yield k, (place, *frame_warnings(track, k))


def _spread(rows: Rows, count: int) -> list[int]:
    if count <= 0 or not len(rows):
        return []
    at = (np.arange(min(count, len(rows))) + 0.5) * len(rows) / min(count, len(rows))
    return [int(k) for k in rows[at.astype(np.int64)]]


def worst_frames(
    track: Trajectory,
    experiment: Experiment,
    path: Path,
    count: int = 24,
    *,
    cameras: Sequence[str] | None = None,
    progress: Progress = lambda done, total: None,
) -> list[BadFrame]:
    """Draw at most `count` of the worst frames side by side, worst first, into a .png, .pdf or .jpg.

    Raises:
        ExperimentError: a camera that track or experiment do not have.
        TrackError: the track is of another experiment.
        OutputError: another suffix, or a file that cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        do = "end the name in .png"
        raise OutputError(refusal(f"--worst {path}", expected=" ".join(SUFFIXES), got=f"'{path.suffix}'", do=do))
    bad = choose_worst(track, count)
    places = {one.k: place for place, one in enumerate(bad)}
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, cameras, opened)
        canvas = _sheet(page, len(bad))
        for done, (k, pictures) in enumerate(pictures_by_row(streams, np.array(sorted(places), np.int64)), start=1):
            _tile(canvas, page, bad[places[k]], places[k], pictures)
            progress(done, len(bad))
    with put_aside(path) as aside:
        Image.fromarray(canvas.finished()).save(aside)
    return bad


def _columns(page: Page) -> int:
    return max(1, PICTURES // (2 * len(page.views)))


def _tile_size(page: Page) -> tuple[int, int]:
    width, height = _pairs_size(page)
    return width, TITLE + height + LINES * LINE + 10


def _sheet(page: Page, count: int) -> Canvas:
    (width, height), columns = _tile_size(page), _columns(page)
    rows = max(1, math.ceil(count / columns))
    canvas = Canvas(columns * (width + BETWEEN) + BETWEEN, HEAD + rows * (height + BETWEEN))
    track = page.track
    names = ", ".join(view.name for view in page.views)
    title = f"{track.experiment}, {track.method}: the {count} worst of {len(track)} frames"
    canvas.text((BETWEEN, 24), f"{title}, worst first; {int(track.valid.sum())} are valid", 17)
    about = f"of each camera ({names}): the crop with the outline, and the sphere re-rendered at the measured pose "
    about += "with body axes (x orange, y green, z blue; dotted: away)"
    canvas.text((BETWEEN, 44), about, 13, ink.FAINT)
    return canvas


def _tile(canvas: Canvas, page: Page, bad: BadFrame, place: int, pictures: Mapping[str, Grey | None]) -> None:
    width, height = _tile_size(page)
    left = BETWEEN + place % _columns(page) * (width + BETWEEN)
    top = HEAD + place // _columns(page) * (height + BETWEEN)
    canvas.text((left, top + 15), f"frame {int(page.numbers[bad.k])}, {page.track.time[bad.k]:.4f} s", 14)
    _draw_pairs(canvas, page, bad.k, pictures, (left, top + TITLE))
    lines = [line for words in bad.words for line in textwrap.wrap(words, int(width / LETTER_PX))]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"{lines[LINES - 1]} ..."]
    colour = ink.INK if bad.words[0].startswith("not in doubt") else ink.DOUBT
    for row, line in enumerate(lines):
        canvas.text((left, top + TITLE + TILE + 17 + row * LINE), line, 13, colour)


def _pairs_size(page: Page) -> tuple[int, int]:
    """Return width and height of the drawing of `_draw_pairs`, px."""
    return 2 * len(page.views) * (TILE + GAP) - GAP, TILE


def _draw_pairs(
    canvas: Canvas, page: Page, k: int, pictures: Mapping[str, Grey | None], corner: tuple[int, int]
) -> None:
    for column, view in enumerate(page.views):
        at = (corner[0] + 2 * column * (TILE + GAP), corner[1])
        centre = view.centre_px(page.track.cameras[view.name], k)
        _pair(canvas, view, k, centre, pictures[view.name], at)


def _pair(
    canvas: Canvas,
    view: OverlayView,
    k: int,
    centre: NDArray[np.float64],
    picture: Grey | None,
    corner: tuple[int, int],
) -> None:
    """Draw crop and re-rendered sphere of one camera; the whole frame if the centre is unknown."""
    path, second = view.model.path, (corner[0] + TILE + GAP, corner[1])
    here = bool(np.isfinite(centre).all()) and np.isfinite(view.half_px)
    half = view.half_px if here else max(view.model.camera.image_size) / 2
    middle = centre if here else np.asarray(view.model.camera.image_size, np.float64) / 2 - 0.5
    window = CropWindow(centre_px=middle, half_px=half, side=max(48, min(2 * TILE, round(2 * half))))
    panels = [Panel(canvas, at, (TILE, TILE), middle - half, TILE / (2 * half)) for at in (corner, second)]
    for panel in panels:
        panel.pixels[:] = 0
    filmed = None if picture is None else crop(picture, window)
    if filmed is not None:
        panels[0].show(view.shown(filmed))
    else:
        canvas.text((corner[0] + TILE / 2, corner[1] + TILE / 2), "no picture", 13, ink.FAINT, "mm")
    if view.placed(k) and here:
        draw_outline(panels[0], view, k)
    if view.light is not None and path.whole[k] and here:
        panels[1].show(view.shown(view.light.picture(view.model.look(k, window), filmed)))
        draw_axes(panels[1], view, k, letters=False)
    else:
        words = "no orientation" if not path.whole[k] else view.why_unlit
        canvas.text((second[0] + TILE / 2, second[1] + TILE / 2), words, 13, ink.FAINT, "mm")
    canvas.text((corner[0] + 5, corner[1] + 15), view.name if here else f"{view.name}, whole", 12)
