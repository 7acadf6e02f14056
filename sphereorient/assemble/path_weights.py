"""What pictures and motion weigh in the path of pairs: a model whose few numbers can be learnt."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from sphereorient import so3
from sphereorient.assemble.continuity import TURNS_RAD3, VARIANCE_MAX
from sphereorient.assemble.second_order_layer import shortest_path_of_pairs, soft_path_of_pairs
from sphereorient.assemble.soft_path import SoftPath
from sphereorient.assemble.trellis import ShortestPath
from sphereorient.errors import SettingsError, check_tail, refusal

TRIPLES_AT_ONCE = 1 << 20  # whose misfits are held at once, 8 MB each array
EVEN = 1e-9  # of a ratio of times: the expected turn is off by less than 4e-9 rad
LOST_RAD2 = 1e6  # variance of the place that says none: whatever it is part of tells nothing


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Numbers of the model; hand-set, or read from `PathWeights`. The defaults are those of `PathSettings`."""

    acceleration_rad_s2: float  # scale of the angular acceleration per axis
    quality: float = 1.0  # of a nat that the pictures claim
    noise: float = 1.0  # the orientations' sigmas are this many times what they claim
    tail: float = 4.0  # degrees of freedom of Student's t
    outlier_probability: float = 0.01  # that an orientation does not follow from the motion
    missing_probability: float = 0.01  # that no candidate of a frame is right although one was in the frame before
    missing_again_probability: float = 0.5  # that none is after a frame in which none was
    doubt_probability: float = 0.01  # that the pictures say nothing on which of a frame's candidates is right
    stuck_probability: float = 0.3  # that a false candidate stands where one stood before
    temperature: float = 1.0  # of all costs

    def __post_init__(self) -> None:
        """Refuse what has no logarithm."""
        for entry in fields(self):
            value, most = getattr(self, entry.name), 1.0 if entry.name.endswith("probability") else math.inf
            if not 0 < value < most:
                expected = "above 0" + (" and below 1" if most == 1.0 else "")
                raise SettingsError(refusal(entry.name, expected=expected, got=str(value), do="change it"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Candidates of N frames of any number of movies; read by `PathWeights`."""

    R_lab_body: Tensor  # (..., N, C, 3, 3)
    nll: Tensor  # (..., N, C), negative log-likelihood of the pictures
    variance_rad2: Tensor  # (..., N, C), per axis, of the orientations' errors as claimed
    mask: Tensor  # (..., N, C) bool, where there is a candidate; what is elsewhere must be finite
    time_s: Tensor  # (..., N), increasing

    def __post_init__(self) -> None:
        """Compare the sizes of the parts."""
        check_tail("Frames.R_lab_body", self.R_lab_body, *self.mask.shape, 3, 3)
        check_tail("Frames.nll", self.nll, *self.mask.shape)
        check_tail("Frames.variance_rad2", self.variance_rad2, *self.mask.shape)
        check_tail("Frames.time_s", self.time_s, *self.mask.shape[:-1])


class PathWeights(nn.Module):
    """The numbers of `Weights` as parameters: logarithms, and of probabilities logits."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        for entry in fields(Weights):
            value = torch.tensor(getattr(weights, entry.name), dtype=torch.float64)
            raw = torch.logit(value) if entry.name.endswith("probability") else value.log()
            self.register_parameter(entry.name, nn.Parameter(raw))

    def value(self, name: str) -> Tensor:
        """Return one number as it stands in `Weights`, 0-dimensional, differentiable."""
        raw: Tensor = getattr(self, name)
        return torch.sigmoid(raw) if name.endswith("probability") else raw.exp()

    def weights(self) -> Weights:
        """Return the numbers as they are now."""
        return Weights(**{entry.name: float(self.value(entry.name).detach()) for entry in fields(Weights)})

    def soft_path(self, frames: Frames) -> SoftPath:
        """Return probabilities of C candidates and, at place C, of none: marginals (..., N, C + 1).

        Frames without any candidate are skipped: the motion is carried over them.
        """
        triple, pair, node, mask = self._costs(frames)
        return soft_path_of_pairs(triple, mask, pair_cost=pair, node_cost=node)

    def shortest_path(self, frames: Frames) -> ShortestPath:
        """Return the most probable history; choice C: no candidate of the frame is right."""
        triple, pair, node, mask = self._costs(frames)
        return shortest_path_of_pairs(triple, mask, pair_cost=pair, node_cost=node)

    def _costs(self, frames: Frames) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Costs of triples, pairs and candidates, over the temperature, and mask; place C, none, in visited frames."""
        visited = frames.mask.any(-1, keepdim=True)
        mask = torch.cat([frames.mask, visited], -1)
        view = torch.eye(3, dtype=frames.R_lab_body.dtype, device=mask.device)
        R = torch.cat([frames.R_lab_body, view.expand_as(frames.R_lab_body[..., :1, :, :])], -3)
        variance = torch.cat([frames.variance_rad2, torch.full_like(frames.nll[..., :1], LOST_RAD2)], -1)
        triple, temperature = self.triple_costs(R, variance, frames.time_s, mask), self._as("temperature", frames.nll)
        pair, node = self._again(mask, frames.nll), self._pictures(frames)
        return triple / temperature, pair / temperature, node / temperature, mask

    def _pictures(self, frames: Frames) -> Tensor:
        """What each candidate, and none, costs by the pictures alone, (..., N, C + 1)."""
        visited, missing = frames.mask.any(-1, keepdim=True), self._as("missing_probability", frames.nll)
        claimed = torch.where(frames.mask, -self._as("quality", frames.nll) * frames.nll, -torch.inf)
        # A frame without candidates has no share: the zeros in it keep the gradient clear of inf - inf.
        share = torch.log_softmax(torch.where(visited, claimed, 0.0), -1)
        doubt, count = self._as("doubt_probability", frames.nll), frames.mask.sum(-1, keepdim=True).clamp_min(1)
        share = torch.logaddexp(share + torch.log1p(-doubt), doubt.log() - count.to(share).log())
        right = torch.where(frames.mask, share, 0.0) + torch.log1p(-missing)
        return -torch.cat([right, missing.log().expand_as(share[..., :1])], -1)

    def _again(self, mask: Tensor, like: Tensor) -> Tensor:
        """What it costs more, or less, to miss or to hit after a miss, (..., N - 1, C + 1, C + 1)."""
        fresh, again = self._as("missing_probability", like), self._as("missing_again_probability", like)
        none = torch.arange(mask.shape[-1], device=mask.device) == mask.shape[-1] - 1
        after = torch.where(none, fresh.log() - again.log(), torch.log1p(-fresh) - torch.log1p(-again))
        return torch.where(none[:, None], after, 0.0).expand(*mask[..., 1:, 0].shape, *[mask.shape[-1]] * 2)

    def triple_costs(self, R_lab_body: Tensor, variance_rad2: Tensor, time_s: Tensor, mask: Tensor) -> Tensor:
        """Return what it costs that three candidates in a row are right: how badly the third follows from the two.

        The turn from the last two frames visited, at the same omega, foretells the orientation; the misfit is Student's
        t of the acceleration and the orientations' errors, or anything with the outliers' probability. As in
        `physical_path`, a candidate that follows by standing still proves little: false ones do.

        Args:
            R_lab_body: (..., N, C, 3, 3), rotations.
            variance_rad2: (..., N, C), per axis, as claimed; `LOST_RAD2`: says nothing.
            time_s: (..., N), increasing; turns between frames visited are below half a turn.
            mask: (..., N, C) bool; frames without candidates are skipped.

        Returns:
            (..., N - 2, C, C, C), nats, as `soft_path_of_pairs` takes it.
        """
        check_tail("R_lab_body", R_lab_body, *mask.shape, 3, 3)
        links = _links(R_lab_body, time_s, mask)
        steps = mask.shape[-2]
        still = self._still(links, R_lab_body, variance_rad2)
        width = max(mask.shape[-1], 1)
        chunk = max(1, TRIPLES_AT_ONCE // (width**3 * max(math.prod(mask.shape[:-2]), 1)))
        parts = [
            self._chunk(links, variance_rad2, still, slice(at, min(at + chunk, steps))) for at in range(2, steps, chunk)
        ]
        none = R_lab_body.new_zeros((*mask.shape[:-2], 0, *[mask.shape[-1]] * 3))
        return torch.cat(parts, -4) if parts else none

    def _chunk(self, links: _Links, variance: Tensor, still: Tensor, steps: slice) -> Tensor:
        """Costs of entering some steps, (..., K, C, C, C)."""
        before = links.before[..., steps]
        earlier = links.before.gather(-1, before)
        expected, here = _taken(links.turn, before, 4), links.turn[..., steps, :, :, :, :]
        dt, span = links.dt_s[..., steps], links.dt_s.gather(-1, before)
        ratio = (dt / span)[..., None, None, None]
        from_middle = scaled_turns(expected, ratio).flatten(-2).transpose(-3, -2)  # (..., j, i, 9)
        misfit = _misfit(from_middle, here.flatten(-2)).transpose(-3, -2)
        drift = (self._as("acceleration_rad_s2", variance) * (span + dt) / 2 * dt).square()[..., None, None, None]
        errors = ratio.square() * _taken(variance, earlier, 1)[..., :, None, None]
        errors = errors + (1 + ratio).square() * _taken(variance, before, 1)[..., None, :, None]
        errors = errors + variance[..., steps, None, None, :]
        follows = self._log_ratio(misfit, drift + self._as("noise", variance).square() * errors)
        outlier = self._as("outlier_probability", variance)
        follows = torch.logaddexp(torch.log1p(-outlier) + follows, outlier.log())
        stuck = self._as("stuck_probability", variance)
        standing = torch.minimum(still[..., steps, None, None, :], follows)
        return torch.logaddexp(torch.log1p(-stuck), stuck.log() + standing) - follows

    def _still(self, links: _Links, R_lab_body: Tensor, variance: Tensor) -> Tensor:
        """How likely a candidate is where it stands if one of the frame before stays, (..., N, C), log of the ratio."""
        misfit = _misfit(_taken(R_lab_body, links.before, 3).flatten(-2), R_lab_body.flatten(-2))
        drift = (self._as("acceleration_rad_s2", variance) * links.dt_s.square()).square()[..., None, None]
        errors = _taken(variance, links.before, 1)[..., :, None] + variance[..., None, :]
        return self._log_ratio(misfit, drift + 3 * self._as("noise", variance).square() * errors).amax(-2)

    def _log_ratio(self, misfit: Tensor, variance: Tensor) -> Tensor:
        """Log of Student's t in three dimensions over the uniform density; 0 where the variance leaves nothing to tell.

        Source: `continuity.Motion.log_ratio`, with the chord for the angle.
        """
        tail = self._as("tail", variance)
        peak = torch.lgamma((tail + 3) / 2) - torch.lgamma(tail / 2) - 1.5 * (tail * math.pi).log()
        fall = (tail + 3) / 2 * torch.log1p(misfit / (tail * variance))
        return torch.where(variance < VARIANCE_MAX, math.log(TURNS_RAD3) + peak - 1.5 * variance.log() - fall, 0.0)

    def _as(self, name: str, like: Tensor) -> Tensor:
        return self.value(name).to(like)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Links:
    """How each step is reached from the one visited before it."""

    turn: Tensor  # (..., N, C, C, 3, 3), lab, from each candidate there to each here
    dt_s: Tensor  # (..., N), the time it took, 1 where there is none before
    before: Tensor  # (..., N) int64, the step visited before, 0 where there is none


def _links(R_lab_body: Tensor, time_s: Tensor, mask: Tensor) -> _Links:
    """Turns between all candidates of steps that follow each other; those into empty steps are any."""
    step = torch.arange(mask.shape[-2], device=mask.device)
    held = torch.where(mask.any(-1), step, 0).cummax(-1).values
    before = torch.cat([torch.zeros_like(held[..., :1]), held[..., :-1]], -1)
    dt = time_s - time_s.gather(-1, before)  # in this order: single precision does not tell apart late times
    rows = _taken(R_lab_body, before, 3)
    # One product of (3C, 3) and (3, 3C) a step, not C^2 small ones: those take ten times as long.
    width = mask.shape[-1]
    after, first = R_lab_body.flatten(-3, -2), rows.flatten(-3, -2)
    every = (after @ first.mT).reshape(*mask.shape[:-1], width, 3, width, 3)  # (..., to, 3, from, 3)
    turn = every.permute(*range(mask.ndim - 1), -2, -4, -3, -1)
    return _Links(turn=turn, dt_s=torch.where(dt > 0, dt, 1.0).to(R_lab_body), before=before)


def _misfit(expected: Tensor, found: Tensor) -> Tensor:
    """(2 sin(angle / 2))^2 between rotations (..., A, 9) and (..., B, 9): angle^2, but smooth at a half turn too."""
    # Differences, not products: small misfits keep their digits in single precision.
    return torch.cdist(expected, found, compute_mode="donot_use_mm_for_euclid_dist").square() / 2


def _taken(part: Tensor, step: Tensor, tail: int) -> Tensor:
    """Rows (..., K, *tail) of a part (..., N, *tail) at some steps (..., K)."""
    index = step[(..., *[None] * tail)]
    return part.gather(-tail - 1, index.expand(*step.shape, *part.shape[part.ndim - tail :]))


def scaled_turns(turn: Tensor, ratio: Tensor) -> Tensor:
    """Return (..., 3, 3), turns about the same axes by `ratio` (..., 1) times the angle.

    Args:
        turn: (..., 3, 3), rotations, below half a turn.
        ratio: (..., 1), broadcasts against the turns' rotation vectors.
    """
    if bool(((ratio - 1).abs() < EVEN).all()):
        return turn
    return so3.exp(so3.log(turn) * ratio)
