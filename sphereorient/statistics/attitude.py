"""Are all attitudes equally likely: Euler angles against the uniform law, and a test on the rotations themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, bootstrap, per_segment, scattered
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]

DRAWS = 20_000  # of the null law; its 5 % point is then known to 0.2 %
SEED = 2011
AT_ONCE = 50_000  # rotations of a block

# orthonormal symmetric traceless matrices: turned by R they are the five-dimensional representation
_TENSORS = np.array(
    [
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[-1 / np.sqrt(3), 0, 0], [0, -1 / np.sqrt(3), 0], [0, 0, 2 / np.sqrt(3)]],
    ]
) / np.sqrt(2.0)


@dataclass(frozen=True, kw_only=True)
class Uniformity:
    """Outcome of the test; made by `uniformity`."""

    statistic: float
    p_value: float
    samples: int
    effective: float  # independent attitudes that would scatter as much
    segments: int

    @property
    def uniform(self) -> bool:
        """Whether the data do not contradict a uniform law at 5 %."""
        return self.p_value >= 0.05


def uniformity(R_lab_body: Floats, segment: NDArray[np.int64] | None = None) -> Uniformity:
    """Test whether rotations are uniform on SO(3).

    The statistic is the squared length of the mean of the matrices of the first two representations: 3 n |<R>|^2 +
    5 n |<D>|^2, chi-squared with 9 + 25 degrees of freedom for independent attitudes. It is blind only to what shows
    in neither means nor second moments of the axes' directions. Along a track attitudes are correlated, so the null
    law is taken with segments as units: a segment, turned as a whole by any rotation in the body, is as likely. Its sum
    then scatters with the covariance that the segments' own sums give, whatever their lengths; many segments make it
    normal, and the statistic a weighted sum of chi-squares.

    Args:
        R_lab_body: (M, 3, 3).
        segment: (M,), increasing, equal within a segment; None takes all rotations as independent.

    Returns:
        Statistic and p-value. Twenty segments are few, two too few to find anything.

    Source: Rayleigh's and Gine's tests on SO(3): Mardia and Jupp 2000, Directional Statistics, 13.2.
    """
    count = len(R_lab_body)
    number = np.arange(count) if segment is None else np.unique(segment, return_inverse=True)[1]
    segments = int(number[-1]) + 1
    first, second = _segment_sums(R_lab_body, number, segments)
    statistic = (3 * np.square(first.sum(0)).sum() + 5 * np.square(second.sum(0)).sum()) / count
    spread = [np.linalg.eigvalsh(np.einsum("sij,skj->ik", x, x)) / count for x in (first, second)]
    rng = np.random.default_rng(SEED)
    # E[(Y Q)(Y Q)^T] over rotations Q leaves Y Y^T / (2 l + 1) in each column
    null = sum(rng.chisquare(len(w), (DRAWS, len(w))) @ w for w in spread)
    independent = 9.0 + 25.0
    mean = float(3 * spread[0].sum() + 5 * spread[1].sum())
    return Uniformity(
        statistic=float(statistic),
        p_value=float((1 + np.sum(null >= statistic)) / (DRAWS + 1)),
        samples=count,
        effective=count * independent / mean,
        segments=segments,
    )


def _segment_sums(R: Floats, segment: NDArray[np.int64], segments: int) -> tuple[Floats, Floats]:
    """Return by segment the sums of R (S, 3, 3) and of its five-dimensional representation (S, 5, 5)."""
    first, second = np.zeros((segments, 3, 3)), np.zeros((segments, 5, 5))
    for k in range(0, len(R), AT_ONCE):
        block, number = R[k : k + AT_ONCE], segment[k : k + AT_ONCE]
        near = slice(number[0], number[-1] + 1)
        here = near.stop - near.start
        first[near] += scattered(block, number - number[0], here)
        second[near] += scattered(five_dimensional(block), number - number[0], here)
    return first, second


def five_dimensional(R: Floats) -> Floats:
    """Return (..., 5, 5), how rotations (..., 3, 3) act on symmetric traceless tensors."""
    turned = R[..., None, :, :] @ _TENSORS @ R[..., None, :, :].swapaxes(-1, -2)  # (..., 5, 3, 3)
    flat = turned.reshape(*turned.shape[:-2], 9)
    return np.asarray((flat @ _TENSORS.reshape(5, 9).T).swapaxes(-1, -2))


@dataclass(frozen=True, kw_only=True, eq=False)
class EulerDensity:
    """PDF of one Euler angle; made by `euler_densities`, drawn by the report."""

    name: str  # theta_x, theta_y, theta_z
    edges_rad: Floats  # (B + 1,)
    pdf: Interval  # (B,), 1/rad
    uniform: Floats  # (B,), mean density of the uniform law in each bin


def euler_densities(
    ensemble: Ensemble, bins: int = 24, settings: BootstrapSettings | None = None
) -> list[EulerDensity]:
    """Return the PDFs of theta_x, theta_y, theta_z beside those of uniform rotations.

    Uniform rotations have theta_x and theta_z uniform over 2 pi and theta_y with density cos(theta_y) / 2.

    Args:
        ensemble: the samples.
        bins: by angle.
        settings: of the bootstrap.

    Source: the paper, section II; the angles by ERRATA E1.
    """
    import torch

    from sphereorient import so3

    theta = so3.to_tait_bryan(torch.from_numpy(ensemble.R_lab_body)).numpy()
    out = []
    for i, name in enumerate(("theta_x", "theta_y", "theta_z")):
        half = np.pi / 2 if i == 1 else np.pi
        edges = np.linspace(-half, half, bins + 1)
        width = edges[1] - edges[0]
        place = np.clip(((theta[:, i] + half) / width).astype(np.int64), 0, bins - 1)
        each = np.zeros((len(theta), bins))
        each[np.arange(len(theta)), place] = 1.0
        sums = per_segment(each, ensemble.segment, ensemble.segments)
        share = bootstrap(sums, _shares, settings)
        pdf = share.scaled(1 / width)
        law = np.diff(np.sin(edges)) / 2 / width if i == 1 else np.full(bins, 1 / (2 * np.pi))
        out.append(EulerDensity(name=name, edges_rad=edges, pdf=pdf, uniform=law))
    return out


def _shares(totals: Floats) -> Floats:
    """Return each bin's share, (..., B)."""
    return np.asarray(totals / totals.sum(-1, keepdims=True))
