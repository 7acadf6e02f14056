"""Paints of an experiment: search for balls before their light is known, and frames to learn it from."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment.recording import CameraStream, Recording
from sphereorient.files.threads import Progress
from sphereorient.follow.appearance import Among, Following
from sphereorient.follow.appearance.light import estimate_blur_px
from sphereorient.follow.follower import frames_at, frames_showing, sample_frames
from sphereorient.follow.initialise import UNPROVEN, Initialiser
from sphereorient.follow.scene_start import SceneStart
from sphereorient.follow.settings import RefineSettings
from sphereorient.follow.tracker import among_found
from sphereorient.locate import Frame, find_scenes, known_diameter_px
from sphereorient.methods.method import Job
from sphereorient.methods.proposers import BlurMatchedSearch, finest_table
from sphereorient.methods.settings import Settings
from sphereorient.pose import CameraView
from sphereorient.pose.camera_view import FIRST_BLUR_PX, defocus_radii
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.neighbours import spoilt
from sphereorient.pose.poses import Poses
from sphereorient.sphere.texture_table import TextureTable

MOSTLY_SEEN = 0.5  # least share of a disk that is visible to each camera, in frames to learn light from
MORE_FRAMES = 2  # times those of a single ball, as others hide it in some


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """Balls of one map and diameter, indistinguishable in pictures."""

    names: Sequence[str]
    base: TextureTable  # finest table of the map
    search: BlurMatchedSearch
    first: Initialiser  # with assumed blur and light


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintSample:
    """n frames from which the appearance of a paint is estimated."""

    first: Initialiser  # of this paint
    frames: Sequence[Sequence[Frame]]  # n of C
    places: Sequence[int]  # n, among the frames in use
    among: Among | None = None  # poses of balls with others beside them


def alike(recording: Recording) -> list[list[str]]:
    """Return the names of the balls, grouped by map and diameter."""
    kinds: list[list[str]] = []
    for name in recording.experiment.names:
        own = recording.of(name)
        for names in kinds:
            other = recording.of(names[0])
            same = own.experiment.radius_mm == other.experiment.radius_mm
            if same and torch.equal(own.texture, other.texture):
                names.append(name)
                break
        else:
            kinds.append([name])
    return kinds


def open_views(
    recording: Recording, stream: CameraStream, settings: Settings, progress: Progress
) -> dict[str, CameraView]:
    """Estimate one camera's background; return the view of each ball by name."""
    stage = f"{stream.name}: background"
    progress(stage, 0, 1)
    found = find_scenes(recording, stream, settings.refine.background_frames, settings.locate)
    progress(stage, 1, 1)
    first = CameraView.of(stream.name, stream.camera, next(iter(found.values())))
    # The lines of sight are computed once.
    return {name: replace(first, diameter_px=scene.diameter_px) for name, scene in found.items()}


def open_paints(job: Job, progress: Progress) -> list[Paint]:
    """Estimate the backgrounds; at the same time build finest table and template bank of each paint."""
    recording, settings = job.recording, job.settings
    blur_px = settings.refine.blur_px or FIRST_BLUR_PX
    with ThreadPoolExecutor(2) as pool:  # decoding, sorting and products release the interpreter lock
        opening = [pool.submit(open_views, recording, stream, settings, progress) for stream in recording.streams]
        tables, searches = [], []
        for names in (kinds := alike(recording)):
            own = recording.of(names[0])
            known = [known_diameter_px(own, stream, settings.locate) for stream in recording.streams]
            sizes = [px or views.result()[names[0]].diameter_px for px, views in zip(known, opening, strict=True)]
            cameras = [stream.camera for stream in recording.streams]
            search = BlurMatchedSearch(own.texture, settings, list(zip(cameras, sizes, strict=True)))
            tables.append(pool.submit(finest_table, own.texture, search.diameter_px, own.unseen))
            searches.append((search, pool.submit(search.of, settings.refine.blur_px or 0.0)))
        each = [views.result() for views in opening]
        paints = []
        for names, base, (search, bank) in zip(kinds, tables, searches, strict=True):
            bank.result()
            views = [of_camera[names[0]] for of_camera in each]
            fitter = first_fitter(views, recording.of(names[0]).experiment.radius_mm, base.result(), blur_px)
            first = search.start(fitter, blur_px)
            paints.append(Paint(names=names, base=base.result(), search=search, first=first))
    return paints


def paint_samples(recording: Recording, refine: RefineSettings, paints: Sequence[Paint]) -> Iterator[PaintSample]:
    """Yield the frames from which the appearance of each paint is estimated.
    Raises ExperimentError: no frame shows a ball mostly unhidden in all cameras that see it.
    """
    if recording.experiment.alone:
        yield _alone(recording, refine, paints[0])
        return
    first = {name: paint.first for paint in paints for name in paint.names}
    views = paints[0].first.fitter.views
    frames, places = sample_frames(recording, views, MORE_FRAMES * refine.appearance_frames)
    start = SceneStart(first)
    found = [start(frame, list(first), {}) for frame in frames]
    for paint in paints:
        rows = _mostly_seen(paint, first, found)
        # Shuffled: light is judged from halves, and each half should contain all balls at all times.
        rows = [rows[k] for k in np.random.default_rng(0).permutation(len(rows))]
        if not rows:
            do = "check the texture and diameter of this ball, and whether it is in view"
            what = f"ball {' or '.join(paint.names)}"
            raise ExperimentError(refusal(what, expected="some frames that show it", got="none", do=do))
        yield PaintSample(
            first=paint.first,
            frames=[frames[k] for k, _ in rows],
            places=[places[k] for k, _ in rows],
            among=Among(
                found=[found[k][name] for k, name in rows],
                neighbours=among_found([(name, found[k]) for k, name in rows], first),
            ),
        )


def _alone(recording: Recording, refine: RefineSettings, paint: Paint) -> PaintSample:
    """Return frames with the only ball; unless a blur is given, the search uses their blur."""
    first = replace(paint.first, score_min=UNPROVEN, known={})
    assert first.known is not None
    views = first.fitter.views
    frames, places = frames_showing(recording, views, refine.appearance_frames, first.disks)
    shown = {id(shot.picture) for frame in frames for shot in frame}
    first = replace(first, known={key: one for key, one in first.known.items() if key[0] in shown})
    if refine.blur_px is None:
        pairs = (pair for frame in frames for pair in zip(frame, first.disks(frame), strict=True))
        blur_px = estimate_blur_px((shot.picture, disk) for shot, disk in pairs if disk is not None)
        # Only blurred pictures need blurred templates; sharp ones share one first guess.
        if defocus_radii(blur_px, paint.search.diameter_px):
            fitter = first_fitter(views, first.fitter.radius_mm, paint.base, blur_px)
            first = paint.search.start(fitter, blur_px, score_min=UNPROVEN, known=first.known)
    return PaintSample(first=first, frames=frames, places=places)


def _mostly_seen(
    paint: Paint, first: Mapping[str, Initialiser], found: Sequence[Mapping[str, Poses]]
) -> list[tuple[int, str]]:
    """Return frames and names of balls of a paint that are mostly unhidden in all cameras that see them."""
    rows = []
    for k, there in enumerate(found):
        for name in paint.names:
            if name not in there or not len(there[name]):
                continue
            poses = there[name]
            fitter, fine = paint.first.fitter, paint.first.fitter.optics.fine
            X = poses.position_lab_mm[:1]
            middle_px, radius_px, _ = fitter.disks_px(X)
            places = fitter.places(X, fine, fitter.stencil(fine, float(radius_px)), middle_px)
            share = spoilt(places, among_found([(name, there)], first)).left[0]
            if bool((share[poses.use] > MOSTLY_SEEN).all()):
                rows.append((k, name))
    return rows


def following(recording: Recording, sample: PaintSample, exposure_s: float) -> Following | None:
    """Return the neighbours of the frames of a study, for the motion in the exposure, s; None: unknown exposure."""
    clock, places = recording.clock, sample.places
    if not exposure_s > 0 or len(clock) < 2:
        return None
    beside = [place + 1 if place + 1 < len(clock) else place - 1 for place in places]
    return Following(
        frames=lambda rows: frames_at(recording, sample.first.fitter.views, [beside[k] for k in rows]),
        open_share=exposure_s / (clock[beside] - clock[places]),
    )
