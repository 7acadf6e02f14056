import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import Camera, nearest_point
from sphereorient.cameras.checks import camera_error
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.cameras.response import Response
from sphereorient.errors import ExperimentError, SettingsError, refusal
from sphereorient.experiment.recording import CameraStream, Recording, given_scene
from sphereorient.files.threads import side_by_side
from sphereorient.locate.background import (
    FREE,
    LOUD,
    Background,
    even_scene,
    filled,
    full_scale_of,
    measure_background,
    without_ball,
)
from sphereorient.locate.disks import cover, find_disks
from sphereorient.locate.outline import Blob, Levels, Mask, Outline, fit_outline
from sphereorient.locate.settings import LocateSettings
from sphereorient.locate.sightings import find_ball

ROUNDS = 4  # most iterations; usually two suffice
RIM = 1.15  # of the radius, with halo and shadow
LOUD_SHARE = 0.1  # share of loud pixels in the disk that triggers `_quieter`
CHANGE_SIGMAS = 0.6745 * 2**0.5  # median difference of two normal numbers, in sigmas
CHANGES = 2.5  # times a pixel's typical scatter: moving texture
RIM_FIXED = 1.06  # of the radius: blur and halo of the rim
TOGETHER = 8  # consecutive frames, of the spread ones, in which a swaying ball counts as fixed
INPAINT_PX = 3.0  # radius of the surroundings from which a pixel is filled
LOOKED_AT = 32  # of the spread frames, for the outlines
ALIKE = 0.4  # of the largest area that changes: least area of another one
RING = 1.5  # of the radius: ring whose median grey replaces the background behind the sphere
BORDER = 0.03  # of the shorter side: border of a photograph, which shows the surroundings of the sphere
LARGEST, SMALLEST_PX, SIZES = 1.2, 30.0, 1.4  # of the shorter side; px, as paint of smaller balls is unreadable; ratio

OUTLINES_MIN = 8  # least number for a scatter
GIVEN_PX = 0.5  # error of a given outline
CHECK_POSE = "check R and T of the cameras (X_cam = R X_lab + T), and which movie belongs to which"
# A ball whose outlines scatter by more than all of these is not fixed: px; of the radius; of their errors.
WANDER_PX, WANDER_SHARE, WANDER_SURE = 1.0, 0.02, 2.0

DiskFinder = Callable[[NDArray[Any], Background], list[Outline]]  # disks in a picture (H, W)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraScene:
    """Background and expected diameter, px, of one camera."""

    background: Background
    diameter_px: float
    merit_min: float = 0.0  # least merit of a blob that may be the sphere; 0: unknown
    response: Response | None = None  # of the camera; None: unknown, grey levels count as light
    outline: Outline | None = None  # of a fixed ball, if it was searched


def known_diameter_px(recording: Recording, stream: CameraStream, settings: LocateSettings) -> float | None:
    """Return the expected diameter, px; None if only the pictures can show it; raises as `expected_diameter_px`."""
    if settings.diameter_px is not None:
        return settings.diameter_px
    experiment, cameras = recording.experiment, recording.cameras
    # Of one picture alone the distance is not known either.
    alone = recording.photograph and stream.name not in experiment.background_paths
    in_place = recording.photograph or experiment.sphere.in_place
    seen = len(cameras) > 1 or bool(stream.camera.project(torch.zeros(3, dtype=torch.float64)).isfinite().all())
    if alone or (in_place and (experiment.diameter_mm is None or not seen)):  # seen: the lab's origin
        return None
    return expected_diameter_px(stream.name, cameras, experiment.diameter_mm)


def find_scenes(
    recording: Recording, stream: CameraStream, count: int, settings: LocateSettings
) -> dict[str, CameraScene]:
    """Return one camera's scene for each sphere, by name, from `count` frames or from the given background: a common
    background, and a diameter for each.

    Raises:
        CameraError: a single telecentric camera, whose pictures do not show the depth.
        ExperimentError: a sphere declared fixed does not rotate in one place, or none in a photograph.
        SettingsError: unknown diameter.
    """
    if len(recording.streams) == 1 and isinstance(stream.camera, TelecentricCamera):
        expected, got = "a camera whose pictures show the depth", "a single telecentric one"
        do = "write model: pinhole and f_px: 1000 times the ball's diameter in px, for a far ball of uncertain depth"
        raise camera_error(f"camera {stream.name}", expected, got, do)
    each = {name: recording.of(name) for name in recording.experiment.names}
    sizes = {name: known_diameter_px(one, stream, settings) for name, one in each.items()}
    empty, background, outline = given_scene(recording.experiment, stream.name, stream.movie.frame_shape), None, None
    photograph = stream.photograph and recording.experiment.alone
    in_place = photograph or (recording.experiment.alone and recording.experiment.sphere.in_place)
    if in_place and (empty is None or None in sizes.values()):
        sways = not recording.experiment.fixed
        fixed = partial(fixed_ball, circle=recording.experiment.circles.get(stream.name))
        find = still_ball if photograph else swaying_ball if sways else fixed
        outline, guess = find(stream.spread(settings.background_frames), settings, empty, stream.shown)
        sizes = {name: px or 2 * outline.radius_px for name, px in sizes.items()}
        background, outline = guess if empty is None else None, None if sways else outline
    known = {name: px for name, px in sizes.items() if px is not None}
    if len(known) < len(sizes):
        do = "set locate.diameter_px, or give more frames"
        raise SettingsError(
            refusal(f"camera {stream.name}", expected="the balls' sizes in px", got="one picture", do=do)
        )
    if background is None:
        background = learn_background(stream.spread(count), tuple(known.values()), settings, empty, stream.shown)
    if stream.movie.full_scale is not None:  # the frames looked at may be dark
        background = replace(background, full_scale=max(background.full_scale, stream.movie.full_scale))
    scene = CameraScene(background=background, diameter_px=0.0, response=stream.response, outline=outline)
    return {name: replace(scene, diameter_px=px) for name, px in known.items()}


def expected_diameter_px(name: str, cameras: Mapping[str, Camera], diameter_mm: float | None) -> float:
    """Return the sphere's diameter, px, at the middle of the volume: nearest point of all axes, or lab origin.

    Raises:
        SettingsError: diameter unknown, or a single uncalibrated camera.
    """
    camera = cameras[name]
    do = "set locate.diameter_px to the diameter of the ball in the picture"
    if diameter_mm is None:
        raise SettingsError(refusal("sphere.diameter", expected="a number of mm", got="null", do=do))
    middle = torch.zeros(3, dtype=torch.float64)
    if len(cameras) > 1:
        axes = [each.rays((torch.tensor(each.image_size, dtype=torch.float64) - 1) / 2) for each in cameras.values()]
        middle, _ = nearest_point(axes)
    aside_lab = camera.across_lab(middle) * diameter_mm / 2
    rim = camera.project(torch.stack([middle - aside_lab, middle + aside_lab]))
    diameter_px = float((rim[1] - rim[0]).norm())
    if not 4 < diameter_px < max(camera.image_size):
        got = f"a sphere of {diameter_px:.3g} px in the middle of the volume"
        if math.isnan(diameter_px):
            got, do = "the middle of the volume out of its sight", CHECK_POSE if len(cameras) > 1 else do
        raise SettingsError(refusal(f"camera {name}", expected="a sphere that fits the picture", got=got, do=do))
    return diameter_px


def learn_background(
    pictures: NDArray[Any],
    diameter_px: float | Sequence[float],
    settings: LocateSettings,
    empty: Levels | None = None,
    shown: Mask | None = None,
) -> Background:
    """Estimate the background of frames (n, H, W): average, find the spheres, measure their pixels from other frames.
    `diameter_px`: of the sphere, or of all spheres. With `empty` (H, W), a given background, only the noise is
    measured. `shown` is False where the sphere is hidden.
    """
    sizes = tuple(diameter_px) if isinstance(diameter_px, Sequence) else (diameter_px,)
    several = len(sizes) > 1
    find = partial(find_disks if several else _only_disk, diameters_px=sizes, settings=settings)
    background = replace(measure_background(pictures, empty), shown=shown)
    if empty is not None:
        return _quieter(background, pictures, sizes, find)
    first, before = background, 0
    if several:  # spheres that stay long determine mean and noise, and hide themselves
        even = even_scene(first, max(sizes))
        covered, _ = _covered(pictures, even, find)
        first = filled(first, even, covered, max(sizes))
        background = without_ball(first, pictures, covered)
    for _ in range(ROUNDS):
        covered, found = _covered(pictures, background, find)
        background = without_ball(first, pictures, covered)
        if found <= before or found == len(pictures) * len(sizes):
            break
        before = found
    return background


def _quieter(background: Background, pictures: NDArray[Any], sizes: Sequence[float], find: DiskFinder) -> Background:
    """Limit the noise to the frame-to-frame change if spheres that never leave their pixels are not found otherwise."""
    loud = background.noise > LOUD * background.typical_noise
    if loud.sum() < LOUD_SHARE * np.pi / 4 * min(sizes) ** 2:
        return background
    found = sum(len(find(picture, background)) for picture in pictures)
    if 2 * found >= len(pictures) * len(sizes):
        return background
    changed = np.median(np.abs(np.diff(pictures[:, loud].astype(np.float32), axis=0)), axis=0) / CHANGE_SIGMAS
    noise = background.noise.copy()
    noise[loud] = np.clip(changed, background.typical_noise, noise[loud])
    return replace(background, noise=noise)


def _only_disk(
    picture: NDArray[Any], background: Background, diameters_px: Sequence[float], settings: LocateSettings
) -> list[Outline]:
    """Return the disk of a single sphere, if found."""
    outline, _ = find_ball(picture, background, diameters_px[0], settings)
    return [] if outline is None else [outline]


def _covered(pictures: NDArray[Any], background: Background, find: DiskFinder) -> tuple[Mask, int]:
    """Return the pixels of all disks found in frames (n, H, W), and their number."""
    covered, found = np.zeros(pictures.shape, bool), 0
    for picture, mask in zip(pictures, covered, strict=True):
        for disk in find(picture, background):
            cover(mask, disk, RIM, True)
            found += 1
    return covered, found


def given_outline(circle: tuple[float, float, float]) -> Outline:
    """Return a user's circle u, v, radius, px, as an outline."""
    return Outline(u_px=circle[0], v_px=circle[1], radius_px=circle[2], rms_px=GIVEN_PX, coverage=1.0)


def fixed_ball(
    pictures: NDArray[Any],
    locating: LocateSettings,
    empty: Levels | None = None,
    shown: Mask | None = None,
    circle: tuple[float, float, float] | None = None,
) -> tuple[Outline, Background]:
    """Find a rotating sphere with a fixed centre in frames (n, H, W), from the pixels that change.
    Return its outline, and the background with a guess behind it. `empty` (H, W): the scene without the sphere; `shown`
    (H, W) is False where something hides the sphere; `circle`: its outline u, v, radius, px, if given.

    Raises:
        ExperimentError: nothing round changes.
    """
    grey = pictures.astype(np.float32)
    middle = np.median(grey, axis=0)
    scatter = np.asarray(grey.std(axis=0), np.float32)
    if shown is not None:
        scatter = np.where(shown, scatter, np.float32(0))
    full_scale = full_scale_of(pictures)
    if circle is not None:
        given = given_outline(circle)
        return given, _around(given, Background(mean=middle, noise=scatter, full_scale=full_scale, shown=shown), empty)
    usual = float(np.median(scatter)) + 0.3 * full_scale / 255
    moved = (cv2.medianBlur(scatter, 5) > CHANGES * usual).astype(np.uint8)  # median filter, px, against single pixels
    count, labels, stats, centres = cv2.connectedComponentsWithStats(moved, connectivity=8)
    if count < 2:
        raise _none_fixed("nothing that changes")
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    inside = (labels == largest).astype(np.uint8)
    filled = np.sqrt(inside.sum() / np.pi)  # radius of a disk of equal area; some of it may be hidden
    around = filled if shown is None else cv2.minEnclosingCircle(np.asarray(cv2.findNonZero(inside)))[1]
    guess = locating.diameter_px or 2 * float(around)
    change = np.minimum(scatter, np.percentile(scatter[inside > 0], 30))  # limb without texture
    blob = Blob(u_px=float(centres[largest][0]), v_px=float(centres[largest][1]), merit=1.0)
    outline = fit_outline(change, 0.2 * usual, blob, guess, locating, shown)
    if outline is None or outline.coverage < locating.coverage_min:
        raise _none_fixed(_what_changes(stats[1:]))
    scene = Background(mean=middle, noise=scatter, full_scale=full_scale, shown=shown)
    return outline, _around(outline, scene, empty)


def wander_px(pictures: NDArray[Any], scene: CameraScene, locating: LocateSettings) -> float:
    """Return the scatter, robust sigma, of the outlines in frames (n, H, W) of a ball taken as fixed; 0 if small, or
    explained by the scatter of their edges.
    """
    one = partial(find_ball, background=scene.background, diameter_px=scene.diameter_px, settings=locating)
    seen = [ball for ball, _ in side_by_side(one, pictures) if ball is not None]
    if len(seen) < OUTLINES_MIN:
        return 0.0
    circles = np.array([ball.circle for ball in seen])
    away = np.abs(circles - np.median(circles, axis=0))[:, :2]
    wander = 1.4826 * float(np.hypot(*np.median(away, axis=0)))
    likely = np.median([ball.rms_px * (ball.spread[0][0] + ball.spread[1][1]) ** 0.5 for ball in seen])
    return wander if wander > max(WANDER_PX, WANDER_SHARE * scene.diameter_px / 2, WANDER_SURE * likely) else 0.0


def swaying_ball(
    pictures: NDArray[Any], locating: LocateSettings, empty: Levels | None = None, shown: Mask | None = None
) -> tuple[Outline, Background]:
    """Find a rotating sphere that sways, or moves slowly, in frames (n, H, W) in order of time, by taking its centre as
    fixed in a few of them. Return the median of its outlines, and the background with a guess where it always is.
    Arguments and errors as in `fixed_ball`.
    """
    together, seen = TOGETHER, dict[int, Outline]()  # by the middle frame of a few
    while 2 * len(seen) * together <= len(pictures):
        if together >= 2 * len(pictures):
            raise _none_fixed("no circle about what changes in a few frames")
        groups = np.array_split(np.arange(len(pictures)), max(1, len(pictures) // together))
        tried = {int(group[len(group) // 2]): _turning(pictures[group], locating, empty, shown) for group in groups}
        seen, together = {k: one for k, one in tried.items() if one is not None}, 2 * together
    some, middles = range(0, len(pictures), max(1, len(pictures) // LOOKED_AT)), np.array(list(seen))
    each = [seen[int(middles[np.abs(middles - k).argmin()])] for k in some]  # by the nearest group
    pictures, size_px = pictures[some], 2 * float(np.median([one.radius_px for one in seen.values()]))
    first, found = replace(measure_background(pictures, empty), shown=shown), 0
    for _ in range(ROUNDS):
        covered = np.zeros(pictures.shape, bool)
        for mask, disk in zip(covered, each, strict=True):
            cover(mask, disk, RIM_FIXED, True)
        background = first if empty is not None else _where_always(without_ball(first, pictures, covered), covered)
        now = [
            one
            for one, _ in side_by_side(
                partial(find_ball, background=background, diameter_px=size_px, settings=locating), pictures
            )
        ]
        if (count := sum(one is not None for one in now)) <= found:
            break
        each, found = [new or old for new, old in zip(now, each, strict=True)], count
    u, v, radius_px = np.median([disk.circle for disk in each], axis=0).tolist()
    return replace(each[0], u_px=u, v_px=v, radius_px=radius_px), background


def _turning(
    pictures: NDArray[Any], locating: LocateSettings, empty: Levels | None, shown: Mask | None
) -> Outline | None:
    """Return the outline of `fixed_ball`; None for a ball that rests, or moves too far in these frames."""
    try:
        return fixed_ball(pictures, locating, empty, shown)[0]
    except ExperimentError:
        return None


def _where_always(background: Background, covered: Mask) -> Background:
    """Return a background filled smoothly where a ball covers pixels in nearly all frames."""
    always = (len(covered) - covered.sum(0) < FREE).astype(np.uint8)
    noise = np.where(always > 0, np.float32(background.typical_noise), background.noise)
    mean = np.asarray(cv2.inpaint(background.mean, always, INPAINT_PX, cv2.INPAINT_TELEA), np.float32)
    return replace(background, mean=mean, noise=noise)


def still_ball(
    pictures: NDArray[Any], locating: LocateSettings, empty: Levels | None = None, shown: Mask | None = None
) -> tuple[Outline, Background]:
    """Find the sphere in a photograph, (1, H, W), which it may fill mostly, by the grey level of the border.
    Return its outline and background, as `fixed_ball`, with its other arguments.

    Raises:
        ExperimentError: nothing round differs from the border.
    """
    middle = pictures[0].astype(np.float32)
    wide = max(2, round(BORDER * min(middle.shape)))
    border = np.ones(middle.shape, bool)
    border[wide:-wide, wide:-wide] = False
    border = border & shown if shown is not None and (border & shown).any() else border
    scene = measure_background(pictures, np.full_like(middle, np.median(middle[border])))
    even = np.full_like(middle, 1.4826 * np.median(np.abs(middle[border] - scene.mean[0, 0])))
    noise = np.maximum(even, 0.3 * scene.full_scale / 255)
    scene = replace(scene, mean=scene.mean if empty is None else empty, noise=noise, shown=shown)
    size_px = locating.diameter_px or measured_size_px(pictures, scene, locating, LARGEST)
    outline = find_ball(pictures[0], scene, size_px, locating)[0] if size_px else None
    if outline is None:
        do = "leave a tenth of its radius around the ball, or set locate.diameter_px"
        raise ExperimentError(refusal("movies", expected="a photograph of a ball", got="nothing round", do=do))
    return outline, _around(outline, replace(scene, mean=middle), empty)


def measured_size_px(
    pictures: Sequence[NDArray[Any]] | NDArray[Any], background: Background, settings: LocateSettings, largest: float
) -> float | None:
    """Return the diameter, px, whose outlines in pictures (H, W) have the best coverage; None without outlines.
    `largest`: tried first, of the picture's shorter side.
    """
    searched = largest * min(background.mean.shape)
    best, size = 0.0, None
    while searched > SMALLEST_PX:
        outlines = [find_ball(picture, background, searched, settings)[0] for picture in pictures]
        seen = [outline for outline in outlines if outline is not None]
        merit = sum(outline.coverage for outline in seen)
        if merit > 1.05 * best:  # circles through paint are smaller than the outline: prefer the larger of equals
            best, size = merit, 2 * float(np.median([outline.radius_px for outline in seen]))
        searched /= SIZES
    return size


def _around(outline: Outline, scene: Background, empty: Levels | None) -> Background:
    """Return a scene with a ball replaced by the grey around it, or by the scene without it, if given."""
    row, column = np.ogrid[: scene.mean.shape[0], : scene.mean.shape[1]]
    away = np.hypot(row - outline.v_px, column - outline.u_px) / outline.radius_px
    ball, ring = away < RIM_FIXED, (away >= RIM_FIXED) & (away < RING)
    around = ring if ring.any() else ~ball
    mean, noise = scene.mean.astype(np.float32), np.maximum(scene.noise, 0.3).astype(np.float32)
    mean[ball], noise[ball] = np.median(scene.mean[around]), np.median(noise[around])
    return replace(scene, mean=mean if empty is None else empty, noise=noise)


def _what_changes(stats: NDArray[Any]) -> str:
    """Return a description of the largest connected regions that change."""
    left, top, width, height, area = stats[stats[:, cv2.CC_STAT_AREA].argsort()[::-1]].T
    alike = int((area > ALIKE * area[0]).sum())
    each = [
        f"{w} x {h} px about ({x + w // 2}, {y + h // 2})" for x, y, w, h in zip(left, top, width, height, strict=True)
    ]
    if alike == 1:
        return f"no circle about what changes, {each[0]}"
    return f"{alike} regions that change, the largest {each[0]} and {each[1]}"


def _none_fixed(got: str) -> ExperimentError:
    do = "check that one ball rotates in its place, mostly in view (sphere.fixed), or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected="a ball that rotates in its place", got=got, do=do))
