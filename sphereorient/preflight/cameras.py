"""Agreement of the cameras, by outlines of the ball in sampled frames and by a short tracked stretch."""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from statistics import median

import torch
from torch import Tensor

from sphereorient.calibration.comparison import Seen, other_readings
from sphereorient.calibration.contradictions import FEWEST, OUTLINES, compare_cameras, majority, said_alone
from sphereorient.cameras import Camera, nearest_point, perspective_centre_lab_mm
from sphereorient.errors import SphereOrientError
from sphereorient.experiment import Experiment
from sphereorient.methods.method import Learnt
from sphereorient.methods.results import TWO_BALLS
from sphereorient.methods.settings import Settings
from sphereorient.preflight.finding import FAULT, OK, WARNING, Finding, Severity, judged, warning
from sphereorient.preflight.in_step import OffsetScan, in_step
from sphereorient.preflight.sample import MovieSample
from sphereorient.run import MemoryStore, Request
from sphereorient.run.stages import opened, run_tracks
from sphereorient.sphere.renderer import rim_directions

GOOD_PX = 0.7  # median px between lines of sight, 0.2 to 0.5 for exact cameras; a fault from that of `OUTLINES` on
CLEARER = 0.2  # swapped or mirrored movies are reported if correction leaves less than this share of the gap
AROUND = 72  # points of the expected outline
OUTLINE_PX = 0.4  # error of an outline's radius, by blur and a dark rim
GOOD, BAD = 0.01, 0.04  # relative error of the size
VOLUME = 0.4  # relative size difference of nearer and farther balls that the tracker accepts
ENOUGH = 60  # least frames for a background from the movie: a ghost in one of 50 changed poses by 0.3 degrees
SEE_BALL = "see the finding on the ball"
TITLE = "cameras agree"


def learn_appearance(experiment: Experiment, settings: Settings, cameras: tuple[str, ...] | None = None) -> Learnt:
    """Learn light, blur and noise of these cameras (None: all) as `track` does, with the same errors."""
    with opened(Request(experiment=experiment, settings=settings, cameras=cameras), MemoryStore()) as work:
        assert work.follower is not None  # the precise method follows frames
        return Learnt.of(work.follower.appearance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracked:
    """Findings of a short stretch, tracked in each camera alone; made by `track_stretch`."""

    findings: tuple[Finding, ...] = ()  # on the number of balls, then on the cameras
    overrules: bool = False  # poses fitted to the paint are more accurate than outlines, which jump at dark paint


NOT_TRACKED = Tracked()


def track_stretch(
    experiment: Experiment, settings: Settings, learning: Future[Learnt], stretch: Sequence[MovieSample], first: int
) -> Tracked:
    """Track consecutive frames of each camera by the learnt appearance; judge cameras and number of balls."""
    try:
        learnt = learning.result()
        # Each camera alone: a joint pose would hide their difference.
        request = Request(
            experiment=replace(experiment, frames=(first, first + len(stretch[0].frame))),
            settings=settings,
            learnt=dict.fromkeys(experiment.names, replace(learnt, together=False, majority=())),
        )
        (track,) = run_tracks(request, MemoryStore()).values()
    except SphereOrientError as error:
        measured, _, do = str(error).rpartition("; ")
        finding = judged(TITLE, f"a run stops: {measured}", (True, FAULT, do.rstrip(".")))
        # The run stops for any cause.
        return Tracked(findings=(replace(unsure(finding, experiment, len(stretch[0].stream)), severity=FAULT),))
    seen, limits = said_alone(track, experiment.cameras, 2 * experiment.radius_mm, consecutive=True)
    position = torch.from_numpy(track.position)
    wider = [outline_stretch(sample, position, experiment.radius_mm) for sample in stretch]
    found = compare_cameras(replace(seen, outline_stretch=torch.stack(wider, 1)), limits)
    measurable = found.frames >= FEWEST and not math.isnan(found.turn_deg)
    if not measurable:
        both = "both" if len(stretch) == 2 else "two"
        measured = f"cannot tell: {both} cameras show the ball and its paint in {found.frames} of {len(track)} frames"
        agree = warning(TITLE, measured, "see the findings on the ball and on the map")
    else:
        measured = f"{found} (median of {found.frames} frames)"
        agree = judged(TITLE, measured, (found.contradicts, FAULT, found.advice))
        agree = unsure(agree, experiment, len(stretch[0].stream))
    measured, _, do = TWO_BALLS.rpartition("; ")
    balls = (judged("one ball", measured, (True, FAULT, do)),) if learnt.second_ball else ()
    return Tracked(findings=(*balls, agree), overrules=measurable)


def unsure(finding: Finding, experiment: Experiment, total: int) -> Finding:
    """Downgrade a fault to "cannot tell" if too few frames (`total`) give a background: it shows the ball."""
    given = experiment.movie_paths.keys() <= experiment.background_paths.keys()
    if finding.severity is not FAULT or total >= ENOUGH or given:
        return finding
    measured = f"cannot tell: {finding.measured}, but the background is learnt from {total} frames"
    return warning(finding.title, measured, "give backgrounds:, or check more frames")


def camera_findings(
    experiment: Experiment, samples: Sequence[MovieSample], scans: Sequence[OffsetScan], tracked: Tracked
) -> Iterator[Finding]:
    """Yield findings by outlines and tracked stretch; the stretch overrules complaints by outlines."""
    if not samples:
        return
    between, diameter_mm = [], experiment.diameter_mm
    if scans and all(sample.balls for sample in samples):  # else the finding on the ball suffices
        in_step_px = max(scan.in_step_px for scan in scans) if any(scan.shift for scan in scans) else None
        between = [lines_of_sight(samples, in_step_px), in_step(scans, experiment.start)]
        between += [] if diameter_mm is None else [ball_size(samples, diameter_mm)]
    between = [unsure(one, experiment, len(samples[0].stream)) for one in between]
    if not scans or diameter_mm is None:
        between += [ball_size_px(sample) for sample in samples]
    yield from (replace(one, severity=OK, advice="") if tracked.overrules else one for one in between)
    yield from tracked.findings


def sample_positions(samples: Sequence[MovieSample]) -> Tensor:
    """Return the positions (n, 3), lab, mm, of the ball in the frames sampled by two cameras or more."""
    return nearest_point([one.camera.rays(one.sightings.centre_px) for one in samples])[0]


def lines_of_sight(samples: Sequence[MovieSample], in_step_px: float | None) -> Finding:
    """Judge the distance between the lines of sight; `in_step_px`: the gap after synchronising the movies."""
    title, names = "lines of sight", [one.name for one in samples]
    centre_px = torch.stack([one.sightings.centre_px for one in samples], 1)
    radius_px = torch.stack([one.sightings.radius_px for one in samples], 1)
    seen = Seen.of_outlines({one.name: one.camera for one in samples}, centre_px, radius_px)
    pairs = {pair: seen.gaps(pair) for pair in seen.pairs}
    counts = {pair: int(torch.isfinite(gaps.signed_mm).sum()) for pair, gaps in pairs.items()}
    k, m = min(counts, key=lambda pair: counts[pair])
    if (count := counts[k, m]) < FEWEST:
        who = "both cameras see" if len(samples) == 2 else f"{names[k]} and {names[m]} see"
        measured = f"{who} the ball in {count} of {len(samples[0].frame)} frames sampled"
        return warning(title, measured, f"{SEE_BALL}, and check start: the movies must show the same time")
    by_pair = {pair: gaps.typical_px for pair, gaps in pairs.items()}
    k, m = max(by_pair, key=by_pair.__getitem__)
    gap_px, gap_mm = by_pair[k, m], float(pairs[k, m].signed_mm.abs().nanmedian())
    who = "they miss" if len(samples) == 2 else f"those of {names[k]} and {names[m]} miss"
    measured = f"{who} each other by {gap_mm:.3f} mm, {gap_px:.2f} px (median of {counts[k, m]} frames)"
    agree = majority(seen) if gap_px > OUTLINES.gap_px else ()
    wrong = [name for k, name in enumerate(names) if agree and k not in agree]
    if wrong:
        others = max(by_pair[pair] for pair in by_pair if {*pair} <= {*agree})
        measured += f"; without {' and '.join(wrong)} they meet to {others:.2f} px"
    if in_step_px is not None:
        measured += f"; {in_step_px:.2f} px once the movies are in step"
        gap_px = in_step_px
    limit, better = min(CLEARER * gap_px, GOOD_PX), []
    for cause, centre_px, _ in other_readings(seen.cameras, seen.centre_px, seen.R_lab_body):
        if (gap := max(seen.gaps(pair, centre_px).typical_px for pair in seen.pairs)) < limit:
            better.append((gap, f"{cause.words} (then it is {gap:.2f} px)"))
    # With cameras at right angles several causes can fit: all are reported.
    mended = ", or ".join(advice for _, advice in sorted(better))
    who = f"{' and '.join(wrong)} contradicts the others and" if wrong else "a camera"
    moved = f"calibrate again: {who} was moved or bumped, or cameras.yaml is of another set-up"
    bumped = "run sphereorient check-cameras, and calibrate --refine-with: a camera may have been bumped"
    complaints = (gap_px > OUTLINES.gap_px, FAULT, mended or moved), (gap_px > GOOD_PX, WARNING, bumped)
    return judged(title, measured, *complaints)


def expected_outline_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return the outline (..., AROUND, 2), px, of a sphere at (..., 3), mm, lab."""
    rim, sight = rim_directions(camera, position_lab_mm, AROUND)
    distance = (position_lab_mm - perspective_centre_lab_mm(camera, position_lab_mm)).norm(dim=-1)
    sine = (radius_mm / distance).clamp_max(0.99)[..., None, None]
    toward = (1 - sine.square()).sqrt() * rim - sine * sight[..., None, :]
    return camera.project(position_lab_mm[..., None, :] + radius_mm * toward)


def outline_stretch(sample: MovieSample, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return the relative excess of the outlines' width (n,) over that of a sphere at positions (n, 3), mm."""
    measured = [math.nan if outline is None else outline.stretch for outline, _ in sample.found]
    rim = expected_outline_px(sample.camera, position_lab_mm, radius_mm)
    width, height = (rim - rim.mean(-2, keepdim=True)).square().mean(-2).sqrt().unbind(-1)
    return torch.tensor(measured, dtype=torch.float64) - (width / height - 1)


def ball_size(samples: Sequence[MovieSample], diameter_mm: float) -> Finding:
    """Compare the size of the ball in the pictures of two cameras or more with the expected size."""
    title, position, ratios = "size of the ball", sample_positions(samples), {}
    for sample in samples:
        outline = expected_outline_px(sample.camera, position, diameter_mm / 2)
        expected = (outline - outline.mean(-2, keepdim=True)).norm(dim=-1).mean(-1)
        ratios[sample.name] = sample.sightings.radius_px / expected
    middle = {name: float(ratio.nanmedian()) for name, ratio in ratios.items()}
    if any(math.isnan(ratio) for ratio in middle.values()):
        both = "both" if len(samples) == 2 else "all"
        return warning(title, f"unknown: no frame shows the ball to {both} cameras", SEE_BALL)
    spread = {name: 1.4826 * float((ratio - ratio.nanmedian()).abs().nanmedian()) for name, ratio in ratios.items()}
    words = ", ".join(f"{name} {ratio:.3f} +- {spread[name]:.3f}" for name, ratio in middle.items())
    mean, apart = sum(middle.values()) / len(middle), max(middle.values()) - min(middle.values())
    tolerance = OUTLINE_PX / min(float(sample.sightings.radius_px.nanmedian()) for sample in samples)
    usual = 1.0 if len(samples) == 2 else median(middle.values())
    name = max(middle, key=lambda one: abs(middle[one] - usual))
    advice = f"check f, pixel_pitch and T of {name} in cameras.yaml: the cameras do not agree on the size"
    if apart <= GOOD + tolerance:
        advice = f"measure the ball: sphere.diameter {diameter_mm * mean:.4g} mm would fit; "
        advice += f"if it is {diameter_mm:g} mm, the lengths of the calibration are wrong (pitch of the plate)"
    return judged(title, f"measured over expected: {words}", *off_size(max(apart, abs(mean - 1)), tolerance, advice))


def off_size(error: float, tolerance: float, advice: str) -> list[tuple[bool, Severity, str]]:
    """Return the complaints about a relative size error, for outlines with this tolerance."""
    return [(error > BAD + tolerance, FAULT, advice), (error > GOOD + tolerance, WARNING, advice)]


def ball_size_px(sample: MovieSample) -> Finding:
    """Report the size of the ball in one camera (distance and size are not separable)."""
    title, radius = f"size of the ball, {sample.name}", sample.sightings.radius_px
    seen = 2 * radius[torch.isfinite(radius)]
    if not len(seen):
        return warning(title, "unknown: no ball was found", SEE_BALL)
    usual = float(seen.median())
    measured = f"{usual:.1f} px across ({float(seen.min()):.1f} .. {float(seen.max()):.1f})"
    if sample.expected_px is None and (sample.stream.photograph or sample.in_place is not None):
        return judged(title, measured)
    if sample.expected_px is None:
        advice = f"set locate.diameter_px to {usual:.0f} (--set, or in the settings file)"
        return warning(title, measured + "; none expected", advice)
    measured += f"; {sample.expected_px:.1f} px expected in the middle of the volume"
    wrong = sample.diameter_px != sample.expected_px and abs(usual / sample.expected_px - 1) >= VOLUME
    advice = f"check sphere.diameter and the camera, or set locate.diameter_px to {usual:.0f}"
    return judged(title, measured, (wrong, FAULT, advice))
