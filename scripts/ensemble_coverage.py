"""Check on synthetic ensembles that the statistics are right and their intervals hold the truth.

    scripts/ensemble_coverage.py [--repetitions 100] [--processes 2] [--segments 300] [--mean-frames 150]

Each repetition draws tracks whose true statistics are those of the paper's Table I (exponential durations, alpha of
flatness 7.6, omega of 4), measures them with 0.1 degree and 0.05 mm of white noise, smooths them as the precise method
does, and computes the statistics. Prints by quantity and component: the mean ratio to the same ensemble
without noise, and in how many repetitions the 95 % interval held the nominal value; then the warnings at 2 degrees.
15 s of one core a repetition.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from ensembles import EnsembleSpec, Nominal, draw_ensemble, nominal, smoothed_track

from sphereorient.motion import ProcessNoise
from sphereorient.statistics.density import fit_stretched
from sphereorient.statistics.moments import moments, noise_let_through
from sphereorient.statistics.segments import UNITS, Ensemble, ensemble_of
from sphereorient.statistics.settings import BootstrapSettings, SegmentSettings
from sphereorient.trajectory import Trajectory

NOISE_DEG, ROUGH_DEG, NOISE_MM = 0.1, 2.0, 0.05
WITHIN = 0.03  # recovery of each rms
HELD = 90, 99  # of 100 repetitions
FITTED = ("omega_lab", "alpha_lab")  # by the stretched exponential
LONG = 2_000_000  # samples: they give the a of a very long record
DRAWS = BootstrapSettings(resamples=1000)


@dataclass(frozen=True, kw_only=True)
class Work:
    """One repetition."""

    seed: int
    spec: EnsembleSpec
    truth: dict[tuple[str, str, int], float]  # by quantity, statistic, component
    known: ProcessNoise


Result = dict[tuple[str, str, int], tuple[float, bool]]  # ratio to the same without noise, whether the interval held


def nominal_a(spec: EnsembleSpec) -> dict[str, float]:
    """Return the a that the fit tends to for the components' laws, from independent samples.

    The laws' densities are near the stretched exponential and not equal to it.
    """
    law = replace(spec, frame="lab").omega_laws()[0]
    rng = np.random.default_rng(7)
    pieces = [law.draw(LONG // 20, rng).at(np.zeros(LONG // 20), np.arange(LONG // 20)) for _ in range(20)]
    segment = np.arange(LONG) // (LONG // 10)
    few = BootstrapSettings(resamples=100)
    both = (np.concatenate(part) for part in zip(*pieces, strict=True))
    return {name: float(fit_stretched(x, segment, 10, few).a.value) for name, x in zip(FITTED, both, strict=True)}


def measure(
    ensemble: Ensemble, settings: BootstrapSettings
) -> Iterator[tuple[tuple[str, str, int], float, float, float]]:
    """Yield key, value and interval of everything that is checked."""
    for quantity in UNITS:
        found = moments(ensemble, quantity, settings)
        for name, part in (("rms", found.corrected_rms), ("flatness", found.corrected_flatness)):
            for i in range(3):
                yield (quantity, name, i), float(part.value[i]), float(part.low[i]), float(part.high[i])
    for quantity in FITTED:
        for i in range(3):
            x = ensemble.values[quantity][:, i]
            share = noise_let_through(ensemble, quantity, i)
            a = fit_stretched(x, ensemble.segment, ensemble.segments, settings, share).a
            yield (quantity, "a", i), float(a.value), float(a.low), float(a.high)


def repeat(work: Work) -> Result:
    """Run one repetition."""
    torch.set_num_threads(1)
    true = draw_ensemble(work.spec, work.seed)
    track, _ = smoothed_track(true, NOISE_DEG, NOISE_MM, work.seed, work.known)
    few = BootstrapSettings(resamples=100)
    ensemble = ensemble_of(track)
    clean = {key: value for key, value, _, _ in measure(same_frames(true, ensemble), few)}
    return {
        key: (value / clean[key], low <= work.truth[key] <= high) for key, value, low, high in measure(ensemble, DRAWS)
    }


def same_frames(exact: Trajectory, ensemble: Ensemble) -> Ensemble:
    """Return the noise-free ensemble at the frames of another one."""
    rows = np.searchsorted(exact.time, ensemble.time_s - 0.5 * ensemble.step_s)
    return ensemble_of(exact.at(rows), SegmentSettings(min_frames=2))


def truths(spec: EnsembleSpec) -> dict[tuple[str, str, int], float]:
    """Return the nominal values by quantity, statistic and component."""
    laws: dict[str, Nominal] = nominal(spec)
    out = {
        (quantity, name, i): float(getattr(laws[quantity], name)[i])
        for quantity in UNITS
        for name in ("rms", "flatness")
        for i in range(3)
    }
    return out | {(quantity, "a", i): a for quantity, a in nominal_a(spec).items() for i in range(3)}


def table(results: list[Result], truth: dict[tuple[str, str, int], float]) -> bool:
    """Print the results; return whether all are within the limits."""
    print("quantity      statistic component    nominal  ratio to no noise (mean, worst)  held")
    fine = True
    for key, value in truth.items():
        ratios = np.array([result[key][0] for result in results])
        held = sum(result[key][1] for result in results)
        worst = ratios[np.abs(ratios - 1).argmax()]
        good = HELD[0] <= 100 * held / len(results) <= HELD[1]
        near = key[1] != "rms" or abs(worst - 1) <= WITHIN
        fine &= good and near
        mark = "" if good and near else "  <--"
        quantity, name, i = key
        print(
            f"{quantity:13} {name:9} {'xyz'[i]}  {value:16.4g}  {ratios.mean():10.4f} {worst:8.4f}  "
            f"{held:14d} of {len(results)}{mark}"
        )
    return bool(fine)


def warnings(spec: EnsembleSpec, degrees: float) -> list[str]:
    """Return the quantities that have a warning at a noise."""
    track, _ = smoothed_track(draw_ensemble(spec, 0), degrees, NOISE_MM, 0)
    ensemble = ensemble_of(track)
    few = BootstrapSettings(resamples=100)
    return [quantity for quantity in UNITS if moments(ensemble, quantity, few).noisy]


def let_through(spec: EnsembleSpec, known: ProcessNoise) -> dict[str, float]:
    """Return by quantity the share of remaining noise in the smoother's stated variance.

    The same motion is smoothed with and without noise, both by the model with noise; the difference is what remains.
    """
    true = draw_ensemble(spec, 10_001)
    noisy, _ = smoothed_track(true, NOISE_DEG, NOISE_MM, 10_001, known)
    quiet, _ = smoothed_track(true, NOISE_DEG, NOISE_MM, 10_001, known, silent=True)
    rows = np.searchsorted(noisy.time, ensemble_of(noisy).time_s - 0.5 / spec.frame_rate_hz)
    return {
        quantity: float(
            np.var((getattr(noisy, quantity) - getattr(quiet, quantity))[rows], axis=0).mean()
            / np.square(getattr(noisy, f"{quantity}_sigma")[rows]).mean()
        )
        for quantity in UNITS
    }


def main() -> None:
    """Read the options, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--segments", type=int, default=300)
    parser.add_argument("--mean-frames", type=float, default=150.0)
    options = parser.parse_args()
    spec = EnsembleSpec(segments=options.segments, mean_frames=options.mean_frames)
    truth = truths(spec)
    _, known = smoothed_track(draw_ensemble(spec, 10_000), NOISE_DEG, NOISE_MM, 10_000)
    works = [Work(seed=seed, spec=spec, truth=truth, known=known) for seed in range(options.repetitions)]
    results = []
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for result in pool.imap_unordered(repeat, works):
            results.append(result)
            print(f"\r{len(results)} of {len(works)} repetitions", end="", file=sys.stderr)
    print(file=sys.stderr)
    fine = table(results, truth)
    for quantity, part in let_through(spec, known).items():
        print(f"{quantity}: {part:.2f} of the smoother's stated variance is remaining noise")
    for degrees in (NOISE_DEG, ROUGH_DEG):
        print(f"warned of at {degrees} degrees: {', '.join(warnings(spec, degrees)) or 'nothing'}")
    print("all within the limits" if fine else "NOT all within the limits: see the arrows")


if __name__ == "__main__":
    main()
