"""The map, the attitudes and the light from the movies, on one page."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.experiment.recording import Progress, Recording
from sphereorient.locate import LocateSettings
from sphereorient.mapping.begin import Start, start_from_movie, start_from_photographs
from sphereorient.mapping.footage import Footage, take_footage
from sphereorient.mapping.grid import look_up
from sphereorient.mapping.record import LearntMap, Round
from sphereorient.mapping.rounds import LIGHT_ROUNDS, Stage, fitted, map_weight, measured, next_round
from sphereorient.mapping.settings import PaintSettings
from sphereorient.mapping.sharpen import sharpened
from sphereorient.pose.fit import FittedPoses
from sphereorient.pose.fitter import CameraView, widest_px
from sphereorient.synth.textures import map_directions

# Cosine of the slant up to which a picture shows a place. More slanted it tells of the paint, but what was never seen
# better is displaced by a degree and more (measured: rms 0.74 degrees with places down to 0.2, 0.15 from 0.4 on).
SHOWN_MIN = 0.4
FINER = 2  # the map that comes out has so many times the rows of the fitted one: it is sharper
RECOVERED = (3, 6)  # rounds after which instants that do not fit are looked for again
GOOD_SHARE = 0.85  # of the usual score, from which on an instant fits
RECOVERY_STEPS = 5  # at each width of detail


def learn_map(recording: Recording, settings: PaintSettings, locating: LocateSettings, progress: Progress) -> LearntMap:
    """Learn the map of the paint and all attitudes from movies alone.

    Args:
        recording: the movies, opened; `recording.Recording` is one. Its texture is not looked at.
        settings: of the room.
        locating: how outlines are found.
        progress: told how far each stage is.

    Returns:
        The map; see `LearntMap` for the body frame it is in.

    Raises:
        ExperimentError: the ball is not found.
        PaintError: one frame only, a sphere that never turns, nothing seen twice, or cameras that see different balls;
            of photographs (the setting `unordered`): fewer than three that share paint, or those of two balls.

    Source: direct alignment of pictures (Lucas and Kanade 1981) on the sphere, a pose graph, and bundle adjustment on
    grey values with the map among the unknowns.
    """
    return learn_from(take_footage(recording, settings, locating, progress), settings, progress)


def learn_from(footage: Footage, settings: PaintSettings, progress: Progress) -> LearntMap:
    """Learn a map from footage; see `learn_map`."""
    begin = start_from_photographs if settings.unordered else start_from_movie
    start = begin(footage, settings, progress)
    stage, chain = start.stage, start.chain.R_lab_body[start.rows]
    rounds: list[Round] = []
    for k in range(settings.rounds):
        progress("map", k, settings.rounds)
        stage, done = next_round(stage, settings, k)
        rounds.append(done)
        if k in RECOVERED:
            stage = recovered(start.footage, stage, chain)
        if k >= LIGHT_ROUNDS and done.moved_rad < math.radians(settings.arrived_deg):
            break
    progress("map", settings.rounds, settings.rounds)
    arrived = rounds[-1].moved_rad < math.radians(settings.arrived_deg)
    return _finished(start, stage, tuple(rounds), arrived)


def _finished(start: Start, stage: Stage, rounds: tuple[Round, ...], arrived: bool) -> LearntMap:
    """Put everything into the noun that comes out."""
    footage, frames, rows, chain = start.footage, start.frames, start.rows, start.chain
    count, cameras = footage.seen.shape
    stage, fit = measured(footage, stage)
    all_R = followed(chain.R_lab_body, rows, stage.R_lab_body)
    # The body frame is the lab's at the first instant: R_new = R Q^T, and new directions are Q times the old.
    Q = all_R[0].clone()
    texture, seen, sigma = finished_map(stage, Q)
    nothing = torch.full((count, 3, 3), torch.nan, dtype=torch.float64)
    R, X = nothing.clone(), nothing[:, 0].clone()
    found = footage.seen.any(1)  # photographs that share no paint with the others have a place and no attitude
    R[frames], X[found] = so3.nearest_rotation(all_R @ Q.mT), footage.position_lab_mm[found]
    X[frames[rows]] = stage.position_lab_mm
    score = torch.full((count, cameras), torch.nan, dtype=torch.float64)
    score[frames[rows]] = torch.where(stage.use, fit.score, torch.nan)
    valid, told = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    valid[frames], told[frames[rows]] = True, True
    return LearntMap(
        texture=texture,
        seen=seen,
        sigma=sigma,
        R_lab_body=R,
        position_lab_mm=X,
        valid=valid,
        fitted=told,
        score=score,
        views=footage.views,
        light=stage.fitter.light,
        blur_px=stage.blur_px,
        closure=chain.closure,
        rounds=rounds,
        arrived=arrived,
    )


def followed(chain: Tensor, rows: Tensor, told: Tensor) -> Tensor:
    """Return attitudes of all instants: those of some as given, the others turned as their neighbours were.

    Args:
        chain: (M, 3, 3), all as the chain has them.
        rows: (n,) int64, rising, of the given ones.
        told: (n, 3, 3).
    """
    off = so3.log(told @ chain[rows].mT)
    at = torch.arange(len(chain)).clamp(int(rows[0]), int(rows[-1]))
    upper = torch.searchsorted(rows, at).clamp(0, len(rows) - 1)
    lower = (upper - 1).clamp_min(0)
    span = (rows[upper] - rows[lower]).clamp_min(1)
    share = ((at - rows[lower]).double() / span).clamp(0, 1)[:, None]
    R = so3.exp(off[lower] * (1 - share) + off[upper] * share) @ chain
    R[rows] = told
    return R


def recovered(footage: Footage, stage: Stage, chain: Tensor) -> Stage:
    """Put instants that do not fit where the chain, corrected as their neighbours were, says they are, and fit again.

    Args:
        footage: with the pictures.
        stage: n instants.
        chain: (n, 3, 3), as the chain has them.
    """
    score = _scores(fitted(stage, 1)[1], stage.use)
    good = score >= GOOD_SHARE * score.nanmedian()
    if good.all() or not good.any():
        return stage
    lost = torch.nonzero(~good)[:, 0]
    R = followed(chain, torch.nonzero(good)[:, 0], stage.R_lab_body[good])[lost]
    X, use = stage.position_lab_mm[lost], stage.use[lost]
    fitter = stage.map_fitter()
    pictures = footage.pictures(stage.frames[lost])
    for level in (fitter.optics.coarse, fitter.optics.middle, fitter.optics.fine):
        fit = fitter.fit(fitter.pixels(pictures, X, level), X, R, use, level, RECOVERY_STEPS)
        R, X = fit.R_lab_body, X if stage.fixed else fit.position_lab_mm
    better = _scores(fit, use) > score[lost]
    new_R, new_X = stage.R_lab_body.clone(), stage.position_lab_mm.clone()
    new_R[lost[better]], new_X[lost[better]] = R[better], X[better]
    return replace(stage, R_lab_body=new_R, position_lab_mm=new_X)


def _scores(fit: FittedPoses, use: Tensor) -> Tensor:
    """Mean score of the cameras that see each instant, (n,)."""
    return torch.where(use, fit.score, torch.nan).nanmean(1)


def finished_map(stage: Stage, Q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sharpen the map and turn it: texture, counts and sigma, (H, 2 H) each; new directions are Q times the old."""
    widest = widest_px(stage.fitter.views)
    height = FINER * len(stage.texture)
    direction = map_directions(height) @ Q  # Q^T d: where the fitted map holds the new texel
    texture = look_up(sharpened(stage.texture, 2 * stage.blur_px / widest), direction).clamp(0, 1)
    weight = look_up(map_weight(stage), direction)
    seen = _counts(stage, direction)
    unknown = (seen == 0) | (weight <= 0)
    sigma = torch.where(unknown, torch.inf, weight.clamp_min(1e-30).rsqrt())
    return torch.where(unknown, torch.nan, texture).float(), torch.where(unknown, 0, seen), sigma.float()


def _counts(stage: Stage, direction_body: Tensor) -> Tensor:
    """Count the pictures that show each direction (..., 3) of the body, not too slanted."""
    seen = torch.zeros(direction_body.shape[:-1], dtype=torch.int64)
    for k, R in enumerate(stage.R_lab_body):
        for c, view in enumerate(stage.fitter.views):
            if not bool(stage.use[k, c]):
                continue
            camera = view.camera
            middle = -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm) - stage.position_lab_mm[k]
            far = float(middle.norm())
            towards = (direction_body @ (R.mT @ (middle / far))).float()
            # Cosine of the slant where the line of sight meets the ball: (D n.e - r) / |D e - r n|.
            away = (far**2 + stage.fitter.radius_mm**2 - 2 * far * stage.fitter.radius_mm * towards).sqrt()
            told = (far * towards - stage.fitter.radius_mm) / away > SHOWN_MIN
            if view.background.shown is not None:
                told &= _not_hidden(view, stage.position_lab_mm[k] + stage.fitter.radius_mm * (direction_body @ R.mT))
            seen += told
    return seen


def _not_hidden(view: CameraView, place_lab_mm: Tensor) -> Tensor:
    """Return which places (..., 3) nothing stands before in a camera's picture, (...)."""
    width, height = view.camera.image_size
    u, v = view.camera.project(place_lab_mm).nan_to_num().round().long().unbind(-1)
    shown = torch.from_numpy(view.background.shown)
    return shown[v.clamp(0, height - 1), u.clamp(0, width - 1)]
