"""Section III of the paper, corrected, step by step: each camera alone, then their fusion."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import assemble, locate, motion
from sphereorient.calibration.comparison import Seen
from sphereorient.calibration.contradictions import majority
from sphereorient.cameras import Camera, R_cam_view
from sphereorient.errors import Reason
from sphereorient.experiment.recording import CameraStream, Recording
from sphereorient.files.threads import Progress
from sphereorient.follow.follower import Follower
from sphereorient.locate import Sightings
from sphereorient.methods import results
from sphereorient.methods.method import Followed, Job, Joined, Method
from sphereorient.methods.proposers import paper_proposer
from sphereorient.methods.settings import Settings
from sphereorient.search import Candidates, Proposer, crop_disk

CHUNK = 64  # frames in memory; no effect on results


def _learn(job: Job, progress: Progress) -> None:
    """Learn nothing: the stages use the whole movie. Raises ExperimentError: several balls."""
    _ = job.recording.experiment.sphere


def track_paper(
    job: Job, follower: Follower | None, measured: Iterable[Followed], progress: Progress
) -> dict[str, Joined]:
    """Measure the movies as in the paper, on a regular time grid; `follower` and `measured` are unused."""
    settings = job.settings
    grid, place = job.recording.gridded()
    cameras, clock = grid.cameras, grid.clock
    sightings = {stream.name: locate_sphere(grid, stream, settings, progress) for stream in grid.streams}
    locate.check_seen(sightings)
    centre_px, radius_px = (
        torch.stack([getattr(one, name) for one in sightings.values()], 1) for name in ("centre_px", "radius_px")
    )
    agree = majority(Seen.of_outlines(cameras, centre_px, radius_px)) or range(len(sightings))
    counted = {name: one for k, (name, one) in enumerate(sightings.items()) if k in agree}
    positions = locate.find_positions(counted, cameras, grid.experiment.diameter_mm)
    proposer_of = cache(partial(paper_proposer, grid.texture, settings=settings))  # cameras of one scale share a bank
    candidates = {
        stream.name: propose_orientations(stream, sightings[stream.name], proposer_of, settings, progress)
        for stream in grid.streams
    }
    paths = assemble.assemble_paths(candidates, clock, settings.assemble)
    fused = assemble.fuse(paths, candidates, clock, settings.assemble)
    rate_hz = grid.experiment.frame_rate_hz
    moved = motion.measure_motion(
        positions.for_motion(),
        fused.R_lab_body,
        fused.segment,
        rate_hz if np.isfinite(rate_hz) else 1 / grid.timeline.frame_s,
        settings.motion,
        (positions.covariance_mm2.diagonal(dim1=-2, dim2=-1).sqrt(), fused.sigma_rad),
    )
    tracks = {name: results.paper_camera(sightings[name], candidates[name], paths[name]) for name in cameras}
    whole = results.paper_track(grid.experiment, clock, positions, fused, moved, tracks)
    return {grid.experiment.sphere.name: (whole if len(whole) == len(place) else whole.at(place), None)}


def locate_sphere(recording: Recording, stream: CameraStream, settings: Settings, progress: Progress) -> Sightings:
    """Find the sphere's outline in every frame of one camera, outliers replaced and short gaps filled."""
    stage = f"{stream.name}: locate"
    progress(stage, 0, len(stream))
    (scene,) = locate.find_scenes(recording, stream, settings.locate.background_frames, settings.locate).values()
    found: list[locate.Found] = []
    for done, shot in enumerate(locate.screened_frames(stream, scene.background), 1):
        if shot.usable:
            found.append(locate.find_ball(shot.picture, scene.background, scene.diameter_px, settings.locate))
        else:
            found.append((None, shot.reason))
        if done % CHUNK == 0 or done == len(stream):
            progress(stage, done, len(stream))
    return locate.fill_gaps(locate.sightings_of(found), settings.locate)


def propose_orientations(
    stream: CameraStream,
    sightings: Sightings,
    proposer_of: Callable[[int], Proposer],
    settings: Settings,
    progress: Progress,
) -> Candidates:
    """Propose orientations, lab, in frames with the sphere; `proposer_of`: the proposer for disks of a size, px."""
    stage = f"{stream.name}: orient"
    total = len(stream)
    progress(stage, 0, total)
    if not sightings.placed.any():
        return in_the_lab(Candidates.none(sightings.reason), stream.camera, sightings.centre_px)
    proposer = proposer_of(locate.size_of(sightings, settings.orient.size_px))
    # An interpolated position without a picture is useless.
    readable = torch.tensor([reason not in BLIND for reason in sightings.reason])
    placed = sightings.placed & readable
    proposals: list[Candidates] = []
    waiting: list[NDArray[np.float32]] = []
    done = 0
    for k, (picture, _) in enumerate(stream.pictures()):
        if placed[k] and picture is not None:
            u, v = sightings.centre_px[k].tolist()
            waiting.append(crop_disk(picture, u, v, float(sightings.radius_px[k]), proposer.size_px))
        if (k + 1) % CHUNK == 0 or k + 1 == total:
            found = proposer.propose(torch.from_numpy(np.stack(waiting))) if waiting else Candidates.none(())
            proposals.append(found.spread(placed[done : k + 1], sightings.reason[done : k + 1]))
            waiting, done = [], k + 1
            progress(stage, done, total)
    return in_the_lab(Candidates.joined(proposals), stream.camera, sightings.centre_px)


BLIND = (Reason.UNDECODABLE, Reason.MISSING, Reason.REPEATED, Reason.DARK, Reason.SATURATED)


def in_the_lab(proposals: Candidates, camera: Camera, centre_px: Tensor) -> Candidates:
    """Add R_lab_view of each frame, from the outline's centre (N, 2): removes the perspective (docs/errata.md A1)."""
    direction_cam = camera.rays(centre_px).direction_lab @ camera.R_cam_lab.mT
    return replace(proposals, R_lab_view=camera.R_cam_lab.mT @ R_cam_view(direction_cam))


PAPER = Method(learn=_learn, resume=None, join=track_paper)
