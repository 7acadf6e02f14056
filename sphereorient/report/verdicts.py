"""The findings of a report as text."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sphereorient.report.plots.style import interval_text
from sphereorient.statistics import Summary
from sphereorient.statistics.cameras import CameraDistance
from sphereorient.statistics.isotropy import anisotropic_frame
from sphereorient.statistics.summary import Distributions
from sphereorient.trajectory import Trajectory, span_words

FEW_SEGMENTS = 20  # below, intervals and tests are weak
LOST_SHARE = 0.05  # of the frames, for a doubt
APART_DEG = 5.0  # median distance of the cameras; the paper's method reaches half of it (docs/paper.md)
MORE = "pass more tracks, or cut a long record with --set statistics.max_duration_s=SECONDS"
GAUSSIAN = 3.0  # flatness
CLEAR, WEAK = 0.001, 0.05  # p-values below which a finding is clear, or weak: a report makes a dozen tests


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One sentence on the tracks; a doubt ends with what to do; made by `verdicts`, printed on the page."""

    title: str
    grade: Literal["good", "neutral", "doubt"]
    words: str


def verdicts(summary: Summary, tracks: Mapping[str, Trajectory], distances: Sequence[CameraDistance]) -> list[Verdict]:
    """Return the findings, those on the measurement first; arguments as of `tables.tables_of`."""
    found = [*_measured(tracks), *_segments(summary, tracks), *_noise(summary), *_apart(distances)]
    if (more := summary.distributions) is not None:
        found += [*_tails(summary, more), *_attitude(more), *_frames(more), *_isotropy(more), *_lift(more)]
    return found


def _say(title: str, words: str, do: str = "", *, good: bool = False) -> Verdict:
    """Return a verdict; with `do` it is a doubt."""
    if do:
        return Verdict(title=title, grade="doubt", words=f"{words}; {do}")
    return Verdict(title=title, grade="good" if good else "neutral", words=words)


def _measured(tracks: Mapping[str, Trajectory]) -> Iterator[Verdict]:
    absent = {name: track.without_ball for name, track in tracks.items()}
    frames = sum(int((~none).sum()) for none in absent.values())
    valid = sum(int(track.valid.sum()) for track in tracks.values())
    share = valid / max(frames, 1)
    each = {name: float(tracks[name].valid[~none].mean()) if not none.all() else 0.0 for name, none in absent.items()}
    elsewhere = sum(int(none.sum()) for none in absent.values())
    shown = " with a ball" if elsewhere else ""
    words = f"{valid:,} of {frames:,} frames{shown} valid ({100 * share:.4g} %)"
    worst = min(each, key=lambda name: each[name])
    if len(tracks) > 1 and valid < frames:
        words += f"; fewest in {worst}, {100 * each[worst]:.4g} %"
    if elsewhere:
        where = "" if len(tracks) > 1 else f": {span_words(absent[worst])}"
        words += f"; no ball in view in {elsewhere:,} more{where}"
    do = "see the reasons under Frame by frame, and run `sphereorient check` on the experiment"
    yield _say("Measured", words, do if share < 1 - LOST_SHARE else "", good=True)
    if all(track.held for track in tracks.values()):
        yield _say("Place", "the centre is fixed: this page reports the rotation only")
    remarks = dict.fromkeys(remark for track in tracks.values() for remark in track.provenance.get("remarks", ()))
    for remark in list(remarks)[:5]:
        yield _say("Remark", str(remark), "if this is not intended, run `sphereorient check`")


def _segments(summary: Summary, tracks: Mapping[str, Trajectory]) -> Iterator[Verdict]:
    count, least_s = summary.ensemble.segments, summary.settings.min_integral_times * summary.integral_time_s
    if not count:
        longest = max(int(np.bincount(track.segment + 1)[1:].max(initial=0)) for track in tracks.values())
        least = f"{summary.settings.min_frames} frames" + (f" and {least_s:.3g} s" if np.isfinite(least_s) else "")
        words = f"none has {least} with a motion: all numbers are unknown; the longest has {longest} frames, and "
        words += "kernels cut its ends"
        if not any(np.isfinite(track.velocity).any() for track in tracks.values()):
            words = "no motion: these poses were not smoothed, so velocities are unknown, as in a track of `live`"
        yield _say("Segments", words, "pass longer tracks, or lower statistics.min_frames")
        return
    if summary.distributions is None:
        words = "one segment only: no intervals and no distributions, since the scatter between segments is unknown"
        yield _say("Segments", words, MORE)
        return
    words = f"{count:,} segments, {len(summary.ensemble):,} samples"
    if np.isfinite(least_s):
        whose = "flow" if summary.integral_time_s == summary.surroundings.integral_time_s else next(iter(summary.table))
        words += f", each longer than {least_s:.3g} s (integral time of the {whose} {summary.integral_time_s:.3g} s)"
    if count < FEW_SEGMENTS:
        words += "; with so few, tails are uncertain and intervals of the flatness too narrow"
    yield _say("Segments", words, MORE if count < FEW_SEGMENTS else "")


def _noise(summary: Summary) -> Iterator[Verdict]:
    if not summary.ensemble.segments:
        return
    shares = {quantity: part.noise_share.value[:3].max() for quantity, part in summary.table.items()}
    if unknown := [quantity for quantity, share in shares.items() if not np.isfinite(share)]:
        words = f"the errors of {', '.join(unknown)} are unknown, at least in some frames: nothing is corrected"
        yield _say("Noise", words, "track again, or read these numbers as upper limits")
    elif not summary.warnings:
        what = "noise" if summary.ensemble.error == "added" else "smoothed away"
        yield _say("Noise", f"at most {100 * max(shares.values()):.2g} % of any variance is {what}", good=True)
    for warning in summary.warnings:
        yield _say("Noise", warning, "read the corrected values, and the figure of kernel widths")


def _apart(distances: Sequence[CameraDistance]) -> Iterator[Verdict]:
    for one in distances:
        if not len(one.distance_rad):
            continue
        median, far = np.rad2deg(np.quantile(one.distance_rad, (0.5, 0.95)))
        names = " and ".join(one.cameras)
        words = f"the orientations of {names} alone differ by {median:.2g}\u00b0 (median), {far:.2g}\u00b0 (95 %)"
        if one.uncorrected_rad is not None and len(one.uncorrected_rad):
            words += f"; without correction of perspective by {np.rad2deg(np.median(one.uncorrected_rad)):.2g}\u00b0"
        do = "run `sphereorient check`: cameras may be swapped, movies out of step, or the calibration poor"
        yield _say("Cameras", words, do if median > APART_DEG else "")


def _tails(summary: Summary, more: Distributions) -> Iterator[Verdict]:
    for quantity in more.correlations:
        flat = summary.table[quantity].corrected_flatness
        flat = flat if np.isfinite(flat.value[:3]).all() else summary.table[quantity].flatness
        fits = more.densities[quantity]
        values = ", ".join(interval_text(flat.part(i)) for i in range(3))
        heavy = all(flat.low[i] > GAUSSIAN for i in range(3))
        light = all(flat.high[i] < GAUSSIAN for i in range(3))
        kind = "heavier tails than" if heavy else "lighter tails than" if light else "not distinguishable from"
        words = f"flatness of x, y, z: {values}: {kind} a Gaussian"
        if heavy and all(part.fit.better_than_gaussian for part in fits):
            a = ", ".join(interval_text(part.fit.a) for part in fits)
            words += f"; the stretched exponential fits better, a = {a}"
        yield _say(f"Tails of {quantity}", words)


def _attitude(more: Distributions) -> Iterator[Verdict]:
    test = more.uniformity
    how = f"p = {test.p_value:.2g}, worth {test.effective:.0f} independent orientations"
    words, do = "consistent with all orientations equally likely", ""
    if test.p_value < CLEAR:
        words = "not all orientations are equally likely"
        do = "see the figure of the angles: too few tracks, lost orientations, or an uneven ball"
    elif test.p_value < WEAK:
        words = "weak signs that not all orientations are equally likely"
    yield _say("Orientations", f"{words} ({how})", do)


def _frames(more: Distributions) -> Iterator[Verdict]:
    for name, row in more.rows.items():
        own = name.removeprefix("omega_")
        sizes = f"off the rotations {100 * row.lab_residual:.3g} % in lab, {100 * row.body_residual:.3g} % in body"
        found, right = own if row.frame == "both" else row.frame, row.frame in (own, "both")
        words = "not in lab or body components" if found == "none" else f"written in {found} components"
        do = "" if right else "compute it again from the orientations, see docs/errata.md E6"
        yield _say(f"Frame of {name}", f"{words} ({sizes})", do, good=True)


def _isotropy(more: Distributions) -> Iterator[Verdict]:
    meaning = {
        "lab": "prefers directions of the lab and none of the body: the flow, or the forcing, has axes",
        "body": "prefers directions of the body and none of the lab: the sphere's own axes differ",
        "both": "prefers directions in lab and in body",
        "neither": "consistent with isotropy in lab and in body",
    }
    for stem in ("omega", "alpha"):
        lab, body = more.isotropies[f"{stem}_lab"], more.isotropies[f"{stem}_body"]
        if not np.isfinite(lab.p_value + body.p_value):
            yield _say(f"Isotropy of {stem}", "too few segments for a test")
            continue
        p = f"p = {lab.p_value:.2g} in lab, {body.p_value:.2g} in body"
        clear, weak = (anisotropic_frame(lab, body, level) for level in (CLEAR, WEAK))
        words = meaning[clear]
        if clear == "neither" and weak != "neither":
            words = f"only weak signs that it {meaning[weak].split(':')[0]}"
        yield _say(f"Isotropy of {stem}", f"{words} ({p})")


def _lift(more: Distributions) -> Iterator[Verdict]:
    if more.lift is not None:
        found = more.lift.correlation
        clear = found.low[3] > 0 or found.high[3] < 0
        seen = "the acceleration follows omega x v" if clear else "no correlation of the acceleration with omega x v"
        yield _say("Lift", f"{seen}: cosine {interval_text(found.part(3))}")
