"""The path with physics: which candidate is right, judged by the pictures and by how omega may change."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from sphereorient.assemble.acceleration import misfits, search_and_learn
from sphereorient.assemble.beam import Histories, Movie
from sphereorient.assemble.continuity import Motion
from sphereorient.assemble.segments import number_segments
from sphereorient.assemble.settings import PathSettings
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.trajectory import Flag

VARIANCE_MIN = 1e-10  # rad^2; what claims to be better than 0.0006 degrees is rounding


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
    frame_s = float(time_s.detach().double().diff().median()) if len(time_s) > 1 else 1.0
    histories, motion = search_and_learn(movie, frame_s, settings)
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


def _chosen(
    hypotheses: Hypotheses,
    frames: Tensor,
    movie: Movie,
    histories: Histories,
    motion: Motion,
    settings: PathSettings,
) -> Chosen:
    """Bring what was found from rows back to frames and places."""
    device, mask, empty = hypotheses.mask.device, hypotheses.mask.cpu(), _nothing(hypotheses)
    place = torch.arange(mask.shape[1]).expand_as(mask)[mask]
    row = torch.from_numpy(histories.row)
    seen, choice = frames[row >= 0], place[row[row >= 0]]
    posterior = empty.posterior.cpu().masked_scatter(mask, torch.from_numpy(histories.posterior))
    probability = empty.probability.cpu().index_put((seen,), posterior[seen, choice])
    begins, spike = _breaks(frames, len(mask), movie, histories, motion, settings)
    present = torch.isfinite(probability)
    recovered = torch.zeros_like(begins)
    recovered[seen[1:]] = (begins | spike)[seen[1:]] | (seen.diff() > 1)
    bits = {
        Flag.AMBIGUOUS: present & (probability < settings.probability_min),
        Flag.RECOVERED: recovered,
        Flag.SPIKE: spike,
    }
    at = seen.to(device), choice.to(device)
    turn = torch.from_numpy(histories.turn_rad).to(device)
    return Chosen(
        choice=empty.choice.index_put(at[:1], at[1]),
        R_lab_body=empty.R_lab_body.index_put(at[:1], hypotheses.R_lab_body.detach().double()[at]),
        covariance_rad2=empty.covariance_rad2.index_put(at[:1], hypotheses.covariance_rad2.detach().double()[at]),
        probability=probability.to(device),
        posterior=posterior.to(device),
        turn_rad=empty.turn_rad.index_put((frames.to(device),), turn),
        segment=number_segments(present, begins | spike, len(mask)).to(device),
        flags=torch.stack([int(flag) * where.long() for flag, where in bits.items()]).sum(0).to(device),
        acceleration_rad_s2=motion.acceleration_rad_s2,
    )


def _breaks(
    frames: Tensor, count: int, movie: Movie, histories: Histories, motion: Motion, settings: PathSettings
) -> tuple[Tensor, Tensor]:
    """Frames whose orientation begins a motion, and those that physics does not explain, (N,) bool each."""
    into, off, variance, drift = misfits(movie, histories, motion)
    usual = np.sqrt(variance + (motion.acceleration_rad_s2 * drift) ** 2)
    spike = histories.breaks.copy()
    spike[into] |= (off > settings.spike_factor * usual) & (off > math.radians(settings.spike_min_deg))
    nowhere = torch.zeros(count, dtype=torch.bool)
    begins, spikes = (nowhere.index_put((frames,), torch.from_numpy(each)) for each in (histories.begins, spike))
    return begins, spikes


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
