"""Whether a few pictures show the map: what it explains of them against what it explains of their mirror images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sphereorient.errors import ExperimentError, Reason, refusal
from sphereorient.files.threads import side_by_side
from sphereorient.follow.appearance.presence import LOOK_ALIKE
from sphereorient.follow.initialise import PLACE_SHARE, Initialiser
from sphereorient.locate import Frame
from sphereorient.locate.outline import Outline
from sphereorient.pose.camera_view import Picture
from sphereorient.pose.fitter import LEAST_LEFT
from sphereorient.pose.poses import Poses

FEW = 8  # frames; more of them tell by their own wrong poses, see `explained`
ORIENTATIONS = 1000.0  # independent views of one paint
CHANCE = (0.15, 0.85)  # least and greatest score that a wrong map is taken to reach
LEAST_ODDS = 10.0  # of the map
BEYOND_PX = 3.0  # of the limb that is mirrored with the disk


@dataclass(frozen=True, kw_only=True, eq=False)
class MapOdds:
    """Scores of a map in n pictures of each of C cameras; made by `map_odds`."""

    score: Tensor  # (n, C), 1 less the share of the variance that the best pose leaves; NaN: no disk to look at
    mirrored: Tensor  # (n, C), the same of the mirrored picture

    @property
    def log_odds(self) -> Tensor:
        """Logarithm of the odds (C,) of the map against its mirror image, which explains as much as any wrong one."""
        likelier = log_odds(self.score, self.mirrored, CHANCE[1]) - log_odds(self.mirrored, self.score)
        return likelier.nan_to_num(0.0).sum(0)

    def check(self, cameras: Sequence[str]) -> None:
        """Raise ExperimentError where the map's mirror image is likelier, or chance explains as much."""
        least, found = math.log(LEAST_ODDS), self.log_odds
        scores = zip(cameras, self.score.nanmedian(0).values, self.mirrored.nanmedian(0).values, strict=True)
        got = ", ".join(
            f"{_percent(one)} of {name}, {_percent(other)} of its mirror image" for name, one, other in scores
        )
        wrong = [name for name, one in zip(cameras, found.tolist(), strict=True) if one < -least]
        if wrong:
            got = f"a map that explains {got}: odds of {_odds(-found.min())} that it is mirrored"
            flip = ", ".join(f"{name}: horizontal" for name in wrong)
            do = f"write flip: {{{flip}}}, or mirror the map (`sphere.texture`) left to right"
            raise ExperimentError(refusal("movies", expected="pictures that are not mirrored", got=got, do=do))
        if float(found.sum()) < least:
            got = f"one that explains {got}: odds of {_odds(found.sum())} against chance"
            expected = "a map that explains the pictures"
            raise ExperimentError(refusal("movies", expected=expected, got=got, do=LOOK_ALIKE))


def log_odds(score: Tensor, other: Tensor, greatest: float = 1.0) -> Tensor:
    """Return the logarithm of the odds (...) that a pose is right against another one that is right or by chance, at
    least 0, by their scores; by chance no score is above `greatest`.
    The best of N independent views of a wrong map leaves the share V of the variance with V ** (-n / 2) = N, of n
    independent pixels; a pose that leaves U has the odds (V / U) ** (n / 2) = N ** (log U / log V - 1).
    """
    left = (1 - score).clamp(LEAST_LEFT, 1 - CHANCE[0]).log() / (1 - other.clamp(CHANCE[0], greatest)).clamp_min(
        LEAST_LEFT
    ).log()
    return math.log(ORIENTATIONS) * (left - 1).clamp_min(0.0)


def map_odds(search: Initialiser, frames: Sequence[Sequence[Frame]], found: Sequence[Poses]) -> MapOdds:
    """Compare what the map explains of n x C pictures at their best poses with what it explains when they are mirrored.
    A disk without a pose is looked at where its outline is.
    """
    views = search.fitter.views
    alone = [replace(search, fitter=search.fitter.of(k), known=None, least=0.0) for k in range(len(views))]

    def compared(pair: tuple[Sequence[Frame], Poses]) -> list[tuple[float, float]]:
        return [_compared(search, one, k, *pair) for k, one in enumerate(alone)]

    rows = list(side_by_side(compared, zip(frames, found, strict=True)))
    score, mirrored = torch.tensor(rows, dtype=torch.float64).reshape(-1, len(views), 2).unbind(-1)
    return MapOdds(score=score, mirrored=mirrored)


def _compared(
    search: Initialiser, alone: Initialiser, k: int, shots: Sequence[Frame], poses: Poses
) -> tuple[float, float]:
    """Return the scores of camera `k`, of its picture and of the mirrored one."""
    view, shot = search.fitter.views[k], shots[k]
    if not shot.usable:
        return math.nan, math.nan
    seen = len(poses) > 0 and bool(poses.use[k])
    if seen:
        X = poses.position_lab_mm[:1]
        (u, v), radius_px = view.camera.project(X)[0].tolist(), float(view.radius_px(X, search.fitter.radius_mm))
        disk: Outline | None = Outline(
            u_px=u, v_px=v, radius_px=radius_px, rms_px=PLACE_SHARE * radius_px, coverage=1.0
        )
    else:
        disk, _ = search.outline(shot.picture, view)
    if disk is None:
        return math.nan, math.nan
    score = float(poses.score[0, k]) if seen else -1.0
    if not seen or len(shots) > 1:
        score = max(score, _best_score(alone, shot.picture, disk))
    return score, _best_score(alone, *_mirrored(shot.picture, disk))


def _best_score(alone: Initialiser, picture: Picture, disk: Outline) -> float:
    ((R, _),) = alone.proposals([(0, picture, disk)])
    poses = alone.fitted([Frame(shown=picture)], [(disk, Reason.OK)], R)
    return float(poses.score[:, 0].max()) if len(poses) else -1.0


def _mirrored(picture: Picture, disk: Outline) -> tuple[Picture, Outline]:
    """Return a picture (H, W) whose disk is mirrored left to right, and the outline there, half a pixel off at most."""
    v, u = np.indices(picture.shape)
    turned = round(2 * disk.u_px) - u[0]
    inside = np.hypot(u - disk.u_px, v - disk.v_px) < disk.radius_px + BEYOND_PX
    other = picture[:, turned.clip(0, picture.shape[1] - 1)]
    return np.where(inside, other, picture), replace(disk, u_px=round(2 * disk.u_px) - disk.u_px)


def _percent(score: Tensor) -> str:
    return f"{100 * float(score.nan_to_num(0.0).clamp_min(0.0)):.0f} %"


def _odds(log_odds: Tensor) -> str:
    return f"{math.exp(min(float(log_odds), 30.0)):.2g} to 1"
