"""Process prior and measurement noise, estimated from the track itself by marginal likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sphereorient.motion.kalman import run_filter
from sphereorient.motion.matern import Prior, prior_of_band
from sphereorient.motion.path import SegmentTrack

Floats = NDArray[np.float64]

POLES = (0.02, 3.0)  # per frame, between which the prior's band is looked for
SPREADS = (1e-3, 1e5)  # of the rate per frame, in sigmas of a measurement
FREE = 6  # unknowns without a prior: the start of the segment and its constant rate
FIRST_TRIES = (0.15, 0.45, 1.2)  # poles per frame from the best of which the search starts


@dataclass(frozen=True, kw_only=True)
class ProcessPrior:
    """The prior of a track's rate and the scale of its sigmas; made by `estimate_process`."""

    prior: Prior  # per frame
    scale: float  # true errors of the measurements over their sigmas

    def at_rate(self, ratio: float) -> ProcessPrior:
        """Return the same motion in frames that last `ratio` times as long."""
        prior = Prior(pole=self.prior.pole * ratio, deviation=self.prior.deviation * ratio)
        return ProcessPrior(prior=prior, scale=self.scale)


@dataclass(frozen=True, kw_only=True)
class ProcessNoise:
    """The processes of positions and orientations; made by `smooth_motion`, reused by other runs."""

    place: ProcessPrior | None  # None: too few frames to estimate it
    turn: ProcessPrior | None
    frame_s: float  # that `ProcessPrior` counts in


def estimate_process(
    paths: Sequence[SegmentTrack], scales: tuple[float, float], band: float | None, before: ProcessPrior | None = None
) -> ProcessPrior:
    """Find the prior and the factor on the measurements' sigmas under which the measurements are most likely.

    Args:
        paths: segments with at least five measurements each.
        scales: least and largest factor accepted.
        band: cycles per frame; fixes the prior, so that only the factor is learnt. None learns both.
        before: the estimate of the same segments with other references or rejections, as a start.

    Source: Rasmussen and Williams 2006, section 5.4.1, by the innovations; the factor in closed form, with FREE fewer
    degrees of freedom a path.
    """
    sigma = float(np.median([path.sigma for path in paths]))
    if band is not None:
        prior = prior_of_band(band, sigma)
    else:

        def prior_at(theta: Floats) -> Prior:
            pole, spread = np.exp(np.clip(theta, np.log([POLES[0], SPREADS[0]]), np.log([POLES[1], SPREADS[1]])))
            return Prior(pole=float(pole), deviation=float(spread * sigma))

        def cost(theta: Floats) -> float:
            return _cost(paths, prior_at(theta), scales)[0]

        if before is None:
            spread = np.clip(_rate_deviation(paths) / sigma, 10 * SPREADS[0], 0.1 * SPREADS[1])
            start, reach = min((np.log([pole, spread]) for pole in FIRST_TRIES), key=cost), 0.4
        else:
            start = np.log([before.prior.pole, before.prior.deviation / before.scale / sigma])
            reach = 0.1
        simplex = start + reach * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.02, "maxfev": 60}
        found = minimize(cost, start, method="Nelder-Mead", options=options)  # type: ignore[call-overload]
        prior = prior_at(found.x)
    scale = _cost(paths, prior, scales)[1]
    return ProcessPrior(prior=Prior(pole=prior.pole, deviation=prior.deviation * scale), scale=scale)


def _rate_deviation(paths: Sequence[SegmentTrack]) -> float:
    """Return a robust standard deviation of the measured rates by axis, per frame."""
    away = np.concatenate([np.abs(rates - np.median(rates, axis=0)) for rates in (path.rates() for path in paths)])
    return float(1.48 * np.median(away))


def _cost(paths: Sequence[SegmentTrack], prior: Prior, scales: tuple[float, float]) -> tuple[float, float]:
    """Return the negative log-likelihood, up to a constant, and the scale; all covariances in units of scale^2."""
    misfit, logs, number = 0.0, 0.0, 0
    for path in paths:
        filtered = run_filter(path.chain(prior))
        misfit += filtered.misfit
        logs += filtered.log_determinant
        number += 3 * int(path.used.sum()) - FREE
    number = max(number, 1)
    scale = float(np.clip(np.sqrt(misfit / number), *scales))
    return 0.5 * (logs + number * 2 * np.log(scale) + misfit / scale**2), scale
