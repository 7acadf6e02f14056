"""The blur of pictures, before the pose of the sphere is known."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.locate import Frame, LocateSettings
from sphereorient.locate.outline import find_blobs
from sphereorient.pose.fitter import CameraView

SOFT, SOFT_PX = 0.06, 1.5  # radii, px: templates of pictures that are blurred by more than both are blurred as well
FIRST_BLUR_PX = 0.625  # first blur of sharp pictures: a pixel's own width and a good lens
CALM_PX = 1.0  # blur that is laid over pictures first, against noise
AROUND = 1.2  # of the radius: the sphere and its rim
CONTRAST = (2.5, 97.5)  # percentiles between which the grey levels of paint and scene lie
STEEPEST = 99.5  # percentile of the slopes: few pixels lie on an edge


def defocus_radii(blur_px: float, diameter_px: float) -> float:
    """Return the blur of pictures, radii, as the search needs it: 0 unless they are defocused."""
    blur = 2 * blur_px / diameter_px
    return blur if blur > SOFT and blur_px > SOFT_PX else 0.0


def estimate_blur_px(views: Sequence[CameraView], shots: Sequence[Sequence[Frame]], locating: LocateSettings) -> float:
    """Return the standard deviation of the blur, px, of the steepest edges about the sphere: median of n x C frames.
    A first guess, biased by noise and paint without edges. 0 where no frame shows a blob of the sphere's size.
    Source: a step of height h under a Gaussian blur sigma is h / (sigma sqrt(2 pi)) steep at most.
    """
    found = [
        _steepest(shot.picture.astype(np.float32), view, locating)
        for frame in shots
        for view, shot in zip(views, frame, strict=True)
        if shot.usable
    ]
    told = [blur for blur in found if blur is not None]
    return float(np.median(told)) if told else 0.0


def _steepest(picture: NDArray[np.float32], view: CameraView, locating: LocateSettings) -> float | None:
    """Return the blur of the steepest edge about the likeliest blob, px; None without one."""
    blobs = find_blobs(view.background.difference(picture), view.background.noise, view.diameter_px, locating)
    if not blobs or blobs[0].merit <= 0:
        return None
    reach = round(AROUND * view.diameter_px / 2)
    left, top = max(0, round(blobs[0].u_px) - reach), max(0, round(blobs[0].v_px) - reach)
    window = picture[top : round(blobs[0].v_px) + reach + 1, left : round(blobs[0].u_px) + reach + 1]
    return steepest_blur_px(window)


def steepest_blur_px(picture: NDArray[np.float32]) -> float:
    """Return the standard deviation of the blur, px, of the steepest edge between the darkest and the brightest."""
    calm = cv2.GaussianBlur(picture, (0, 0), CALM_PX)
    slope = np.hypot(cv2.Scharr(calm, cv2.CV_32F, 1, 0), cv2.Scharr(calm, cv2.CV_32F, 0, 1)) / 32
    low, high = np.percentile(calm, CONTRAST)
    steepest = float(np.percentile(slope, STEEPEST))
    blur = float(high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9)
    return float(np.sqrt(max(blur**2 - CALM_PX**2, 0.0)))
