"""Quality of every frame of a track, as a page shows it, and the stretches of frames that are not good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.report.doubts import FLAG_WORDS, doubts, flag_words, reason_words
from sphereorient.trajectory import Reason, Trajectory

MOST_BINS = 20_000  # frames of longer tracks are taken together: the page stays small enough for a browser
APART_FRAMES = 10  # stretches with fewer frames between them are one
DIGITS = 4  # of the numbers on the page
GOOD, DOUBTFUL, NOT_VALID = range(3)
STATUS_WORDS = ("good", "doubtful", "not valid")
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Numbers = tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class CameraStrip:
    """What one camera says, n bins; a part of `Strip`."""

    name: str
    score: Numbers  # the lowest of the bin
    reason: tuple[int, ...]  # place in Strip.reason_words; 0: measured; of a bin the first that is not


@dataclass(frozen=True, kw_only=True)
class Strip:
    """Quality of all frames, or of n bins of `per_bin` frames each, the worst of a bin standing for it.

    Made by `strip_of`, read by the page. What is not known is None: JSON has no NaN.
    """

    name: str  # of the experiment
    frames: int
    per_bin: int  # the last bin may have fewer
    counts: tuple[int, int, int]  # frames that are good, doubtful, not valid
    row: tuple[int, ...]  # (n), row of the track: the first of those of the bin's status
    number: tuple[int, ...]  # the experiment's number of that frame
    time_s: Numbers  # of that frame
    status: tuple[int, ...]  # place in status_words
    orientation_error_deg: Numbers  # stated, one standard deviation about an axis; the largest of the bin
    position_error_mm: Numbers  # the same along an axis
    cameras: tuple[CameraStrip, ...]
    apart_deg: Numbers | None  # between the two cameras' own orientations, the largest; None without two cameras
    flags: tuple[int, ...]  # bits, those of all frames of the bin
    status_words: tuple[str, str, str]
    reason_words: tuple[str, ...]
    flag_words: tuple[tuple[int, str], ...]  # bit and what it means

    def as_json(self) -> dict[str, Any]:
        """Return the strip as `json` takes it, without NaN."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Frames that are doubtful or not valid, with at most nine good ones in a row between them; made by `stretches`."""

    first: int  # row of the track
    last: int  # row, itself in it
    first_number: int  # the experiment's
    last_number: int
    start_s: float
    end_s: float  # of the last frame
    doubtful: int  # frames
    not_valid: int  # frames
    reasons: tuple[tuple[str, int], ...]  # in words, and of how many frames that is said; the most frequent first

    @property
    def frames(self) -> int:
        """Number of frames, the good ones between the others counted too."""
        return self.last - self.first + 1


def strip_of(track: Trajectory, numbers: Ints | None = None) -> Strip:
    """Collect what a page shows of the quality of every frame.

    Up to 20,000 frames each stands for itself; of longer tracks equal numbers of frames are taken together, and what
    is shown is the worst of them: no bad frame gets lost.

    Args:
        track: what was measured.
        numbers: (N,), the experiment's numbers of the frames; None: as their times say.

    Returns:
        The strip; what is doubtful in a frame is what `report.doubts` says.
    """
    bins = _Bins(len(track), max(1, -(-len(track) // MOST_BINS)))
    numbers = frame_numbers(track) if numbers is None else numbers
    status = status_of(track)
    codes, words = _reason_codes(track)
    row = bins.row_of(status)
    seen = track.cameras.items()
    return Strip(
        name=track.experiment,
        frames=len(track),
        per_bin=bins.size,
        counts=_counted(status),
        row=_whole(row),
        number=_whole(numbers[row]),
        time_s=_short(track.time[row], 9),
        status=_whole(status[row]),
        orientation_error_deg=_short(bins.largest(np.rad2deg(_stated_error(track.orientation_cov)))),
        position_error_mm=_short(bins.largest(_stated_error(track.position_cov))),
        cameras=tuple(
            CameraStrip(
                name=name, score=_short(-bins.largest(-camera.score)), reason=_whole(bins.first_not_zero(codes[name]))
            )
            for name, camera in seen
        ),
        apart_deg=_short(bins.largest(_cameras_apart(track))) if len(track.cameras) == 2 else None,
        flags=_whole(bins.any_bit(_told_flags(track))),
        status_words=STATUS_WORDS,
        reason_words=words,
        flag_words=tuple((int(flag), words) for flag, words in FLAG_WORDS.items()),
    )


def stretches(track: Trajectory, numbers: Ints | None = None) -> list[Stretch]:
    """Find the runs of frames that are doubtful or not valid; runs fewer than ten frames apart are one.

    Args:
        track: what was measured.
        numbers: (N,), the experiment's numbers of the frames; None: as their times say.

    Returns:
        Longest first; of equally long ones those with more frames that are not valid.
    """
    numbers = frame_numbers(track) if numbers is None else numbers
    kind, said = _kinds(track)
    status = status_of(track)
    found = []
    for first, last in _merged_runs(np.flatnonzero(status)):
        _, doubtful, not_valid = _counted(status[first : last + 1])
        stretch = Stretch(
            first=first,
            last=last,
            first_number=int(numbers[first]),
            last_number=int(numbers[last]),
            start_s=float(track.time[first]),
            end_s=float(track.time[last]),
            doubtful=doubtful,
            not_valid=not_valid,
            reasons=_reasons(kind[first : last + 1], said),
        )
        found.append(stretch)
    return sorted(found, key=lambda stretch: (-stretch.frames, -stretch.not_valid, stretch.first))


def status_of(track: Trajectory) -> Ints:
    """Return of every frame whether it is GOOD, DOUBTFUL or NOT_VALID, (N,)."""
    kind, said = _kinds(track)
    doubtful = np.array([bool(words) for words in said], dtype=bool)[kind]
    return np.where(track.valid, np.where(doubtful, DOUBTFUL, GOOD), NOT_VALID)


def frame_numbers(track: Trajectory) -> Ints:
    """Return the experiment's numbers of the frames as their times say, (N,); the rows where those are uneven."""
    rows = np.arange(len(track))
    at = track.time * track.frame_rate
    if not np.isfinite(at).all():
        return rows
    number = np.rint(at).astype(np.int64)
    # A table of times or a camera's own stamps: they say when, not which.
    even = bool((np.abs(at - number) < 0.1).all() and (np.diff(number) > 0).all())
    return number if even else rows


class _Bins:
    """Takes frames together, `size` at a time."""

    def __init__(self, frames: int, size: int) -> None:
        self.frames, self.size, self.count = frames, size, -(-frames // size)

    def _split(self, values: NDArray[Any], fill: Any) -> NDArray[Any]:
        """Return (count, size), the last bin filled up."""
        padded = np.full(self.count * self.size, fill, values.dtype)
        padded[: self.frames] = values
        return padded.reshape(self.count, self.size)

    def row_of(self, status: Ints) -> Ints:
        """Return the first frame of the worst status of every bin."""
        within = self._split(status, -1).argmax(1) if self.count else np.zeros(0, np.int64)
        return np.asarray(np.arange(self.count) * self.size + within, np.int64)

    def largest(self, values: Floats) -> Floats:
        """Return the largest value of every bin; NaN where there is none."""
        return np.asarray(np.fmax.reduce(self._split(values, np.nan), axis=1, initial=np.nan), np.float64)

    def first_not_zero(self, codes: Ints) -> Ints:
        """Return the first code of every bin that is not 0, and 0 where all are."""
        split = self._split(codes, 0)
        at = (split != 0).argmax(1) if self.count else np.zeros(0, np.int64)
        return np.asarray(split[np.arange(self.count), at], np.int64)

    def any_bit(self, flags: Ints) -> Ints:
        """Return the bits that any frame of a bin has."""
        return np.asarray(np.bitwise_or.reduce(self._split(flags, 0), axis=1), np.int64)


def _kinds(track: Trajectory) -> tuple[Ints, list[list[str]]]:
    """Return the kind of every frame, (N,), and what is said of each kind: frames of one kind are said the same of."""
    codes, _ = _reason_codes(track)
    kind = np.asarray(track.valid, np.int64)
    for values in (track.flags.astype(np.int64), *codes.values()):
        _, part = np.unique(values, return_inverse=True)
        _, kind = np.unique(kind * (part.max(initial=0) + 1) + part, return_inverse=True)
    _, first = np.unique(kind, return_index=True)
    return kind, [doubts(track, int(k)) for k in first]


def _reason_codes(track: Trajectory) -> tuple[dict[str, Ints], tuple[str, ...]]:
    """Return each camera's reasons as small numbers, (N,), 0 where it measured, and what the numbers mean."""
    known: dict[str, int] = {Reason.OK: 0}
    words = {0: "measured"}
    codes = {}
    for name, camera in track.cameras.items():
        told = (known.setdefault(reason, len(known)) for reason in camera.reason)
        codes[name] = np.fromiter(told, np.int64, len(track))
        for code, k in zip(*np.unique(codes[name], return_index=True), strict=True):
            words[int(code)] = reason_words(track, int(k))[name]
    return codes, tuple(words[code] for code in range(len(known)))


def _told_flags(track: Trajectory) -> Ints:
    """Return the bits of every frame that are told, (N,)."""
    bit = {words: int(flag) for flag, words in FLAG_WORDS.items()}
    _, first, which = np.unique(track.flags, return_index=True, return_inverse=True)
    told = [sum(bit[words] for words in flag_words(track, int(k))) for k in first]
    return np.array(told, np.int64)[which]


def _merged_runs(bad: Ints) -> list[tuple[int, int]]:
    """Return first and last of the runs of rows, fewer than ten others between two rows of one run."""
    if not len(bad):
        return []
    breaks = np.flatnonzero(np.diff(bad) > APART_FRAMES)
    firsts, lasts = bad[np.concatenate([[0], breaks + 1])], bad[np.concatenate([breaks, [len(bad) - 1]])]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _reasons(kind: Ints, said: Sequence[Sequence[str]]) -> tuple[tuple[str, int], ...]:
    """Count in how many frames each thing is said; that a frame is not valid is told apart from the reasons."""
    counted: dict[str, int] = {}
    for which, frames in zip(*np.unique(kind, return_counts=True), strict=True):
        for words in said[which]:
            counted[words] = counted.get(words, 0) + int(frames)
    counted.pop("not valid", None)
    return tuple(sorted(counted.items(), key=lambda entry: -entry[1]))


def _stated_error(cov: Floats) -> Floats:
    """Return the standard deviation along or about an axis, the mean of three, (N,)."""
    return np.asarray(np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3), np.float64)


def _cameras_apart(track: Trajectory) -> Floats:
    """Return the distance of the two cameras' own orientations, (N,), degrees."""
    one, other = (torch.from_numpy(camera.orientation) for camera in track.cameras.values())
    return np.asarray(np.rad2deg(so3.geodesic_distance(one, other).numpy()), np.float64)


def _counted(status: Ints) -> tuple[int, int, int]:
    good, doubtful, not_valid = np.bincount(status, minlength=3).tolist()
    return good, doubtful, not_valid


def _whole(values: Ints) -> tuple[int, ...]:
    return tuple(values.tolist())


def _short(values: Floats, digits: int = DIGITS) -> Numbers:
    return tuple(float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist())
