"""The appearance of a movie, and the state of its estimation."""

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

ALWAYS = 1.0  # score_min for blurred pictures: no outline is trusted, the texture locates the sphere
CLEAR = 3.0  # times the unexplained variance of the typical right pose
MUCH_WORN = 0.2  # share of the ball: errors were 0.9 times the stated ones at 0.11, 3 times at 0.29
ENOUGH = 1400  # pixels used of each disk; more changed nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """Light, blur and noise of movies, and how well right and wrong poses explain them."""

    fitter: Fitter
    still: Fitter  # for frames of unknown motion: the same, or with motion blur as blur
    lasting: Lasting  # errors common to all poses
    score_min: float  # between right and wrong poses
    right_score: float  # typical of right poses
    usual_apart_rad: float = math.inf  # typical angle between the orientations by two cameras alone
    together: bool = True  # whether the cameras see the sphere at one position
    majority: tuple[int, ...] = ()  # if not, the agreeing cameras, more than half of all; empty: no majority
    second_ball: bool = False  # whether another sphere with this texture is in view
    sharper: bool = False  # whether the pictures are clearly sharper than the exposure allows
    map_log_odds: float | None = None  # that the map is right, from a few frames; None: there are many frames
    worn: Tensor | None = None  # worn paint, not used, see `worn_cells`; None: no worn paint

    def of(self, *cameras: int) -> "Appearance":
        """Return the appearance in some of the cameras."""
        fitter, still, lasting = self.fitter.of(*cameras), self.still.of(*cameras), self.lasting.of(*cameras)
        return replace(self, fitter=fitter, still=still, lasting=lasting)

    def on(self, device: torch.device) -> "Appearance":
        """Return an appearance whose fits run on another device."""
        return replace(self, fitter=self.fitter.on(device), still=self.still.on(device))

    @property
    def clear_score(self) -> float:
        """Score at which a search ends; out of reach for blurred pictures."""
        return ALWAYS if self.soft else self.score_min

    @property
    def usual_score(self) -> float:
        """Usual score of right poses."""
        return max(self.poor_score, clear_of(self.right_score))

    @property
    def poor_score(self) -> float:
        """Score halfway between least and usual score of a right pose."""
        return 0.5 * (self.score_min + self.right_score)

    @property
    def soft(self) -> bool:
        """Whether the pictures are out of focus, with model errors beyond the covariance."""
        return soft(self.fitter)

    @property
    def in_doubt(self) -> bool:
        """Whether errors exceed the stated ones: soft pictures, or much worn paint."""
        return self.soft or (self.worn is not None and worn_share(self.worn) > MUCH_WORN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Following:
    """Frames next to the sampled ones, to measure the motion during the exposure."""

    frames: Callable[[Sequence[int]], Sequence[Sequence[Frame]]]  # by index of the sampled frame
    open_share: (
        Tensor  # (n,), exposure over the time from each sampled frame to the next one; negative: to the previous one
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Among:
    """Known poses of n frames, of balls with neighbours; a frame may occur for each of two balls."""

    found: Sequence[Poses]
    neighbours: Neighbours  # of the n poses


@dataclass(frozen=True, kw_only=True, eq=False)
class Studied:
    """B poses in the pictures of C cameras, from which the appearance is estimated, with the present estimate."""

    fitter: Fitter  # with the present blur and light
    paint: TextureTable  # finest table of the used paint
    whole: Pixels  # of B * C disks
    pixels: Pixels  # about `ENOUGH` per disk
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
        """Fit poses with the assumed light: positions (B, 3), rotations (B, 3, 3) and use (B, C)."""
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
    """Return the least score of right poses with a known typical one."""
    return 1 - CLEAR * (1 - typical)


def soft(fitter: Fitter) -> bool:
    """Return whether the pictures are out of focus by the present blur."""
    return defocus_radii(fitter.optics.blur_px, widest_px(fitter.views)) > 0


def enough_of(whole: Pixels) -> Pixels:
    """Return about `ENOUGH` pixels of each disk."""
    return whole.thinned(max(1, round(whole.grey.shape[1] / ENOUGH)))
