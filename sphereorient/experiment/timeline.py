"""Times of an experiment's frames, and the picture of each movie at each frame."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.experiment.experiment import MOVIES_OWN, Experiment, check_exposure, input_error
from sphereorient.files.whole_file import read_text
from sphereorient.movies import Movie
from sphereorient.movies.stamps import UNITS, doubt, other_units, rate_of, unit_in
from sphereorient.movies.write import times_path

Rows = NDArray[np.int64]
Floats = NDArray[np.float64]

NONE = -1  # in `Timeline.rows`: no picture
PAIR_STEPS = 0.5  # frame periods: nearer stamps of several cameras count as one instant
LATE_STEPS = 0.05  # frame periods: a larger median difference of stamps causes a remark
EVEN_STEPS = 1e-3  # frame periods: tolerance of evenly spaced times
ON_GRID = 0.02  # frame periods: tolerance of a regular grid
CONTRADICTION = 0.01  # of a frame rate: a larger difference from the stamps of a movie causes a remark
LONGEST_PAUSE = 50  # frame periods; no motion continues over a longer pause


@dataclass(frozen=True, kw_only=True, eq=False)
class Timeline:
    """N frames of an experiment."""

    number: Rows  # (N,), frame numbers, increasing
    time_s: Floats  # (N,), mid-exposure times, s, increasing
    rows: Mapping[str, Rows]  # (N,) per camera: number in its movie, or NONE
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.number)

    @property
    def frame_s(self) -> float:
        """Median time between frames, s; NaN for a single frame."""
        return float(np.median(np.diff(self.time_s))) if len(self) > 1 else float("nan")

    def gridded(self) -> "tuple[Timeline, Rows]":
        """Resample onto a regular grid, inserting missing frames; return it and the frames' indices in it.
        Raises ExperimentError (times on no regular grid).
        """
        steps = np.rint(np.diff(self.time_s) / self.frame_s).clip(1, LONGEST_PAUSE).astype(np.int64)
        place: Rows = np.concatenate([[0], np.cumsum(steps)])
        off = np.abs(np.diff(self.time_s) - steps * self.frame_s)
        if (off[steps < LONGEST_PAUSE] > ON_GRID * self.frame_s).any():
            do = "use --method precise, which takes any times"
            got = f"steps from {np.diff(self.time_s).min():.4g} to {np.diff(self.time_s).max():.4g} s"
            raise input_error("times", "frames on an even grid", got, do)
        frames = np.arange(int(place[-1]) + 1)
        rows = {name: np.full(len(frames), NONE) for name in self.rows}
        for name, row in self.rows.items():
            rows[name][place] = row
        time_s = np.interp(frames, place, self.time_s)
        return replace(self, number=self.number[0] + frames, time_s=time_s, rows=rows), place

    @property
    def even(self) -> bool:
        """Whether all frames are evenly spaced."""
        return bool((np.abs(np.diff(self.time_s) - self.frame_s) <= EVEN_STEPS * self.frame_s).all())


def timeline(experiment: Experiment, movies: Mapping[str, Movie]) -> Timeline:
    """Return the times of the selected frames and the pictures of the cameras at each frame.

    Times come from the frame rate, a table, or stamps of the movies; equal stamps of several cameras make one frame. A
    remark is added for a rate implausible for cameras, and for a frame rate that contradicts a movie's stamps.

    Raises ExperimentError (unreadable table of times, one of another length, times without a unit that are hardly in s,
    an exposure longer than a frame), MovieError (a movie without enough frames, or without time stamps for `times:
    movies`).
    """
    whole = _stamped(experiment, movies) if experiment.times == MOVIES_OWN else _counted(experiment, movies)
    check_exposure(experiment.path, experiment.exposure_s, _longest_step(whole), EVEN_STEPS)
    whole = replace(whole, remarks=(*whole.remarks, *_questioned(experiment, whole.frame_s, movies)))
    if experiment.frames is None:
        return whole
    first, last = experiment.frames
    if len(whole) < last:
        expected, do = f"{last} frames, by frames:", "lower the end of frames:"
        raise MovieError(refusal(f"{experiment.path}, movies", expected=expected, got=f"{len(whole)}", do=do))
    rows = {name: row[first:last] for name, row in whole.rows.items()}
    return replace(whole, number=whole.number[first:last], time_s=whole.time_s[first:last], rows=rows)


def _longest_step(whole: Timeline) -> float:
    """Return the longest of the cameras' median times between pictures, s."""
    seen_s = [np.diff(whole.time_s[row != NONE]) for row in whole.rows.values()]
    return max((float(np.median(steps)) for steps in seen_s if len(steps)), default=math.inf)


def _counted(experiment: Experiment, movies: Mapping[str, Movie]) -> Timeline:
    there = {name: len(movie) - experiment.start.get(name, 0) for name, movie in movies.items()}
    if min(there.values()) <= 0:
        name, got = f"{experiment.path}, movies", " and ".join(f"{count} ({name})" for name, count in there.items())
        raise MovieError(refusal(name, expected="frames after start", got=got, do="correct start:"))
    count = max(there.values())
    wanted = count if experiment.frames is None else min(count, experiment.frames[1])
    others = "the other camera has" if len(there) == 2 else "other cameras have"
    remarks = tuple(
        f"{movies[name].path}: no pictures of frames {of_movie} to {wanted - 1}; only {others} them"
        for name, of_movie in there.items()
        if of_movie < wanted
    )
    number, rows = np.arange(count), {}
    for name, of_movie in there.items():
        rows[name] = np.where(number < of_movie, number + experiment.start.get(name, 0), NONE)
    if experiment.times is None:
        time_s = number / experiment.frame_rate_hz
    else:
        time_s = load_times(Path(experiment.times), experiment.time_unit)
        if len(time_s) != count:
            do = "give one time for each frame of the experiment, counted after start:"
            raise input_error(experiment.times, f"{count} times", f"{len(time_s)}", do)
    return Timeline(number=number, time_s=np.asarray(time_s, np.float64), rows=rows, remarks=remarks)


def _questioned(experiment: Experiment, frame_s: float, movies: Mapping[str, Movie]) -> Iterator[str]:
    """Yield remarks on a rate implausible for cameras, or contradicting the time stamps of a movie."""
    if (why := doubt(1 / frame_s)) and max(map(len, movies.values())) > 1:
        yield f"{experiment.path}: the frame rate is {why}"
    for movie in movies.values():
        rate_hz = rate_of(movie.times_s) if movie.times_s is not None and movie.times_unit else float("nan")
        if abs(rate_hz / experiment.frame_rate_hz - 1) > CONTRADICTION:
            yield f"{movie.path}: {rate_hz:.6g} Hz by its time stamps, {1 / frame_s:.6g} Hz in {experiment.path}"


def load_times(path: Path, unit: str = "") -> Floats:
    """Read a table of times, (N,), s, one a line; its first line may name the unit, such as time_ms; else it is `unit`.
    Raises ExperimentError (missing, too large, a line without a number, times not increasing, or hardly in s).
    """
    do = "write one time a line, increasing"
    lines = read_text(path, 1 << 24, "a table of times", ExperimentError, "correct times:").splitlines()
    values: list[float] = []
    for number, line in enumerate(lines, 1):
        text = line.split("#")[0].strip().rstrip(",;")
        try:
            values += [float(text)] if text else []
        except ValueError:
            if number > 1:  # the first line may be a heading
                raise input_error(f"{path}, line {number}", "a number", repr(text[:40]), do) from None
    times = _increasing(str(path), np.asarray(values, np.float64), do)
    unit = unit_in(lines[0]) or unit  # without a time it was refused
    return _in_s(str(path), times, unit)


def _in_s(name: str, times: Floats, unit: str) -> Floats:
    """Return times, (N,), in s; ExperimentError for times without a unit that are hardly in s."""
    rate_hz = rate_of(times)
    if not unit and (others := other_units(rate_hz)):
        do = "write the right time_unit: (ms, us, ns or s) in experiment.yaml"
        raise input_error(name, "times in s", f"{doubt(rate_hz)}; by their size they are in {others}", do)
    return times * UNITS[unit or "s"]


def _increasing(name: str, time_s: Floats, do: str) -> Floats:
    wrong = np.flatnonzero(~(np.diff(time_s) > 0))
    if not len(time_s) or not np.isfinite(time_s).all():
        got = "none" if not len(time_s) else f"{time_s[~np.isfinite(time_s)][0]}"
        raise input_error(name, "finite times", got, do)
    if len(wrong):
        k = int(wrong[0])
        raise input_error(name, "times that increase", f"{time_s[k + 1]:.9g} after {time_s[k]:.9g}", do)
    return time_s


def _stamped(experiment: Experiment, movies: Mapping[str, Movie]) -> Timeline:
    clocks: dict[str, Floats] = {}
    for name, movie in movies.items():
        start = experiment.start.get(name, 0)
        own = movie.times_s
        if own is None and movie.played_hz and any(one.times_s is not None for one in movies.values()):
            own = np.arange(len(movie)) / movie.played_hz
        if own is None:
            do, table = "write frame_rate:, or times: with a file", times_path(movie.path)
            if table.is_file():
                do = f"write times: {table.name}"
            elif movie.played_hz:
                do = f"write frame_rate: {movie.played_hz:.6g}, at which players show it, if it was recorded so"
            raise MovieError(refusal(str(movie.path), expected="time stamps", got="none in this file", do=do))
        if start >= len(movie):
            got, do = f"{len(movie)}", "correct start:"
            raise MovieError(refusal(str(movie.path), expected=f"more than {start} frames", got=got, do=do))
        where, unit = f"{movie.path}, time stamps", "s" if movie.times_unit else experiment.time_unit
        stamps = _in_s(where, _increasing(where, own, "write frame_rate:, or times: with a file"), unit)
        # With `start` each clock begins at that picture; otherwise all stamps count from the trigger.
        clocks[name] = stamps[start:] - stamps[start] if experiment.start_given else stamps[start:]
    usual_s, names = float(np.median(np.concatenate([np.diff(clock) for clock in clocks.values()]))), list(clocks)
    chosen = {names[0]: np.arange(len(clocks[names[0]]))}
    taken = clocks[names[0]][None]
    for name in names[1:]:
        before, own = paired_times(np.nanmean(taken, axis=0), clocks[name], PAIR_STEPS * usual_s).T
        chosen = {one: np.where(before >= 0, row[before], NONE) for one, row in chosen.items()} | {name: own}
        taken = np.stack([np.where(row >= 0, clocks[one][row], np.nan) for one, row in chosen.items()])
        order = np.argsort(np.nanmean(taken, axis=0), kind="stable")
        chosen, taken = {one: row[order] for one, row in chosen.items()}, taken[:, order]
    rows = {name: np.where(row >= 0, row + experiment.start.get(name, 0), NONE) for name, row in chosen.items()}
    remarks = [
        f"{movies[name].path}: {lacking} of {taken.shape[1]} instants have no picture"
        for name, lacking in zip(names, np.isnan(taken).sum(1).tolist(), strict=True)
        if lacking
    ]
    for k, name in enumerate(names[1:], 1):
        apart = np.abs(taken[0] - taken[k])
        late = float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf
        if not np.isfinite(late):
            remarks.append(f"{experiment.path}: no pictures of {names[0]} and {name} are of the same instant")
        elif late > LATE_STEPS * usual_s:
            remarks.append(f"{experiment.path}: the stamps of {names[0]} and {name} usually differ by {late:.3g} s")
    number = np.arange(taken.shape[1])
    return Timeline(number=number, time_s=np.nanmean(taken, axis=0), rows=rows, remarks=tuple(remarks))


def paired_times(one: Floats, other: Floats, within_s: float) -> Rows:
    """Pair increasing times nearer than `within_s`; return (N, 2) indices in order of time, NONE without a partner."""
    high = np.searchsorted(other, one).clip(max=len(other) - 1)
    low = (high - 1).clip(0)
    nearest = np.where(np.abs(other[high] - one) < np.abs(other[low] - one), high, low)
    apart = np.abs(other[nearest] - one)
    near = apart <= within_s
    # Two times of `one` may have the same nearest neighbour: the nearer one gets it.
    best = np.full(len(other), NONE)
    nearest_last = np.flatnonzero(near)[np.argsort(apart[near], kind="stable")[::-1]]
    best[nearest[nearest_last]] = nearest_last
    partner = np.full(len(one), NONE)
    there = best >= 0
    partner[best[there]] = np.flatnonzero(there)
    alone = np.flatnonzero(~there)
    pairs = np.stack([np.r_[np.arange(len(one)), np.full(len(alone), NONE)], np.r_[partner, alone]], 1)
    when = np.where(pairs[:, 0] >= 0, one[pairs[:, 0]], other[pairs[:, 1]])
    when = np.where((pairs >= 0).all(1), (when + other[pairs[:, 1]]) / 2, when)
    order: Rows = pairs[np.argsort(when, kind="stable")]
    return order
