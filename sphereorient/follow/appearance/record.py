"""What is known of the pictures of a movie before it is tracked, and what of that is known so far."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from sphereorient.locate import Frame
from sphereorient.pose.camera_view import Picture, defocus_radii, widest_px
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.neighbours import Neighbours
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, Poses, PoseStart
from sphereorient.pose.worn import worn_share
from sphereorient.sphere.texture_table import TextureTable

ALWAYS = 1.0  # score from which outlines of blurred pictures are trusted: the texture locates the sphere
CLEAR = 3.0  # times the variance that the typical right pose leaves
MUCH_WORN = 0.2  # share of the ball: errors of what is left were 0.9 times those stated at 0.11, 3 times at 0.29
ENOUGH = 1400  # pixels of each disk that are used: more of them changed nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """Light, blur and noise of movies, and how well right and wrong poses explain them."""

    fitter: Fitter
    still: Fitter  # of frames whose motion is not known: the same, or with a blur that holds what motion adds
    lasting: Lasting  # errors of all poses alike
    score_min: float  # between right and wrong poses
    right_score: float  # typical of right poses
    usual_apart_rad: float = math.inf  # typical angle between the orientations that two cameras alone give
    together: bool = True  # whether the cameras see the sphere at one position
    majority: tuple[int, ...] = ()  # if not, the cameras that do, more than half of all; empty: none
    second_ball: bool = False  # whether another sphere with this texture is in view
    sharper: bool = False  # whether the pictures are clearly sharper than the exposure allows
    map_log_odds: float | None = None  # that the map is right, by the pictures of a few frames; None: of many frames
    worn: Tensor | None = None  # where the paint differs from the map and is not used, see `worn_cells`; None: nowhere

    def of(self, *cameras: int) -> "Appearance":
        """Return the appearance in some cameras."""
        fitter, still, lasting = self.fitter.of(*cameras), self.still.of(*cameras), self.lasting.of(*cameras)
        return replace(self, fitter=fitter, still=still, lasting=lasting)

    def on(self, device: torch.device) -> "Appearance":
        """Return an appearance whose fits are computed on another device."""
        return replace(self, fitter=self.fitter.on(device), still=self.still.on(device))

    @property
    def clear_score(self) -> float:
        """Score from which a search ends; out of reach for blurred pictures."""
        return ALWAYS if self.soft else self.score_min

    @property
    def usual_score(self) -> float:
        """Score that right poses usually reach."""
        return max(self.poor_score, clear_of(self.right_score))

    @property
    def poor_score(self) -> float:
        """Score halfway between the least and the usual one of a right pose."""
        return 0.5 * (self.score_min + self.right_score)

    @property
    def soft(self) -> bool:
        """Whether the pictures are out of focus; the model of blur then errs by more than noise, and is not stated."""
        return soft(self.fitter)

    @property
    def in_doubt(self) -> bool:
        """Whether the model errs by more than its stated errors hold: soft pictures, or paint of which much is worn."""
        return self.soft or (self.worn is not None and worn_share(self.worn) > MUCH_WORN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Following:
    """Frames beside those studied, from which the motion while the shutter is open is measured."""

    frames: Callable[[Sequence[int]], Sequence[Sequence[Frame]]]  # by index of the studied frame
    open_share: Tensor  # (n,), exposure over the time from each studied frame to that beside it; negative: it is before


@dataclass(frozen=True, kw_only=True, eq=False)
class Among:
    """Poses of n frames, found beforehand, of balls that others are beside; the same frame may stand for two balls."""

    found: Sequence[Poses]
    neighbours: Neighbours  # of the n poses


@dataclass(frozen=True, kw_only=True, eq=False)
class Studied:
    """B poses that are studied, in the pictures of C cameras, with what is known so far."""

    fitter: Fitter  # with blur and light as far as they are known
    paint: TextureTable  # finest table of the paint that is used
    whole: Pixels  # of B * C disks
    pixels: Pixels  # about `ENOUGH` of each
    fit: FittedPoses
    use: Tensor  # (B, C) bool

    @classmethod
    def begun(
        cls,
        fitter: Fitter,
        paint: TextureTable,
        pictures: Sequence[Sequence[Picture]],
        poses: tuple[Tensor, Tensor, Tensor],
        others: Neighbours | None,
    ) -> Self:
        """Fit poses, with the light that is assumed: positions (B, 3), rotations (B, 3, 3) and use (B, C)."""
        fine = fitter.optics.fine
        whole = fitter.pixels(pictures, poses[0], fine, neighbours=others)
        pixels = enough_of(whole)
        fit = fitter.fit(pixels, PoseStart(*poses), fine, 4)
        return cls(fitter=fitter, paint=paint, whole=whole, pixels=pixels, fit=fit, use=poses[2])

    @property
    def right_score(self) -> float:
        """Score of the typical pose."""
        return float(self.fit.score[self.use].median())

    def lit(self) -> Self:
        """Estimate the light, and fit the poses with it."""
        fitter = self.fitter.with_light_of(self.pixels, self.fit, self.use)
        return replace(self, fitter=fitter, fit=fitter.again(self.pixels, self.fit, self.use))


def clear_of(typical: float) -> float:
    """Return the score that right poses reach where the typical one is known."""
    return 1 - CLEAR * (1 - typical)


def soft(fitter: Fitter) -> bool:
    """Return whether the pictures are out of focus by the blur that is known."""
    return defocus_radii(fitter.optics.blur_px, widest_px(fitter.views)) > 0


def enough_of(whole: Pixels) -> Pixels:
    """Return about `ENOUGH` pixels of each disk."""
    return whole.thinned(max(1, round(whole.grey.shape[1] / ENOUGH)))
