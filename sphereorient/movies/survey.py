"""A look at some frames of a movie: what is in them, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies.movie import Grey, Movie
from sphereorient.movies.readable import readable

UNDECODABLE, DARK, SATURATED, REPEATED = "undecodable", "black", "saturated", "repeated"
FAULTS = (UNDECODABLE, DARK, SATURATED, REPEATED)
DARK_LEVEL = 0.2  # of the brightness that frames of this movie usually reach
WHITE_SHARE = 0.2  # of the pixels at full scale
BRIGHT_QUANTILE = 0.999  # of a frame's pixels: what a frame reaches, hot pixels aside
SCALES = (255, 1023, 4095, 16383, 65535)  # largest values of 8, 10, 12, 14 and 16 bit
SHOWN_PX = 320  # longest side of the small pictures that are kept


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """One frame that was looked at."""

    number: int
    small: NDArray[np.float32] | None  # (h, w) grey levels, reduced; None: undecodable
    fault: str  # one of FAULTS, empty where nothing is wrong


@dataclass(frozen=True, eq=False)
class Survey:
    """What some frames of a movie show; made by `survey`, read by the contact sheet."""

    frames: tuple[SeenFrame, ...]  # spread over the movie, those that are shown
    looked: int  # frames that were looked at
    lowest: int  # grey levels
    highest: int
    faults: dict[str, tuple[int, ...]]  # fault -> numbers of the frames that have it


@dataclass
class _Seen:
    number: int
    small: NDArray[np.float32] | None
    lowest: int = 0
    highest: int = 0
    bright: float = 0.0
    white: dict[int, float] | None = None  # share of pixels at each full scale
    repeated: bool = False


def survey(
    movie: Movie, count: int = 24, every: bool = False, progress: Callable[[int, int], None] = lambda done, total: None
) -> Survey:
    """Look at frames spread over a movie, each with the one before it, or at every frame.

    Args:
        movie: any movie.
        count: of the frames to look at and to keep.
        every: look at every frame of the movie; `count` are kept.
        progress: called with frames done and of all.
    """
    kept = {int(number) for number in np.linspace(0, len(movie) - 1, min(count, len(movie))).round()}
    pairs = _all_pairs(movie) if every else _spread_pairs(movie, sorted(kept))
    total = len(movie) if every else len(kept)
    seen = []
    for number, before, picture in pairs:
        seen.append(_look(number, before, picture, number in kept))
        progress(len(seen), total)
    highest = max((one.highest for one in seen), default=0)
    there = [one for one in seen if one.white is not None]
    usual = float(np.median([one.bright for one in there])) if there else 0.0
    scale = next(scale for scale in SCALES if scale >= highest)
    fault = {one.number: _fault(one, usual, scale) for one in seen}
    return Survey(
        frames=tuple(SeenFrame(one.number, one.small, fault[one.number]) for one in seen if one.number in kept),
        looked=len(seen),
        lowest=min((one.lowest for one in there), default=0),
        highest=highest,
        faults={name: tuple(number for number, this in fault.items() if this == name) for name in FAULTS},
    )


def _spread_pairs(movie: Movie, numbers: list[int]) -> Iterator[tuple[int, Grey | None, Grey | None]]:
    for number in numbers:
        *before, picture = readable(movie, max(number - 1, 0), number + 1)
        yield number, before[0] if before else None, picture


def _all_pairs(movie: Movie) -> Iterator[tuple[int, Grey | None, Grey | None]]:
    before: Grey | None = None
    for number, picture in enumerate(readable(movie)):
        yield number, before, picture
        before = picture


def _look(number: int, before: Grey | None, picture: Grey | None, keep: bool) -> _Seen:
    if picture is None:
        return _Seen(number, None)
    return _Seen(
        number=number,
        small=_reduced(picture) if keep else None,
        lowest=int(picture.min()),
        highest=int(picture.max()),
        bright=float(np.quantile(picture, BRIGHT_QUANTILE)),
        white={scale: float(np.mean(picture == scale)) for scale in SCALES if scale <= np.iinfo(picture.dtype).max},
        repeated=before is not None and np.array_equal(before, picture),
    )


def _fault(one: _Seen, usual: float, scale: int) -> str:
    if one.white is None:
        return UNDECODABLE
    if one.white.get(scale, 0.0) > WHITE_SHARE:
        return SATURATED
    if one.highest == 0 or one.bright < DARK_LEVEL * usual:
        return DARK
    return REPEATED if one.repeated else ""


def _reduced(picture: Grey) -> NDArray[np.float32]:
    """Return a picture made smaller by a whole number, each pixel the mean of those that it stands for."""
    times = max(1, -(-max(picture.shape) // SHOWN_PX))
    height, width = picture.shape[0] // times, picture.shape[1] // times
    tiles = picture[: height * times, : width * times].reshape(height, times, width, times)
    small: NDArray[np.float32] = tiles.mean(axis=(1, 3), dtype=np.float32)
    return small
