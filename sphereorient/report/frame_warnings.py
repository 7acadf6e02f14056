"""Quality of the frames of a track: warnings, worst frames, stretches of bad frames, data of the page."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, combinations, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Flag, Reason
from sphereorient.trajectory import Trajectory, runs_of
from sphereorient.trajectory.rotations import Floats, distance_deg

FLAG_WORDS = {
    Flag.POSITION_INTERPOLATED: "position interpolated over a gap",
    Flag.POSITION_OUTLIER_REPLACED: "position was an outlier and was replaced",
    Flag.ONE_CAMERA: "one camera only",
    Flag.REPAIRED_FROM_OTHER_CAMERA: "the cameras disagreed; one was repaired from the other",
    Flag.AMBIGUOUS: "another orientation fits nearly as well",
    Flag.DOUBTFUL_FIT: "fit worse than usual, or another camera does not show the ball",
    Flag.RECOVERED: "found again after a loss",
    Flag.SPIKE: "the orientation jumps",
    Flag.EXTRAPOLATED: "not measured; the smoother's value",
    Flag.CONTRADICTION: "the cameras contradict each other",
    Flag.IDENTITY: "it may be another ball",
}
REASON_WORDS: dict[str, str] = {
    Reason.OK: "measured",
    Reason.NOT_FOUND: "no ball found",
    Reason.OUTLINE: "no clear outline",
    Reason.DARK: "too dark",
    Reason.SATURATED: "too bright",
    Reason.REPEATED: "same picture as before",
    Reason.RUNAWAY: "too many possible orientations",
    Reason.LOW_SCORE: "no orientation explains the picture",
    Reason.AMBIGUOUS: "orientation ambiguous",
    Reason.UNSEEN: "shows paint that the map lacks",
    Reason.CONTRADICTS: "contradicts the other cameras",
    Reason.SECOND_BALL: "may show the second ball",
    Reason.HIDDEN: "hidden by another ball",
    Reason.UNDECODABLE: "picture damaged",
    Reason.MISSING: "no picture",
}
FAR = 4.0  # robust standard deviations from the usual value: an outlier
APART_FRAMES = 3  # frames nearer than this show the same problem
STRETCH_FRAMES = 10  # stretches with fewer frames between them are one
MOST_BINS = 20_000  # frames of longer tracks are binned, so that a browser can show the page
DIGITS = 4  # significant digits on the page
GOOD, NO_BALL, DOUBTFUL, NOT_VALID = range(4)
STATUS_WORDS = ("good", "no ball", "doubtful", "not valid")
Ints = NDArray[np.int64]
Ranked = Iterator[tuple[int, str]]  # rows and reasons, worst first


def shown_flags(track: Trajectory, rows: Any = slice(None)) -> NDArray[np.uint32]:
    """Return the flags of some rows that have a text, without ONE_CAMERA in an experiment of one camera."""
    alone = len(track.cameras) < 2
    known = sum(flag for flag in FLAG_WORDS if not (alone and flag == Flag.ONE_CAMERA))
    flags: NDArray[np.uint32] = track.flags[rows] & np.uint32(known)
    return flags


def flag_words(track: Trajectory, k: int) -> list[str]:
    """Return the shown flags of frame k as text."""
    bits = int(shown_flags(track, k))
    return [words for flag, words in FLAG_WORDS.items() if bits & flag]


def lost_cameras(track: Trajectory, k: int) -> dict[str, str]:
    """Return the reasons of the cameras without an orientation in frame k as text, by name."""
    said = {name: camera.reason[k] for name, camera in track.cameras.items()}
    return {name: REASON_WORDS.get(why, str(why)) for name, why in said.items() if why != Reason.OK}


def frame_warnings(track: Trajectory, k: int) -> list[str]:
    """Return all warnings of frame k as text; empty for a good frame."""
    if track.without_ball[k]:
        return [STATUS_WORDS[NO_BALL]]
    found = [] if track.valid[k] else ["not valid"]
    return [*found, *flag_words(track, k), *(f"{name}: {why}" for name, why in lost_cameras(track, k).items())]


def stated_error(cov: Floats) -> Floats:
    """Return sigma along or about an axis, (N,), mean over three axes, of covariances (N, 3, 3)."""
    return np.asarray(np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3), np.float64)


def choose_worst(track: Trajectory, count: int) -> dict[int, tuple[str, ...]]:
    """Choose at most `count` of the worst frames; return the reasons by row, worst first, alternating the kinds of
    problem. Chosen frames are at least three apart. If fewer are bad, those with the lowest scores follow.
    """
    kinds = [list(ranked) for ranked in _kinds(track)]
    why: dict[int, list[str]] = {}
    for k, words in chain.from_iterable(kinds):
        why.setdefault(k, []).append(words)
    lowest = {k: [words] for k, words in _lowest(track) if k not in why}
    in_turn = [entry[0] for entry in chain.from_iterable(zip_longest(*kinds)) if entry is not None]
    taken: list[int] = []
    for k in chain(in_turn, lowest):
        if len(taken) < count and all(abs(k - other) >= APART_FRAMES for other in taken):
            taken.append(k)
    return {k: tuple(dict.fromkeys(why.get(k) or lowest[k])) for k in taken}


def _kinds(track: Trajectory) -> Iterator[Ranked]:
    yield _gaps(track)
    yield _flags(track)
    apart = _cameras_apart_deg(track)
    if apart is not None:
        yield _outliers(apart, "cameras {:.2g}\u00b0 apart, usually {:.2g}\u00b0")
    yield chain.from_iterable(
        _outliers(-camera.score, f"{name}: score {{:.3f}}, usually {{:.3f}}", sign=-1)
        for name, camera in track.cameras.items()
    )
    off = distance_deg(track.orientation, track.orientation_smooth)
    yield _outliers(off, "{:.2g}\u00b0 from the smooth motion, usually {:.2g}\u00b0")
    unit = track.length_unit
    degrees, lengths = np.rad2deg(stated_error(track.orientation_cov)), stated_error(track.position_cov)
    yield chain(
        _outliers(degrees, "stated error of the orientation {:.2g}\u00b0, usually {:.2g}\u00b0"),
        _outliers(lengths, f"stated error of the position {{:.2g}} {unit}, usually {{:.2g}} {unit}"),
    )


def _gaps(track: Trajectory) -> Ranked:
    """Yield the first frame of every gap with a ball in view, longest first, and the first frame after it."""
    gaps = ~track.valid & ~(track.without_ball & track.valid.any())  # all of a track without poses
    for first, last in sorted(runs_of(gaps), key=lambda run: run[0] - run[1]):
        lasts = "1 frame" if last - first == 1 else f"{last - first} frames"
        found = [words for words in frame_warnings(track, first) if words != "not valid"]
        yield first, f"gap of {lasts} begins" + (f": {', '.join(found)}" if found else "")
        if last < len(track):
            yield last, f"first frame after a gap of {lasts}"


def _flags(track: Trajectory) -> Ranked:
    """Yield flagged valid frames, rarest flags first; from each run the frame with the lowest score."""
    score = np.nan_to_num(_score(track), nan=np.inf)
    flags = shown_flags(track)
    for _, flag in sorted((int((flags & flag > 0).sum()), flag) for flag in FLAG_WORDS):
        runs = runs_of((flags & flag > 0) & track.valid)
        for first, last in sorted(runs, key=lambda run: float(score[run[0] : run[1]].min())):
            yield first + int(score[first:last].argmin()), FLAG_WORDS[flag]


def _lowest(track: Trajectory) -> Ranked:
    score = _score(track)
    known = np.flatnonzero(np.isfinite(score) & track.valid)
    usual = np.nanmedian(score) if len(known) else np.nan
    for k in known[np.argsort(score[known], kind="stable")].tolist():
        yield k, f"not in doubt; among the lowest scores: {score[k]:.3f}, usually {usual:.3f}"


def _outliers(values: Floats, words: str, sign: int = 1) -> Ranked:
    """Yield frames far above the usual value, farthest first; `words` get `sign` times value and usual value."""
    there = np.isfinite(values)
    if there.sum() < 2:
        return
    usual = float(np.median(values[there]))
    spread = 1.4826 * float(np.median(np.abs(values[there] - usual)))
    # If most values are equal, the spread is zero; then rounding errors are no outliers.
    far = np.where(there, (values - usual) / max(spread, 1e-3 * abs(usual), 1e-12), -np.inf)
    for k in np.argsort(-far, kind="stable").tolist():
        if far[k] < FAR:
            return
        yield k, words.format(sign * float(values[k]), sign * usual)


def _score(track: Trajectory) -> Floats:
    """Return the lowest score of the cameras, (N,); NaN without scores."""
    scores = [np.full(len(track), np.nan), *(camera.score for camera in track.cameras.values())]
    return np.asarray(np.fmin.reduce(scores), np.float64)


@dataclass(frozen=True, kw_only=True)
class BadStretch:
    """Doubtful or invalid frames, with at most nine good ones in a row among them."""

    first: int  # row of the track
    last: int  # row, included
    doubtful: int  # frames
    not_valid: int  # frames
    reasons: tuple[tuple[str, int], ...]  # warning, and its number of frames; the most frequent first

    @property
    def frames(self) -> int:
        """Number of frames, including the good ones among the others."""
        return self.last - self.first + 1


def strip_of(track: Trajectory, numbers: Ints | None = None) -> dict[str, Any]:
    """Return the quality of n bins of frames, each represented by its worst frame, for JSON; None: unknown. `numbers`
    (N,): the experiment's; None: by the times. A bin is one frame, or several of a long track.
    """
    size = max(1, -(-len(track) // MOST_BINS))
    rows, starts = np.arange(len(track)), np.arange(0, len(track), size)
    numbers = frame_numbers(track) if numbers is None else numbers
    status = status_of(track)
    codes, words = _reason_codes(track)
    apart = _cameras_apart_deg(track)

    def largest(values: Floats) -> Floats:
        return np.asarray(np.fmax.reduceat(values, starts), np.float64)

    def first(wanted: NDArray[np.bool_]) -> Ints:  # else the first of the bin
        found = np.minimum.reduceat(np.where(wanted, rows, len(track)), starts)
        return np.where(found < len(track), found, starts)

    row = first(status == np.repeat(np.maximum.reduceat(status, starts), size)[: len(track)])
    return {
        "name": track.experiment,
        "frames": len(track),
        "per_bin": size,  # the last bin may have fewer
        "counts": np.bincount(status, minlength=len(STATUS_WORDS)).tolist(),  # frames by status
        "row": row.tolist(),  # (n), row of the track: the bin's first with its status
        "number": numbers[row].tolist(),  # the experiment's number of that frame
        "time_s": _short(track.time[row], 9),  # of that frame
        "status": status[row].tolist(),  # index in status_words
        # Stated, one standard deviation about or along an axis; the largest of the bin.
        "orientation_error_deg": _short(largest(np.rad2deg(stated_error(track.orientation_cov)))),
        "length_unit": track.length_unit,
        "position_error": _short(largest(stated_error(track.position_cov))),
        "cameras": [
            {
                "name": name,
                "score": _short(-largest(-camera.score)),  # the lowest of the bin
                # Index in reason_words, 0: measured; the first other one in the bin.
                "reason": codes[name][first(codes[name] != 0)].tolist(),
            }
            for name, camera in track.cameras.items()
        ],
        # Largest angle between two cameras' own orientations; None for one camera.
        "apart_deg": None if apart is None else _short(largest(apart)),
        "flags": np.bitwise_or.reduceat(shown_flags(track), starts).tolist(),  # those of all frames of the bin
        "status_words": STATUS_WORDS,
        "reason_words": words,
        "flag_words": [(int(flag), words) for flag, words in FLAG_WORDS.items()],  # bit and its meaning
    }


def _cameras_apart_deg(track: Trajectory) -> Floats | None:
    """Return the largest angle between two cameras' own orientations, (N,), degrees; None of one camera."""
    seen = [camera.orientation for camera in track.cameras.values()]
    pairs = [distance_deg(one, other) for one, other in combinations(seen, 2)]
    return np.asarray(np.fmax.reduce(pairs), np.float64) if pairs else None


def bad_stretches(track: Trajectory) -> list[BadStretch]:
    """Find runs of bad frames, joined over fewer than ten good ones, longest first."""
    doubts, status = _doubts(track), status_of(track)
    bad, found = np.flatnonzero(status >= DOUBTFUL), []
    parts = np.split(bad, np.flatnonzero(np.diff(bad) > STRETCH_FRAMES) + 1) if len(bad) else []
    for first, last in ((int(part[0]), int(part[-1])) for part in parts):
        inside = slice(first, last + 1)
        *_, doubtful, not_valid = np.bincount(status[inside], minlength=len(STATUS_WORDS)).tolist()
        shown = status[inside] != NO_BALL
        counts = Counter({words: int(there[inside][shown].sum()) for words, there in doubts.items()})
        reasons = tuple((words, count) for words, count in counts.most_common() if count)
        found.append(BadStretch(first=first, last=last, doubtful=doubtful, not_valid=not_valid, reasons=reasons))
    return sorted(found, key=lambda stretch: (-stretch.frames, -stretch.not_valid, stretch.first))


def status_of(track: Trajectory) -> Ints:
    """Return the status of every frame, GOOD, NO_BALL, DOUBTFUL or NOT_VALID, (N,)."""
    doubtful = np.any([np.zeros(len(track), bool), *_doubts(track).values()], axis=0)
    measured = np.where(doubtful, DOUBTFUL, GOOD)
    return np.where(track.valid, measured, np.where(track.without_ball, NO_BALL, NOT_VALID))


def _doubts(track: Trajectory) -> dict[str, NDArray[np.bool_]]:
    """Return the frames (N,) of each warning of `frame_warnings` but "not valid"."""
    flags, (codes, words) = shown_flags(track), _reason_codes(track)
    found = {text: flags & flag > 0 for flag, text in FLAG_WORDS.items()}
    for name, code in codes.items():
        found |= {f"{name}: {why}": code == number for number, why in enumerate(words) if number}
    return found


def frame_numbers(track: Trajectory) -> Ints:
    """Return the experiment's numbers of the frames by their times, (N,); the rows if the times are irregular."""
    rows = np.arange(len(track))
    at = track.time * track.frame_rate
    if not np.isfinite(at).all():
        return rows
    number = np.rint(at).astype(np.int64)
    # Irregular times give no numbers.
    even = bool((np.abs(at - number) < 0.1).all() and (np.diff(number) > 0).all())
    return number if even else rows


def _reason_codes(track: Trajectory) -> tuple[dict[str, Ints], list[str]]:
    """Return each camera's reasons as numbers, (N,), 0 if measured, and the meaning of the numbers."""
    code: dict[str, int] = {Reason.OK: 0}
    codes = {
        name: np.array([code.setdefault(reason, len(code)) for reason in camera.reason], np.int64)
        for name, camera in track.cameras.items()
    }
    return codes, [REASON_WORDS.get(reason, str(reason)) for reason in code]


def _short(values: Floats, digits: int = DIGITS) -> list[float | None]:
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist()]
