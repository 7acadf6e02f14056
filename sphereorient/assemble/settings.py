"""Settings of the room assemble."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class AssembleSettings(BaseModel):
    """How candidates of single frames become one history (the paper's assembly and its two cameras)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    quality_min: float = Field(
        0.5, ge=0, le=1, description="candidates of lower T never enter the graph; the paper's 0.5"
    )
    gap_frames_max: int = Field(4, ge=0, description="longest hole inside a segment, frames; the paper: under 5")
    spike_window_frames: int = Field(
        41, ge=5, description="frames over which xi's usual size is taken (moving median): a few turns of the velocity"
    )
    spike_factor: float = Field(
        6.0,
        gt=1,
        description="a spike is this many robust deviations (1.48 MAD) above xi's moving median; noise stays below",
    )
    spike_min_deg: float = Field(
        15.0,
        gt=0,
        description="a smaller turn between frames is never a spike, however still the sphere stood; 5 fine steps",
    )
    repair_deg: float = Field(
        30.0,
        gt=0,
        le=180,
        description="cameras further apart than this are repaired, one from the other; the paper's 30",
    )
    repair_margin: float = Field(
        0.02,
        ge=0,
        description="mean T by which one camera must beat the other in a repair; below it, continuity decides",
    )
    weight_window_frames: int = Field(
        25, ge=5, description="frames of the moving variance of xi that weighs the cameras; the paper gives no number"
    )
