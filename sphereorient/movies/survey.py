from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from sphereorient.movies.movie import Grey, Movie

UNDECODABLE, DARK, SATURATED, REPEATED = "undecodable", "black", "saturated", "repeated"
FAULTS = (UNDECODABLE, DARK, SATURATED, REPEATED)
DARK_LEVEL = 0.2  # of the usual brightness of the movie's frames
WHITE_SHARE = 0.2  # of the pixels at full scale
BRIGHT_QUANTILE = 0.999  # of the pixels of a frame: its brightness without hot pixels
SCALES = (255, 1023, 4095, 16383, 65535)  # largest values of 8, 10, 12, 14 and 16 bit
SHOWN_PX = 320  # longest side of the kept small pictures


@dataclass(kw_only=True, eq=False)
class SurveyedFrame:
    """One frame of a survey."""

    number: int
    small: NDArray[np.float32] | None = None  # (h, w) grey levels, reduced; None: undecodable or not kept
    fault: str = ""  # one of FAULTS, empty for a good frame
    lowest: int = 0  # grey levels
    highest: int = 0
    bright: float = 0.0
    white: dict[int, float] | None = None  # share of pixels at each full scale; None: undecodable
    repeated: bool = False


@dataclass(frozen=True, eq=False)
class Survey:
    """A sample of a movie's frames, and their faults."""

    frames: tuple[SurveyedFrame, ...]  # evenly spread over the movie, for display
    looked: int  # number of frames examined
    lowest: int  # grey levels
    highest: int
    faults: dict[str, tuple[int, ...]]  # fault -> frame numbers


def survey(
    movie: Movie, count: int = 24, every: bool = False, progress: Callable[[int, int], None] = lambda done, total: None
) -> Survey:
    """Examine `count` frames spread over a movie, each with the one before it; with `every` all, keeping `count`."""
    kept = {int(number) for number in np.linspace(0, len(movie) - 1, min(count, len(movie))).round()}
    seen: list[SurveyedFrame] = []
    for number, before, picture in _pairs(movie, None if every else sorted(kept)):
        seen.append(_examine(number, before, picture, number in kept))
        progress(len(seen), len(movie) if every else len(kept))
    highest = max((one.highest for one in seen), default=0)
    decoded = [one for one in seen if one.white is not None]
    usual = float(np.median([one.bright for one in decoded])) if decoded else 0.0
    scale = next(scale for scale in SCALES if scale >= highest)
    for one in seen:
        one.fault = _fault(one, usual, scale)
    return Survey(
        frames=tuple(one for one in seen if one.number in kept),
        looked=len(seen),
        lowest=min((one.lowest for one in decoded), default=0),
        highest=highest,
        faults={name: tuple(one.number for one in seen if one.fault == name) for name in FAULTS},
    )


def _pairs(movie: Movie, numbers: Iterable[int] | None) -> Iterator[tuple[int, Grey | None, Grey | None]]:
    if numbers is None:
        for number, (before, picture) in enumerate(pairwise(chain([None], movie.readable()))):
            yield number, before, picture
        return
    for number in numbers:
        *earlier, picture = movie.readable(max(number - 1, 0), number + 1)
        yield number, earlier[0] if earlier else None, picture


def _examine(number: int, before: Grey | None, picture: Grey | None, keep: bool) -> SurveyedFrame:
    if picture is None:
        return SurveyedFrame(number=number)
    return SurveyedFrame(
        number=number,
        small=_reduced(picture) if keep else None,
        lowest=int(picture.min()),
        highest=int(picture.max()),
        bright=float(np.quantile(picture, BRIGHT_QUANTILE)),
        white={scale: float(np.mean(picture == scale)) for scale in SCALES if scale <= np.iinfo(picture.dtype).max},
        repeated=before is not None and np.array_equal(before, picture),
    )


def _fault(one: SurveyedFrame, usual: float, scale: int) -> str:
    if one.white is None:
        return UNDECODABLE
    if one.white.get(scale, 0.0) > WHITE_SHARE:
        return SATURATED
    if one.highest == 0 or one.bright < DARK_LEVEL * usual:
        return DARK
    return REPEATED if one.repeated else ""


def _reduced(picture: Grey) -> NDArray[np.float32]:
    times = max(1, -(-max(picture.shape) // SHOWN_PX))
    height, width = picture.shape[0] // times, picture.shape[1] // times
    tiles = picture[: height * times, : width * times].reshape(height, times, width, times)
    small: NDArray[np.float32] = tiles.mean(axis=(1, 3), dtype=np.float32)
    return small
