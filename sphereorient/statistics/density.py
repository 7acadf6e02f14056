"""Probability densities of normalised components, the stretched exponential fitted to them, and the Gaussian."""

from dataclasses import dataclass

import numpy as np
from scipy.special import erfcx, log_ndtr, logsumexp

from sphereorient.statistics.bootstrap import Floats, Interval, Rows, Statistic, bootstrap, segment_counts, segment_sums
from sphereorient.statistics.moments import noise_let_through
from sphereorient.statistics.segments import Ensemble
from sphereorient.statistics.settings import BootstrapSettings

ROOT3 = np.sqrt(3.0)
WIDEST_S = 1.5  # upper limit of the fit: flatness 14,000
NARROWEST_S = 0.02  # nearly the uniform law, flatness 1.8
NODES = 120  # values of a at which the likelihood is tabulated
STEP = 1e-3  # of ln|x|, of its derivative
FINE_BINS = 2000  # of ln|x|, for the likelihood: they round x by 0.5 %
SMALLEST, LARGEST = 1e-4, 1e3  # limits of |x| in the likelihood
REACH, BINS = 10.0, 61  # of the PDF to either side, standard deviations; odd, for a bin at 0


def stretched_exponential(x: Floats, a: Floats | float) -> Floats:
    """Return the density of unit variance that the paper fits to accelerations, at x (...), in standard deviations.
    p(x) = exp(3 a^2 / 2) / (4 sqrt 3) erfc((ln|x / sqrt 3| + 2 a^2) / (sqrt 2 a)); a broadcasts against x.
    Source: Mordant, Crawford and Bodenschatz 2004, Physica D 193, 245; the paper, section IV.
    """
    return np.asarray(np.exp(log_stretched_exponential(x, a)))


def log_stretched_exponential(x: Floats, a: Floats | float, noise_share: float = 0.0) -> Floats:
    """Return the logarithm of `stretched_exponential`; `noise_share` (< 1) of the variance of x is normal noise."""
    if noise_share > 0:
        place, weight = np.polynomial.hermite_e.hermegauss(24)  # nodes for the noise
        clean = np.sqrt(1 - noise_share)
        each = [log_stretched_exponential((x - np.sqrt(noise_share) * z) / clean, a) for z in place]
        logs = [np.log(w / np.sqrt(2 * np.pi)) + one for w, one in zip(weight, each, strict=True)]
        return np.asarray(logsumexp(logs, axis=0) - np.log(clean), np.float64)
    a = np.asarray(a, np.float64)
    size = np.maximum(np.abs(x), 1e-300)  # keeps the logarithm of 0 finite
    z = (np.log(size / ROOT3) + 2 * a**2) / (np.sqrt(2) * a)
    far = np.maximum(z, 0.0)
    near = np.log(2.0) + log_ndtr(-np.sqrt(2) * np.minimum(z, 0.0))
    log_erfc = np.where(z > 0, np.log(erfcx(far)) - far**2, near)  # without underflow
    return np.asarray(1.5 * a**2 - np.log(4 * ROOT3) + log_erfc, np.float64)


def flatness_of(a: Floats | float) -> Floats:
    """Return the flatness of the stretched exponential, 9/5 exp(4 a^2)."""
    return np.asarray(1.8 * np.exp(4 * np.asarray(a) ** 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class StretchedFit:
    """The stretched exponential of maximum likelihood."""

    a: Interval  # scalar
    flatness: Interval  # 9/5 exp(4 a^2)
    log_likelihood: float  # mean per sample, of values in standard deviations
    log_likelihood_gaussian: float  # of the Gaussian, for comparison

    @property
    def better_than_gaussian(self) -> bool:
        """Whether its likelihood exceeds the Gaussian's."""
        return self.log_likelihood > self.log_likelihood_gaussian


def fit_stretched(
    x: Floats, segment: Rows, segments: int, settings: BootstrapSettings | None = None, noise_share: float = 0.0
) -> StretchedFit:
    """Fit the stretched exponential to the motion in a component (M,), any unit, by maximum likelihood, with intervals.
    `noise_share` of the variance (`moments.noise_let_through`) is treated as noise, which would fill the peak of the
    density and lower a. `segment` (M,), 0 .. segments - 1, increases.
    """
    normal = (x - x.mean()) / x.std()
    edges = np.linspace(np.log(SMALLEST), np.log(LARGEST), FINE_BINS + 1)
    logs = np.log(np.clip(np.abs(normal), SMALLEST, LARGEST))
    bins = np.clip(((logs - edges[0]) / (edges[1] - edges[0])).astype(np.int64), 0, FINE_BINS - 1)
    middle = (edges[1:] + edges[:-1]) / 2
    used = np.flatnonzero(np.bincount(bins, minlength=FINE_BINS))
    counts = segment_counts(bins, FINE_BINS, segment, segments)
    squares = segment_sums(np.stack([normal, normal**2], axis=1), segment, segments)
    sums = np.concatenate([counts[:, used].astype(np.float64), squares], axis=1)
    found = bootstrap(sums, _likeliest(middle[used], noise_share), settings)
    logs = log_stretched_exponential(np.exp(middle[used]), float(found.value[0]), noise_share)
    return StretchedFit(
        a=found.part(0),
        flatness=found.part(1),
        log_likelihood=float(counts.sum(0)[used] @ logs) / len(x),
        log_likelihood_gaussian=float(-0.5 * np.log(2 * np.pi) - 0.5 * (normal**2).mean()),
    )


def _likeliest(log_x: Floats, noise_share: float) -> Statistic:
    """Return the fit of a and flatness (..., 2) to counts by ln|x| (K,) and sums of x and x^2, (..., K + 2)."""
    nodes = np.linspace(NARROWEST_S, WIDEST_S, NODES)
    steps = (0.0, STEP, -STEP)
    table, up, down = (log_stretched_exponential(np.exp(log_x + s)[:, None], nodes, noise_share) for s in steps)
    slope = (up - down) / (2 * STEP)  # as a resampled ensemble is divided by its own standard deviation

    def fit(totals: Floats) -> Floats:
        counts, first, second = totals[..., :-2], totals[..., -2], totals[..., -1]
        number = counts.sum(-1)
        log_scale = 0.5 * np.log(second / number - (first / number) ** 2)
        value = counts @ table - log_scale[..., None] * (counts @ slope)
        # the largest value, interpolated by a parabola
        k = np.clip(value.argmax(-1), 1, NODES - 2)[..., None]
        left, mid, right = (np.take_along_axis(value, k + j, axis=-1)[..., 0] for j in (-1, 0, 1))
        bend = left - 2 * mid + right
        shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1.0), 0.0)
        a = nodes[0] + np.clip(k[..., 0] + shift, 0, NODES - 1) * (nodes[1] - nodes[0])
        return np.stack([a, flatness_of(a)], axis=-1)

    return fit


@dataclass(frozen=True, kw_only=True, eq=False)
class Density:
    """PDF of one component in its standard deviations."""

    edges: Floats  # (B + 1,)
    pdf: Interval  # (B,)
    counts: Rows  # (B,)
    fit: StretchedFit

    @property
    def centres(self) -> Floats:
        """Middle of each bin, (B,)."""
        return np.asarray((self.edges[1:] + self.edges[:-1]) / 2)


def density(ensemble: Ensemble, quantity: str, component: int, *, settings: BootstrapSettings | None = None) -> Density:
    """Return the PDF of a measured component, with intervals, and the fit to the motion without noise."""
    x = ensemble.values[quantity][:, component]
    share = noise_let_through(ensemble, quantity, component)
    return density_of(x, ensemble.segment, ensemble.segments, settings=settings, noise_share=share)


def density_of(
    x: Floats, segment: Rows, segments: int, *, settings: BootstrapSettings | None = None, noise_share: float = 0.0
) -> Density:
    """Return the PDF of values (M,) sorted by segment, over 10 standard deviations to either side; as `density`."""
    edges = np.linspace(-REACH, REACH, BINS + 1)
    place = np.searchsorted(edges, (x - x.mean()) / x.std(), side="right") - 1
    inside = (place >= 0) & (place < BINS)
    flat = segment_counts(place[inside], BINS, segment[inside], segments)
    sums = np.concatenate([flat, np.bincount(segment, minlength=segments)[:, None]], axis=1).astype(np.float64)
    width = edges[1] - edges[0]
    pdf = bootstrap(sums, lambda totals: totals[..., :-1] / (totals[..., -1:] * width), settings)
    fit = fit_stretched(x, segment, segments, settings, noise_share)
    return Density(edges=edges, pdf=pdf, counts=flat.sum(0), fit=fit)
