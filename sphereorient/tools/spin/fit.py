"""Uniform spins R(t) = exp(omega (t - t0)) R(t0) through candidates.
At multiples of one step, omega and its aliases omega + 2 pi k / step agree; all aliases below a limit are reported.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sphereorient import so3

ANCHORS = 40  # evenly spread pairs of neighbouring pictures, for guesses of the spin
PER_PICTURE = 6  # candidates of a picture in these guesses
KEPT = 256  # guesses to refine
FIRST_SPAN = 2.6  # median steps to each side of a guess's pair, in the first comparison
GROWTH = 1.6  # of the span; errors of a fit fall faster
LOOSE_RAD, TIGHT_RAD = math.radians(12.0), math.radians(1.0)  # scatter of right candidates: initial, least
ITERATIONS = 3  # of each fit while the span grows
LAST_ITERATIONS = 12
STRAYS = 0.2  # initial share of pictures without a right candidate
SAME_RAD = math.radians(6.0)  # spins are equal if their orientations at all pictures' times differ by less
PRIOR = 1e-6  # prior information, so that undetermined unknowns do not move
ALIAS_SCATTER = 3.0  # initial scatter of an alias over that of the best spin, as times jitter
REPORTED = 32  # spins at most


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureCandidates:
    """Candidate orientations of F pictures, C each, padded."""

    time_s: Tensor  # (F,) float64
    R_view_body: Tensor  # (F, C, 3, 3) float64
    weight: Tensor  # (F, C), 0 where padded; the sum over C is 1, or 0

    @property
    def step_s(self) -> float:
        """Shortest time, s, between two pictures, averaged over all gaps as multiples of it."""
        gap = self.time_s.sort().values.diff()
        gap = gap[gap > 0]
        return float(gap.sum() / (gap / gap.min()).round().sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class Spins:
    """K uniform spins, best first."""

    omega_view_rad_s: Tensor  # (K, 3), view frame: x right, y down, z from the camera to the ball
    R0_view_body: Tensor  # (K, 3, 3), at time0_s
    time0_s: Tensor  # (K,)
    evidence: Tensor  # (K,), log of the candidates' likelihood over that with random orientations
    scatter_rad: Tensor  # (K,), of right candidates about the spin, each axis
    covariance: Tensor  # (K, 6, 6), of a small rotation of R0 (view, rad) and of omega (rad/s)

    def __len__(self) -> int:
        return len(self.evidence)

    def of(self, chosen: Tensor) -> "Spins":
        """Select spins by mask or by index."""
        return Spins(**{name: values[chosen] for name, values in vars(self).items()})

    def R_view_body(self, time_s: Tensor) -> Tensor:
        """Return orientations (K, F, 3, 3) at times (F,), s."""
        since = time_s - self.time0_s[:, None]
        return so3.exp(self.omega_view_rad_s[:, None] * since[..., None]) @ self.R0_view_body[:, None]

    def rate_sigma(self) -> Tensor:
        """Return the standard deviation (K,) of the rate |omega|, rad/s."""
        axis = torch.nn.functional.normalize(self.omega_view_rad_s, dim=-1)
        return torch.einsum("ki,kij,kj->k", axis, self.covariance[:, 3:, 3:], axis).clamp_min(0).sqrt()


def picture_candidates(time_s: Tensor, offset: Tensor, R_view_body: Tensor, weight: Tensor) -> PictureCandidates:
    """Pad candidates (M, 3, 3): rows offset[f] .. offset[f + 1] belong to the picture at time_s[f] (F,), s.
    Weights (M,), not negative, any unit: only ratios within a picture count.
    """
    counts = offset.diff()
    width = max(int(counts.max()) if len(counts) else 0, 1)
    there = torch.arange(width) < counts[:, None]
    R = torch.eye(3, dtype=torch.float64).repeat(len(counts), width, 1, 1)
    padded = torch.zeros(len(counts), width, dtype=torch.float64)
    R[there], padded[there] = R_view_body.double(), weight.double().clamp_min(0)
    padded = padded / padded.sum(1, keepdim=True).clamp_min(1e-300)
    return PictureCandidates(time_s=time_s.double(), R_view_body=R, weight=padded)


def fit_spins(seen: PictureCandidates, omega_max_rad_s: float) -> Spins:
    """Find the best uniform spin below a limit and all its aliases, best first; none without neighbouring pictures."""
    spins = _guesses(seen, omega_max_rad_s)
    if not len(spins):
        return spins
    # From a few pictures near each guess to all; only the better guesses continue.
    usual = float(seen.time_s.sort().values.diff().median())
    spans = [FIRST_SPAN * max(usual, seen.step_s)]
    while spans[-1] < float(seen.time_s.max() - seen.time_s.min()):
        spans.append(GROWTH * spans[-1])
    parts = torch.split(torch.arange(len(spins)), KEPT)
    spins = _joined([refine_spins(seen, spins.of(some), iterations=0, span_s=spans[0]) for some in parts])
    spins = spins.of(spins.evidence.argsort(descending=True, stable=True)[:KEPT])
    for span in spans:
        spins = _distinct(refine_spins(seen, spins, iterations=ITERATIONS, span_s=span), seen.time_s)
    spins = refine_spins(seen, spins, iterations=LAST_ITERATIONS)
    aliases = _aliases(spins.of(spins.evidence.argmax()[None]), seen, omega_max_rad_s)
    family = refine_spins(seen, aliases, iterations=LAST_ITERATIONS)
    below = family.omega_view_rad_s.norm(dim=-1) <= omega_max_rad_s
    return _distinct(family.of(below), seen.time_s, by_spin=True)


def refine_spins(seen: PictureCandidates, spins: Spins, *, iterations: int, span_s: float = math.inf) -> Spins:
    """Fit spins and their scatter to candidates within a span of time0, by EM (Dempster et al. 1977)."""
    since = seen.time_s - spins.time0_s[:, None]
    near = (since.abs() <= span_s).double()
    for _ in range(iterations):
        turn, share, _ = _matched(seen, spins)
        share = share * near[..., None]
        residual = (share[..., None] * turn).sum(2)  # (K, F, 3), weighted by the shares
        slope = _slope(spins.omega_view_rad_s, since)
        amount = share.sum(2)
        information = (amount[..., None, None] * (slope.mT @ slope)).sum(1)
        unit = information.diagonal(dim1=1, dim2=2).clamp_min(1e-12).rsqrt()
        scaled = information * unit[:, None] * unit[..., None] + PRIOR * torch.eye(6, dtype=torch.float64)
        right = (slope.mT @ residual[..., None]).sum(1)[..., 0] * unit
        move = torch.linalg.solve(scaled, right) * unit
        squares = (share * turn.square().sum(-1)).sum((1, 2))
        free = (3 * amount.sum(1) - 6).clamp_min(1.0)
        left = (squares - (move * (right / unit)).sum(-1)).clamp_min(0)
        scatter = (left / free).sqrt().clamp(TIGHT_RAD, LOOSE_RAD)
        inverse = torch.linalg.inv(scaled) * unit[:, None] * unit[..., None]
        spins = replace(
            spins,
            R0_view_body=so3.exp(move[:, :3]) @ spins.R0_view_body,
            omega_view_rad_s=spins.omega_view_rad_s + move[:, 3:],
            scatter_rad=scatter,
            covariance=inverse * scatter[:, None, None] ** 2,
        )
    return replace(spins, evidence=(evidence_of(seen, spins) * near).sum(1))


def evidence_of(seen: PictureCandidates, spins: Spins) -> Tensor:
    """Return each picture's evidence, (K, F): below 0 if no candidate is near."""
    return _matched(seen, spins)[2]


def _guesses(seen: PictureCandidates, omega_max_rad_s: float) -> Spins:
    """Return spins through two candidates of neighbouring pictures, with any number of revolutions between them."""
    order = seen.time_s.argsort(stable=True)
    gap = seen.time_s[order].diff()
    usable = torch.nonzero(gap > 0)[:, 0]
    usable = usable[torch.linspace(0, len(usable) - 1, min(ANCHORS, len(usable))).round().long()]
    i, j = order[usable], order[usable + 1]
    width = min(PER_PICTURE, seen.weight.shape[1])
    both = (seen.weight[i][:, :width, None] * seen.weight[j][:, None, :width]) > 0
    first, second = seen.R_view_body[i][:, :width, None], seen.R_view_body[j][:, None, :width]
    turn = so3.log(second @ first.mT)  # (A, C, C, 3)
    angle = turn.norm(dim=-1, keepdim=True)
    axis = turn / angle.clamp_min(1e-9)
    gaps = gap[usable][:, None, None]
    time0 = (0.5 * (seen.time_s[i] + seen.time_s[j]))[:, None, None].expand_as(both)
    most = math.ceil(omega_max_rad_s * float(gap[usable].max()) / (2 * math.pi)) + 1
    parts = []
    for k in range(-most, most + 1):
        omega = axis * (angle + 2 * math.pi * k) / gaps[..., None]
        use = both & (omega.norm(dim=-1) <= 1.1 * omega_max_rad_s)
        middle = so3.exp(0.5 * omega * gaps[..., None]) @ first
        parts.append((omega[use], middle.expand(*both.shape, 3, 3)[use], time0[use]))
    omega, middle, time0 = (torch.cat(column) for column in zip(*parts, strict=True))
    return Spins(
        omega_view_rad_s=omega,
        R0_view_body=middle,
        time0_s=time0,
        evidence=torch.zeros_like(time0),
        scatter_rad=torch.full_like(time0, LOOSE_RAD),
        covariance=omega.new_zeros(len(omega), 6, 6),
    )


def _aliases(best: Spins, seen: PictureCandidates, omega_max_rad_s: float) -> Spins:
    """Return a spin with whole revolutions per step added, in both directions, up to the limit."""
    # Move R0 to the time of a picture, where all aliases agree.
    nearest = (seen.time_s - best.time0_s).abs().argmin()[None]
    best = replace(best, R0_view_body=best.R_view_body(seen.time_s)[:, nearest[0]], time0_s=seen.time_s[nearest])
    rate = float(best.omega_view_rad_s.norm())
    axis = torch.nn.functional.normalize(best.omega_view_rad_s, dim=-1)
    turn = 2 * math.pi / seen.step_s
    rates = [rate + k * turn for k in range(-math.ceil((omega_max_rad_s + rate) / turn), REPORTED)]
    rates = sorted((each for each in rates if abs(each) <= 1.05 * omega_max_rad_s), key=abs)[:REPORTED]
    wider = (ALIAS_SCATTER * best.scatter_rad).clamp(max=LOOSE_RAD)
    return _joined([replace(best, omega_view_rad_s=axis * each, scatter_rad=wider) for each in rates])


def _matched(seen: PictureCandidates, spins: Spins) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotations (K, F, C, 3), view, from spins to candidates, probabilities (K, F, C), log evidence (K, F)."""
    predicted = spins.R_view_body(seen.time_s)  # (K, F, 3, 3)
    turn = so3.log(seen.R_view_body @ predicted[:, :, None].mT)
    scatter = spins.scatter_rad[:, None, None]
    # Density over SO(3), whose volume is 8 pi^2, over that of random orientations.
    height = math.log(8 * math.pi**2) - 1.5 * math.log(2 * math.pi) - 3 * scatter.log()
    log = height - 0.5 * turn.square().sum(-1) / scatter**2 + seen.weight.clamp_min(1e-300).log() + math.log(1 - STRAYS)
    whole = torch.logaddexp(log.logsumexp(-1), log.new_tensor(math.log(STRAYS)))
    share = torch.where(seen.weight > 0, (log - whole[..., None]).exp(), 0.0)
    return turn, share, torch.where(seen.weight.sum(-1) == 0, 0.0, whole)


def _slope(omega: Tensor, since: Tensor) -> Tensor:
    """Return the derivative of the orientations (K, F, 3, 6), view frame, by a rotation of R0 and by omega."""
    swept = omega[:, None] * since[..., None]
    angle = swept.norm(dim=-1)[..., None, None]
    axis = torch.nn.functional.normalize(swept, dim=-1)
    safe = angle.clamp_min(1e-6)
    along = axis[..., :, None] * axis[..., None, :]
    sine, rest = torch.sin(safe) / safe, (1 - torch.cos(safe)) / safe
    jacobian = sine * torch.eye(3, dtype=torch.float64) + (1 - sine) * along + rest * so3.hat(axis)
    return torch.cat([so3.exp(swept), jacobian * since[..., None, None]], dim=-1)


def _joined(parts: Sequence[Spins]) -> Spins:
    return Spins(**{name: torch.cat([vars(part)[name] for part in parts]) for name in vars(parts[0])})


def _distinct(spins: Spins, time_s: Tensor, by_spin: bool = False) -> Spins:
    """Return spins, best first, without those with the orientations (`by_spin`: and the rate) of a better one."""
    spins = spins.of(spins.evidence.argsort(descending=True, stable=True))
    R = spins.R_view_body(time_s)
    apart = torch.stack([so3.geodesic_distance(R, one).amax(-1) for one in R]) if len(R) else R.new_zeros(0, 0)
    same = apart < SAME_RAD
    if by_spin:
        omega = spins.omega_view_rad_s
        same &= (omega[:, None] - omega).norm(dim=-1) < 0.02 * omega.norm(dim=-1) + 1e-3
    return spins.of(~torch.tril(same, -1).any(1))
