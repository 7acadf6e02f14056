"""Differentiable paths: a layer with learnable parameters, and the soft track of fitted candidates.

docs/differentiable.md connects the soft track to the cameras.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sphereorient import so3
from sphereorient.assemble import trellis
from sphereorient.assemble.second_order import Chosen, physical_path
from sphereorient.assemble.second_order_cost import PARAMETERS, VARIANCE_MAX, SecondOrderCost
from sphereorient.assemble.settings import AssembleSettings, PathSettings
from sphereorient.assemble.trellis import ShortestPath, SoftPath, soft_path, taken, visited_before
from sphereorient.errors import SettingsError, ShapeError, check_tail, refusal

Values = Tensor | NDArray[np.floating]

TRIPLES_AT_ONCE = 1 << 20  # triples held at once, 8 MB per array
EVEN = 1e-9  # tolerance of a ratio of times: the error of the expected rotation is below 4e-9 rad
LOST_RAD2 = 1e6  # variance of the place for no candidate: no prediction
LEAST = {"tail": 2.0}  # bounds of parameters, as in PathSettings
MOST = {name: 1.0 for name in PARAMETERS if name.endswith("probability") or name == "evidence_doubt"}
MOST |= {"stuck_probability": 0.5, "follow_probability": 0.5}


class PathLayer(nn.Module):
    """Choose among candidate orientations along time, for the methods `paper` (order 1) and `precise` (order 2). In
    order 1, the paper's, an edge costs d(A, B) (2 - T_A - T_B) / dt. Order 2 has the `SecondOrderCost`. Its hard path
    is a beam search; its soft path is a recursion from which the cost is learnt. In the soft path a break of the motion
    is a mixture instead of a state, rotations between visited frames are below half a turn, and omega is forgotten
    after a frame without a right candidate, which has its own place.

    Args:
        order: 1 or 2.
        soft: temperature of the soft path, in units of the costs; None: the cheapest, or most probable, path.
        settings: AssembleSettings (order 1) or PathSettings (order 2). In a soft path of order 2 the settings of
            the cost, with an acceleration, become parameters of the module: logarithms, or logits of probabilities.
    """

    def __init__(
        self, order: int = 2, *, soft: float | None = None, settings: AssembleSettings | PathSettings | None = None
    ) -> None:
        super().__init__()
        if order not in (1, 2):
            raise SettingsError(refusal("order", expected="1 or 2", got=str(order), do="take 2"))
        kind = AssembleSettings if order == 1 else PathSettings
        self._settings = kind() if settings is None else settings
        if not isinstance(self._settings, kind):
            got, do = type(settings).__name__, "pass the settings of this order"
            raise SettingsError(refusal("settings", expected=f"{kind.__name__} for order {order}", got=got, do=do))
        self.order, self.soft = order, soft
        if isinstance(self._settings, PathSettings) and soft is not None:
            cost = SecondOrderCost.of(self._settings)
            for name in PARAMETERS:
                value = torch.tensor(float(getattr(cost, name)), dtype=torch.float64)
                raw = torch.logit(value / MOST[name]) if name in MOST else (value - LEAST.get(name, 0.0)).log()
                self.register_parameter(name, nn.Parameter(raw))

    @property
    def settings(self) -> AssembleSettings | PathSettings:
        """Return the settings with the present parameters; `track` reads them under the key `path`."""
        learnt = {name: float(self._value(name).detach()) for name, _ in self.named_parameters()}
        return type(self._settings)(**{**self._settings.model_dump(), **learnt})

    def cost(self, like: Tensor) -> SecondOrderCost:
        """Return the cost of the soft second-order path, with the dtype and device of a tensor; differentiable."""
        return SecondOrderCost(**{name: self._value(name).to(like) for name in PARAMETERS})

    def forward(
        self,
        R_lab_body: Values,
        score: Values,
        time_s: Values,
        variance_rad2: Values | None = None,
        mask: Values | None = None,
    ) -> ShortestPath | Chosen | SoftPath:
        """Return the cheapest path (order 1), the most probable history (order 2), or probabilities (`soft`).
        Probabilities are differentiable in all but mask and times; order 2 has one more place, for no candidate.

        Args:
            R_lab_body: (..., N, C, 3, 3), candidates; arbitrary if masked.
            score: (..., N, C), quality T, 0 .. 1 (order 1), or log-likelihood of the pictures, nats (order 2).
            time_s: (..., N), increasing; frames without candidates are skipped.
            variance_rad2: (..., N, C), of the orientations, per axis, for order 2. None: 0.
            mask: (..., N, C) bool, True for a candidate; None: all. Order 1 drops those below `quality_min`.

        Raises:
            ShapeError: the inputs differ in frames or candidates; candidates are no rotations; times do not
                increase.
            SettingsError: the temperature is not above 0.
        """
        R, time = torch.as_tensor(R_lab_body), torch.as_tensor(time_s)
        check_tail("R_lab_body", R, *R.shape[-4:-2], 3, 3)
        score = torch.as_tensor(score).to(R)
        variance = torch.zeros_like(score) if variance_rad2 is None else torch.as_tensor(variance_rad2).to(R)
        there = torch.ones_like(score, dtype=torch.bool) if mask is None else torch.as_tensor(mask)
        for name, part in (("score", score), ("variance_rad2", variance), ("mask", there), ("time_s", time)):
            shape = tuple(R.shape[:-3] if name == "time_s" else R.shape[:-2])
            if tuple(part.shape) != shape or R.ndim < 4:
                do, got = "give one value for each candidate, and one time for each frame", str(tuple(part.shape))
                raise ShapeError(refusal(name, expected=f"shape {shape}", got=got, do=do))
        if isinstance(self._settings, AssembleSettings):
            there = there & (score >= self._settings.quality_min)
        unit = torch.eye(3, dtype=R.dtype, device=R.device)
        R = torch.where(there[..., None, None], R, unit)  # 0 times NaN would reach the gradients
        so3.check_rotations("R_lab_body", R)
        if not bool((time.diff(dim=-1) > 0).all()):
            got, do = "times that decrease, repeat or are NaN", "sort the frames by time, each once"
            raise ShapeError(refusal("time_s", expected="increasing times", got=got, do=do))
        score, variance = torch.where(there, score, 0.0), torch.where(there, variance, 0.0)
        if self.order == 2 and self.soft is None:
            return self._histories(R, -score, variance, there, time)
        if self.order == 1:
            edge = trellis.edge_costs(R, score, time, there)
            return trellis.shortest_path(edge, there) if self.soft is None else soft_path(edge, there, self.soft)
        assert self.soft is not None
        edge, there, node, triple = self._second_order_costs(R, score, time, variance, there)
        return soft_path(edge, there, self.soft, node, triple)

    def _histories(self, R: Tensor, nll: Tensor, variance: Tensor, mask: Tensor, time_s: Tensor) -> Chosen:
        """Search each movie."""
        assert isinstance(self._settings, PathSettings)
        if mask.ndim == 2:
            return physical_path(R, nll, variance, mask, time_s, self._settings)
        found = [vars(self._histories(*movie)) for movie in zip(R, nll, variance, mask, time_s, strict=True)]
        if not found:
            return Chosen.nothing(mask)
        return Chosen(**{name: torch.stack([one[name] for one in found]) for name in found[0]})

    def _second_order_costs(
        self, R: Tensor, score: Tensor, time_s: Tensor, variance: Tensor, mask: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return costs of edges, mask, and costs of candidates and triples, with one more place for no candidate."""
        cost, visited = self.cost(score), mask.any(-1, keepdim=True)
        (hit_again, hit), (miss_again, miss) = cost.presence()
        right = hit - cost.picture_log_weight(-score, mask)
        node = torch.cat([right, miss.expand_as(right[..., :1])], -1)
        with_none = torch.cat([mask, visited], -1)
        none = torch.arange(with_none.shape[-1], device=mask.device) == mask.shape[-1]
        after_none = torch.where(none, miss_again - miss, hit_again - hit)
        edge = torch.where(none[:, None], after_none, 0.0).expand(*with_none[..., 1:, 0].shape, *[len(none)] * 2)
        unit = torch.eye(3, dtype=R.dtype, device=R.device)
        R = torch.cat([R, unit.expand_as(R[..., :1, :, :])], -3)
        lost = torch.full_like(variance[..., :1], LOST_RAD2)
        triple = triple_costs(cost, R, torch.cat([variance, lost], -1), time_s, with_none)
        return edge, with_none, node, triple

    def _value(self, name: str) -> Tensor:
        raw: Tensor = getattr(self, name)
        return MOST[name] * torch.sigmoid(raw) if name in MOST else raw.exp() + LEAST.get(name, 0.0)


def triple_costs(
    cost: SecondOrderCost, R_lab_body: Tensor, variance_rad2: Tensor, time_s: Tensor, mask: Tensor
) -> Tensor:
    """Return the cost (..., N - 2, C, C, C), nats, of the third of three successive candidates after the other two.
    R_lab_body is (..., N, C, 3, 3), variance_rad2 (..., N, C) per axis (`LOST_RAD2`: unknown), time_s (..., N), mask
    (..., N, C). Frames without candidates are skipped; rotations between visited frames are below half a turn.
    """
    variance = cost.sigma_scale**2 * variance_rad2
    links, steps, width = _Links.of(R_lab_body, time_s, mask), mask.shape[-2], max(mask.shape[-1], 1)
    stays = _squared_chord(taken(R_lab_body, links.before, 3).flatten(-2), R_lab_body.flatten(-2))
    here = taken(variance, links.before, 1)[..., :, None]
    rest = cost.rest_variance(links.dt_s[..., None, None], here, variance[..., None, :])
    still = _log_ratio(cost, stays, rest).amax(-2)  # (..., N, C), of each candidate if one of the previous frame stays
    chunk = max(1, TRIPLES_AT_ONCE // (width**3 * max(math.prod(mask.shape[:-2]), 1)))
    parts = [_chunk(cost, links, variance, still, slice(at, min(at + chunk, steps))) for at in range(2, steps, chunk)]
    none = R_lab_body.new_zeros((*mask.shape[:-2], 0, *[mask.shape[-1]] * 3))
    return torch.cat(parts, -4) if parts else none


def _chunk(cost: SecondOrderCost, links: "_Links", variance: Tensor, still: Tensor, steps: slice) -> Tensor:
    before = links.before[..., steps]
    earlier = links.before.gather(-1, before)
    dt, span = (each[..., None, None, None] for each in (links.dt_s[..., steps], links.dt_s.gather(-1, before)))
    expected, ratio = taken(links.turn, before, 4), dt / span
    if not bool(((ratio - 1).abs() < EVEN).all()):  # rotations about the same axes, below half a turn
        expected = so3.exp(so3.log(expected) * ratio)
    expected = expected.flatten(-2).transpose(-3, -2)  # (..., j, i, 9)
    misfit = _squared_chord(expected, links.turn[..., steps, :, :, :, :].flatten(-2)).transpose(-3, -2)
    first, second = taken(variance, earlier, 1)[..., :, None, None], taken(variance, before, 1)[..., None, :, None]
    predicted = cost.predicted_variance(dt, span, first, second, variance[..., steps, None, None, :])
    broken = torch.as_tensor(cost.break_probability)
    follows = torch.logaddexp(torch.log1p(-broken) + _log_ratio(cost, misfit, predicted), broken.log())
    return cost.candidate(follows, still[..., steps, None, None, :])


def _log_ratio(cost: SecondOrderCost, misfit: Tensor, variance: Tensor) -> Tensor:
    """Return the log density ratio; 0 (uniform) if the variance is too large to follow a motion."""
    return torch.where(variance < VARIANCE_MAX, cost.log_ratio(misfit, variance), 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Links:
    """The link of each step to the previously visited one."""

    turn: Tensor  # (..., N, C, C, 3, 3), lab, from each previous candidate to each present one
    dt_s: Tensor  # (..., N), time between; 1 without a previous step
    before: Tensor  # (..., N) int64, the previously visited step; 0: none

    @classmethod
    def of(cls, R_lab_body: Tensor, time_s: Tensor, mask: Tensor) -> Self:
        """Return the rotations between all candidates of successive steps; those into empty steps are arbitrary."""
        before, width = visited_before(mask), mask.shape[-1]
        dt = time_s - time_s.gather(-1, before)  # in this order, as single precision cannot separate late times
        # One product of (3C, 3) and (3, 3C) per step: C^2 small ones take ten times as long.
        after, first = R_lab_body.flatten(-3, -2), taken(R_lab_body, before, 3).flatten(-3, -2)
        every = (after @ first.mT).reshape(*mask.shape[:-1], width, 3, width, 3)  # (..., to, 3, from, 3)
        turn = every.permute(*range(mask.ndim - 1), -2, -4, -3, -1)
        return cls(turn=turn, dt_s=torch.where(dt > 0, dt, 1.0).to(R_lab_body), before=before)


def _squared_chord(expected: Tensor, found: Tensor) -> Tensor:
    """Return (2 sin(angle / 2))^2 between rotations (..., A, 9) and (..., B, 9): like angle^2, but smooth at pi."""
    # Differences, not products, keep the digits of small misfits in single precision.
    return torch.cdist(expected, found, compute_mode="donot_use_mm_for_euclid_dist").square() / 2


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftTrack:
    """Mean poses of N frames over their candidates, NaN in frames without candidates; differentiable."""

    R_lab_body: Tensor  # (..., N, 3, 3)
    position_lab_mm: Tensor  # (..., N, 3)
    marginals: Tensor  # (..., N, C), probability of each candidate
    free_energy: Tensor  # (...), of the soft path


def soft_track(
    R_lab_body: Tensor,
    position_lab_mm: Tensor,
    misfit: Tensor,
    mask: Tensor,
    *,
    turn_rad: float,
    temperature: float = 1.0,
) -> SoftTrack:
    """Return the mean poses of candidates, weighted by fit to the pictures and rotation from frame to frame. Raises
    ShapeError (the inputs differ in frames or candidates), SettingsError (`turn_rad` or temperature up to 0).

    Args:
        R_lab_body: (..., N, C, 3, 3), candidates; arbitrary if masked.
        position_lab_mm: (..., N, C, 3), of the candidates.
        misfit: (..., N, C), cost of each, such as half the mean squared residual.
        mask: (..., N, C) bool, True for a candidate.
        turn_rad: standard deviation of the rotation between neighbouring frames; grows with the frames of a gap.
        temperature: of the soft path, in units of the costs.
    """
    check_tail("R_lab_body", R_lab_body, *mask.shape, 3, 3)
    check_tail("position_lab_mm", position_lab_mm, *mask.shape, 3)
    check_tail("misfit", misfit, *mask.shape)
    if not turn_rad > 0:
        raise SettingsError(refusal("turn_rad", expected="above 0", got=f"{turn_rad:g}", do="give a typical rotation"))
    unit = torch.eye(3, dtype=R_lab_body.dtype, device=R_lab_body.device)
    R = torch.where(mask[..., None, None], R_lab_body, unit)  # 0 times NaN would reach the gradients
    X = torch.where(mask[..., None], position_lab_mm, 0.0)
    soft = soft_path(turning_costs(R, mask, turn_rad), mask, temperature, torch.where(mask, misfit, 0.0))
    share = soft.marginals
    position = torch.where(mask.any(-1)[..., None], (share[..., None] * X).sum(-2), torch.nan)
    mean = expected_orientation(R, share)
    return SoftTrack(R_lab_body=mean, position_lab_mm=position, marginals=share, free_energy=soft.free_energy)


def turning_costs(R_lab_body: Tensor, mask: Tensor, turn_rad: float) -> Tensor:
    """Return the edges (..., N - 1, C, C) of `soft_track`: half the squared rotation, in units of `turn_rad`.
    R_lab_body (..., N, C, 3, 3) is finite everywhere; an edge starts at the last frame with candidates in the mask.
    """
    frames = torch.arange(mask.shape[-2], device=mask.device) - visited_before(mask)
    return 0.5 * (trellis.turns_over_gaps(R_lab_body, mask) / (turn_rad * frames[..., 1:, None, None])).square()


def expected_orientation(R_lab_body: Tensor, marginals: Tensor) -> Tensor:
    """Return the rotation (..., N, 3, 3) with the least weighted mean squared chord to R_lab_body (..., N, C, 3, 3).
    NaN are left out; marginals (..., N, C) are not negative; NaN if all are 0. The gradient is always finite. Raises
    ShapeError (candidates and marginals differ in shape).
    Source: chordal mean, Hartley et al. 2013, Rotation averaging, 5.1; projected by `so3.nearest_rotation`.
    """
    check_tail("R_lab_body", R_lab_body, *marginals.shape[-1:], 3, 3)
    known = torch.where(R_lab_body.isnan(), 0.0, R_lab_body)
    mean = so3.nearest_rotation((marginals[..., None, None].to(known) * known).sum(-3))
    return torch.where((marginals.sum(-1) > 0)[..., None, None], mean, torch.nan)
