"""Quality of every frame of a track for the page, and the stretches of bad frames."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.report.frame_warnings import (
    FLAG_WORDS,
    distance_deg,
    flag_words,
    frame_warnings,
    reason_words,
    stated_error,
)
from sphereorient.trajectory import Reason, Trajectory

MOST_BINS = 20_000  # frames of longer tracks are binned, so that a browser can show the page
APART_FRAMES = 10  # stretches with fewer frames between them are one
DIGITS = 4  # of the numbers on the page
GOOD, DOUBTFUL, NOT_VALID = range(3)
STATUS_WORDS = ("good", "doubtful", "not valid")
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Numbers = tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class CameraStrip:
    """Scores and reasons of one camera, n bins; a part of `QualityStrip`."""

    name: str
    score: Numbers  # the lowest of the bin
    reason: tuple[int, ...]  # index in QualityStrip.reason_words; 0: measured; of a bin the first other one


@dataclass(frozen=True, kw_only=True)
class QualityStrip:
    """Quality of n bins of `per_bin` frames, represented by the worst one; None (not NaN, for JSON) where unknown."""

    name: str  # of the experiment
    frames: int
    per_bin: int  # the last bin may have fewer
    counts: tuple[int, int, int]  # frames that are good, doubtful, not valid
    row: tuple[int, ...]  # (n), row of the track: the first of those of the bin's status
    number: tuple[int, ...]  # the experiment's number of that frame
    time_s: Numbers  # of that frame
    status: tuple[int, ...]  # index in status_words
    orientation_error_deg: Numbers  # stated, one standard deviation about an axis; the largest of the bin
    position_error_mm: Numbers  # the same along an axis
    cameras: tuple[CameraStrip, ...]
    apart_deg: Numbers | None  # between the two cameras' own orientations, the largest; None without two cameras
    flags: tuple[int, ...]  # bits, those of all frames of the bin
    status_words: tuple[str, str, str]
    reason_words: tuple[str, ...]
    flag_words: tuple[tuple[int, str], ...]  # bit and its meaning

    def as_json(self) -> dict[str, Any]:
        """Return the strip for `json`, without NaN."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class BadStretch:
    """Frames that are doubtful or not valid, with at most nine good ones in a row among them."""

    first: int  # row of the track
    last: int  # row, included
    first_number: int  # the experiment's
    last_number: int
    start_s: float
    end_s: float  # of the last frame
    doubtful: int  # frames
    not_valid: int  # frames
    reasons: tuple[tuple[str, int], ...]  # warning, and its number of frames; the most frequent first

    @property
    def frames(self) -> int:
        """Number of frames, including the good ones among the others."""
        return self.last - self.first + 1


def strip_of(track: Trajectory, numbers: Ints | None = None) -> QualityStrip:
    """Collect the quality of frames, or bins of a long track; `numbers` (N,): the experiment's; None: by the times."""
    size = max(1, -(-len(track) // MOST_BINS))
    rows, starts = np.arange(len(track)), np.arange(0, len(track), size)
    numbers = frame_numbers(track) if numbers is None else numbers
    status = status_of(track)
    codes, words = _reason_codes(track)
    seen = [camera.orientation for camera in track.cameras.values()]

    def first(wanted: NDArray[np.bool_]) -> Ints:
        """Return the first such frame of every bin; else the first of the bin."""
        found = np.minimum.reduceat(np.where(wanted, rows, len(track)), starts)
        return np.where(found < len(track), found, starts)

    def largest(values: Floats) -> Floats:
        return np.asarray(np.fmax.reduceat(values, starts), np.float64)

    row = first(status == np.repeat(np.maximum.reduceat(status, starts), size)[: len(track)])
    return QualityStrip(
        name=track.experiment,
        frames=len(track),
        per_bin=size,
        counts=_counted(status),
        row=tuple(row.tolist()),
        number=tuple(numbers[row].tolist()),
        time_s=_short(track.time[row], 9),
        status=tuple(status[row].tolist()),
        orientation_error_deg=_short(largest(np.rad2deg(stated_error(track.orientation_cov)))),
        position_error_mm=_short(largest(stated_error(track.position_cov))),
        cameras=tuple(
            CameraStrip(
                name=name,
                score=_short(-largest(-camera.score)),
                reason=tuple(codes[name][first(codes[name] != 0)].tolist()),
            )
            for name, camera in track.cameras.items()
        ),
        apart_deg=_short(largest(distance_deg(*seen))) if len(seen) == 2 else None,
        flags=tuple(np.bitwise_or.reduceat(_shown_flags(track), starts).tolist()),
        status_words=STATUS_WORDS,
        reason_words=words,
        flag_words=tuple((int(flag), words) for flag, words in FLAG_WORDS.items()),
    )


def bad_stretches(track: Trajectory, numbers: Ints | None = None) -> list[BadStretch]:
    """Find runs of bad frames, joined over fewer than ten good ones, longest first; `numbers` as for `strip_of`."""
    numbers = frame_numbers(track) if numbers is None else numbers
    group, warnings = _groups(track)
    status = status_of(track)
    bad, found = np.flatnonzero(status), []
    breaks = np.flatnonzero(np.diff(bad) > APART_FRAMES)
    firsts, lasts = bad[np.concatenate([[0], breaks + 1])[: len(bad)]], bad[np.append(breaks, -1)[: len(bad)]]
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        _, doubtful, not_valid = _counted(status[first : last + 1])
        stretch = BadStretch(
            first=first,
            last=last,
            first_number=int(numbers[first]),
            last_number=int(numbers[last]),
            start_s=float(track.time[first]),
            end_s=float(track.time[last]),
            doubtful=doubtful,
            not_valid=not_valid,
            reasons=_reasons(group[first : last + 1], warnings),
        )
        found.append(stretch)
    return sorted(found, key=lambda stretch: (-stretch.frames, -stretch.not_valid, stretch.first))


def status_of(track: Trajectory) -> Ints:
    """Return the status of every frame, GOOD, DOUBTFUL or NOT_VALID, (N,)."""
    group, warnings = _groups(track)
    doubtful = np.array([bool(words) for words in warnings], dtype=bool)[group]
    return np.where(track.valid, np.where(doubtful, DOUBTFUL, GOOD), NOT_VALID)


def frame_numbers(track: Trajectory) -> Ints:
    """Return the experiment's numbers of the frames by their times, (N,); the rows if the times are irregular."""
    rows = np.arange(len(track))
    at = track.time * track.frame_rate
    if not np.isfinite(at).all():
        return rows
    number = np.rint(at).astype(np.int64)
    # Times of a table or a camera's clock do not give numbers.
    even = bool((np.abs(at - number) < 0.1).all() and (np.diff(number) > 0).all())
    return number if even else rows


def _groups(track: Trajectory) -> tuple[Ints, list[list[str]]]:
    """Group frames with the same warnings; return each frame's group, (N,), and the warnings of each group."""
    codes, _ = _reason_codes(track)
    group = np.asarray(track.valid, np.int64)
    for values in (track.flags.astype(np.int64), *codes.values()):
        _, part = np.unique(values, return_inverse=True)
        _, group = np.unique(group * (part.max(initial=0) + 1) + part, return_inverse=True)
    _, first = np.unique(group, return_index=True)
    return group, [frame_warnings(track, int(k)) for k in first]


def _reason_codes(track: Trajectory) -> tuple[dict[str, Ints], tuple[str, ...]]:
    """Return each camera's reasons as numbers, (N,), 0 if measured, and the meaning of the numbers."""
    known: dict[str, int] = {Reason.OK: 0}
    words = {0: "measured"}
    codes = {}
    for name, camera in track.cameras.items():
        numbered = (known.setdefault(reason, len(known)) for reason in camera.reason)
        codes[name] = np.fromiter(numbered, np.int64, len(track))
        for code, k in zip(*np.unique(codes[name], return_index=True), strict=True):
            words[int(code)] = reason_words(track, int(k))[name]
    return codes, tuple(words[code] for code in range(len(known)))


def _shown_flags(track: Trajectory) -> Ints:
    """Return the bits of every frame that `flag_words` shows, (N,)."""
    bit = {words: int(flag) for flag, words in FLAG_WORDS.items()}
    _, first, which = np.unique(track.flags, return_index=True, return_inverse=True)
    shown = [sum(bit[words] for words in flag_words(track, int(k))) for k in first]
    return np.array(shown, np.int64)[which]


def _reasons(group: Ints, warnings: Sequence[Sequence[str]]) -> tuple[tuple[str, int], ...]:
    """Count the frames of each warning, without "not valid", which is counted apart."""
    counted: dict[str, int] = {}
    for which, frames in zip(*np.unique(group, return_counts=True), strict=True):
        for words in warnings[which]:
            counted[words] = counted.get(words, 0) + int(frames)
    counted.pop("not valid", None)
    return tuple(sorted(counted.items(), key=lambda entry: -entry[1]))


def _counted(status: Ints) -> tuple[int, int, int]:
    good, doubtful, not_valid = np.bincount(status, minlength=3).tolist()
    return good, doubtful, not_valid


def _short(values: Floats, digits: int = DIGITS) -> Numbers:
    return tuple(float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist())
