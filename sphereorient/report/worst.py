"""The contact sheet of a track's worst frames: what was filmed, what the track says, and why it is looked at."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from sphereorient.errors import OutputError, refusal
from sphereorient.experiment import Experiment
from sphereorient.movies import Grey
from sphereorient.report import overlay_canvas as ink
from sphereorient.report.overlay import pictures_at, prepared
from sphereorient.report.overlay_canvas import Canvas, Panel
from sphereorient.report.overlay_model import Window, crop
from sphereorient.report.overlay_page import Page
from sphereorient.report.overlay_view import View, draw_axes, draw_outline, shown
from sphereorient.report.worst_choice import BadFrame, choose_worst
from sphereorient.trajectory import Trajectory

TILE, GAP, HEAD, TITLE, LINE, LINES = 152, 6, 54, 22, 17, 3  # px; lines of text under a frame
BETWEEN = 18  # px, between frames
PICTURES = 12  # side by side in a row, at most
SUFFIXES = (".png", ".pdf", ".jpg")
LETTER_PX = 7.4  # usual width


def worst_frames(
    track: Trajectory,
    experiment: Experiment,
    path: Path,
    count: int = 24,
    *,
    cameras: Sequence[str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[BadFrame]:
    """Draw the worst frames side by side, each with outline, axes, re-rendered sphere and the reasons in words.

    Args:
        track: what was measured.
        experiment: what it was measured from; movies and texture are opened.
        path: .png, .pdf or .jpg.
        count: frames at most.
        cameras: names; None: those of the track.
        progress: called with frames done and all frames.

    Returns:
        The frames, worst first.

    Raises:
        ExperimentError: a camera that track or experiment do not have.
        TrackError: the track is of another experiment.
        OutputError: another suffix, or a file that cannot be written.
    """
    from PIL import Image

    if path.suffix.lower() not in SUFFIXES:
        do = "end the name in .png"
        raise OutputError(refusal(f"--worst {path}", expected=" ".join(SUFFIXES), got=f"'{path.suffix}'", do=do))
    bad = choose_worst(track, count)
    with ExitStack() as opened:
        page, streams = prepared(track, experiment, cameras, opened)
        rows = np.array(sorted(one.k for one in bad), dtype=np.int64)
        places = {one.k: place for place, one in enumerate(bad)}
        canvas = _sheet(page, len(bad))
        readers = [pictures_at(stream, rows) for stream in streams.values()]
        for done, (k, *pictures) in enumerate(zip(rows.tolist(), *readers, strict=True), start=1):
            place = places[k]
            _tile(canvas, page, bad[place], place, dict(zip(streams, pictures, strict=True)))
            progress(done, len(rows))
    try:
        Image.fromarray(canvas.finished()).save(path)
    except OSError as error:
        do = "choose a folder that exists, may be written and has room"
        got = f"'{error.strerror or error}'"
        raise OutputError(refusal(str(path), expected="a file that can be written", got=got, do=do)) from error
    return bad


def _columns(page: Page) -> int:
    return max(1, PICTURES // (2 * len(page.views)))


def pairs_size(page: Page) -> tuple[int, int]:
    """Return width and height of what `draw_pairs` draws, px."""
    return 2 * len(page.views) * (TILE + GAP) - GAP, TILE


def _tile_size(page: Page) -> tuple[int, int]:
    width, height = pairs_size(page)
    return width, TITLE + height + LINES * LINE + 10


def _sheet(page: Page, count: int) -> Canvas:
    (width, height), columns = _tile_size(page), _columns(page)
    rows = max(1, math.ceil(count / columns))
    canvas = Canvas(columns * (width + BETWEEN) + BETWEEN, HEAD + rows * (height + BETWEEN))
    track = page.track
    names = ", ".join(view.name for view in page.views)
    title = f"{track.experiment}, {track.method}: the {count} worst of {len(track)} frames"
    canvas.text((BETWEEN, 24), f"{title}, worst first; {int(track.valid.sum())} are valid", 17)
    about = f"of each camera ({names}): the crop with the outline, and the sphere re-rendered as the track says "
    about += "with body axes (x orange, y green, z blue; dotted: away)"
    canvas.text((BETWEEN, 44), about, 13, ink.FAINT)
    return canvas


def _tile(canvas: Canvas, page: Page, bad: BadFrame, place: int, pictures: Mapping[str, Grey | None]) -> None:
    """Draw one frame at its place of the sheet."""
    width, height = _tile_size(page)
    left = BETWEEN + place % _columns(page) * (width + BETWEEN)
    top = HEAD + place // _columns(page) * (height + BETWEEN)
    k = bad.k
    canvas.text((left, top + 15), f"frame {int(page.numbers[k])}, {page.track.time[k]:.4f} s", 14)
    draw_pairs(canvas, page, k, pictures, (left, top + TITLE))
    lines = [line for words in bad.words for line in textwrap.wrap(words, int(width / LETTER_PX))]
    if len(lines) > LINES:
        lines = [*lines[: LINES - 1], f"{lines[LINES - 1]} ..."]
    colour = ink.INK if bad.words[0].startswith("not in doubt") else ink.DOUBT
    for row, line in enumerate(lines):
        canvas.text((left, top + TITLE + TILE + 17 + row * LINE), line, 13, colour)


def draw_pairs(
    canvas: Canvas, page: Page, k: int, pictures: Mapping[str, Grey | None], corner: tuple[int, int]
) -> None:
    """Draw of each camera, side by side, the crop with outline and the re-rendered sphere with axes.

    Args:
        canvas: what is drawn on.
        page: of `overlay.prepared`.
        k: row of the track.
        pictures: (h, w) of each camera; None where it has none.
        corner: column and row of the top left corner, px.
    """
    for column, view in enumerate(page.views):
        at = (corner[0] + 2 * column * (TILE + GAP), corner[1])
        _pair(canvas, view, page.track, k, pictures[view.name], at)


def _pair(canvas: Canvas, view: View, track: Trajectory, k: int, picture: Grey | None, corner: tuple[int, int]) -> None:
    """Draw the crop and the re-rendered sphere of one camera; the whole frame where the ball has no place."""
    path = view.model.path
    placed = bool(np.isfinite(path.position_mm[k]).all())
    centre = view.trail_px[k] if placed else track.cameras[view.name].centre_px[k]
    second = (corner[0] + TILE + GAP, corner[1])
    here = bool(np.isfinite(centre).all()) and np.isfinite(view.half_px)
    half = view.half_px if here else max(view.model.camera.image_size) / 2
    middle = centre if here else np.asarray(view.model.camera.image_size, np.float64) / 2 - 0.5
    window = Window(centre_px=middle, half_px=half, side=max(48, min(2 * TILE, round(2 * half))))
    panels = [Panel(canvas, at, (TILE, TILE), middle - half, TILE / (2 * half)) for at in (corner, second)]
    for panel in panels:
        panel.pixels[:] = 0
    if picture is not None:
        panels[0].show(shown(crop(picture, window), view))
    else:
        canvas.text((corner[0] + TILE / 2, corner[1] + TILE / 2), "no picture", 13, ink.FAINT, "mm")
    if placed and here:
        draw_outline(panels[0], view, k)
    if view.light is not None and path.whole[k] and here:
        filmed = None if picture is None else crop(picture, window)
        panels[1].show(shown(view.light.picture(view.model.look(k, window), filmed), view))
        draw_axes(panels[1], view, k, letters=False)
    else:
        words = "no orientation" if not path.whole[k] else view.why_unlit
        canvas.text((second[0] + TILE / 2, second[1] + TILE / 2), words, 13, ink.FAINT, "mm")
    canvas.text((corner[0] + 5, corner[1] + 15), view.name if here else f"{view.name}, whole", 12)
