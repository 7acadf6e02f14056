"""The check of several balls: how many disks each camera shows, which of the named balls are found, and their sizes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import PaintError
from sphereorient.experiment import Sphere
from sphereorient.experiment.recording import Recording, load_map
from sphereorient.files.threads import Progress, counted
from sphereorient.files.whole_file import relative_path
from sphereorient.follow.follower import sample_frames
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.scene_start import EXPLAINED, SceneFound, SceneStart
from sphereorient.locate import Frame, find_disks
from sphereorient.locate.outline import Outline
from sphereorient.methods.method import Job
from sphereorient.methods.paint import open_paints
from sphereorient.methods.settings import Settings
from sphereorient.preflight import texture_map
from sphereorient.preflight.cameras import BAD, OUTLINE_PX, off_size
from sphereorient.preflight.finding import FAULT, WARNING, Finding, judged, warning
from sphereorient.preflight.movies import BALL_SEEN
from sphereorient.sphere.compare import compare_maps

WHOLE = 0.7  # least share of the rim from which a ball's size is measured


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneView:
    """A picture of one camera with the disks in it, and the balls found; read by the figure."""

    name: str
    frame: int  # among the frames in use
    picture: NDArray[Any]  # (H, W)
    disks: tuple[Outline, ...]
    balls: Mapping[str, tuple[float, float]]  # centre, px


def look_at_scene(
    recording: Recording, settings: Settings, progress: Progress
) -> tuple[tuple[SceneView, ...], list[Finding]]:
    """Look for the balls of an experiment in a few frames; return a picture of each camera, and the findings."""
    spheres = recording.experiment.spheres
    missing = [one for one in spheres if one.texture_path is None or not one.texture_path.exists()]
    if missing:
        return (), [_no_map(sphere) for sphere in missing]
    loaded = {path: load_map(path) for path in dict.fromkeys(one.texture_path for one in spheres) if path is not None}
    maps = {one.name: loaded[one.texture_path] for one in spheres if one.texture_path is not None}
    job = Job(recording=replace(recording, maps=maps), settings=settings, device=torch.device("cpu"))
    first = {name: paint.first for paint in open_paints(job, progress) for name in paint.names}
    balls = {name: first[name] for name in recording.experiment.names}
    cameras = next(iter(balls.values())).fitter.views
    frames, places = sample_frames(job.recording, cameras, texture_map.FRAMES)
    start, found, disks = SceneStart(balls), [], []
    for frame in counted("balls", frames, len(frames), progress):
        disks.append(_disks(frame, balls))
        found.append(start(frame, list(balls), {}))
    best = max(range(len(frames)), key=lambda k: sum(len(one) > 0 for one in found[k].values()))
    seen = tuple(
        SceneView(
            name=view.name,
            frame=places[best],
            picture=np.asarray(shot.picture[:, :]),
            disks=tuple(disks[best][c]),
            balls={
                name: _middle(balls[name], one.position_lab_mm[0], c) for name, one in found[best].items() if len(one)
            },
        )
        for c, (view, shot) in enumerate(zip(cameras, frames[best], strict=True))
        if shot.usable
    )
    named = {relative_path(path, job.recording.experiment.folder): one for path, one in loaded.items()}
    contrasts = {
        name: texture_map.judge_contrast(texture_map.measure_texture(one.grey), _least_px(balls))
        for name, one in named.items()
    }
    if len(loaded) > 1:
        contrasts = {name: replace(one, title=f"{one.title} {name}") for name, one in contrasts.items()}
    one_paint = same_paint({name: one.grey for name, one in named.items()}, progress)
    sizes = ball_sizes(found, disks, balls)
    return seen, [*disk_counts(disks, balls), *found_balls(found, balls), *sizes, *contrasts.values(), *one_paint]


def _no_map(ball: Sphere) -> Finding:
    path = ball.texture_path
    measured = "no texture map is given" if path is None else f"no texture map: {path} is not there"
    do = f"learn it with `sphereorient map`, or correct spheres.{ball.name}.texture"
    return judged(f"paint of ball {ball.name}", measured, (True, FAULT, do))


def same_paint(maps: Mapping[str, Tensor], progress: Progress) -> Iterator[Finding]:
    """Yield a warning for maps of two files that show the same paint, in any body frames."""
    pairs = list(combinations(maps, 2))
    for one, other in counted("maps", pairs, len(pairs), progress):
        try:
            alike = compare_maps(maps[one], maps[other]).correlation
        except PaintError:
            continue
        measured = f"both show the same paint (correlation {alike:.2f})"
        do = "name one map for all balls of this paint; else `track` may exchange these balls without a warning"
        yield warning(f"paint of {one} and {other}", measured, do)


def _disks(frames: Sequence[Frame], balls: Mapping[str, Initialiser]) -> list[list[Outline]]:
    each, found = list(balls.values()), []
    for c, shot in enumerate(frames):
        sizes = [one.fitter.views[c].diameter_px for one in each]
        background = each[0].fitter.views[c].background
        found.append(find_disks(shot.picture, background, sizes, each[0].locating) if shot.usable else [])
    return found


def _middle(ball: Initialiser, position_lab_mm: Tensor, camera: int) -> tuple[float, float]:
    u, v = ball.fitter.views[camera].camera.project(position_lab_mm).tolist()
    return u, v


def _least_px(balls: Mapping[str, Initialiser]) -> float:
    return min(view.diameter_px / 2 for one in balls.values() for view in one.fitter.views)


def disk_counts(disks: Sequence[Sequence[Sequence[Outline]]], balls: Mapping[str, Initialiser]) -> Iterator[Finding]:
    """Compare the number of disks of each camera with the number of balls."""
    for c, view in enumerate(next(iter(balls.values())).fitter.views):
        counts = [len(one[c]) for one in disks]
        measured = f"{median(counts):g} disks in the usual frame ({min(counts)} to {max(counts)}), {len(balls)} named"
        more = "name the other balls under `spheres`; mask round objects that are no balls (`sphereorient mark`)"
        fewer = "remove absent balls from `spheres`; give backgrounds: if the balls hardly move"
        complaints = (median(counts) > len(balls), WARNING, more), (max(counts) < len(balls), WARNING, fewer)
        yield judged(f"balls {view.name}", measured, *complaints)


def found_balls(found: Sequence[SceneFound], balls: Mapping[str, Initialiser]) -> Iterator[Finding]:
    """Count the frames in which each ball is found by its paint."""
    for name in balls:
        count = sum(len(one[name]) > 0 for one in found)
        none = f"check texture and diameter under spheres.{name}, or remove it if it is absent"
        few = "it is hidden, out of view, or its paint is not the named map"
        measured = f"found by its paint in {count} of {len(found)} frames"
        complaints = (not count, FAULT, none), (count < BALL_SEEN * len(found), WARNING, few)
        yield judged(f"ball {name}", measured, *complaints)


def ball_sizes(
    found: Sequence[SceneFound], disks: Sequence[Sequence[Sequence[Outline]]], balls: Mapping[str, Initialiser]
) -> Iterator[Finding]:
    """Compare the diameters of balls that several cameras see with the named ones."""
    ratios: dict[str, float] = {}
    for name, ball in balls.items():
        seen = [
            disk.radius_px / float(view.radius_px(poses[name].position_lab_mm[:1], ball.fitter.radius_mm)[0])
            for poses, frame in zip(found, disks, strict=True)
            if len(poses[name]) and int(poses[name].use.sum()) > 1
            for c, view in enumerate(ball.fitter.views)
            for disk in frame[c]
            if disk.coverage > WHOLE
            and math.dist((disk.u_px, disk.v_px), _middle(ball, poses[name].position_lab_mm[0], c))
            < EXPLAINED * disk.radius_px
        ]
        if seen:
            ratios[name] = median(seen)
    named = {name: 2 * balls[name].fitter.radius_mm for name in ratios}
    measured = {name: ratio * named[name] for name, ratio in ratios.items()}
    tolerance = OUTLINE_PX / _least_px(balls)
    for name, mm in measured.items():
        error = abs(ratios[name] - 1)
        other = next((one for one in measured if _exchanged(name, one, measured, named)), None)
        advice = f"measure it: spheres.{name}.diameter {mm:.3g} would fit"
        if other is not None:
            advice = f"the diameters, or the textures, of {name} and {other} are exchanged: correct `spheres`"
        words = f"{mm:.4g} mm in the pictures, {named[name]:g} mm named"
        yield judged(f"size of ball {name}", words, *off_size(error, tolerance, advice))


def _exchanged(one: str, other: str, measured: Mapping[str, float], named: Mapping[str, float]) -> bool:
    """Return whether the measured diameters of two balls are those named for the other."""
    swapped = all(abs(measured[a] / named[b] - 1) < BAD for a, b in ((one, other), (other, one)))
    return swapped and abs(named[one] / named[other] - 1) > BAD
