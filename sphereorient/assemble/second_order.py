"""The second-order path: candidates by the pictures and the change of omega; the acceleration is estimated too."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphereorient.assemble.beam import BeamSearch, Histories
from sphereorient.assemble.path import number_segments
from sphereorient.assemble.second_order_cost import SecondOrderCost
from sphereorient.assemble.settings import PathSettings
from sphereorient.assemble.states import CandidateRows, Floats, Ints, rotated, rotation_between
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.trajectory import Flag

VARIANCE_MIN = 1e-10  # rad^2; a smaller variance (0.0006 degrees) is rounding
LINKS_MIN = 8  # fewer do not determine an acceleration
ROUNDS_MAX = 4
ROUND_ENOUGH = 0.3  # a scale that changes by less, as a logarithm, changes no choice
START_DEG = (0.1, 0.5, 2.0)  # changes of the rotation from frame to frame, one of which is near enough to begin with
CHANGE_MAX_DEG = 10.0
SAMPLES, SAMPLE_FRAMES = 3, 100  # parts of the movie from which the start is chosen
FLOOR_SIGMAS = 1.0  # of a single orientation: a smaller acceleration is not seen in one frame interval


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypotheses:
    """Candidate orientations of N frames, C places each, best first; masked places may hold anything."""

    R_lab_body: Tensor  # (N, C, 3, 3) float64
    nll: Tensor  # (N, C) float64, negative log-likelihood of the pictures, less that of the frame's best
    covariance_rad2: Tensor  # (N, C, 3, 3), of delta in R_true = exp([delta]x) R_lab_body
    mask: Tensor  # (N, C) bool, where there is a candidate

    def __post_init__(self) -> None:
        check_tail("Hypotheses.R_lab_body", self.R_lab_body, 3, 3)
        for entry in fields(self):
            tail = (3, 3) if entry.name in ("R_lab_body", "covariance_rad2") else ()
            part, expected = getattr(self, entry.name), (*self.R_lab_body.shape[:-2], *tail)
            if self.R_lab_body.ndim != 4 or tuple(part.shape) != expected:
                sizes, got = f"shape (N, C{', 3, 3' if tail else ''})", str(tuple(part.shape))
                do = "give every part one row a frame and one place a candidate"
                raise ShapeError(refusal(f"Hypotheses.{entry.name}", expected=sizes, got=got, do=do))

    def __len__(self) -> int:
        return len(self.mask)


@dataclass(frozen=True, kw_only=True, eq=False)
class Chosen:
    """The most probable history of N frames; made by `physical_path`."""

    choice: Tensor  # (N,) int64, index of the candidate, -1 where no candidate is right
    probability: Tensor  # (N,) float64, of the choice, NaN where it is -1
    posterior: Tensor  # (N, C) float64, of each candidate, 0 where masked
    turn_rad: Tensor  # (N, 3), rad, lab, from the orientation before, may exceed half a turn; NaN where a motion begins
    segment: Tensor  # (N,) int64, -1 outside any; gaps inside a segment belong to it
    flags: Tensor  # (N,) int64, bits of trajectory.Flag
    acceleration_rad_s2: float  # scale per axis that the choice was made with

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return self.choice >= 0


def physical_path(hypotheses: Hypotheses, time_s: Tensor, settings: PathSettings) -> Chosen:
    """Choose one candidate of each frame, or none, for the most probable history (`SecondOrderCost`); time_s (N,)
    increases.
    Flags: `AMBIGUOUS` where the choice is not sure, `RECOVERED` on the first frame with an orientation after a gap or a
    break, `SPIKE` where a rotation does not follow from the motion.
    Source: textbook hidden Markov model of second order; unlike the paper's cost, it does not favour candidates at rest
    (docs/errata.md A6).

    Raises:
        ShapeError: the number of times is not N.
    """
    if tuple(time_s.shape) != (len(hypotheses),):
        do, got = "pass one time a frame", str(tuple(time_s.shape))
        raise ShapeError(refusal("time_s", expected=f"shape ({len(hypotheses)},)", got=got, do=do))
    device = hypotheses.mask.device
    parts = {entry.name: getattr(hypotheses, entry.name).detach().cpu() for entry in fields(hypotheses)}
    known = Hypotheses(**{name: part if name == "mask" else part.double() for name, part in parts.items()})
    frames = torch.nonzero(known.mask.any(1))[:, 0]
    chosen = _nothing(known.mask)
    if len(frames):
        scale = settings.acceleration_rad_s2 or 1.0
        cost = SecondOrderCost.of(settings.model_copy(update={"acceleration_rad_s2": scale}))
        rows = _rows(known, time_s.detach().cpu().double(), frames, cost)
        chosen = _chosen(known, frames, rows, *_search(rows, cost, settings), settings)
    moved: dict[str, Any] = {name: part.to(device) for name, part in vars(chosen).items() if torch.is_tensor(part)}
    return replace(chosen, **moved)


def _rows(known: Hypotheses, time_s: Tensor, frames: Tensor, cost: SecondOrderCost) -> CandidateRows:
    """Return the candidates as rows; the variance is the mean over axes: false candidates are degrees away."""
    mask = known.mask
    variance = (float(cost.sigma_scale) ** 2 * known.covariance_rad2).diagonal(dim1=-2, dim2=-1).mean(-1)
    return CandidateRows(
        R_lab_body=known.R_lab_body[mask].numpy(),
        variance=variance[mask].clamp_min(VARIANCE_MIN).numpy(),
        log_weight=cost.picture_log_weight(known.nll[frames], mask[frames])[mask[frames]].numpy(),
        offset=np.concatenate([[0], mask[frames].sum(-1).cumsum(0).numpy()]),
        time_s=time_s[frames].numpy(),
        frame_s=float(time_s.diff().median()) if len(time_s) > 1 else 1.0,
    )


def _chosen(
    known: Hypotheses,
    frames: Tensor,
    rows: CandidateRows,
    histories: Histories,
    cost: SecondOrderCost,
    settings: PathSettings,
) -> Chosen:
    mask, empty = known.mask, _nothing(known.mask)
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
    bits = {
        Flag.AMBIGUOUS: present & (probability < settings.probability_min),
        Flag.RECOVERED: recovered,
        Flag.SPIKE: spike,
    }
    return Chosen(
        choice=empty.choice.index_put((seen,), choice),
        probability=probability,
        posterior=posterior,
        turn_rad=empty.turn_rad.index_put((frames,), torch.from_numpy(histories.turn_rad)),
        segment=number_segments(present, begins | spike, len(mask)),
        flags=torch.stack([int(flag) * where.long() for flag, where in bits.items()]).sum(0),
        acceleration_rad_s2=float(cost.acceleration_rad_s2),
    )


def _nothing(mask: Tensor) -> Chosen:
    none = torch.full(mask.shape[:1], -1)
    missing = torch.full((len(mask), 3), torch.nan, dtype=torch.float64)
    return Chosen(
        choice=none,
        probability=missing[:, 0],
        posterior=torch.zeros(mask.shape, dtype=torch.float64),
        turn_rad=missing,
        segment=none,
        flags=torch.zeros_like(none),
        acceleration_rad_s2=math.nan,
    )


def _search(rows: CandidateRows, cost: SecondOrderCost, settings: PathSettings) -> tuple[Histories, SecondOrderCost]:
    """Search, estimate the acceleration from the best history, and repeat until it stays; a given one is kept."""
    gap = settings.gap_frames_max
    if settings.acceleration_rad_s2 is not None:
        return BeamSearch(rows, cost, gap).run(), cost
    cost = _start(rows, cost, gap)
    histories = BeamSearch(rows, cost, gap).run()
    for _ in range(ROUNDS_MAX):
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
    """Return the cost with the acceleration under which parts of the movie show a motion most clearly."""
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
        # The root of the ratio, not the ratio: where errors make most of the misfit, whole steps would overshoot.
        scale = float(np.clip(scale * math.sqrt(np.mean(weight * distance) / 3), least, most))
    return scale
