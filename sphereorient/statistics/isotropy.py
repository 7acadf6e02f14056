"""Is a vector's scatter the same in all directions, in the lab and in the body; and does a row belong to a frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sphereorient.statistics.bootstrap import Interval, bootstrap, per_segment
from sphereorient.statistics.lags import Pairs
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

Floats = NDArray[np.float64]

ALIKE = 0.3  # of a row's own size: what the turns of the orientation may differ from it


@dataclass(frozen=True, kw_only=True, eq=False)
class Isotropy:
    """Whether a quantity is isotropic; made by `isotropy`."""

    quantity: str
    variance_share: Interval  # (3,), of x, y, z in the sum; a third each where isotropic
    cross_correlation: Interval  # (3,), xy, xz, yz; none where isotropic
    p_value: float

    @property
    def isotropic(self) -> bool:
        """Whether the data do not contradict isotropy at 5 %."""
        return self.p_value >= 0.05


def isotropy(ensemble: Ensemble, quantity: str, settings: BootstrapSettings | None = None) -> Isotropy:
    """Test whether the covariance of a quantity is the same in all directions of its frame.

    Isotropy says that the five numbers of the covariance's traceless part are zero. Each segment contributes their
    sums; Hotelling's test asks whether all segments together differ from zero by more than they differ among
    themselves, so that correlation along a track does no harm.

    Args:
        ensemble: the samples; more than six segments.
        quantity: a name in UNITS.
        settings: of the bootstrap for the intervals.

    Returns:
        Shares, correlations, and the p-value (NaN with six segments or fewer).

    Source: Hotelling 1931; the paper, Table I, with ERRATA E6.
    """
    x = ensemble.values[quantity] - ensemble.values[quantity].mean(0)
    xy, xz, yz = x[:, 0] * x[:, 1], x[:, 0] * x[:, 2], x[:, 1] * x[:, 2]
    products = np.column_stack([x * x, xy, xz, yz])
    sums = per_segment(products, ensemble.segment, ensemble.segments)
    found = bootstrap(sums, _shares, settings)
    xx, yy, zz = sums[:, :3].T
    traceless = np.column_stack([xx - yy, (2 * zz - xx - yy) / np.sqrt(3), 2 * sums[:, 3:]])
    return Isotropy(
        quantity=quantity,
        variance_share=found.part(0),
        cross_correlation=found.part(1),
        p_value=zero_mean_p_value(traceless),
    )


def _shares(totals: Floats) -> Floats:
    """Return shares of the variance and correlations, (..., 2, 3), of sums (..., 6)."""
    var, cross = totals[..., :3], totals[..., 3:]
    pairs = np.sqrt(var[..., [0, 0, 1]] * var[..., [1, 2, 2]])
    return np.stack([var / var.sum(-1, keepdims=True), cross / pairs], axis=-2)


def zero_mean_p_value(rows: Floats) -> float:
    """Return Hotelling's p-value for independent rows (S, P) to have mean zero; NaN where S is not above P + 1."""
    from scipy.stats import f as fisher

    count, size = rows.shape
    if count <= size + 1:
        return float("nan")
    mean = rows.mean(0)
    deviation = rows - mean
    covariance = deviation.T @ deviation / (count - 1)
    t2 = count * mean @ np.linalg.pinv(covariance) @ mean
    return float(fisher.sf(t2 * (count - size) / (size * (count - 1)), size, count - size))


def anisotropic_frame(lab: Isotropy, body: Isotropy, level: float = 0.05) -> Literal["lab", "body", "both", "neither"]:
    """Say in which frame a vector prefers directions.

    A flow that has axes shows in the lab and is averaged out in a body that tumbles; a body whose axes differ shows in
    the body.

    Args:
        lab: the test on lab components.
        body: the test on body components.
        level: p-values below it count.
    """
    if lab.p_value >= level:
        return "neither" if body.p_value >= level else "body"
    return "lab" if body.p_value >= level else "both"


@dataclass(frozen=True, kw_only=True)
class FrameOfRow:
    """Which frame an angular velocity is written in; made by `frame_of_omega`."""

    lab_residual: float  # rms difference from the turns' own lab components over the row's rms
    body_residual: float
    frame: Literal["lab", "body", "none", "both"]


def frame_of_omega(ensemble: Ensemble, omega: Floats) -> FrameOfRow:
    """Find out in which frame the components of an angular velocity are written.

    From frame to frame the sphere turns by R_{k+1} R_k^T in lab components and by R_k^T R_{k+1} in body components
    (ERRATA E4); the mean of the row's two values is compared with both. A row of the paper's Table I, R omega_lab,
    fits neither (E6).

    Args:
        ensemble: gives the orientations.
        omega: (M, 3), rad/s, the row in question.

    Returns:
        The residuals and the verdict.
    """
    from scipy.spatial.transform import Rotation

    first, second = Pairs(ensemble).at(1)
    before, after = (Rotation.from_matrix(ensemble.R_lab_body[rows]) for rows in (first, second))
    step_s = (ensemble.time_s[second] - ensemble.time_s[first])[:, None]
    middle = (omega[first] + omega[second]) / 2
    size = np.sqrt(np.square(middle).mean())
    turns = {"lab": after * before.inv(), "body": before.inv() * after}
    residual = {
        name: float(np.sqrt(np.square(turn.as_rotvec() / step_s - middle).mean()) / size)
        for name, turn in turns.items()
    }
    fits = [name for name in ("lab", "body") if residual[name] < ALIKE]
    verdict: Literal["lab", "body", "none", "both"] = "both" if len(fits) == 2 else "none"
    if len(fits) == 1:
        verdict = "lab" if fits[0] == "lab" else "body"
    return FrameOfRow(lab_residual=residual["lab"], body_residual=residual["body"], frame=verdict)
