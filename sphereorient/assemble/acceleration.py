"""The scale of the angular acceleration, learnt from the track that it helps to find."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sphereorient.assemble.beam import Histories, Movie, search
from sphereorient.assemble.continuity import Floats, Ints, Motion, turn_between, turned
from sphereorient.assemble.settings import PathSettings

LINKS_MIN = 8  # fewer teach no acceleration
ROUNDS_MAX = 4
ROUND_ENOUGH = 0.3  # a scale that changes by less, as a logarithm, changes no choice
START_DEG = (0.1, 0.5, 2.0)  # changes of the turn from frame to frame, one of which is near enough to begin with
CHANGE_MAX_DEG = 10.0
SAMPLES, SAMPLE_FRAMES = 3, 100  # stretches of the movie by which it is chosen
FLOOR_SIGMAS = 1.0  # of a single orientation: less acceleration is not seen in one frame interval


def search_and_learn(movie: Movie, frame_s: float, settings: PathSettings) -> tuple[Histories, Motion]:
    """Search, learn the acceleration from what was found, and search again until it stays.

    Args:
        movie: at least one frame.
        frame_s: usual time between frames.
        settings: of the path; its acceleration, where given, is not learnt.
    """
    motion = Motion(
        acceleration_rad_s2=settings.acceleration_rad_s2 or 1.0,
        tail=settings.tail,
        frame_s=frame_s,
    )
    if settings.acceleration_rad_s2 is not None:
        return search(movie, motion, settings), motion
    motion = _start(movie, motion, settings)
    histories = search(movie, motion, settings)
    for _ in range(ROUNDS_MAX):
        learnt = _learnt(movie, [(movie, histories)], motion)
        if abs(math.log(learnt / motion.acceleration_rad_s2)) < ROUND_ENOUGH:
            break
        motion = replace(motion, acceleration_rad_s2=learnt)
        histories = search(movie, motion, settings)
    return histories, motion


def _bounds(movie: Movie, motion: Motion) -> tuple[float, float]:
    """Least and largest acceleration, rad/s^2."""
    least = FLOOR_SIGMAS * float(np.sqrt(np.median(movie.variance)))
    most = max(math.radians(CHANGE_MAX_DEG), least)
    return least / motion.frame_s**2, most / motion.frame_s**2


def _start(movie: Movie, motion: Motion, settings: PathSettings) -> Motion:
    """The acceleration to begin with: the one by which a motion stands out most in some stretches of the movie.

    What the pictures' favourites do tells nothing here: they may stand still.
    """
    frames = len(movie.time_s)
    parts = [movie]
    if frames > SAMPLES * SAMPLE_FRAMES:
        firsts = np.linspace(0, frames - SAMPLE_FRAMES, SAMPLES).astype(np.int64).tolist()
        parts = [movie.part(first, first + SAMPLE_FRAMES) for first in firsts]
    least, most = _bounds(movie, motion)
    trials = [
        replace(motion, acceleration_rad_s2=float(np.clip(math.radians(change) / motion.frame_s**2, least, most)))
        for change in START_DEG
    ]
    best, found = motion, -math.inf
    for trial in trials:
        searched = [(part, search(part, trial, settings)) for part in parts]
        evidence = sum(histories.evidence for _, histories in searched)
        if evidence > found:
            best, found = replace(trial, acceleration_rad_s2=_learnt(movie, searched, trial)), evidence
    return best


def misfits(movie: Movie, histories: Histories, motion: Motion) -> tuple[Ints, Floats, Floats, Floats]:
    """Compare each orientation of a history with what the two before it predict.

    Args:
        movie: candidates.
        histories: found in them.
        motion: its acceleration does not matter.

    Returns:
        Frames (L,) where a prediction can be made; how far the orientation is off, rad (L,); variance of that per axis
        by the orientations' own errors, rad^2 (L,); its drift per unit of acceleration, s^2 (L,).
    """
    frame = np.flatnonzero(histories.row >= 0)
    row, begins = histories.row[frame], histories.begins[frame]
    before, here, after = row[:-2], row[1:-1], row[2:]
    steps = np.diff(movie.time_s[frame])
    span, dt = steps[:-1], steps[1:]
    turn = np.nan_to_num(histories.turn_rad[frame[1:-1]])
    expected = turned(movie.R_lab_body[here], turn * (dt / span)[:, None])
    off, _ = turn_between(expected, movie.R_lab_body[after])
    errors = (movie.variance[before], movie.variance[here], movie.variance[after])
    variance = replace(motion, acceleration_rad_s2=0.0).predicted_variance(dt, span, *errors)
    drift = (span + dt) / 2 * dt
    whole = ~begins[1:-1] & ~begins[2:]
    return frame[2:][whole], off[whole], variance[whole], drift[whole]


def _learnt(movie: Movie, searched: Sequence[tuple[Movie, Histories]], motion: Motion) -> float:
    """Scale of the acceleration in the histories of some parts of a movie, rad/s^2.

    Source: textbook, expectation and maximisation of Student's t; its weights make a few wrong links harmless.
    """
    links = [misfits(part, histories, motion)[1:] for part, histories in searched]
    off, variance, drift = (np.concatenate(each) for each in zip(*links, strict=True))
    scale = motion.acceleration_rad_s2
    if len(off) < LINKS_MIN:
        return scale
    least, most = _bounds(movie, motion)
    for _ in range(50):
        distance = off**2 / ((scale * drift) ** 2 + variance)
        weight = (motion.tail + 3) / (motion.tail + distance)
        # The root of the ratio, not the ratio: where errors make most of the misfit, whole steps would overshoot.
        scale = float(np.clip(scale * math.sqrt(np.mean(weight * distance) / 3), least, most))
    return scale
