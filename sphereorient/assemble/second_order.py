"""The second-order path: candidates by the pictures and the change of omega, with an estimate of the acceleration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sphereorient.assemble.beam import BeamSearch, CandidateRows, Histories, Ints, rotated, rotation_between
from sphereorient.assemble.second_order_cost import Floats, SecondOrderCost
from sphereorient.assemble.segments import flags_where, number_segments
from sphereorient.assemble.settings import PathSettings
from sphereorient.errors import Flag

VARIANCE_MIN = 1e-10  # rad^2; a smaller variance (0.0006 degrees) is rounding
LINKS_MIN = 8  # fewer do not determine an acceleration
ROUND_ENOUGH = 0.3  # change of the scale's logarithm that leaves all choices unchanged
START_DEG = (0.1, 0.5, 2.0)  # tried changes of the rotation from frame to frame, for the start
CHANGE_MAX_DEG = 10.0  # largest tried change of the rotation from frame to frame
SAMPLES, SAMPLE_FRAMES = 3, 100  # parts of the movie for the choice of the start
MOSTLY_SURE = 0.5  # share of frames with one candidate from which these determine the acceleration
FLOOR_SIGMAS = 1.0  # of a single orientation: a smaller acceleration has no effect in one frame interval


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """The most probable history of N frames, by `PathLayer` of second order."""

    choice: Tensor  # (..., N) int64, index of the candidate; -1: no candidate is right
    probability: Tensor  # (..., N) float64, of the choice; NaN if it is -1
    posterior: Tensor  # (..., N, C) float64, of each candidate; 0 if masked
    turn_rad: Tensor  # (..., N, 3), lab, from the previous orientation; may exceed half a turn; NaN at starts
    segment: Tensor  # (..., N) int64, -1 outside any; gaps inside a segment belong to it
    flags: Tensor  # (..., N) int64, bits of trajectory.Flag
    acceleration_rad_s2: Tensor  # (...), scale per axis of the cost; NaN without candidates

    @classmethod
    def nothing(cls, mask: Tensor) -> "Chosen":
        """Return histories without an orientation for candidates in a mask (..., N, C)."""
        none = torch.full(mask.shape[:-1], -1, device=mask.device)
        missing = torch.full((*none.shape, 3), torch.nan, dtype=torch.float64, device=mask.device)
        return cls(
            choice=none,
            probability=missing[..., 0],
            posterior=torch.zeros(mask.shape, dtype=torch.float64, device=mask.device),
            turn_rad=missing,
            segment=none,
            flags=torch.zeros_like(none),
            acceleration_rad_s2=missing.new_full(mask.shape[:-2], torch.nan),
        )

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return self.choice >= 0


def physical_path(
    R_lab_body: Tensor, nll: Tensor, variance_rad2: Tensor, mask: Tensor, time_s: Tensor, settings: PathSettings
) -> Chosen:
    """Choose one candidate of each frame of a movie, or none, for the most probable history (`SecondOrderCost`).
    Candidates R (N, C, 3, 3), nll (N, C) of the pictures, variance (N, C) per axis, mask (N, C); time_s (N,) increases.
    Flags: `AMBIGUOUS` for an uncertain choice, `RECOVERED` on the first frame with an orientation after a gap or a
    break, `SPIKE` for a rotation that the motion does not explain.
    Source: textbook hidden Markov model of second order; it does not favour rest as the paper does (docs/errata.md A6).
    """
    device = mask.device
    R, nll, variance, time = (part.detach().cpu().double() for part in (R_lab_body, nll, variance_rad2, time_s))
    frames = torch.nonzero(mask.any(1))[:, 0].cpu()
    if not len(frames):
        return Chosen.nothing(mask)
    mask = mask.cpu()
    scale = settings.acceleration_rad_s2 or 1.0
    cost = SecondOrderCost.of(settings.model_copy(update={"acceleration_rad_s2": scale}))
    variance = float(cost.sigma_scale) ** 2 * variance[mask]
    rows = CandidateRows(
        R_lab_body=R[mask].numpy(),
        variance=variance.clamp_min(VARIANCE_MIN).numpy(),
        log_weight=cost.picture_log_weight(nll[frames], mask[frames])[mask[frames]].numpy(),
        offset=np.concatenate([[0], mask[frames].sum(-1).cumsum(0).numpy()]),
        time_s=time[frames].numpy(),
        frame_s=float(time.diff().median()) if len(time) > 1 else 1.0,
    )
    chosen = _chosen(mask, frames, rows, _search(rows, cost, settings), settings)
    return Chosen(**{name: part.to(device) for name, part in vars(chosen).items()})


def _chosen(
    mask: Tensor, frames: Tensor, rows: CandidateRows, found: tuple[Histories, SecondOrderCost], settings: PathSettings
) -> Chosen:
    (histories, cost), empty = found, Chosen.nothing(mask)
    place = torch.arange(mask.shape[1]).expand_as(mask)[mask]
    row = torch.from_numpy(histories.row)
    seen, choice = frames[row >= 0], place[row[row >= 0]]
    posterior = empty.posterior.masked_scatter(mask, torch.from_numpy(histories.posterior))
    probability = empty.probability.index_put((seen,), posterior[seen, choice])
    into, off, variance, drift = _misfits(rows, histories, cost)
    usual = np.sqrt(variance + (cost.acceleration_rad_s2 * drift) ** 2)
    unlikely = histories.breaks.copy()
    unlikely[into] |= (off > settings.spike_factor * usual) & (off > math.radians(settings.spike_min_deg))
    nowhere = torch.zeros(len(mask), dtype=torch.bool)
    begins, spike = (nowhere.index_put((frames,), torch.from_numpy(each)) for each in (histories.begins, unlikely))
    present = torch.isfinite(probability)
    recovered = torch.zeros_like(begins)
    recovered[seen[1:]] = (begins | spike)[seen[1:]] | (seen.diff() > 1)
    ambiguous = present & (probability < settings.probability_min)
    return Chosen(
        choice=empty.choice.index_put((seen,), choice),
        probability=probability,
        posterior=posterior,
        turn_rad=empty.turn_rad.index_put((frames,), torch.from_numpy(histories.turn_rad)),
        segment=number_segments(present, begins | spike, len(mask)),
        flags=flags_where({Flag.AMBIGUOUS: ambiguous, Flag.RECOVERED: recovered, Flag.SPIKE: spike}),
        acceleration_rad_s2=torch.tensor(float(cost.acceleration_rad_s2), dtype=torch.float64),
    )


def _search(rows: CandidateRows, cost: SecondOrderCost, settings: PathSettings) -> tuple[Histories, SecondOrderCost]:
    """Search, estimate the acceleration from the best history, and repeat until it converges; a given one is kept."""
    gap = settings.gap_frames_max
    if settings.acceleration_rad_s2 is not None:
        return BeamSearch(rows, cost, gap).run(), cost
    cost = _start(rows, cost, gap)
    histories = BeamSearch(rows, cost, gap).run()
    for _ in range(4):  # at most four rounds
        scale = _acceleration(rows, [(rows, histories)], cost)
        if abs(math.log(scale / cost.acceleration_rad_s2)) < ROUND_ENOUGH:
            break
        cost = replace(cost, acceleration_rad_s2=scale)
        histories = BeamSearch(rows, cost, gap).run()
    return histories, cost


def _bounds(rows: CandidateRows) -> tuple[float, float]:
    least = FLOOR_SIGMAS * float(np.sqrt(np.median(rows.variance)))
    most = max(math.radians(CHANGE_MAX_DEG), least)
    return least / rows.frame_s**2, most / rows.frame_s**2


def _start(rows: CandidateRows, cost: SecondOrderCost, gap_frames_max: int) -> SecondOrderCost:
    """Return the cost with the acceleration from frames with one candidate, if most frames are such, else with the one
    that gives parts of the movie the clearest motion.
    """
    sure = _sure(rows)
    if (sure.row >= 0).mean() > MOSTLY_SURE:
        middle = replace(cost, acceleration_rad_s2=math.sqrt(math.prod(_bounds(rows))))
        return replace(cost, acceleration_rad_s2=_acceleration(rows, [(rows, sure)], middle))
    frames, parts = len(rows.time_s), [rows]
    if frames > SAMPLES * SAMPLE_FRAMES:
        firsts = np.linspace(0, frames - SAMPLE_FRAMES, SAMPLES).astype(np.int64).tolist()
        parts = [rows.part(first, first + SAMPLE_FRAMES) for first in firsts]
    least, most = _bounds(rows)
    best, most_evidence = cost, -math.inf
    for change_deg in START_DEG:
        scale = float(np.clip(math.radians(change_deg) / rows.frame_s**2, least, most))
        trial = replace(cost, acceleration_rad_s2=scale)
        searched = [(part, BeamSearch(part, trial, gap_frames_max).run()) for part in parts]
        evidence = sum(histories.evidence for _, histories in searched)
        if evidence > most_evidence:
            best, most_evidence = replace(trial, acceleration_rad_s2=_acceleration(rows, searched, trial)), evidence
    return best


def _sure(rows: CandidateRows) -> Histories:
    """Return the history of the frames with one candidate each: a motion through consistent ones."""
    single = np.diff(rows.offset) == 1
    row = np.where(single, rows.offset[:-1], -1)
    begins = np.ones(len(row), np.bool_)
    begins[1:] = ~(single[1:] & single[:-1]) | (rows.zones(np.diff(rows.time_s)) > 1)
    angle, axis = rotation_between(rows.R_lab_body[np.roll(row, 1)], rows.R_lab_body[row])
    turn = np.where(begins[:, None], np.nan, angle[:, None] * axis)
    none = np.zeros(len(rows.variance))
    return Histories(row=row, begins=begins, breaks=begins, turn_rad=turn, posterior=none, evidence=0.0)


def _misfits(rows: CandidateRows, histories: Histories, cost: SecondOrderCost) -> tuple[Ints, Floats, Floats, Floats]:
    """Return the frames (L,) with a prediction, and misfit, rad, variance, rad^2, and drift per acceleration, s^2."""
    frame = np.flatnonzero(histories.row >= 0)
    row, begins = histories.row[frame], histories.begins[frame]
    before, here, after = row[:-2], row[1:-1], row[2:]
    steps = np.diff(rows.time_s[frame])
    span, dt = steps[:-1], steps[1:]
    turn = np.nan_to_num(histories.turn_rad[frame[1:-1]])
    expected = rotated(rows.R_lab_body[here], turn * (dt / span)[:, None])
    off, _ = rotation_between(expected, rows.R_lab_body[after])
    errors = (rows.variance[before], rows.variance[here], rows.variance[after])
    variance = replace(cost, acceleration_rad_s2=0.0).predicted_variance(dt, span, *errors)
    drift = (span + dt) / 2 * dt
    whole = ~begins[1:-1] & ~begins[2:]
    return frame[2:][whole], off[whole], variance[whole], drift[whole]


def _acceleration(
    rows: CandidateRows, searched: Sequence[tuple[CandidateRows, Histories]], cost: SecondOrderCost
) -> float:
    """Return the scale of the acceleration, rad/s^2, in some parts of a movie, by EM of Student's t (textbook)."""
    links = [_misfits(part, histories, cost)[1:] for part, histories in searched]
    off, variance, drift = (np.concatenate(each) for each in zip(*links, strict=True))
    scale, tail = float(cost.acceleration_rad_s2), float(cost.tail)
    if len(off) < LINKS_MIN:
        return scale
    least, most = _bounds(rows)
    for _ in range(50):
        distance = off**2 / ((scale * drift) ** 2 + variance)
        weight = (tail + 3) / (tail + distance)
        # The root of the ratio: if errors dominate the misfit, whole steps overshoot.
        scale = float(np.clip(scale * math.sqrt(np.mean(weight * distance) / 3), least, most))
    return scale
