"""Isotropy of vectors in lab and body, and of orientations on SO(3); Euler angles; the frame of a vector."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sphereorient.motion import rotvec_between
from sphereorient.statistics.bootstrap import Floats, Interval, Rows, bootstrap, segment_counts, segment_sums
from sphereorient.statistics.lags import Pairs
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings
from sphereorient.trajectory.rotations import tait_bryan

ALIKE = 0.3  # largest residual of a row against the rotations, relative to the row
DRAWS = 20_000  # of the null distribution, for its 5 % point to 0.2 %
AT_ONCE = 50_000  # rotations of a block
BINS = 24  # of an Euler angle
# Orthonormal symmetric traceless matrices; R acts on them as the five-dimensional representation
_TENSORS = np.array(
    [
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[-1 / np.sqrt(3), 0, 0], [0, -1 / np.sqrt(3), 0], [0, 0, 2 / np.sqrt(3)]],
    ]
) / np.sqrt(2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Isotropy:
    """Result of the test of a quantity's isotropy."""

    quantity: str
    variance_share: Interval  # (3,), of x, y, z in the sum; 1/3 each if isotropic
    cross_correlation: Interval  # (3,), xy, xz, yz; 0 if isotropic
    p_value: float


def isotropy(ensemble: Ensemble, quantity: str, settings: BootstrapSettings | None = None) -> Isotropy:
    """Test whether the covariance of a quantity (a name in UNITS) is the same in all directions of its frame.
    Samples are whole segments, since frames of a track are correlated. NaN p-value for six segments or fewer.
    Source: Hotelling 1931; the paper, Table I, with docs/errata.md E6.
    """
    x = ensemble.values[quantity] - ensemble.values[quantity].mean(0)
    products = np.column_stack([x * x, x[:, [0, 0, 1]] * x[:, [1, 2, 2]]])
    sums = segment_sums(products, ensemble.segment, ensemble.segments)
    found = bootstrap(sums, _variance_shares, settings)
    xx, yy, zz = sums[:, :3].T
    p_value = zero_mean_p_value(np.column_stack([xx - yy, (2 * zz - xx - yy) / np.sqrt(3), 2 * sums[:, 3:]]))
    return Isotropy(quantity=quantity, variance_share=found.part(0), cross_correlation=found.part(1), p_value=p_value)


def _variance_shares(totals: Floats) -> Floats:
    """Return shares of the variance and correlations, (..., 2, 3), of sums (..., 6)."""
    var, cross = totals[..., :3], totals[..., 3:]
    pairs = np.sqrt(var[..., [0, 0, 1]] * var[..., [1, 2, 2]])
    return np.stack([var / var.sum(-1, keepdims=True), cross / pairs], axis=-2)


def zero_mean_p_value(rows: Floats) -> float:
    """Return Hotelling's p-value for independent rows (S, P) to have mean zero; NaN if S is not above P + 1."""
    from scipy.stats import f as fisher

    count, size = rows.shape
    if count <= size + 1:
        return float("nan")
    mean = rows.mean(0)
    covariance = (rows - mean).T @ (rows - mean) / (count - 1)
    t2 = count * mean @ np.linalg.pinv(covariance) @ mean
    return float(fisher.sf(t2 * (count - size) / (size * (count - 1)), size, count - size))


def anisotropic_frame(lab: Isotropy, body: Isotropy, level: float = 0.05) -> Literal["lab", "body", "both", "neither"]:
    """Return the frame in which a vector is anisotropic, by the tests of its lab and body components at a level."""
    if lab.p_value >= level:
        return "neither" if body.p_value >= level else "body"
    return "lab" if body.p_value >= level else "both"


@dataclass(frozen=True, kw_only=True)
class FrameOfRow:
    """The frame of the components of an angular velocity."""

    lab_residual: float  # rms difference from the lab components of the rotations over the row's rms
    body_residual: float
    frame: Literal["lab", "body", "none", "both"]


def frame_of_omega(ensemble: Ensemble, omega: Floats) -> FrameOfRow:
    """Find the frame of the components of omega (M, 3), rad/s, from the rotations. Source: docs/errata.md E4, E6."""
    first, second = Pairs(ensemble).at(1)
    before, after = ensemble.R_lab_body[first], ensemble.R_lab_body[second]
    step_s = (ensemble.time_s[second] - ensemble.time_s[first])[:, None]
    middle = (omega[first] + omega[second]) / 2
    size = np.sqrt(np.square(middle).mean())
    turns = rotvec_between(before, after), rotvec_between(after.mT, before.mT)
    lab, body = (float(np.sqrt(np.square(turn / step_s - middle).mean()) / size) for turn in turns)
    frame: Literal["lab", "body", "none", "both"] = "lab" if lab < ALIKE else "none"
    if body < ALIKE:
        frame = "both" if lab < ALIKE else "body"
    return FrameOfRow(lab_residual=lab, body_residual=body, frame=frame)


@dataclass(frozen=True, kw_only=True)
class Uniformity:
    """Result of the test of uniform orientations."""

    statistic: float
    p_value: float
    samples: int
    effective: float  # number of independent orientations with the same scatter
    segments: int

    @property
    def uniform(self) -> bool:
        """Whether the test does not reject a uniform distribution at 5 %."""
        return self.p_value >= 0.05


def uniformity(R_lab_body: Floats, segment: Rows | None = None) -> Uniformity:
    """Test whether rotations (M, 3, 3) are uniform on SO(3), by the first and second moments of the axes' directions.
    Statistic: 3 n |<R>|^2 + 5 n |<D>|^2, D of `five_dimensional`. The null distribution rotates whole segments, (M,),
    increasing; None: all rotations are independent. Twenty segments are few; with two the test has no power.
    Source: Rayleigh's and Gine's tests on SO(3): Mardia and Jupp 2000, Directional Statistics, 13.2.
    """
    count = len(R_lab_body)
    number = np.arange(count) if segment is None else np.unique(segment, return_inverse=True)[1]
    segments = int(number[-1]) + 1
    first, second = np.zeros((segments, 3, 3)), np.zeros((segments, 5, 5))  # sums of R and of D by segment
    for k in range(0, count, AT_ONCE):
        block, near = R_lab_body[k : k + AT_ONCE], number[k : k + AT_ONCE]
        here = slice(near[0], near[-1] + 1)
        first[here] += segment_sums(block, near - near[0], here.stop - here.start)
        second[here] += segment_sums(five_dimensional(block), near - near[0], here.stop - here.start)
    statistic = (3 * np.square(first.sum(0)).sum() + 5 * np.square(second.sum(0)).sum()) / count
    spread = [np.linalg.eigvalsh(np.einsum("sij,skj->ik", x, x)) / count for x in (first, second)]
    rng = np.random.default_rng(2011)
    # E[(Y Q)(Y Q)^T] over rotations Q is Y Y^T / (2 l + 1) in each column
    null = sum(rng.chisquare(len(w), (DRAWS, len(w))) @ w for w in spread)
    mean = float(3 * spread[0].sum() + 5 * spread[1].sum())
    return Uniformity(
        statistic=float(statistic),
        p_value=float((1 + np.sum(null >= statistic)) / (DRAWS + 1)),
        samples=count,
        effective=count * (9.0 + 25.0) / mean,
        segments=segments,
    )


def five_dimensional(R: Floats) -> Floats:
    """Return (..., 5, 5), the action of rotations (..., 3, 3) on symmetric traceless tensors."""
    rotated = R[..., None, :, :] @ _TENSORS @ R[..., None, :, :].swapaxes(-1, -2)  # (..., 5, 3, 3)
    flat = rotated.reshape(*rotated.shape[:-2], 9)
    return np.asarray((flat @ _TENSORS.reshape(5, 9).T).swapaxes(-1, -2))


@dataclass(frozen=True, kw_only=True, eq=False)
class EulerDensity:
    """PDF of one Euler angle."""

    name: str  # theta_x, theta_y, theta_z
    edges_rad: Floats  # (B + 1,)
    pdf: Interval  # (B,), 1/rad
    uniform: Floats  # (B,), mean density of uniform rotations in each bin


def euler_densities(ensemble: Ensemble, settings: BootstrapSettings | None = None) -> list[EulerDensity]:
    """Return PDFs of the Euler angles and of uniform rotations. Source: the paper, section II; docs/errata.md E1."""
    theta = tait_bryan(ensemble.R_lab_body)
    out = []
    for i, name in enumerate(("theta_x", "theta_y", "theta_z")):
        half = np.pi / 2 if i == 1 else np.pi
        edges = np.linspace(-half, half, BINS + 1)
        width = edges[1] - edges[0]
        place = np.clip(((theta[:, i] + half) / width).astype(np.int64), 0, BINS - 1)
        sums = segment_counts(place, BINS, ensemble.segment, ensemble.segments).astype(np.float64)
        share = bootstrap(sums, lambda totals: np.asarray(totals / totals.sum(-1, keepdims=True)), settings)
        law = np.diff(np.sin(edges)) / 2 / width if i == 1 else np.full(BINS, 1 / (2 * np.pi))
        out.append(EulerDensity(name=name, edges_rad=edges, pdf=share.scaled(1 / width), uniform=law))
    return out
