"""Whether a few pictures show the map: its score compared with the score of the mirrored pictures."""

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

FEW = 8  # frames; for more, wrong poses are compared instead, see `explained`
VIEWS = 50.0  # independent views of a paint; calibrated on 191 stills of balls with other maps
CHANCE, BEYOND_CHANCE = 0.25, 0.85  # least and greatest assumed score of the best pose of a wrong map
LEAST_ODDS = 4.0  # of the map; 191 right maps had 5 or more
SURE_ODDS = 20.0  # of the mirror image, from which it is reported
MOST = math.log(1e6)  # log odds of one picture, limited by the errors of the model
RIM_PX = 3.0  # outside the limb, mirrored with the disk


@dataclass(frozen=True, kw_only=True, eq=False)
class MapOdds:
    """Scores of a map in n pictures of each of C cameras."""

    score: Tensor  # (n, C), of the best pose; NaN: no disk
    mirrored: Tensor  # (n, C), of the best pose in the mirrored picture

    @property
    def log_odds(self) -> Tensor:
        """Logarithm of the odds (C,) of the map against a wrong map, which explains as much as its mirror image."""
        likelier = pose_log_odds(self.score, self.mirrored, BEYOND_CHANCE) - pose_log_odds(self.mirrored, self.score)
        return likelier.nan_to_num(0.0).sum(0)

    def check(self, cameras: Sequence[str], *, choices: int) -> None:
        """Raise ExperimentError if the mirror image is likelier or chance explains as much; `choices`: the number of
        sets of pictures of which these are the best, 0 if no pose is proven.
        """
        odds, scores = self.log_odds, [_percent(one) for one in (self.score, self.mirrored)]
        both = zip(cameras, *scores, strict=True)
        got = "a map that explains " + ", ".join(
            f"{one} of {name}, {other} of its mirror image" for name, one, other in both
        )
        if wrong := [name for name, one in zip(cameras, odds.tolist(), strict=True) if one < -math.log(SURE_ODDS)]:
            got += f": odds of {_odds_words(-odds.min())} that it is mirrored"
            flip = ", ".join(f"{name}: horizontal" for name in wrong)
            do = f"write flip: {{{flip}}}, remove an existing one, or correct a map that is mirrored or upside down"
            raise ExperimentError(refusal("movies", expected="pictures that are not mirrored", got=got, do=do))
        if choices and (against := odds.sum() - math.log(choices)) < math.log(LEAST_ODDS):
            got += f": odds of {_odds_words(against)} against chance"
            expected = f"a map with odds of {LEAST_ODDS:.0f} to 1"
            raise ExperimentError(refusal("movies", expected=expected, got=got, do=LOOK_ALIKE))


def pose_log_odds(score: Tensor, other: Tensor, greatest: float = 1.0) -> Tensor:
    """Return the log odds (...), at least 0, of a pose against another one, by their scores; `greatest`: most a wrong
    pose reaches. The best of N independent views of a wrong map leaves the share V of the variance, with V ** (-n / 2)
    = N for n independent pixels. A pose that leaves U has the odds (V / U) ** (n / 2) = N ** (log U / log V - 1).
    """
    gain, chance = (
        -(1 - one.clamp(CHANCE, most)).clamp_min(LEAST_LEFT).log() for one, most in ((score, 1.0), (other, greatest))
    )
    odds: Tensor = math.log(VIEWS) * (gain / chance - 1)
    return odds.clamp(0.0, MOST)


def map_odds(search: Initialiser, frames: Sequence[Sequence[Frame]], found: Sequence[Poses], *, only: bool) -> MapOdds:
    """Compare the scores of the map in n x C pictures at their best poses with those in the mirrored pictures.
    `only`: a single ball is located by its outline if there are several cameras, since one mirrored movie spoils the
    joint pose; without a pose, always by the outline.
    """
    views, radius_mm = search.fitter.views, search.fitter.radius_mm
    alone = [replace(search, fitter=search.fitter.of(k), known=None, least=0.0) for k in range(len(views))]

    def compared(frame: Sequence[Frame], poses: Poses, k: int) -> tuple[float, float]:
        if not frame[k].usable:
            return math.nan, math.nan
        view, picture = views[k], frame[k].picture
        posed, several = len(poses) > 0 and bool(poses.use[k]), len(views) > 1
        disk = search.outline(picture, view)[0] if not posed or (only and several) else None
        if posed and disk is None:
            X = poses.position_lab_mm[:1]
            (u, v), size = view.camera.project(X)[0].tolist(), float(view.radius_px(X, radius_mm))
            disk = Outline(u_px=u, v_px=v, radius_px=size, rms_px=PLACE_SHARE * size, coverage=1.0)
        if disk is None:
            return math.nan, math.nan
        score = float(poses.score[0, k]) if posed else -1.0
        if not posed or several:
            score = max(score, _best_score(alone[k], picture, disk))
        return score, _best_score(alone[k], *_mirrored(picture, disk))

    def of_frame(pair: tuple[Sequence[Frame], Poses]) -> list[tuple[float, float]]:
        return [compared(*pair, k) for k in range(len(views))]

    rows = list(side_by_side(of_frame, zip(frames, found, strict=True)))
    score, mirrored = torch.tensor(rows, dtype=torch.float64).reshape(-1, len(views), 2).unbind(-1)
    return MapOdds(score=score, mirrored=mirrored)


def _best_score(alone: Initialiser, picture: Picture, disk: Outline) -> float:
    ((R, _),) = alone.proposals([(0, picture, disk)])
    poses = alone.fitted([Frame(shown=picture)], [(disk, Reason.OK)], R)
    return float(poses.score[:, 0].max()) if len(poses) else -1.0


def _mirrored(picture: Picture, disk: Outline) -> tuple[Picture, Outline]:
    """Return a picture (H, W) whose disk is mirrored left to right, and its outline there, at most half a pixel off."""
    height, width = picture.shape
    v, u = np.arange(height)[:, None], np.arange(width)
    inside = np.hypot(u - disk.u_px, v - disk.v_px) < disk.radius_px + RIM_PX
    other = picture[:, (round(2 * disk.u_px) - u).clip(0, width - 1)]
    return np.where(inside, other, picture), replace(disk, u_px=round(2 * disk.u_px) - disk.u_px)


def _percent(score: Tensor) -> list[str]:
    median = score.nanmedian(0).values.nan_to_num(0.0).clamp_min(0.0)
    return [f"{100 * one:.0f} %" for one in median.tolist()]


def _odds_words(log_odds: Tensor) -> str:
    odds = math.exp(min(float(log_odds), MOST))
    if odds < LEAST_ODDS:
        return f"{odds:.1f} to 1"
    return f"{'over ' if log_odds >= MOST else ''}{odds:,.0f} to 1"
