"""Checks of each movie: files, pictures, background, ball, exposure, sharpness, motion blur."""

import math
import os
from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import Reason
from sphereorient.experiment.experiment import Experiment, outside_paths
from sphereorient.experiment.timeline import NONE, Timeline
from sphereorient.locate.outline import Outline
from sphereorient.preflight.finding import FAULT, WARNING, Finding, judged, warning
from sphereorient.preflight.sample import MovieSample
from sphereorient.trajectory import span_words

MANY = 0.5  # share of bad frames above which a movie is a fault
BALL_SEEN = 0.8  # share of the frames in which the ball should be found
STAYS = 0.5  # share of the frames in which the ball may cover one pixel
INSIDE = 0.9  # of the radius: the disk whose grey levels count
SATURATED, MUCH_SATURATED = 0.03, 0.2  # share of the ball's pixels; reflections are 1 % in a good movie
BLACK = 0.2  # share of the ball's pixels at level 0
RANGE = 0.12  # of full scale: the least distance of black and white paint
SIGNAL = 10.0  # white minus black paint, in standard deviations of the noise
SOFT_PX, SOFT_SHARE = 1.3, 0.035  # standard deviation of the limb's blur: px, and as share of the radius
SMEAR_PX = 2.0  # motion of the ball during an exposure
INTERPOLATION_PX2 = 1 / 6  # variance that linear interpolation adds: that of a triangle two pixels wide
AROUND, REACH, FINE = 90, 7.0, 0.25  # directions, px to both sides, px between samples of the limb's profile
REMEDY = {
    Reason.UNDECODABLE: "export the movie again; the frames that cannot be decoded are left out of the track",
    Reason.DARK: "light the ball more, open the lens, or expose longer",
    Reason.SATURATED: "close the lens or expose shorter: white paint must stay below the brightest level",
    Reason.REPEATED: "export the movie without a change of frame rate; the repeated frames are left out of the track",
    Reason.NOT_FOUND: "check sphere.diameter, or set locate.diameter_px; give backgrounds: if the ball hardly moves",
    Reason.OUTLINE: "give backgrounds: pictures of the scene without the ball; check sphere.diameter and the light",
}


def frames(experiment: Experiment, timeline: Timeline) -> Finding:
    """Report number, duration and rate of the frames, and the remarks of the timeline."""
    count = len(timeline)
    measured = f"{count} of {', '.join(experiment.movie_paths)}"
    if count > 1:
        pace = f"{1 / timeline.frame_s:.6g} Hz" if timeline.even else f"uneven, usually {1 / timeline.frame_s:.6g} Hz"
        measured += f"; {timeline.time_s[-1] - timeline.time_s[0] + timeline.frame_s:.4g} s, {pace}"
    advice = "check start: and frames: if the cameras began and ended together"
    return judged("frames", "; ".join([measured, *timeline.remarks]), (bool(timeline.remarks), WARNING, advice))


def outside(experiment: Experiment) -> list[Finding]:
    """Report files outside the folder of the experiment."""
    paths = [os.path.relpath(path, experiment.folder) for path in outside_paths(experiment)]
    measured = f"not in the folder of {experiment.path.name}: {', '.join(paths)}"
    found = warning("files elsewhere", measured, "check these paths if somebody else made the experiment")
    return [found] if paths else []


def movie_file(sample: MovieSample) -> Finding:
    """Report the contents of a movie file, and the remarks of its reader."""
    movie = sample.stream.movie
    height, width = movie.frame_shape
    brightest = f"brightest level {sample.background.full_scale:.0f}"
    measured = f"{movie.path.name}: {len(movie)} pictures of {width} x {height} px, {brightest}"
    complaint = (bool(movie.remarks), WARNING, "record or export the movie again if this is not intended")
    return judged(f"movie {sample.name}", "; ".join([measured, *movie.remarks]), complaint)


def pictures(samples: Sequence[MovieSample]) -> Finding:
    """Count the sampled frames of one camera that cannot show a ball; each sample is of consecutive frames."""
    seen: dict[int, Reason] = {}
    for sample in samples:
        for row, reason in zip(sample.row.tolist(), sample.screen, strict=True):
            # A frame in two samples counts as repeated if it repeats its neighbour in either.
            if row != NONE and seen.get(row, Reason.OK) is Reason.OK:
                seen[row] = reason
    title = f"pictures {samples[0].name}"
    bad = {row: reason for row, reason in sorted(seen.items()) if reason is not Reason.OK}
    if not bad:
        return judged(title, f"{len(seen)} frames sampled: all readable, none black, white or repeated")
    counts = Counter(bad.values()).most_common()
    words = ", ".join(f"{count} {reason}" for reason, count in counts)
    measured = f"of {len(seen)} frames sampled: {words} (the first: picture {next(iter(bad))} of the movie)"
    severity = FAULT if len(bad) > MANY * len(seen) else WARNING
    return judged(title, measured, (True, severity, REMEDY[counts[0][0]]))


def ball(sample: MovieSample) -> Finding:
    """Count the frames with a ball and the reasons for the others; name the frames without a ball."""
    title, none = f"ball {sample.name}", np.array([why is Reason.NOT_FOUND for _, why in sample.found])
    usable = [k for k, reason in enumerate(sample.screen) if reason in (Reason.OK, Reason.REPEATED)]
    if sample.in_place is not None:
        return judged(title, f"fixed: one outline for {len(usable)} frames")
    reasons = Counter(sample.found[k][1] for k in usable)
    seen, absent = reasons.pop(Reason.OK, 0), 0
    if seen:
        absent = reasons.pop(Reason.NOT_FOUND, 0)
    measured = f"found in {seen} of {len(usable) - absent} frames"
    if absent:
        measured += f"; no ball in view in {absent} more: {span_words(none, sample.frame)}"
    if reasons:
        measured += f" ({', '.join(f'{count} {reason}' for reason, count in reasons.most_common())})"
    remedy = REMEDY[reasons.most_common(1)[0][0] if reasons else Reason.NOT_FOUND]
    few = seen < BALL_SEEN * (len(usable) - absent)
    return judged(title, measured, (not seen, FAULT, remedy), (few, WARNING, remedy))


def background(sample: MovieSample, experiment: Experiment) -> Finding:
    """Report the source of the background: given, learnt from the movie, or guessed."""
    title = f"background {sample.name}"
    if sample.name in experiment.background_paths:
        return judged(title, f"given: {experiment.background_paths[sample.name].name}")
    advice = f"add backgrounds: {{{sample.name}: FILE}}, a picture of the scene without the ball"
    if experiment.sphere.in_place:
        return warning(title, "none given: the background of a fixed ball is guessed from its surroundings", advice)
    if sample.stream.photograph:
        return judged(title, "one picture: guessed from the surroundings of the ball")
    balls = [outline.circle for _, outline in sample.balls]
    covers = (sum((u - x) ** 2 + (v - y) ** 2 < r**2 for x, y, r in balls) / len(balls) for u, v, _ in balls)
    share = max(covers, default=0.0)
    measured = f"learnt from the movie: the ball covers no pixel in more than {100 * share:.0f} % of the frames"
    return judged(title, measured, (share > STAYS, WARNING, advice))


def exposure(sample: MovieSample) -> Finding:
    """Judge the grey levels of the ball."""
    title, values = f"exposure {sample.name}", []
    for picture, outline in sample.balls:
        row, column = np.ogrid[: picture.shape[0], : picture.shape[1]]
        square = (row - outline.v_px) ** 2 + (column - outline.u_px) ** 2
        inside, shown = square < (INSIDE * outline.radius_px) ** 2, sample.stream.shown
        values.append(picture[inside if shown is None else inside & shown])
    if not any(map(len, values)):
        return judged(title, "unknown: no ball was found")
    grey, full_scale, noise = np.concatenate(values), sample.background.full_scale, sample.background.typical_noise
    black, white = np.percentile(grey, [5, 95])
    signal = (white - black) / max(noise, 1e-9)
    saturated, dark = float(np.mean(grey >= full_scale)), float(np.mean(grey == 0))
    measured = f"paint from {black:.0f} to {white:.0f} of {full_scale:.0f}; {100 * saturated:.1f} % of the ball "
    measured += f"saturated, {100 * dark:.1f} % at 0; noise {noise:.1f}, signal {signal:.0f} times that"
    faint = white - black < RANGE * full_scale or signal < SIGNAL
    alike = "light the ball more, or paint it with more contrast: black and white are hardly apart"
    return judged(
        title,
        measured,
        (saturated > MUCH_SATURATED, FAULT, REMEDY[Reason.SATURATED]),
        (saturated > SATURATED, WARNING, REMEDY[Reason.SATURATED]),
        (faint, WARNING, alike),
        (dark > BLACK, WARNING, "raise the camera's black level: dark paint is cut off at 0"),
    )


def sharpness(sample: MovieSample) -> Finding:
    """Judge the blur of the ball's limb."""
    title, blur_px = f"sharpness {sample.name}", limb_blur_px(sample)
    if math.isnan(blur_px):
        return judged(title, "unknown: too little of the limb stands out")
    radius_px = float(np.median([outline.radius_px for _, outline in sample.balls]))
    measured = f"the limb is blurred by {blur_px:.2f} px (standard deviation), on a ball of {2 * radius_px:.0f} px"
    advice = "focus on the ball, close the lens for more depth, or expose shorter"
    return judged(title, measured, (blur_px > max(SOFT_PX, SOFT_SHARE * radius_px), WARNING, advice))


def limb_blur_px(sample: MovieSample) -> float:
    """Return the blur of the ball's limb, standard deviation, px: optics, pixel and motion; NaN: not measurable."""
    offset = np.arange(-REACH, REACH + FINE / 2, FINE)
    profiles = [_profiles(sample, picture, outline, offset) for picture, outline in sample.balls]
    shifted = np.concatenate([np.zeros((0, len(offset))), *profiles])
    if len(shifted) < AROUND // 4:
        return math.nan
    mean = np.minimum.accumulate(np.median(shifted, axis=0))
    x84, x16 = (float(np.interp(-level, -mean, offset)) for level in (0.8413, 0.1587))
    return math.sqrt(max(0.0, ((x16 - x84) / 2) ** 2 - INTERPOLATION_PX2))


def _profiles(
    sample: MovieSample, picture: NDArray[np.generic], outline: Outline, offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return profiles across the limb, 1 inside and 0 outside, where the paint at the limb is even."""
    angle = np.arange(AROUND) * (2 * np.pi / AROUND)
    reach = outline.radius_px + offset
    u = (outline.u_px + np.cos(angle)[:, None] * reach).astype(np.float32)
    v = (outline.v_px + np.sin(angle)[:, None] * reach).astype(np.float32)
    difference = sample.background.difference(picture)
    profile = cv2.remap(difference, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    within, beyond = profile[:, offset < -3.0], profile[:, offset > 3.0]
    inside, outside = within.mean(1), beyond.mean(1)
    step = inside - outside
    height, width = picture.shape
    whole = (u[:, -1] >= 0) & (u[:, -1] <= width - 1) & (v[:, -1] >= 0) & (v[:, -1] <= height - 1)
    clear = whole & (step > 12 * sample.background.typical_noise)
    even = (within.std(1) < 0.12 * step) & (beyond.std(1) < 0.12 * step) & clear
    share = (profile[even] - outside[even, None]) / step[even, None]
    # The last sample of each profile above a half.
    last = share.shape[1] - 1 - (share[:, ::-1] > 0.5).argmax(1)
    shifted = []
    for one, k in zip(share, last, strict=True):
        if 0 < k < len(offset) - 1:
            crossing = offset[k] + FINE * (one[k] - 0.5) / max(one[k] - one[k + 1], 1e-9)
            if abs(crossing) < 2.5:
                shifted.append(np.interp(offset + crossing, offset, one))
    return np.asarray(shifted).reshape(-1, len(offset))


def motion_blur(sample: MovieSample, exposure_s: float | None, frame_s: float) -> Finding:
    """Judge the motion of the ball during an exposure, measured between consecutive frames."""
    title = f"motion blur {sample.name}"
    # The centre of a disk cut by the border is too uncertain to measure motion.
    centre = sample.sightings.centre_px.where(sample.whole[:, None], torch.nan)
    neighbours = np.flatnonzero(np.diff(sample.frame) == 1)
    moved = (centre[neighbours + 1] - centre[neighbours]).norm(dim=-1).numpy()
    moved = moved[np.isfinite(moved)]
    if not len(moved):
        return judged(title, "unknown: no two consecutive frames show the whole ball")
    usual, fast = np.percentile(moved, [50, 95])
    measured = f"the ball moves {usual:.2f} px a frame, {fast:.2f} at its fastest"
    if exposure_s is None:
        return judged(title, measured + "; exposure: is not given")
    share = exposure_s / frame_s
    measured += f"; {share * usual:.2f} and {share * fast:.2f} px during an exposure"
    return judged(title, measured, (share * fast > SMEAR_PX, WARNING, "expose shorter, with more light"))
