"""Settings of the room statistics."""

from pydantic import BaseModel, Field


class SegmentSettings(BaseModel, frozen=True, extra="forbid"):
    """Which frames and segments of a track go into its statistics."""

    min_frames: int = Field(50, ge=2, description="segments with fewer frames are left out, as the paper does")
    min_integral_times: float = Field(0.25, ge=0, description="shorter segments are left out, integral times")
    integral_time_s: float | None = Field(None, gt=0, description="s; null: of experiment.yaml, or the velocity's")
    max_duration_s: float | None = Field(
        None, gt=0, description="longer segments are cut into pieces of this duration, s: several integral times"
    )
    max_sigma: float = Field(
        3.0, gt=1, description="frames are left out whose error of acceleration or alpha exceeds this many medians"
    )
    keep_extrapolated: bool = Field(False, description="also use frames filled by the smoother")


class BootstrapSettings(BaseModel, frozen=True, extra="forbid"):
    """Error bars by resampling of whole segments, since frames of one segment are not independent."""

    resamples: int = Field(1000, ge=100, description="number of resampled ensembles")
    level: float = Field(0.95, gt=0, lt=1, description="probability that an interval contains the true value")
    seed: int = Field(2011, ge=0, description="of the resampling; the same seed gives the same intervals")


class StatisticsSettings(BootstrapSettings, SegmentSettings):
    """Statistics of tracks: used segments, and error bars."""
