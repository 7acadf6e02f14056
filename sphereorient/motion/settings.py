from collections.abc import Sequence
from typing import Self

from pydantic import BaseModel, Field, model_validator

from sphereorient.errors import SettingsError, refusal


def check_separations(separations: Sequence[int], name: str = "separations") -> None:
    """Raise SettingsError unless the separations are different numbers from 1 up."""
    if not separations or min(separations) < 1 or len(set(separations)) < len(separations):
        expected, do = "different numbers from 1 up", "give each separation once"
        raise SettingsError(refusal(name, expected=expected, got=str(tuple(separations)), do=do))


class MotionSettings(BaseModel, frozen=True, extra="forbid"):
    """How velocities and accelerations follow from positions and orientations.
    The defaults fit the paper's experiment, 600 Hz and 1 degree of attitude noise. They are widths in frames: double
    them at twice the frame rate. Wider windows give less noise and more low-pass bias.
    """

    velocity_sigma_frames: float = Field(
        3.5, gt=0, description="width of the Gaussian for velocity, frames; 0.1 mm of white noise at 600 Hz: 0.003 m/s"
    )
    acceleration_sigma_frames: float = Field(
        5.0, gt=0, description="width of the Gaussian for acceleration, frames; noise falls as its power 2.5"
    )
    alpha_sigma_frames: float = Field(
        2.0, gt=0, description="width of the Gaussian for alpha from omega, frames; omega is already an average"
    )
    truncate: float = Field(3.0, gt=0, description="half width of these windows, sigmas; 3 holds 99.7 % of them")
    min_share: float = Field(0.55, gt=0, le=1, description="least measured share, else NaN; 0.55 passes two gaps")
    separations: tuple[int, ...] = Field(
        (1, 2, 3, 4, 5), min_length=1, description="omega averages rotations from k - m to k + m, below 180 degrees"
    )
    min_separations: int = Field(3, ge=1, description="least measured separations, else NaN; 3 loses 3 frames at ends")

    @model_validator(mode="after")
    def _separations_can_be_measured(self) -> Self:
        check_separations(self.separations, "motion.separations")
        most = len(self.separations)
        if self.min_separations > most:
            got, do = str(self.min_separations), "lower it or give more separations"
            raise SettingsError(refusal("motion.min_separations", expected=f"at most {most}", got=got, do=do))
        return self


class SmoothSettings(BaseModel, frozen=True, extra="forbid"):
    """How the motion is smoothed in method precise."""

    position_band_hz: float | None = Field(
        None, gt=0, description="highest frequency of positions, Hz; null learns it from the track"
    )
    orientation_band_hz: float | None = Field(
        None, gt=0, description="highest frequency of orientations, Hz; null learns it from the track"
    )
    learn_frames: int = Field(600, ge=20, description="most frames for learning band and noise; more only cost time")
    least_frames: int = Field(10, ge=5, description="least number of measured frames for smoothing")
    least_scale: float = Field(0.5, gt=0, description="least factor on the measurements' sigmas")
    most_scale: float = Field(4.0, gt=0, description="largest factor on the measurements' sigmas")
    slow_share: float = Field(
        0.25, ge=0, lt=1, description="least share of the error variance that lasts and is not reduced by smoothing"
    )
    outlier_sigma: float = Field(6.0, gt=0, description="a measurement farther from all others is left out, sigmas")
    outlier_share: float = Field(0.1, ge=0, le=0.5, description="largest share of a segment that may be left out")
