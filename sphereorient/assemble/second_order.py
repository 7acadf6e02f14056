"""The path with physics: which candidate is right, judged by the pictures and by how omega may change."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from sphereorient.assemble.beam import Histories, Movie, search
from sphereorient.assemble.continuity import Floats, Ints, Motion, turn_between, turned
from sphereorient.assemble.segments import number_segments
from sphereorient.assemble.settings import PathSettings
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.trajectory import Flag

VARIANCE_MIN = 1e-10  # rad^2; what claims to be better than 0.0006 degrees is rounding
LINKS_MIN = 8  # fewer teach no acceleration
ROUNDS_MAX = 4
ROUND_ENOUGH = 0.2  # a scale that changes by less, as a logarithm, changes no choice
START_DEG = (0.1, 0.5, 2.0)  # changes of the turn from frame to frame, one of which is near enough to begin with
CHANGE_MAX_DEG = 10.0
SAMPLES, SAMPLE_FRAMES = 3, 100  # stretches of the movie by which it is chosen
FLOOR_SIGMAS = 1.0  # of a single orientation: less acceleration is not seen in one frame interval


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypotheses:
    """Possible orientations of N frames from all cameras together; made by the joint refinement, read by the path.

    C places a frame, best first; those not in use may hold anything.
    """

    R_lab_body: Tensor  # (N, C, 3, 3) float64
    nll: Tensor  # (N, C) float64, negative log-likelihood of the pictures, less that of the frame's best
    covariance_rad2: Tensor  # (N, C, 3, 3), of delta in R_true = exp([delta]x) R_lab_body
    mask: Tensor  # (N, C) bool, where there is a candidate

    def __post_init__(self) -> None:
        """Compare the sizes of the parts."""
        check_tail("Hypotheses.R_lab_body", self.R_lab_body, 3, 3)
        for entry in fields(self):
            tail = (3, 3) if entry.name in ("R_lab_body", "covariance_rad2") else ()
            part, expected = getattr(self, entry.name), (*self.R_lab_body.shape[:-2], *tail)
            if self.R_lab_body.ndim != 4 or tuple(part.shape) != expected:
                do = "give every part one row a frame and one place a candidate"
                sizes = f"shape (N, C{', 3, 3' if tail else ''})"
                name = f"Hypotheses.{entry.name}"
                raise ShapeError(refusal(name, expected=sizes, got=str(tuple(part.shape)), do=do))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.mask)


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """The most probable history of N frames; made by `physical_path`, read by motion and the pipeline."""

    choice: Tensor  # (N,) int64, place of the candidate, -1 where none is right
    R_lab_body: Tensor  # (N, 3, 3) float64, NaN where none is
    covariance_rad2: Tensor  # (N, 3, 3), NaN where none is
    probability: Tensor  # (N,) float64, of the choice among the frame's candidates and none; NaN where none is
    posterior: Tensor  # (N, C) float64, the same of each candidate, 0 where there is none
    turn_rad: (
        Tensor  # (N, 3), rad, lab, from the last orientation before, may exceed half a turn; NaN where none enters
    )
    segment: Tensor  # (N,) int64, -1 outside any; holes inside a segment belong to it
    flags: Tensor  # (N,) int64, bits of trajectory.Flag
    acceleration_rad_s2: float  # scale of the angular acceleration per axis that the choice was made with

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return self.choice >= 0


def physical_path(hypotheses: Hypotheses, time_s: Tensor, settings: PathSettings) -> Chosen:
    """Choose in each frame the right candidate, or none, so that the movie's history is the most probable one.

    A history says which candidate of each frame is right, that none is, or that the motion breaks off and another
    begins. Its probability is that of the pictures and of the changes of omega from one pair of orientations to the
    next, whatever the time between them (Student's t; the scale is learnt from the history itself). A candidate that
    is false stands anywhere, or where one stood just before.

    Args:
        hypotheses: N frames.
        time_s: (N,), increasing, need not be even.
        settings: of the path.

    Returns:
        The choices with their probabilities. Flags: `AMBIGUOUS` where the choice is not sure, `RECOVERED` on the first
        frame with an orientation after frames without or a break, `SPIKE` where a turn does not follow from the motion.

    Raises:
        ShapeError: not one time a frame.

    Source: ERRATA A6 (a prior on the change of omega has no hole for candidates that stand still); textbook hidden
        Markov model of second order.
    """
    if tuple(time_s.shape) != (len(hypotheses),):
        do, got = "pass one time a frame", str(tuple(time_s.shape))
        raise ShapeError(refusal("time_s", expected=f"shape ({len(hypotheses)},)", got=got, do=do))
    frames = torch.nonzero(hypotheses.mask.any(1))[:, 0].cpu()
    if not len(frames):
        return _nothing(hypotheses)
    movie = _movie(hypotheses, time_s, frames, settings.evidence_doubt)
    histories, motion = _settle(movie, settings)
    return _chosen(hypotheses, frames, movie, histories, motion, settings)


def _movie(hypotheses: Hypotheses, time_s: Tensor, frames: Tensor, doubt: float) -> Movie:
    """Rows of the candidates there are; of a covariance its mean variance: false ones are degrees away, any axis."""
    mask = hypotheses.mask.cpu()
    weight = torch.softmax(torch.where(mask, -hypotheses.nll.detach().cpu().double(), -torch.inf)[frames], -1)
    counts = mask[frames].sum(-1)
    weight = (1 - doubt) * weight + doubt / counts[:, None]
    variance = hypotheses.covariance_rad2.detach().cpu().double().diagonal(dim1=-2, dim2=-1).mean(-1)
    return Movie(
        R_lab_body=hypotheses.R_lab_body.detach().cpu().double()[mask].numpy(),
        variance=variance[mask].clamp_min(VARIANCE_MIN).numpy(),
        log_weight=weight.log()[mask[frames]].numpy(),
        offset=np.concatenate([[0], counts.cumsum(0).numpy()]),
        time_s=time_s.detach().cpu().double()[frames].numpy(),
    )


def _settle(movie: Movie, settings: PathSettings) -> tuple[Histories, Motion]:
    """Search and learn the acceleration from what was found, until it stays."""
    dt = np.diff(movie.time_s)
    motion = Motion(
        acceleration_rad_s2=settings.acceleration_rad_s2 or 1.0,
        tail=settings.tail,
        frame_s=float(np.median(dt)) if len(dt) else 1.0,
    )
    if settings.acceleration_rad_s2 is not None:
        return search(movie, motion, settings), motion
    motion = _start(movie, motion, settings)
    histories = search(movie, motion, settings)
    for _ in range(ROUNDS_MAX):
        learnt = _learnt(movie, histories, motion)
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
    firsts = {int(first) for first in np.linspace(0, max(frames - SAMPLE_FRAMES, 0), SAMPLES)}
    parts = [movie.part(first, min(first + SAMPLE_FRAMES, frames)) for first in sorted(firsts)]
    least, most = _bounds(movie, motion)
    trials = [
        replace(motion, acceleration_rad_s2=float(np.clip(math.radians(change) / motion.frame_s**2, least, most)))
        for change in START_DEG
    ]
    return max(trials, key=lambda trial: sum(search(part, trial, settings).evidence for part in parts))


def _misfit(
    movie: Movie, motion: Motion, before: Ints, here: Ints, after: Ints, frame: Ints, turn: Floats | None = None
) -> tuple[Floats, Floats, Floats]:
    """Compare each third orientation with what the two before predict.

    Args:
        movie, motion: their acceleration does not matter.
        before, here, after: (L,), rows.
        frame: (L + 2,), frames of the orientations.
        turn: (L, 3), rad, from `before` to `here`; the shortest where it is not given.

    Returns:
        Angle (L,), rad; variance (L,) of it per axis by the orientations' errors alone; its drift (L,) per unit of
        acceleration, s^2.
    """
    R, time = movie.R_lab_body, movie.time_s[frame]
    span, dt = np.diff(time)[:-1], np.diff(time)[1:]
    if turn is None:
        angle, axis = turn_between(R[before], R[here])
        turn = angle[:, None] * axis
    off, _ = turn_between(turned(R[here], turn * (dt / span)[:, None]), R[after])
    errors = (movie.variance[before], movie.variance[here], movie.variance[after])
    variance = replace(motion, acceleration_rad_s2=0.0).predicted_variance(dt, span, *errors)
    return off, variance, (span + dt) / 2 * dt


def _links(movie: Movie, histories: Histories, motion: Motion) -> tuple[Ints, Floats, Floats, Floats]:
    """Frames that an omega leads into, and their `_misfit`."""
    frame = np.flatnonzero(histories.row >= 0)
    row, begins = histories.row[frame], histories.begins[frame]
    off, variance, drift = _misfit(
        movie, motion, row[:-2], row[1:-1], row[2:], frame, np.nan_to_num(histories.turn_rad[frame[1:-1]])
    )
    whole = ~begins[1:-1] & ~begins[2:]
    return frame[2:][whole], off[whole], variance[whole], drift[whole]


def _learnt(movie: Movie, histories: Histories, motion: Motion) -> float:
    """Scale of the acceleration in a history, rad/s^2, by expectation and maximisation of Student's t.

    Source: textbook; weights (tail + 3)/(tail + d^2) make a few wrong links harmless.
    """
    _, off, variance, drift = _links(movie, histories, motion)
    scale = motion.acceleration_rad_s2
    if len(off) < LINKS_MIN:
        return scale
    least, most = _bounds(movie, motion)
    for _ in range(50):
        distance = off**2 / ((scale * drift) ** 2 + variance)
        weight = (motion.tail + 3) / (motion.tail + distance)
        # Whole steps of a part-noise scale run away: the square root of the ratio settles in a few rounds.
        scale = float(np.clip(scale * math.sqrt(np.mean(weight * distance) / 3), least, most))
    return scale


def _chosen(
    hypotheses: Hypotheses,
    frames: Tensor,
    movie: Movie,
    histories: Histories,
    motion: Motion,
    settings: PathSettings,
) -> Chosen:
    """Bring what was found from rows back to frames and places."""
    device, mask = hypotheses.mask.device, hypotheses.mask.cpu()
    empty = _nothing(hypotheses)
    place = torch.arange(mask.shape[1]).expand_as(mask)[mask]
    row = torch.from_numpy(histories.row)
    seen, row = frames[row >= 0], row[row >= 0]
    choice = empty.choice.cpu().index_put((seen,), place[row])
    posterior = empty.posterior.cpu().masked_scatter(mask, torch.from_numpy(histories.posterior))
    probability = empty.probability.cpu().index_put((seen,), posterior[seen, choice[seen]])
    turn = empty.turn_rad.cpu().index_put((frames,), torch.from_numpy(histories.turn_rad))
    begins = torch.zeros(len(mask), dtype=torch.bool).index_put((frames,), torch.from_numpy(histories.begins))
    spike = torch.zeros_like(begins)
    into, off, variance, drift = _links(movie, histories, motion)
    far = off > settings.spike_factor * np.sqrt(variance + (motion.acceleration_rad_s2 * drift) ** 2)
    spike[frames[torch.from_numpy(into[far & (off > math.radians(settings.spike_min_deg))])]] = True
    present = choice >= 0
    spike[frames[torch.from_numpy(histories.breaks)]] = True
    segment = number_segments(present, begins | spike, len(mask))
    recovered = torch.zeros_like(begins)
    recovered[seen[1:][begins[seen[1:]] | (seen.diff() > 1)]] = True
    bits = {
        Flag.AMBIGUOUS: present & (probability < settings.probability_min),
        Flag.RECOVERED: recovered,
        Flag.SPIKE: spike,
    }
    at = seen.to(device), choice[seen].to(device)
    return Chosen(
        choice=choice.to(device),
        R_lab_body=empty.R_lab_body.index_put((at[0],), hypotheses.R_lab_body.detach().double()[at]),
        covariance_rad2=empty.covariance_rad2.index_put((at[0],), hypotheses.covariance_rad2.detach().double()[at]),
        probability=probability.to(device),
        posterior=posterior.to(device),
        turn_rad=turn.to(device),
        segment=segment.to(device),
        flags=torch.stack([int(flag) * where.long() for flag, where in bits.items()]).sum(0).to(device),
        acceleration_rad_s2=motion.acceleration_rad_s2,
    )


def _nothing(hypotheses: Hypotheses) -> Chosen:
    """Return the path of frames without candidates."""
    frames, device = len(hypotheses), hypotheses.mask.device
    none = torch.full((frames,), -1, dtype=torch.int64, device=device)
    missing = torch.full((frames, 3, 3), torch.nan, dtype=torch.float64, device=device)
    return Chosen(
        choice=none,
        R_lab_body=missing,
        covariance_rad2=missing,
        probability=missing[:, 0, 0],
        posterior=torch.zeros(hypotheses.mask.shape, dtype=torch.float64, device=device),
        turn_rad=missing[:, 0],
        segment=none,
        flags=torch.zeros_like(none),
        acceleration_rad_s2=math.nan,
    )
