"""The numbers of the paper beside ours: results of each method in the movies, with error bars, and the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from paper_movies import LAWS, TEXTURE_SEED

from sphereorient import so3
from sphereorient.bench import Score, score_track
from sphereorient.cameras import Camera
from sphereorient.errors import TrackError, refusal
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.methods.proposers import paper_proposer, precise_proposer
from sphereorient.methods.settings import Settings
from sphereorient.report.build import uncorrected
from sphereorient.report.plots import style as look
from sphereorient.search.candidates import resized
from sphereorient.sphere import load_texture, orthographic_view
from sphereorient.statistics import Interval, Moments, StatisticsSettings, Summary, Surroundings, summarise
from sphereorient.statistics.bootstrap import bootstrap, segment_sums
from sphereorient.statistics.cameras import camera_distances
from sphereorient.statistics.density import StretchedFit, fit_stretched, flatness_of
from sphereorient.statistics.flow import FlowScales
from sphereorient.statistics.moments import noise_let_through, table_of_moments
from sphereorient.statistics.segments import UNITS, Ensemble, durations
from sphereorient.trajectory import Flag, Trajectory

Floats = NDArray[np.float64]
WRONG_DEG = 10.0  # an orientation further off is another candidate, not an error of measurement
APART_DEG = 30.0  # the paper's limit above which cameras are repaired
VIEW_PX = 80  # of single synthetic views
LARGEST_PX = 96.0  # diameter of the disk at the near side of the field
VISCOSITY_M2_S, DISSIPATION_W_KG = 8e-6, 1.7  # docs/errata.md A5; the paper's power


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """All tracks of one method, with truth."""

    tracks: list[Trajectory]
    experiments: list[Experiment]
    truths: list[dict[str, Floats]]  # datasets of truth.h5 at the frames of each track
    scores: list[Score]
    summary: Summary

    @property
    def true_ensemble(self) -> Ensemble:
        """The true motion in the same frames of the same segments."""
        mine = self.summary.ensemble
        number = mine.track[mine.segment]
        values = {name: np.empty_like(x) for name, x in mine.values.items()}
        for k, (track, truth) in enumerate(zip(self.tracks, self.truths, strict=True)):
            rows = number == k
            frame = np.searchsorted(track.time, mine.time_s[rows])
            for name in UNITS:
                values[name][rows] = truth[name][frame]
        return replace(mine, values=values, sigmas={name: np.zeros_like(x) for name, x in values.items()})


def measured(folders: Sequence[Path], tracks: Sequence[Path], settings: StatisticsSettings) -> Measured:
    """Read the tracks of one method that exist, and compute their statistics; refuse if there is none."""
    there = [(folder, path) for folder, path in zip(folders, tracks, strict=True) if path.exists()]
    if not there:
        do = "read above why the movies could not be tracked"
        raise TrackError(refusal(str(tracks[0].parent), expected="tracks", got="none", do=do))
    loaded = [Trajectory.load(path) for _, path in there]
    experiments = [load_experiment(folder / "experiment.yaml") for folder, _ in there]
    truths = []
    for folder, _ in there:
        with h5py.File(folder / "truth.h5") as file:
            parts = {name: file[name][()] for name in ("time", "position", "orientation", *UNITS)}
            truths.append(parts | {name: file[name]["centre_px"][()] for name in experiments[0].cameras})
    return Measured(
        tracks=loaded,
        experiments=experiments,
        truths=truths,
        scores=[score_track(track, folder / "truth.h5") for track, (folder, _) in zip(loaded, there, strict=True)],
        summary=summarise(loaded, settings, Surroundings(diameter_mm=18.0)),
    )


def whole_in_picture(centre_px: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Mark the frames (N,) whose disk, about (N, 2), is wholly in the picture."""
    reach = 0.5 * LARGEST_PX
    return np.asarray(((centre_px > reach) & (centre_px < np.array(camera.image_size) - 1 - reach)).all(1))


def mean_of(parts: Sequence[Floats], root: bool = False) -> Interval:
    """Return the mean of the finite values of all movies, or the root of the mean square; movies are resampled."""
    kept = [part[np.isfinite(part)].astype(np.float64) for part in parts]
    sums = np.array([[np.square(part).sum() if root else part.sum(), len(part)] for part in kept])

    def mean(totals: Floats) -> Floats:
        ratio = totals[..., 0] / totals[..., 1]
        return np.sqrt(ratio) if root else ratio

    return bootstrap(sums, mean)


def right(errors_deg: Sequence[Floats]) -> list[Floats]:
    """Return the errors below WRONG_DEG."""
    return [error[error < WRONG_DEG] for error in errors_deg]


def wrong(errors_deg: Sequence[Floats]) -> list[Floats]:
    """Return 100 where an error is larger than WRONG_DEG, else 0; NaN stays."""
    return [np.where(np.isfinite(error), 100.0 * (error > WRONG_DEG), np.nan) for error in errors_deg]


def single_views(texture_path: Path, count: int) -> dict[str, Floats]:
    """Return the errors, degrees, of best candidates for noiseless views of random orientations, below WRONG_DEG."""
    texture = load_texture(texture_path)
    R = so3.random_rotations(count, generator=torch.Generator().manual_seed(TEXTURE_SEED), dtype=torch.float64)
    disks = 20 + 150 * orthographic_view(VIEW_PX).render(texture, R.float(), outside=-20 / 150)
    found = {}
    for method, proposer in (
        ("paper", paper_proposer(texture, VIEW_PX, Settings())),
        ("precise", precise_proposer(texture, Settings())),
    ):
        each = proposer.propose(resized(disks, proposer.size_px)).each()
        best = torch.stack([own.R_view_body[0] if len(own.score) else torch.full((3, 3), torch.nan) for own in each])
        errors = np.rad2deg(so3.geodesic_distance(best.double(), R).numpy())
        found[method] = errors[errors < WRONG_DEG]
    return found


def pooled(ensemble: Ensemble, quantity: str, settings: StatisticsSettings) -> tuple[StretchedFit, Interval]:
    """Fit the stretched exponential to the three components together, and return their flatness."""
    x = ensemble.values[quantity]
    normal = ((x - x.mean(0)) / x.std(0)).reshape(-1)
    segment = ensemble.segment.repeat(3)
    share = float(np.mean([noise_let_through(ensemble, quantity, i) for i in range(3)]))
    fit = fit_stretched(normal, segment, ensemble.segments, settings, share)
    sums = segment_sums(np.stack([np.ones_like(normal), normal**2, normal**4], 1), segment, ensemble.segments)
    return fit, bootstrap(sums, lambda t: t[..., 2] * t[..., 0] / t[..., 1] ** 2, settings)


def pm(of: Interval, part: int | None = None) -> str:
    """Return a value with its standard error as text."""
    value, error = (float(x if part is None else x[part]) for x in (of.value, of.error))
    if not math.isfinite(value):
        return "–"
    if not (math.isfinite(error) and error > 0):
        return look.three_digits(value) if value else "0"
    places = look.decimals(error)
    return f"{value:.{places}f} ± {error:.{places}f}"


def xyz(of: Interval) -> str:
    """Return the components x, y, z with their errors."""
    return ", ".join(pm(of, i) for i in range(3))


@dataclass(frozen=True)
class Row:
    """One line of the table; a heading has only a quantity."""

    quantity: str
    printed: str = ""
    corrected: str = ""
    truth: str = ""
    paper: str = ""
    precise: str = ""


def table(found: Mapping[str, Measured], views: Mapping[str, Floats], settings: StatisticsSettings) -> list[Row]:
    """Return all lines; `found` and `views` are by method."""
    return [
        Row("**Accuracy**"),
        *accuracy_rows(found, views),
        Row("**Candidates, path, two cameras**"),
        *path_rows(found),
        Row("**Table I** (rms; of norms mean, rms)"),
        *motion_rows(found, settings),
        Row("**Shape of the distributions** (three components together)"),
        *shape_rows(found, settings),
        Row("**Flow and tracks**"),
        *track_rows(found),
    ]


def each(found: Mapping[str, Measured], of: Callable[[Measured], Interval]) -> dict[str, str]:
    """Return the cells of both methods."""
    return {method: pm(of(one)) for method, one in found.items()}


def accuracy_rows(found: Mapping[str, Measured], views: Mapping[str, Floats]) -> list[Row]:
    """Return the errors of orientations and positions."""

    def of_cameras(one: Measured) -> list[Floats]:
        return [np.concatenate(list(score.camera_orientation_deg.values())) for score in one.scores]

    def distances(one: Measured, corrected: bool) -> list[Floats]:
        parts = []
        for track, experiment in zip(one.tracks, one.experiments, strict=True):
            (apart,) = camera_distances(track, [uncorrected(track, experiment.cameras)])
            radians = apart.distance_rad if corrected else apart.uncorrected_rad
            parts.append(np.rad2deg(radians[radians < math.radians(APART_DEG)]))
        return parts

    def fused(one: Measured) -> list[Floats]:
        return [score.orientation_deg for score in one.scores]

    def positions(one: Measured) -> list[Floats]:
        both = [(track.flags & np.uint32(Flag.ONE_CAMERA)) == 0 for track in one.tracks]
        return [score.position_mm[there] for score, there in zip(one.scores, both, strict=True)]

    single = {method: mean_of(np.split(errors, len(errors)), root=True) for method, errors in views.items()}
    return [
        Row(
            "error of single noiseless views, rms (°)",
            "2",
            truth="0",
            **{method: pm(error) for method, error in single.items()},
        ),
        Row(
            "error of one camera in the movies, rms (°)",
            truth="0",
            **each(found, lambda one: mean_of(right(of_cameras(one)), root=True)),
        ),
        Row(
            f"the same, above {WRONG_DEG:.0f}° and not counted there (%)",
            truth="0",
            **each(found, lambda one: mean_of(wrong(of_cameras(one)))),
        ),
        Row(
            f"distance of two cameras below {APART_DEG:.0f}°, rms (°)",
            "3.5",
            truth="0",
            **each(found, lambda one: mean_of(distances(one, True), root=True)),
        ),
        Row(
            "the same without the correction of perspective (°)",
            **each(found, lambda one: mean_of(distances(one, False), root=True)),
        ),
        Row(
            "error of the orientation from both cameras, rms (°)",
            truth="0",
            **each(found, lambda one: mean_of(right(fused(one)), root=True)),
        ),
        Row(
            f"the same, above {WRONG_DEG:.0f}° and not counted there (%)",
            truth="0",
            **each(found, lambda one: mean_of(wrong(fused(one)))),
        ),
        Row(
            "error of the position from both cameras, rms (mm)",
            truth="0",
            **each(found, lambda one: mean_of(positions(one), root=True)),
        ),
    ]


def path_rows(found: Mapping[str, Measured]) -> list[Row]:
    """Return how often there are candidates, and how often a path is repaired."""

    def counts(one: Measured) -> list[Floats]:
        parts = []
        for track, truth, experiment in zip(one.tracks, one.truths, one.experiments, strict=True):
            whole = {name: whole_in_picture(truth[name], camera) for name, camera in experiment.cameras.items()}
            parts.append(np.concatenate([np.diff(c.candidate_offset)[whole[n]] for n, c in track.cameras.items()]))
        return [part.astype(np.float64) for part in parts]

    def repaired(one: Measured) -> list[Floats]:
        oriented = [np.isfinite(track.orientation).all((1, 2)) for track in one.tracks]
        flag = np.uint32(Flag.REPAIRED_FROM_OTHER_CAMERA)
        return [100.0 * ((t.flags[o] & flag) > 0) for t, o in zip(one.tracks, oriented, strict=True)]

    def segments(one: Measured) -> list[Floats]:
        flag = np.uint32(Flag.REPAIRED_FROM_OTHER_CAMERA)
        parts = []
        for track in one.tracks:
            labels = np.unique(track.segment[track.segment >= 0])
            parts.append(np.array([100.0 * ((track.flags[track.segment == n] & flag) > 0).any() for n in labels]))
        return parts

    def with_any(one: Measured) -> list[Floats]:
        return [100.0 * (count > 0) for count in counts(one)]

    def only(of: Callable[[Measured], list[Floats]]) -> dict[str, str]:
        return {"paper": pm(mean_of(of(found["paper"])))}

    return [
        Row(
            "pictures of the whole sphere with candidates (%)",
            truth="100",
            **each(found, lambda o: mean_of(with_any(o))),
        ),
        Row("candidates per picture", truth="1", **each(found, lambda one: mean_of(counts(one)))),
        Row("frames repaired from the other camera (%)", **only(repaired)),
        Row("segments with a repaired frame (%)", **only(segments)),
        Row("orientations of the grid of 12°", "23,586", "9,119", paper=f"{len(so3.lattman_grid(math.radians(12))):,}"),
    ]


SYMBOLS = {
    "velocity": ("v (m/s)", "0.28, 0.40, 0.37", "", "0.6, 0.2"),
    "acceleration": ("a (m/s²)", "5.5, 5.6, 6.0", "", "8.4, 5.3"),
    "omega_lab": ("ω lab (rad/s)", "8.0, 7.8, 7.7", "7.1, 8.2, 8.1", "12.2, 5.8"),
    "omega_body": ("ω body (rad/s)", "7.1, 8.2, 8.1", "missing (E6)", ""),
    "alpha_lab": ("α lab (rad/s²)", "590, 554, 559", "624, 516, 534", "820, 530"),
    "alpha_body": ("α body (rad/s²)", "624, 516, 534", "missing (E6)", ""),
}


def motion_rows(found: Mapping[str, Measured], settings: StatisticsSettings) -> list[Row]:
    """Return Table I as measured, and the rms of accelerations without the stated noise of the tracks."""
    tables: dict[str, Mapping[str, Moments]] = {method: one.summary.table for method, one in found.items()}
    tables["truth"] = table_of_moments(found["paper"].true_ensemble, settings)
    rows = []
    for quantity, (symbol, printed, corrected, norm) in SYMBOLS.items():
        rows.append(Row(symbol, printed, corrected, **{who: xyz(t[quantity].rms) for who, t in tables.items()}))
        if quantity in ("acceleration", "alpha_lab"):
            ours = {who: xyz(tables[who][quantity].corrected_rms) for who in found}
            rows.append(Row(f"{symbol.replace(' (', ', without noise (')}", **ours))
        if norm:
            both = {who: f"{pm(t[quantity].mean, 3)}, {pm(t[quantity].rms, 3)}" for who, t in tables.items()}
            rows.append(Row(f"norm of {symbol}", norm, **both))
    return rows


LAW_FLATNESS = {
    "velocity": 3.0,
    "acceleration": 3.0,
    "omega_lab": LAWS.omega_flatness,
    "alpha_lab": LAWS.alpha_flatness,
}
PRINTED_SHAPE = {  # a and flatness, printed; flatness corrected
    "velocity": ("", "below 3, or 3", "E10"),
    "acceleration": ("0.6", "", f"{flatness_of(0.6):.1f}"),
    "omega_lab": ("0.45", "4", f"{flatness_of(0.45):.2f}"),
    "alpha_lab": ("0.6", "7.6", f"{flatness_of(0.6):.1f}"),
}


def shape_rows(found: Mapping[str, Measured], settings: StatisticsSettings) -> list[Row]:
    """Return flatness and the width a of the stretched exponential."""
    ensembles = {method: one.summary.ensemble for method, one in found.items()}
    ensembles["truth"] = found["paper"].true_ensemble
    rows = []
    for quantity, (a, flatness, corrected) in PRINTED_SHAPE.items():
        symbol = SYMBOLS[quantity][0].split(" (")[0]
        fits = {who: pooled(one, quantity, settings) for who, one in ensembles.items()}
        flat = {who: pm(own) for who, (_, own) in fits.items()}
        flat["truth"] += f" (law: {LAW_FLATNESS[quantity]:g})"
        rows.append(Row(f"flatness of {symbol}", flatness, corrected, **flat))
        if a:
            rows.append(Row(f"a of {symbol}", a, **{who: pm(fit.a) for who, (fit, _) in fits.items()}))
    return rows


def stays(truth: Mapping[str, Floats], experiment: Experiment) -> Floats:
    """Return how long the whole sphere stays in the picture of some camera, (S,), s."""
    seen = np.any([whole_in_picture(truth[name], camera) for name, camera in experiment.cameras.items()], axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    return np.asarray((edges[1::2] - edges[::2]) / experiment.frame_rate_hz)


def track_rows(found: Mapping[str, Measured]) -> list[Row]:
    """Return durations, uniformity, and scales of the flow."""
    flow = FlowScales(viscosity_m2_s=VISCOSITY_M2_S, dissipation_w_kg=DISSIPATION_W_KG)
    more = {method: one.summary.distributions for method, one in found.items()}
    known = {method: one for method, one in more.items() if one is not None}
    decay = {m: pm(one.durations.decay_time_s) for m, one in known.items() if one.durations is not None}
    stays_s = np.concatenate(
        [stays(*both) for both in zip(found["paper"].truths, found["paper"].experiments, strict=True)]
    )
    spans = more["paper"].durations if more["paper"] is not None else None
    if spans is not None and (stays_s >= spans.truncated_s).sum() >= 2:
        decay["truth"] = pm(durations(stays_s, spans.truncated_s).decay_time_s)
    curves = {method: one.correlations["velocity"].integral_time_s for method, one in known.items()}
    return [
        Row("segments", **{method: str(one.summary.ensemble.segments) for method, one in found.items()}),
        Row("frames in them", **{method: f"{len(one.summary.ensemble):,}" for method, one in found.items()}),
        Row("decay time of the durations (s)", "about 0.3", **decay),
        Row("integral time of v (s)", **{method: pm(time, 3) for method, time in curves.items()}),
        Row(
            "uniform orientations, p-value",
            "uniform",
            **{m: f"{one.uniformity.p_value:.2f}" for m, one in known.items()},
        ),
        Row("Kolmogorov length of water-glycerol (µm)", "30", f"{1e6 * flow.eta_m:.0f} (A5)"),
        Row("Kolmogorov time (ms)", "1", f"{1e3 * flow.tau_eta_s:.1f} (A5)"),
        Row("D / Kolmogorov length", "600", f"{0.018 / flow.eta_m:.0f} (A5)"),
    ]


def markdown(rows: Sequence[Row]) -> str:
    """Return the table."""
    head = "| quantity | paper, printed | corrected | synthetic truth | ours, `paper` | ours, `precise` |"
    lines = [head, "|---|---|---|---|---|---|"]
    for row in rows:
        cells = (row.quantity, row.printed, row.corrected, row.truth, row.paper, row.precise)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
